"""`instancemap diff RUN RUN`: list the changed objects between two runs with the same world frame."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

from framework.commands.command_line import arguments, one_line_errors
from framework.errors import DataError
from framework.files.atomic_write import path_exists
from framework.files.json_file import write_json
from framework.files.tum_trajectory import read_tum
from framework.queries.changes import Change, Kind, Visit, changes
from framework.queries.labeled_surface import LabeledSurface
from framework.runs.stored_runs import EXTERNAL, METRICS, TRAJECTORY, read_metrics
from framework.runs.world_frames import in_world

log = logging.getLogger(__name__)

UNCHANGED = (Kind.STAYED, Kind.NOT_SEEN)


def main() -> None:
    """Run the command `instancemap diff`."""
    parser = argparse.ArgumentParser(
        description="List the objects that appeared, vanished or moved between two runs, with probabilities. Both runs "
        "need the same world frame: run the second with localize_in=FIRST, or both with tracker=ground_truth."
    )
    parser.add_argument("before", metavar="FIRST", type=Path, help="run directory of the first visit")
    parser.add_argument("after", metavar="SECOND", type=Path, help="run directory of the second visit")
    unchanged = "also list unchanged objects and objects not observed in the other run"
    parser.add_argument("--all", action="store_true", help=unchanged)
    parser.add_argument("--out", metavar="FILE", type=Path, help="JSON file for all changes; default: none")
    parsed = arguments(parser)
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    with one_line_errors():
        if not in_world(parsed.after, parsed.before):
            message = "%s: expected the world frame of %s, got a different or unknown world frame; %s"
            log.warning(message, parsed.after, parsed.before, world_fix(parsed.before, parsed.after))
        found = changes(*visits_of(parsed.before, parsed.after))
        if parsed.out is not None:
            write_json(parsed.out, [entry(change) for change in found])
        shown = [change for change in found if parsed.all or change.kind not in UNCHANGED]
        print("\n".join(map(line, shown)) or "no changes")
        rest = {kind: sum(change.kind is kind for change in found) for kind in UNCHANGED}
        print(f"{rest[Kind.STAYED]} stayed, {rest[Kind.NOT_SEEN]} not observed in the other run")


def visits_of(*runs: Path) -> list[Visit]:
    """Return the maps and trajectories of two stored runs. An imported map has the poses of the other run.

    Raises:
        DataError: A file is missing or invalid, or both maps are imported.
    """
    from framework.api import scene_of  # slow import: after the arguments are checked

    scenes = [LabeledSurface.of_run(run) if is_imported(run) else scene_of("diff", run) for run in runs]
    poses = [read_tum(run / TRAJECTORY)[1] for run in runs if not is_imported(run)]
    if not poses:
        raise DataError(
            f"FIRST, SECOND: expected at least one run with {TRAJECTORY}, got two imported maps; compare each with "
            "a run"
        )
    return [Visit(scene, of_run) for scene, of_run in zip(scenes, [poses[0], poses[-1]], strict=True)]


def is_imported(run: Path) -> bool:
    """Return True for the run directory of an imported map."""
    return path_exists(run / METRICS) and read_metrics(run).get("pose_source") == EXTERNAL


def world_fix(before: Path, after: Path) -> str:
    """Return the fix for two runs with different world frames."""
    if is_imported(before) or is_imported(after):
        return "import the map with --transform, or run the other map with tracker=ground_truth"
    return f"run it again with localize_in={before}, or run both with tracker=ground_truth"


def line(change: Change) -> str:
    """Return a change as one line of text, with lengths in meters."""
    x, y, z = change.place
    where = f"at ({x:.2f}, {y:.2f}, {z:.2f}) m"
    if change.kind is Kind.MOVED:
        where = f"by {change.distance:.2f} m, now {where}"
    ids = " -> ".join("-" if key is None else str(key) for key in (change.before, change.after))
    return f"{change.kind.value:<9} {change.name:<16} {change.probability:.2f}  {where}  ({ids})"


def entry(change: Change) -> dict[str, object]:
    """Return a change as a JSON object, with lengths in meters."""
    return {
        "kind": change.kind.value,
        "class": change.name,
        "probability": change.probability,
        "before": change.before,
        "after": change.after,
        "place": change.place.tolist(),
        "distance": change.distance,
    }

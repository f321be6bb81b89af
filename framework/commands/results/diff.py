"""`python -m framework diff RUN RUN`: what has changed between two visits of a place."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

from omegaconf import DictConfig

from framework.commands.command_line import arguments, one_line_errors
from framework.files.atomic_write import is_there
from framework.files.json_file import read_json, write_json
from framework.files.tum_trajectory import read_tum
from framework.files.yaml_file import load_yaml
from framework.queries.changes import Change, Kind, Visit, changes
from framework.runs.stored_runs import CONFIG, METRICS, TRAJECTORY

log = logging.getLogger(__name__)

UNCHANGED = (Kind.STAYED, Kind.NOT_SEEN)


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Lists the objects that appeared, vanished or moved from one run to another, with probabilities. "
        "Both must lie in one world: run the second with localize_in=FIRST, or both with given poses.",
    )
    parser.add_argument("before", metavar="FIRST", type=Path, help="the directory of the first visit's run")
    parser.add_argument("after", metavar="SECOND", type=Path, help="that of the second's")
    parser.add_argument("--all", action="store_true", help="list what stayed, and what the second did not see, too")
    parser.add_argument("--out", metavar="FILE", type=Path, help="write all of it there, too, as JSON")
    asked = arguments(parser)
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    with one_line_errors():
        if not in_world(asked.after, asked.before):
            log.warning(
                "%s does not say that it lies in the world of %s: run it with localize_in=%s, or both with given poses",
                asked.after,
                asked.before,
                asked.before,
            )
        found = changes(visit_of(asked.before), visit_of(asked.after))
        if asked.out is not None:
            write_json(asked.out, [entry(change) for change in found])
        shown = [change for change in found if asked.all or change.kind not in UNCHANGED]
        print("\n".join(map(line, shown)) or "nothing has changed")
        rest = {kind: sum(change.kind is kind for change in found) for kind in UNCHANGED}
        print(f"{rest[Kind.STAYED]} stayed; of {rest[Kind.NOT_SEEN]} the other visit does not tell")


def visit_of(run: Path) -> Visit:
    """What a stored run saw. Raises DataError for a directory that holds no run's map and trajectory."""
    from framework.api import scene_of  # here: what is wrong with the arguments is said at once

    scene = scene_of("diff", run)
    _, poses = read_tum(run / TRAJECTORY)
    return Visit(scene, poses)


def in_world(run: Path, world: Path) -> bool:
    """Whether a run lies in the world of another, as far as their records say."""
    config = load_yaml(run / CONFIG) if is_there(run / CONFIG) else None
    asked = [config.get(key) for key in ("localize_in", "resume_from")] if isinstance(config, DictConfig) else []
    if any(isinstance(path, str) and Path(path).expanduser().resolve() == world.resolve() for path in asked):
        return True
    records = [read_json(place / METRICS) if is_there(place / METRICS) else None for place in (run, world)]
    return all(isinstance(record, dict) and record.get("pose_source") == "ground_truth" for record in records)


def line(change: Change) -> str:
    """One change for people."""
    x, y, z = change.place
    where = f"at ({x:.2f}, {y:.2f}, {z:.2f}) m"
    if change.kind is Kind.MOVED:
        where = f"by {change.distance:.2f} m, now {where}"
    ids = " -> ".join("-" if key is None else str(key) for key in (change.before, change.after))
    return f"{change.kind.value:<9} {change.name:<16} {change.probability:.2f}  {where}  ({ids})"


def entry(change: Change) -> dict[str, object]:
    """One change for programs."""
    return {
        "kind": change.kind.value,
        "class": change.name,
        "probability": change.probability,
        "before": change.before,
        "after": change.after,
        "place": change.place.tolist(),
        "distance": change.distance,
    }

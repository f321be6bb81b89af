"""`instancemap evaluate RUN...`: re-evaluate stored runs without re-running them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from tqdm import tqdm

from framework.commands.command_line import EXIT_FAILED, KNOWN_ERRORS, arguments, one_line_errors, print_error
from framework.errors import ConfigError, DataError
from framework.evaluation.compared_classes import ComparedClasses
from framework.evaluation.instances import Transfer
from framework.evaluation.scannet_benchmark import BenchmarkScene, benchmark_metrics
from framework.registry import STAGES
from framework.runs.metrics import CLASS_NAMES, LABEL_SPACE, MAIN_FIGURES, ignored_names
from framework.runs.reevaluation import Reevaluation, Truth, dataset_of
from framework.runs.stored_runs import Record, find_records
from framework.tables.metric_columns import head

SCANNET = {"ap": "AP", "ap50": "AP50", "ap25": "AP25"}  # headings by metric


def main() -> None:
    """Run the command `instancemap evaluate`."""
    parser = argparse.ArgumentParser(
        description="Re-evaluate the instances of stored runs from mesh.ply and instances.json, update their metrics "
        "in metrics.json and print the changes. Other metrics, such as trajectory errors, are not changed."
    )
    parser.add_argument("run", metavar="RUN", nargs="+", type=Path, help="run directory, or folder of run directories")
    parser.add_argument(
        "--transfer",
        choices=[transfer.value for transfer in Transfer],
        default=Transfer.TO_TRUTH.value,
        help="direction of the label transfer for the printed metrics: to_truth (each ground-truth point gets the "
        "instance of the nearest map vertex) or to_map (each map vertex gets the instance of the nearest "
        "ground-truth point); both are stored; default: to_truth",
    )
    parser.add_argument(
        "--ground-truth",
        metavar="PATH",
        help="ground truth, as in dataset.ground_truth: labeled mesh or run directory; '' = ground truth of the "
        "dataset; default: ground truth used by the run",
    )
    changed = "evaluate even if the ground truth has changed since the run; implied by --ground-truth"
    parser.add_argument("--allow-changed-ground-truth", action="store_true", help=changed)
    space = (
        "label space, as in evaluation.label_space: coco, nyu40, scannet20, scannet200, agnostic or a file; '' = names "
        "are compared unchanged; default: label space of the last evaluation"
    )
    parser.add_argument("--label-space", metavar="SPACE", help=space)
    named = (
        "convert NAME to CLASS of the label space, as in evaluation.names; empty CLASS = ignore; repeatable; requires "
        "--label-space"
    )
    parser.add_argument("--name", metavar="NAME=CLASS", action="append", default=[], help=named)
    parser.add_argument("--dry-run", action="store_true", help="print the changes without writing them")
    parsed = arguments(parser)
    with one_line_errors():
        transfer, write = Transfer(parsed.transfer), not parsed.dry_run
        changed, classes = parsed.allow_changed_ground_truth, chosen_classes(parsed.label_space, parsed.name)
        failed = evaluate_runs(parsed.run, transfer, write, changed, parsed.ground_truth, classes)
    if failed:
        sys.exit(EXIT_FAILED)


def chosen_classes(label_space: str | None, names: Sequence[str]) -> ComparedClasses | None:
    """Return the label space of the options --label-space and --name, or None without the options.

    Raises:
        ConfigError: An option is invalid.
    """
    if label_space is None and not names:
        return None
    if label_space is None:
        raise ConfigError(
            "--name: expected --label-space, got none; add --label-space SPACE ('' = names are compared unchanged)"
        )
    pairs = [word.partition("=") for word in names]
    if wrong := [name + sign + chosen for name, sign, chosen in pairs if not name or not sign]:
        raise ConfigError(f"--name: expected NAME=CLASS, got {wrong[0]!r:.60}")
    table = {name: chosen or None for name, _, chosen in pairs}
    return ComparedClasses.of({"evaluation": {"label_space": label_space or None, "names": table}})


def evaluate_runs(
    roots: Sequence[Path],
    transfer: Transfer,
    write: bool,
    allow_changed: bool = False,
    ground_truth: str | None = None,
    classes: ComparedClasses | None = None,
) -> int:
    """Evaluate all runs in folders and their subfolders, and print one line per run.

    Args:
        roots: Run directories, or folders of run directories.
        transfer: Direction of the label transfer for the printed metrics.
        write: Write the metrics to metrics.json.
        allow_changed: Evaluate even if the ground truth has changed since the run.
        ground_truth: Value of --ground-truth; None = ground truth used by the run.
        classes: The label space; None = the label space of the last evaluation.

    Returns:
        The number of failures.
    """
    records, failures = _find(roots)
    for failure in failures:
        print_error(failure)
    failed = len(failures)
    pooled: list[tuple[Reevaluation, BenchmarkScene]] = []

    def key(record: Record) -> str:
        return str(dataset_of(record, ground_truth))

    with tqdm(total=len(records), unit=" runs", disable=None, dynamic_ncols=True) as bar:
        # sorted by dataset, so that only one ground truth is in memory at a time
        for _, group in groupby(sorted(records, key=key), key):
            truth: Truth | None = None
            for record in group:
                try:
                    truth = truth or Truth.of(dataset_of(record, ground_truth))
                    found = Reevaluation.of(record, truth, allow_changed or ground_truth is not None, classes)
                    if write:
                        found.write()
                    tqdm.write(f"{record.directory}: {summary(found, transfer)}")
                    for side, names in ignored_names(found.metrics):
                        tqdm.write(f"  ignored in the {side}: {names}")
                    if found.scene is not None:
                        pooled.append((found, found.scene))
                except KNOWN_ERRORS as error:
                    print_error(error, f"error: {record.directory}: " if truth is None else "error: ")
                    failed += 1
                bar.update()
    if len(pooled) > 1:
        why_not = differing([found for found, _ in pooled])
        scenes = [scene for _, scene in pooled]
        print(f"no metrics over all scenes: {why_not}" if why_not else over_scenes(scenes))
    return failed


def differing(found: Sequence[Reevaluation]) -> str:
    """Return the reason why runs are not the scenes of one method in one label space, or "" if they are."""
    sequences = {one.metrics.get("sequence") for one in found}
    if len(sequences) < len(found):
        return "several runs have the same sequence"
    if len({(one.metrics.get(LABEL_SPACE), one.metrics.get(CLASS_NAMES)) for one in found}) > 1:
        return "the label spaces of the runs differ"
    stages = {stage for stage in STAGES if stage != "dataset"}
    methods = {(one.record.row, *(one.record.choices.get(stage) for stage in sorted(stages))) for one in found}
    return "the stages of the runs differ" if len(methods) > 1 else ""


def over_scenes(scenes: Sequence[BenchmarkScene]) -> str:
    """Return ScanNet's metrics over several scenes together, as text."""
    classes = sorted({name for scene in scenes for name in scene.truth_classes})
    found = benchmark_metrics(scenes, classes)
    means = ", ".join(f"{name} {found[f'instances.scannet.{key}']:.3f}" for key, name in SCANNET.items() if found)
    return f"{len(scenes)} scenes, ScanNet benchmark metrics: {means or 'no ground truth'}"


def summary(found: Reevaluation, transfer: Transfer) -> str:
    """Return the changes and new values of the main metrics, and the numbers of other changes, as text."""
    changed, added = found.changed, found.added
    prefix = "instances." if transfer is Transfer.TO_TRUTH else f"instances.{transfer.value}."
    main = [prefix + name for name in MAIN_FIGURES]
    shown = [key for key in (*main, "annotation_release") if key in changed]
    parts = [f"{head(key)} {found.metrics[key]:.3f}" for key in main if key in added and found.metrics[key] is not None]
    new = len(added) - len(parts)
    parts += [f"{head(key)} {_step(*changed[key])}" for key in shown]
    if others := len(changed) - len(shown):
        parts.append(f"{others} other{'s' * (others > 1)}")
    if new:
        parts.append(f"{new} new")
    return ", ".join(parts) or "unchanged"


def _step(old: Any, new: Any) -> str:
    texts = [f"{value:.3f}" if isinstance(value, float) else str(value or "unknown") for value in (old, new)]
    return " -> ".join(texts if texts[0] != texts[1] else [repr(old), repr(new)])


def _find(roots: Sequence[Path]) -> tuple[list[Record], list[DataError]]:
    """Return the complete runs in folders, and an error for each incomplete run and each folder without runs."""
    records: dict[Path, Record] = {}
    failures: dict[Path, DataError] = {}
    for root in roots:
        complete, others = find_records(root)
        records |= {record.directory.resolve(): record for record in complete}
        failures |= {one.directory.resolve(): DataError(f"{one.directory}: {one.reason}") for one in others}
        if not complete and not others:
            failures[root.resolve()] = DataError(f"{root}: expected a run directory or a folder of runs, got neither")
    return list(records.values()), list(failures.values())

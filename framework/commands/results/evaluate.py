"""`python -m framework evaluate RUN...`: evaluates stored runs anew, without running them again."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from tqdm import tqdm

from framework.commands.command_line import EXIT_FAILED, KNOWN_ERRORS, arguments, one_line_errors, show_traceback
from framework.config.composition import one_line
from framework.evaluation.instances import Transfer
from framework.runs.metrics import MAIN_FIGURES
from framework.runs.reevaluation import Reevaluation, Truth, dataset_of
from framework.runs.stored_runs import Record, find_records
from framework.tables.layouts import head


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Evaluates the instances of stored runs anew, from mesh.ply and instances.json, and replaces these "
        "figures in metrics.json; prints what has changed. All others stay, those of the trajectory too: they need "
        "every frame read again.",
    )
    parser.add_argument("run", metavar="RUN", nargs="+", type=Path, help="a run's directory, or a folder of runs")
    parser.add_argument(
        "--transfer",
        choices=[transfer.value for transfer in Transfer],
        default=Transfer.TO_TRUTH.value,
        help="whose figures to print; both transfers are evaluated",
    )
    parser.add_argument(
        "--other-truth",
        action="store_true",
        help="also where the true instances are no longer those that the run was compared with",
    )
    parser.add_argument("--dry-run", action="store_true", help="print only, write nothing")
    asked = arguments(parser)
    with one_line_errors():
        refused = evaluate_runs(asked.run, Transfer(asked.transfer), not asked.dry_run, asked.other_truth)
    if refused:
        sys.exit(EXIT_FAILED)


def evaluate_runs(roots: Sequence[Path], transfer: Transfer, write: bool, other_truth: bool = False) -> int:
    """Evaluates all runs at and below `roots`, one line each, and returns how many were refused."""
    records, refused = _find(roots)
    for reason in refused:
        _refuse(reason)
    count = len(refused)
    with tqdm(total=len(records), unit=" runs", disable=None, dynamic_ncols=True) as bar:
        for same_truth in _by_dataset(records):
            try:
                truth = Truth.of(same_truth[0].config)
            except KNOWN_ERRORS as error:
                show_traceback(error)
                for record in same_truth:
                    _refuse(f"{record.directory}: {one_line(error)}")
                count += len(same_truth)
                bar.update(len(same_truth))
                continue
            for record in same_truth:
                try:
                    found = Reevaluation.of(record, truth, other_truth)
                    if write:
                        found.write()
                    tqdm.write(f"{record.directory}: {summary(found, transfer)}")
                except KNOWN_ERRORS as error:
                    show_traceback(error)
                    _refuse(one_line(error))
                    count += 1
                bar.update()
    return count


def summary(found: Reevaluation, transfer: Transfer) -> str:
    """What has changed: the main figures of one transfer, and how many others."""
    changed, added = found.changed, found.added
    prefix = "instances." if transfer is Transfer.TO_TRUTH else f"instances.{transfer.value}."
    shown = [key for key in (*(prefix + name for name in MAIN_FIGURES), "annotation_release") if key in changed]
    parts = [f"{head(key)} {_step(*changed[key])}" for key in shown]
    if others := len(changed) - len(shown):
        parts.append(f"{others} other{'s' * (others > 1)}")
    if added:
        parts.append(f"{len(added)} new")
    return ", ".join(parts) or "unchanged"


def _step(old: Any, new: Any) -> str:
    texts = [f"{value:.3f}" if isinstance(value, float) else _named(value) for value in (old, new)]
    return " -> ".join(texts if texts[0] != texts[1] else [repr(old), repr(new)])


def _named(value: Any) -> str:
    return "not known" if value is None else str(value)


def _find(roots: Sequence[Path]) -> tuple[list[Record], list[str]]:
    """The complete records, each once, and why the others are none."""
    records: dict[Path, Record] = {}
    refused: dict[Path, str] = {}
    for root in roots:
        complete, others = find_records(root)
        records |= {record.directory.resolve(): record for record in complete}
        refused |= {one.directory.resolve(): f"{one.directory}: {one.reason}" for one in others}
        if not complete and not others:
            refused[root.resolve()] = f"{root}: there is no run at or below it"
    return list(records.values()), list(refused.values())


def _by_dataset(records: Sequence[Record]) -> Iterator[list[Record]]:
    """Runs on the same truth together, so that it is made once and one at a time is in memory."""
    ordered = sorted(records, key=dataset_of)
    return (list(same) for _, same in groupby(ordered, dataset_of))


def _refuse(reason: str) -> None:
    tqdm.write(f"refused: {reason}", file=sys.stderr)

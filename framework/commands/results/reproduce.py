"""`instancemap reproduce RUN|FOLDER|TABLE|BUNDLE`: run stored runs again and compare the results."""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from framework.commands.command_line import EXIT_FAILED, KNOWN_ERRORS, arguments, one_line_errors, print_error
from framework.config.text_values import value_in
from framework.errors import ConfigError, DataError
from framework.registry import text_kind
from framework.runs.reproduction import Reproduction, causes
from framework.runs.run_bundle import opened_bundle
from framework.runs.stored_runs import (
    METRICS,
    Record,
    check_resolved,
    find_records,
    no_run_error,
    read_record,
    without_derived,
)
from framework.tables.comparison import ComparisonTable
from framework.tables.table_check import TABLE_FORMATS, changed_tables


def main() -> None:
    """Run the command `instancemap reproduce`."""
    parser = argparse.ArgumentParser(
        description="Run stored runs again and compare the results: byte-identical, or the first stage and frame that "
        "differ. Changes to tables, files, parameters, inputs, code and packages since then are listed first."
    )
    kinds = "run directory, folder of runs, its table (table.md, table.tex or table.csv), or bundle (.zip)"
    parser.add_argument("source", metavar="SOURCE", type=Path, help=kinds)
    parser.add_argument("overrides", metavar="KEY=VALUE", nargs="*", help="overrides, e.g. dataset.root=DIR")
    parser.add_argument("--row", metavar="ROW", help="row of the table to reproduce; default: all rows")
    repeated = "output folder of the repeated runs; default: a temporary folder"
    parser.add_argument("--out", metavar="DIR", type=Path, help=repeated)
    check = "list the changes since the runs without running them again"
    parser.add_argument("--check-only", action="store_true", help=check)
    trust = "run the plugin code in a bundle; inspect its folder plugins/ first"
    parser.add_argument("--trust-code", action="store_true", help=trust)
    parsed = arguments(parser)
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    with one_line_errors(), ExitStack() as stack:
        folder, out = parsed.source, parsed.out
        if folder.suffix in TABLE_FORMATS:
            folder = folder.parent
        elif folder.suffix == ".zip":
            folder = stack.enter_context(opened_bundle(folder, parsed.trust_code))
        if out is None and not parsed.check_only:
            out = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="instancemap_")))
        different = reproduce_all(folder, parsed.overrides, parsed.row, None if parsed.check_only else out)
    if different:
        sys.exit(EXIT_FAILED)


def reproduce_all(folder: Path, overrides: Sequence[str], row: str | None, out: Path | None) -> int:
    """Run completed runs again, and print the changes and the differences.

    A run with an edited config.yaml or metrics.json counts as different and is not run again.

    Args:
        folder: The folder of the runs and their tables.
        overrides: Overrides of the stored configs.
        row: Only the runs in this row of the table; None = all runs.
        out: The folder of the repeated runs; None = only list the changes.

    Returns:
        The number of changed tables and different runs.
    """
    found, invalid = find_records(folder)
    edited = [one for one in invalid if (one.directory / METRICS).exists()]
    records, incomplete = without_derived(found, invalid)
    if not records and not edited:
        raise no_run_error(folder, incomplete)
    if records and row is not None:
        records = _of_row(folder, row)
    different = len(edited)
    if not edited:
        for change in changed_tables(folder):
            print(f"changed: {change}")
            different += 1
    for one in edited:
        print_error(DataError(one.reason))
        try:
            _print_changes(read_record(one.directory, check_files=False))
        except KNOWN_ERRORS as error:
            print_error(error, f"error: {one.directory.name}: ")
    for number, record in enumerate(records):
        repeated = None if out is None else out / f"{number:03d}_{record.directory.name}"[:200]
        try:
            different += _is_different(record, overrides, repeated)
        except KNOWN_ERRORS as error:
            print_error(error, f"error: {record.directory.name}: ")
            different += 1
    return different


def _is_different(record: Record, overrides: Sequence[str], repeated: Path | None) -> bool:
    """Run a stored run again in the folder `repeated`, and return True if the results differ.

    Without a folder, the run is not repeated. Imported maps are never repeated. The result is then True if anything has
    changed since the run.
    """
    changed = _print_changes(record)
    if record.is_imported:
        print(f"{record.directory.name}: imported map, not run again")
    if repeated is None or record.is_imported:
        return changed
    _run_again(record, overrides, repeated)
    found = Reproduction.of(record.directory, repeated)
    print(f"{record.directory.name}: {found}", flush=True)
    return not found.is_identical


def _print_changes(record: Record) -> bool:
    """Print the changes since a run, and return True if there are any."""
    changes = causes(record)
    for change in changes:
        print(f"{record.directory.name}: changed: {change}")
    return bool(changes)


def _of_row(folder: Path, row: str) -> list[Record]:
    """Return the runs in a row of the table."""
    comparison = ComparisonTable.below(folder)
    rows = {comparison.called(one): list(one.records.values()) for one in comparison.rows}
    if row not in rows:
        raise ConfigError(f"--row: expected one of the rows {'; '.join(rows)}, got {row!r}")
    return rows[row]


def _run_again(record: Record, overrides: Sequence[str], directory: Path) -> None:
    """Run the stored config, with overrides, in a new run directory."""
    from framework.commands.running.run import run

    check_resolved(record.config)
    config = OmegaConf.create(dict(record.config))
    OmegaConf.set_struct(config, True)  # unknown keys are errors
    for override in overrides:
        try:
            OmegaConf.update(config, *value_in(config, override, text_kind))
        except (HydraException, OmegaConfBaseException) as error:
            raise ConfigError(
                f"{override}: expected KEY=VALUE with a key and a type of the run's config, got an unknown key or a "
                "value of another type"
            ) from error
    run(config, directory, record.choices)

"""`instancemap reproduce RUN|FOLDER|BUNDLE`: run stored runs again and compare the results."""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from framework.commands.command_line import EXIT_FAILED, KNOWN_ERRORS, arguments, one_line_errors, print_error
from framework.errors import ConfigError, DataError
from framework.runs.reproduction import Reproduction, causes
from framework.runs.run_bundle import opened_bundle
from framework.runs.stored_runs import METRICS, Record, find_records, read_record


def main() -> None:
    """Run the command `instancemap reproduce`."""
    parser = argparse.ArgumentParser(
        description="Run stored runs again and compare the results: byte-identical, or the first stage and frame that "
        "differ. Changes of files, parameters, inputs, code and packages since the runs are listed first."
    )
    parser.add_argument("source", metavar="SOURCE", type=Path, help="run directory, folder of runs, or bundle (.zip)")
    parser.add_argument("overrides", metavar="KEY=VALUE", nargs="*", help="overrides, e.g. dataset.root=DIR")
    parser.add_argument("--cell", metavar="ROW", help="reproduce only the runs of this row of the table; default: all")
    parser.add_argument("--out", metavar="DIR", type=Path, help="folder of the repeated runs; default: temporary")
    check = "list the changes since the runs without running them again"
    parser.add_argument("--check-only", action="store_true", help=check)
    trust = "run the plugin code in a bundle; inspect its folder plugins/ first"
    parser.add_argument("--trust-code", action="store_true", help=trust)
    parsed = arguments(parser)
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    with one_line_errors(), _folder(parsed.source, parsed.trust_code) as folder, _output(parsed.out) as out:
        different = reproduce_all(folder, parsed.overrides, parsed.cell, None if parsed.check_only else out)
    if different:
        sys.exit(EXIT_FAILED)


@contextmanager
def _folder(source: Path, trust_code: bool) -> Iterator[Path]:
    """Yield the folder of the runs; a bundle is extracted to a temporary folder."""
    if source.suffix == ".zip":
        with opened_bundle(source, trust_code) as folder:
            yield folder
    else:
        yield source


@contextmanager
def _output(chosen: Path | None) -> Iterator[Path]:
    if chosen is not None:
        yield chosen
        return
    with tempfile.TemporaryDirectory(prefix="instancemap_") as folder:
        yield Path(folder)


def reproduce_all(folder: Path, overrides: Sequence[str], row: str | None, out: Path | None) -> int:
    """Print the changes and the comparison of each completed run, and return the number of different runs.

    `out` is the folder of the repeated runs; None = only list the changes.
    """
    records, incomplete = find_records(folder)
    edited = [one for one in incomplete if (one.directory / METRICS).exists()]
    for one in edited:
        print_error(DataError(one.reason), "error: ")
        for change in causes(read_record(one.directory, check_config=False)):
            print(f"{one.directory.name}: changed: {change}")
    if edited and not records:
        return len(edited)
    if row is not None:
        rows = sorted({str(record.config.get("row")) for record in records})
        records = [record for record in records if str(record.config.get("row")) == row]
        if not records:
            raise ConfigError(f"--cell: expected one of {', '.join(rows)}, got {row!r}")
    if not records:
        why = "; ".join(one.reason for one in incomplete[:3])
        raise DataError(f"{folder}: expected a completed run, got none{f' ({why})' if why else ''}")
    different = len(edited)
    for number, record in enumerate(records):
        name = record.directory.name
        try:
            changes = causes(record)
            for change in changes:
                print(f"{name}: changed: {change}")
            if out is None:
                different += bool(changes)
                continue
            repeated = out / f"{number:03d}_{name}"[:200]
            _run_again(record, overrides, repeated)
            found = Reproduction.of(record.directory, repeated)
            print(f"{name}: {found}", flush=True)
            different += str(found) != "byte-identical"
        except KNOWN_ERRORS as error:
            print_error(error, f"error: {name}: ")
            different += 1
    return different


def _run_again(record: Record, overrides: Sequence[str], directory: Path) -> None:
    """Run the stored config, with overrides, in a new run directory."""
    from framework.commands.running.run import run

    config: Any = OmegaConf.create(dict(record.config))
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals or OmegaConf.select(config, key, default=config) is config:
            raise ConfigError(f"{override}: expected KEY=VALUE with a key of the run's config, got an unknown key")
        try:
            config = OmegaConf.merge(config, OmegaConf.from_dotlist([f"{key}={value}"]))
        except OmegaConfBaseException as error:
            raise ConfigError(f"{key}: expected a valid value, got {value!r}") from error
    run(config, directory, record.choices)

"""`instancemap report RUN...`: write HTML reports of runs and compare them."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from tqdm import tqdm

from framework.commands.command_line import arguments, one_line_errors
from framework.errors import DataError
from framework.files.atomic_write import check_regular
from framework.runs.stored_runs import REPORT

COMPARISON = "comparison.html"


def main() -> None:
    """Run the command `instancemap report`."""
    parser = argparse.ArgumentParser(
        description="Write an interactive HTML report of a run: map, objects, trajectory, run times and, with ground "
        "truth, accuracy. For several runs, also write a comparison. Each report is a single file."
    )
    parser.add_argument("run", metavar="RUN", nargs="+", type=Path, help="run directory")
    default = f"default: {REPORT} in the run directory, or {COMPARISON} in the common parent folder of the runs"
    parser.add_argument("--out", metavar="FILE", type=Path, help=f"output file of the report or comparison; {default}")
    parsed = arguments(parser)
    with one_line_errors():
        for path in write_reports(parsed.run, parsed.out):
            print(path.resolve().as_uri())


def write_reports(directories: Sequence[Path], out: Path | None = None) -> list[Path]:
    """Write the report of each run and, for several runs, their comparison.

    All runs are read before a file is written.

    Args:
        directories: Run directories.
        out: Path of the only report or of the comparison; None = default path.

    Returns:
        The paths of the files, the comparison last.

    Raises:
        DataError: A run cannot be read.
    """
    from framework.reporting.comparison_page import Comparison
    from framework.reporting.markup import write_page
    from framework.reporting.run_contents import RunContents
    from framework.reporting.run_page import RunReport

    places = [directory.resolve() for directory in directories]
    if again := [place for k, place in enumerate(places) if place in places[:k]]:
        raise DataError(f"{again[0]}: expected distinct runs, got this run twice; remove the duplicate")
    if out is not None:
        if not out.parent.is_dir():
            raise DataError(f"{out}: expected an existing parent folder, got none; create {out.parent}")
        if out.exists():
            check_regular(out)
    runs = [RunContents.read(directory) for directory in directories]
    if len(runs) == 1:
        path = out or directories[0] / REPORT
        write_page(path, RunReport.of(runs[0]).html())
        return [path]
    pages = [directory / REPORT for directory in directories]
    for page, run in zip(tqdm(pages, unit=" pages", disable=None, dynamic_ncols=True), runs, strict=True):
        write_page(page, RunReport.of(run).html())
    path = out or Path(os.path.commonpath([place.parent for place in places])) / COMPARISON
    links = [quote(os.path.relpath(page.resolve(), path.resolve().parent)) for page in pages]
    write_page(path, Comparison.of(runs, links).html())
    return [*pages, path]

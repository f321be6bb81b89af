"""`python -m framework report RUN...`: a run, or several side by side, as a page for the browser."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from tqdm import tqdm

from framework.commands.command_line import arguments, one_line_errors
from framework.errors import DataError
from framework.files.atomic_write import check_regular, written_whole
from framework.runs.stored_runs import REPORT

COMPARISON = "comparison.html"


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Writes a page that shows a run: its map to turn, its objects, trajectory and times, and where the "
        "true instances are known what is right, wrong and missed. Of several runs it writes one each, and one that "
        "sets them side by side. A page is one file that loads nothing from elsewhere.",
    )
    parser.add_argument("run", metavar="RUN", nargs="+", type=Path, help="a run's directory")
    parser.add_argument(
        "--out",
        metavar="FILE",
        type=Path,
        help=f"where the page goes, that of the comparison where there are several runs; else {REPORT} in the run's "
        f"directory, or {COMPARISON} in the folder that all of them are in",
    )
    asked = arguments(parser)
    with one_line_errors():
        for path in write_reports(asked.run, asked.out):
            print(path.resolve().as_uri())


def write_reports(directories: Sequence[Path], out: Path | None = None) -> list[Path]:
    """Writes the pages and returns where they are, the one that was asked for last.

    Raises DataError when a record cannot be read, before any page is written.
    """
    from framework.reporting.comparison_page import Comparison
    from framework.reporting.run_contents import RunContents
    from framework.reporting.run_page import RunReport

    places = [directory.resolve() for directory in directories]
    if again := [place for k, place in enumerate(places) if place in places[:k]]:
        raise DataError(f"{again[0]}: each run is to be named once")
    if out is not None:
        _check_place(out)  # before the maps are looked at, which takes a while
    runs = [RunContents.read(directory) for directory in directories]
    if len(runs) == 1:
        path = out or directories[0] / REPORT
        _write(path, RunReport.of(runs[0]).html())
        return [path]
    pages = [directory / REPORT for directory in directories]
    for page, run in zip(tqdm(pages, unit=" pages", disable=None, dynamic_ncols=True), runs, strict=True):
        _write(page, RunReport.of(run).html())
    path = out or Path(os.path.commonpath([place.parent for place in places])) / COMPARISON
    links = [quote(os.path.relpath(page.resolve(), path.resolve().parent)) for page in pages]
    _write(path, Comparison.of(runs, links).html())
    return [*pages, path]


def _check_place(path: Path) -> None:
    if not path.parent.is_dir():
        raise DataError(f"{path} could not be written: its folder does not exist")
    if path.exists():
        check_regular(path)


def _write(path: Path, page: str) -> None:
    with written_whole(path) as temporary:
        temporary.write_text(page, encoding="utf-8", errors="backslashreplace")  # names may be no text

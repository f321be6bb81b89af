"""Stored runs as a pandas data frame."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from framework.files.search_paths import usable_path
from framework.runs.stored_runs import CHOICE, Record, completed_runs, is_number
from framework.runtime.plain_output import plain

if TYPE_CHECKING:
    from pandas import DataFrame, Series

RUN = "run"  # column of the run directory
LONGEST = 2**63  # exclusive limit of the integers in a column of type Int64

log = logging.getLogger(__name__)


def load_runs(folder: Path | str) -> DataFrame:
    """Read the completed runs in a folder and its subfolders as a pandas data frame.

    The data frame has one row per run. For example, `load_runs(DIR).groupby("refiner")["instances.ap50"].mean()`
    compares the refiners of a sweep.

    Args:
        folder: The folder of a sweep or of several runs.

    Returns:
        The runs, sorted by directory. Columns are named as on the command line and in metrics.json:

        - `run`: the run directory, relative to `folder`
        - `row`: the row of an experiment
        - `dataset`, `detector`, `tracker`, `refiner`, `fuser`, `preset`: the chosen options
        - `fuser.voxel_size`, ...: the parameters, with lists as JSON
        - `instances.ap50`, `fps`, ...: the metrics, in the units of metrics.json
        - `git_commit`, `code.refiner`, `config_hash`, `inputs_sha256`, `environment.cpus`, ...: the provenance

        The types of the columns are Int64, float64, boolean and string. Missing values are NA.

    Raises:
        DataError: The folder is missing or contains no completed run.
    """
    root = usable_path("folder", folder)
    records, others = completed_runs(root)
    for one in others:
        log.warning("load_runs: omitted %s: %s", one.directory, one.reason)
    return data_frame(records, root)


def data_frame(records: Sequence[Record], root: Path) -> DataFrame:
    """Return a data frame of runs with the columns of `load_runs`."""
    from pandas import DataFrame

    rows = [dict(_values(record, root)) for record in records]
    columns = dict.fromkeys(key for row in rows for key in row)
    return DataFrame({key: _column([row.get(key) for row in rows]) for key in columns})


def _values(record: Record, root: Path) -> Iterator[tuple[str, Any]]:
    """Yield the name and the value of each column of a run."""
    yield RUN, record.directory.relative_to(root).as_posix()
    yield from record.settings.items()
    for key, value in record.metrics.items():  # a setting has precedence over a metric of the same name
        if key not in record.settings and not key.startswith(CHOICE):
            yield key, value


def _column(values: list[Any]) -> Series:
    """Return a column of the values, with NA for None."""
    from pandas import Series

    known = [value for value in values if value is not None]
    if not known or all(isinstance(value, float) or is_number(value) for value in known):
        whole = known and all(isinstance(value, int) and abs(value) < LONGEST for value in known)
        return Series(values, dtype="Int64" if whole else "float64")
    if all(isinstance(value, bool) for value in known):
        return Series(values, dtype="boolean")
    texts = [value if value is None or isinstance(value, str) else json.dumps(value) for value in values]
    return Series(texts, dtype="string")


def without_formulas(frame: DataFrame) -> DataFrame:
    """Return a data frame whose texts are not formulas in a spreadsheet program, with control characters escaped."""
    return frame.map(lambda value: plain_cell(value) if isinstance(value, str) else value).rename(columns=plain_cell)


def plain_cell(text: str) -> str:
    """Return a text that a spreadsheet program does not interpret as a formula. Numbers are unchanged."""
    text = plain(text)
    if not text.startswith(("=", "+", "-", "@", "\t", "\n")):
        return text
    with suppress(ValueError):
        float(text)
        return text
    return f"'{text}"

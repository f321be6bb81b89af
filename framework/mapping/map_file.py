"""A saved map: one .npz with a header of plain numbers and the map's arrays, written whole or not at all."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Array, check_array
from framework.errors import DataError, InstanceMapError
from framework.files.whole_files import written_whole
from framework.mapping.evidence import Combine
from framework.mapping.instance_table import FrameSet, InstanceRecord, InstanceTable

DEFLATE_LEVEL = 1  # of zlib: at most a tenth larger than level 6, which np.savez_compressed has, in half its time

FAULTS_OF_FILES = (OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error)
UNREADABLE = (*FAULTS_OF_FILES, LookupError, TypeError, ValueError, AttributeError)
"""What is raised for a file that is no map, or whose header has something else where a number or a list should be."""


def write_map(path: Path | str, header: Mapping[str, Any], arrays: Mapping[str, Array]) -> None:
    """Writes an .npz as np.load reads it, lightly compressed: a third of the arrays' size. It has no time in it."""
    encoded = np.frombuffer(json.dumps(header).encode(), np.uint8)
    with (
        written_whole(Path(path)) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=DEFLATE_LEVEL) as archive,
    ):
        for name, array in {"header": encoded, **arrays}.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)


def read_map(path: Path | str, expected_format: object, names: Sequence[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The header and the named arrays of a saved map.

    Raises DataError for a file that is none, for another format and for a checksum that fails.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        if damaged is not None:
            raise DataError(f"{path}: the checksum of {damaged} does not hold; the file is damaged, map again")
        with np.load(path, allow_pickle=False) as file:
            header = json.loads(file["header"].tobytes())
            found = header.get("format")
            if found != expected_format:  # its arrays may have other names
                raise DataError(f"{path} has map format {found}, this version reads {expected_format}; map again")
            arrays = {name: file[name] for name in names}
    except UNREADABLE as error:
        raise DataError(f"{path} is not a map that can be read: {error}") from error
    return header, arrays


@contextmanager
def faults_of(path: Path | str) -> Iterator[None]:
    """Turns what goes wrong while a map is made from a file into a DataError that names the file."""
    try:
        yield
    except InstanceMapError as error:
        raise DataError(f"{path}: {error}; map again") from error
    except UNREADABLE as error:
        raise DataError(f"{path} is not a map that can be read: {type(error).__name__} {error}; map again") from error


def check_like(arrays: Mapping[str, Array], expected: Mapping[str, Array], length: int, prefix: str = "") -> None:
    """Raises DataError unless the arrays, which kernels read without looking, have the expected types, and the expected
    shapes but for the `length`.
    """
    for name, like in expected.items():
        check_array(prefix + name, arrays[prefix + name], (length, *like.shape[1:]), like.dtype)


def check_known(name: str, array: Array, known: Iterable[int]) -> None:
    """Raises DataError unless all numbers in the array, which kernels take for places in others, are known ones."""
    unknown = array[~np.isin(array, list(known))]
    if unknown.size:
        raise DataError(f"{name} has {unknown[0]}, which is none of the map's")


def check_blocks(coords: Any) -> None:
    """Raises DataError unless blocks (B, 3) lie within 2^20 blocks of the origin, and each is named once."""
    if len(coords) and np.abs(coords, dtype=np.int64).max() >= 1 << 20:
        raise DataError(f"block_coords must be within 2^20 of 0, found {coords.min()} to {coords.max()}")
    if len(np.unique(coords, axis=0)) < len(coords):
        raise DataError("block_coords has a block twice")


def plain_table(table: InstanceTable) -> dict[str, Any]:
    """The table of instances as JSON can hold it."""
    return {
        "combine": table.combine.name,
        "logarithmic": table.logarithmic,
        "last_id": table.last_id,
        "instances": [
            {
                **asdict(record),
                "class_evidence": record.class_evidence.tolist(),
                "observed_in": sorted(record.observed_in),
                "in_view": record.in_view.spans,
            }
            for record in table.records.values()
        ],
    }


def table_of(plain: Mapping[str, Any], classes: int) -> InstanceTable:
    """The table that `plain_table` wrote down, of a map with so many classes."""
    table = InstanceTable(Combine[plain["combine"]], plain["logarithmic"])
    table.last_id = plain["last_id"]
    for entry in plain["instances"]:
        record = InstanceRecord(**entry)
        record.class_evidence = np.array(record.class_evidence, np.float64)
        check_array(f"class_evidence of {record.id}", record.class_evidence, (classes,), np.float64)
        record.observed_in = set(record.observed_in)
        record.in_view = FrameSet(entry["in_view"])
        table.records[record.id] = record
        if not 0 < record.id <= table.last_id:
            raise DataError(f"the table's ids must be in [1, {table.last_id}], found {record.id}")
    return table

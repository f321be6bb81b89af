"""Map files: .npz archives with a JSON header and the arrays of the map."""

from __future__ import annotations

import json
import math
import os
import re
import struct
import zipfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Array, Float64, check_array
from framework.errors import DataError, InstanceMapError, reason_of
from framework.files.atomic_write import atomic_write, check_regular
from framework.files.json_file import parse_json
from framework.files.manifest import verified
from framework.files.search_paths import usable_path
from framework.mapping.instances.instance_calibration import InstanceCalibration
from framework.mapping.instances.instance_table import PAGE, FrameSet, InstanceRecord, InstanceTable
from framework.mapping.instances.object_embedding import ARRAYS, SPACE, embedding_arrays, read_embeddings
from framework.mapping.instances.viewing import Point, Viewing
from framework.mapping.labels.label_evidence_kernels import Combine
from framework.mapping.storage.map_file_kernels import find_unknown
from framework.mapping.storage.map_header import LARGEST_COUNT, MapHeader, whole
from framework.mapping.voxels.voxel_grid_kernels import FARTHEST_BLOCK

DEFLATE_LEVEL = 1  # zlib level; files are at most a tenth larger than at level 6, and writing takes half the time

HEADER = "header"  # name of the array with the JSON header
CLASS_EVIDENCE = "class_evidence"  # name of the array with the class evidence (I, C) of the I instances
LARGEST_HEADER = 2**28  # maximum size of the header, bytes; an hour of mapping with thousands of instances takes 10 MB
LARGEST_ID = 2**24  # maximum instance id
MAX_EVIDENCE = 1e12  # maximum absolute evidence for a class
PAGE_NUMBER, PAGE_BITS = re.compile("0|-?[1-9][0-9]{0,12}"), re.compile(f"[1-9a-f][0-9a-f]{{0,{PAGE // 4 - 1}}}")
LOCAL_LENGTHS = 26  # offset of the lengths of the name and the additional fields in the header of a zip member, bytes
MAX_ARRAYS = 100  # maximum number of arrays listed in the header of a file
MAX_MEMORY_FRACTION = 0.5  # maximum size of a loaded map, as a fraction of the memory


class _TooLargeError(DataError):
    """Error for a map file that exceeds the memory limit."""


def write_map(
    path: Path | str, header: Mapping[str, Any], arrays: Mapping[str, Array], stored: Collection[str] = ()
) -> None:
    """Write a header and arrays to a map file.

    The file has no timestamps and can be read by np.load.

    Args:
        path: The file.
        header: The header.
        arrays: The arrays by name.
        stored: The names of arrays with little redundancy. They are not compressed, because it would take seconds for
            a large map.
    """
    target = usable_path("map file", path)
    encoded = np.frombuffer(json.dumps(header).encode(), np.uint8)
    with (
        atomic_write(target) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=DEFLATE_LEVEL) as archive,
    ):
        for name, array in {HEADER: encoded, **arrays}.items():
            member_name = f"{name}.npy"
            info = zipfile.ZipInfo(member_name) if name in stored else member_name  # a ZipInfo is not compressed
            with archive.open(info, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)


@contextmanager
def map_contents(
    path: Path | str, expected_format: object, names: Sequence[str]
) -> Iterator[tuple[MapHeader, dict[str, Any]]]:
    """Read the header, the named arrays and any embeddings of a map file, and build the map in the `with` body.

    Array sizes are checked against the file and the available memory before allocation. The file is compared with the
    manifest of its run in the background, or, without a manifest, with the checksum of each array. Errors in the body
    are converted to a DataError with the path of the file.

    Raises:
        DataError: If the file is not a map file, has another format or is damaged.
    """
    with verified(Path(path)) as is_hashed, _file_errors(path):
        with _opened(path) as archive:
            header = _header(archive)
            found = header.values.get("format")
            if found != expected_format:
                raise DataError(f"expected map format {expected_format}, got {found!r:.60}")
            there = set(archive.namelist())
            optional = [name for name in ARRAYS if f"{name}.npy" in there]
            read = _unchecked_array if is_hashed else _array
            arrays = {name: read(archive, name) for name in dict.fromkeys((*names, *optional))}
        yield header, arrays


def read_arrays(path: Path | str, expected_format: object) -> dict[str, Array]:
    """Return the arrays that the header of a file lists as `names`.

    Raises:
        DataError: If the file has another format or is damaged.
    """
    with _file_errors(path), _opened(path) as archive:
        names = _header(archive).items("names")
    with map_contents(path, expected_format, [str(name) for name in names[:MAX_ARRAYS]]) as (_, arrays):
        return arrays


def read_format(path: Path | str) -> str:
    """Return the format of a map file.

    Raises:
        DataError: If the file is not a map file.
    """
    with _file_errors(path), _opened(path) as archive:
        return str(_header(archive).values.get("format"))


@contextmanager
def _file_errors(path: Path | str) -> Iterator[None]:
    """Convert errors while reading a map file to a DataError with the path of the file."""
    check_regular(usable_path("map file", path))  # its errors contain the path
    try:
        yield
    except _TooLargeError as error:
        raise DataError(f"{path}: {error}") from error
    except InstanceMapError as error:
        raise DataError(f"{path}: {error}; map again") from error
    except Exception as error:  # zipfile and numpy raise many types for damaged archives
        raise DataError(f"{path}: expected a map file, got unreadable data ({reason_of(error)}); map again") from error


@contextmanager
def _opened(path: Path | str) -> Iterator[zipfile.ZipFile]:
    with zipfile.ZipFile(path) as archive:
        check_memory(sum(info.file_size for info in archive.infolist()))
        yield archive


def check_memory(size: int) -> None:
    """Raise DataError if a map with `size` unpacked bytes exceeds the memory limit."""
    limit = MAX_MEMORY_FRACTION * machine_memory()
    if size > limit:
        raise _TooLargeError(
            f"expected at most {limit:.0f} unpacked bytes (half of this machine's memory), got {size}; open it "
            "on a machine with more memory, or map again with a larger fuser.voxel_size"
        )


def _header(archive: zipfile.ZipFile) -> MapHeader:
    info = archive.getinfo(f"{HEADER}.npy")
    if info.file_size > LARGEST_HEADER:
        raise DataError(f"header: expected at most {LARGEST_HEADER} bytes, got {info.file_size}")
    return MapHeader.of(parse_json("header", _array(archive, HEADER).tobytes()))


def _array(archive: zipfile.ZipFile, name: str) -> Array:
    """Return an array of the archive after checking its size."""
    with archive.open(_checked_info(archive, name)) as member:
        array = np.asarray(np.lib.format.read_array(member, allow_pickle=False))
        member.read()  # at the end of the data, zipfile compares the checksum
    return array


def _unchecked_array(archive: zipfile.ZipFile, name: str) -> Array:
    """Return an array without comparing its checksum, which takes a fifth of the time to load a map."""
    info = _checked_info(archive, name)
    if info.compress_type != zipfile.ZIP_STORED or archive.filename is None:
        return _array(archive, name)
    with Path(archive.filename).open("rb") as file:
        file.seek(info.header_offset + LOCAL_LENGTHS)
        start = sum(struct.unpack("<HH", file.read(4)))  # name and additional fields
        file.seek(start, os.SEEK_CUR)
        return np.asarray(np.lib.format.read_array(file, allow_pickle=False))


def _checked_info(archive: zipfile.ZipFile, name: str) -> zipfile.ZipInfo:
    """Return the entry of an array after comparing its size with its shape."""
    info = archive.getinfo(f"{name}.npy")
    with archive.open(info) as member:
        version = np.lib.format.read_magic(member)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(member)
        claimed = member.tell() + math.prod(shape) * dtype.itemsize
    if min(shape, default=0) < 0:
        raise DataError(f"{name}: expected dimensions >= 0, got {shape}")
    if claimed != info.file_size:
        raise DataError(
            f"{name}: expected {claimed} bytes for shape {shape} and dtype {dtype}, got {info.file_size} bytes"
        )
    return info


def machine_memory() -> int:
    """Return the memory of this machine in bytes, 2^34 if unknown."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return 2**34


def check_like(arrays: Mapping[str, Array], expected: Mapping[str, Array], length: int, prefix: str = "") -> None:
    """Raise DataError unless the arrays have `length` rows, and the types and row shapes of the expected arrays.

    The names in `arrays` begin with `prefix`.
    """
    for name, like in expected.items():
        check_array(prefix + name, arrays[prefix + name], (length, *like.shape[1:]), like.dtype)


def check_known(name: str, array: Array, known: Collection[int]) -> None:
    """Raise DataError unless all values of the array are in `known`."""
    is_known = np.zeros(max(known, default=-1) + 1, np.bool_)
    is_known[[*known]] = True
    unknown = find_unknown(array.ravel(), is_known)  # kernels would use it as an index
    if unknown >= 0:
        raise DataError(f"{name}: expected ids in the map, got {array.flat[unknown]}")


def check_numbers(name: str, numbers: Array, count: int) -> None:
    """Raise DataError unless the array contains each index below `count` exactly once, and otherwise only -1."""
    used = numbers[numbers != -1]
    beyond = used[(used < 0) | (used >= count)]
    if beyond.size:
        raise DataError(f"{name}: expected indices in [-1, {count}), got {beyond[0]}")
    if used.size != count or not np.array_equal(np.bincount(used, minlength=count), np.ones(count)):
        raise DataError(
            f"{name}: expected each of {count} indices once, got {used.size} indices, {len(np.unique(used))} distinct"
        )


def check_blocks(coords: Any) -> None:
    """Raise DataError unless the block coordinates (B, 3) are unique and in range."""
    if len(coords) and np.abs(coords, dtype=np.int64).max() >= FARTHEST_BLOCK:
        raise DataError(
            f"block_coords: expected values in [{1 - FARTHEST_BLOCK}, {FARTHEST_BLOCK - 1}], got {coords.min()} to "
            f"{coords.max()}"
        )
    offset = np.asarray(coords, np.int64) + FARTHEST_BLOCK
    keys = (offset[:, 0] * 2 * FARTHEST_BLOCK + offset[:, 1]) * 2 * FARTHEST_BLOCK + offset[:, 2]
    if len(np.unique(keys)) < len(coords):
        raise DataError("block_coords: expected unique blocks, got duplicates")


def plain_table(table: InstanceTable) -> dict[str, Any]:
    """Return an instance table as JSON values, without its class evidence and its embeddings."""
    embedded = any(record.embedding is not None for record in table.records.values())
    space = {SPACE: table.embedding_space} if embedded else {}
    return {
        "combine": table.combine.name,
        "logarithmic": table.logarithmic,
        "last_id": table.last_id,
        "calibration": asdict(table.calibration),
        "tentative": [[k, table.frames_detected - frame] for k, frame in table.tentative.items()],
        **space,
        "instances": [_plain_record(record) for record in table.records.values()],
    }


def _plain_record(record: InstanceRecord) -> dict[str, Any]:
    plain = {
        **vars(record),
        "observed_in": _plain_frames(record.observed_in),
        "in_view": _plain_frames(record.in_view),
        "viewing": asdict(record.viewing),
    }
    del plain["class_evidence"], plain["embedding"]
    return plain


def _plain_frames(frames: FrameSet) -> dict[str, str]:
    """Return the bits of each page, hexadecimal."""
    return {str(number): f"{bits:x}" for number, bits in sorted(frames.pages().items())}


def table_arrays(table: InstanceTable, classes: int) -> dict[str, Array]:
    """Return the arrays of an instance table: the class evidence, and the embeddings if there are any.

    Args:
        table: The instance table.
        classes: The number of classes.
    """
    evidence = np.array([record.class_evidence for record in table.records.values()], np.float64)
    embeddings = {k: record.embedding for k, record in table.records.items() if record.embedding is not None}
    return {CLASS_EVIDENCE: evidence.reshape(len(table.records), classes), **embedding_arrays(embeddings)}


def table_of(plain: MapHeader, classes: int, arrays: Mapping[str, Any]) -> InstanceTable:
    """Return the instance table of a map file.

    Args:
        plain: The table in the header.
        classes: The number of classes.
        arrays: The arrays of the file.

    Raises:
        DataError: If the table is invalid.
    """
    table = InstanceTable(plain.option("combine", Combine), plain.flag("logarithmic"))
    table.last_id = plain.whole("last_id", 0, LARGEST_ID)
    table.calibration = InstanceCalibration.of(plain.part("calibration").values, f"{plain.name}.calibration")
    entries, evidence = list(plain.parts("instances")), arrays[CLASS_EVIDENCE]
    check_array(CLASS_EVIDENCE, evidence, (len(entries), classes), np.float64)
    if len(entries) and not classes:
        raise DataError(f"{CLASS_EVIDENCE}: expected at least 1 class for {len(entries)} instances, got 0")
    if len(entries) and np.abs(evidence).max() > MAX_EVIDENCE:
        raise DataError(
            f"{CLASS_EVIDENCE}: expected numbers in [-{MAX_EVIDENCE:g}, {MAX_EVIDENCE:g}], got {evidence.min():g} to "
            f"{evidence.max():g}"
        )
    for entry, of_classes in zip(entries, evidence, strict=True):
        record = _record(entry, table, of_classes)
        if record.id in table.records:
            raise DataError(f"{entry.name}.id: expected a unique id, got {record.id} twice")
        table.add(record)
    _read_tentative(table, plain)
    table.embedding_space, embeddings = read_embeddings(plain, arrays)
    check_known("embedding_ids", np.array(list(embeddings), np.int32), table.records)
    for k, embedding in embeddings.items():
        table.records[k].embedding = embedding
    return table


def _read_tentative(table: InstanceTable, plain: MapHeader) -> None:
    """Read the age of each tentative instance."""
    where, oldest = f"{plain.name}.tentative", LARGEST_COUNT
    for entry in plain.items("tentative"):
        k, age = entry if isinstance(entry, list) and len(entry) == 2 else (entry, None)
        if whole(where, k, 1, table.last_id) not in table.records or k in table.tentative:
            raise DataError(f"{where}: expected each instance at most once, got {k}")
        oldest = whole(where, age, 0, oldest)
        table.tentative[k] = -oldest


def _record(entry: MapHeader, table: InstanceTable, class_evidence: Float64) -> InstanceRecord:
    return InstanceRecord(
        id=entry.whole("id", 1, table.last_id),
        class_evidence=class_evidence.copy(),
        first_frame=entry.whole("first_frame", -LARGEST_COUNT),
        last_frame=entry.whole("last_frame", -LARGEST_COUNT),
        observed_in=table.frame_set(_pages(entry.part("observed_in"))),
        in_view=table.frame_set(_pages(entry.part("in_view"))),
        score_sum=entry.number("score_sum", (0.0, float(entry.whole("detections")))),
        detections=entry.whole("detections"),
        viewing=_viewing(entry.part("viewing")),
    )


def _viewing(entry: MapHeader) -> Viewing:
    """Return the statistics of the views of an instance."""
    outlines = entry.whole("outlines")
    return Viewing(
        views=entry.whole("views"),
        outlines=outlines,
        outline_sum=entry.number("outline_sum", (0.0, float(outlines))),
        centered=entry.whole("centered"),
        center_sum=_point(entry, "center_sum"),
        camera=None if entry.values.get("camera") is None else _point(entry, "camera"),
    )


def _point(entry: MapHeader, name: str) -> Point:
    """Return three numbers.

    Raises:
        DataError: The value is no list of three numbers.
    """
    match entry.values.get(name):
        case [int() | float() as x, int() | float() as y, int() | float() as z] if np.isfinite([x, y, z]).all():
            return float(x), float(y), float(z)
        case other:
            raise DataError(f"{entry.name}.{name}: expected three numbers, got {other!r:.60}")


def _pages(entry: MapHeader) -> dict[int, int]:
    pages = {}
    for number, bits in entry.values.items():
        if not PAGE_NUMBER.fullmatch(number) or not isinstance(bits, str) or not PAGE_BITS.fullmatch(bits):
            raise DataError(
                f"{entry.name}: expected the bits of {PAGE} frames by page number, got {number!r:.20}: {bits!r:.60}"
            )
        pages[int(number)] = int(bits, 16)
    return pages

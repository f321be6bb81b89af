"""Records of an OpenNI recording (.oni).

OpenNI 2 can crash on a damaged file. The records are therefore checked before the images are decoded.
"""

from __future__ import annotations

import shutil
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO, NamedTuple

from framework.errors import DataError
from framework.files.atomic_write import check_regular

FILE_HEADER = struct.Struct("<4sBBHIQI")  # magic number, version (four numbers), largest time, largest node
FILE_MAGIC = b"NI10"
LARGEST_NODE_AT = FILE_HEADER.size - 4
VERSIONS = (1, 0, 0, 4), (1, 0, 1, 0)  # first and last version that OpenNI 2 supports
FIRST_WIDE = (1, 0, 1, 0)  # first version with 64-bit file positions
IMAGE_FIELDS = struct.Struct("<QI")  # time, us; number
RECORD_MAGIC = b"NIR\0"
LARGEST_NODE = 255  # maximum node id; ids begin at 1; OpenNI allocates as many nodes as the header declares
LARGEST_FIELDS = 2**20  # bytes per record; OpenNI reads the fields into a buffer of 5.8 MB without a check


class OniRecord(IntEnum):
    """Record types of the file format."""

    NODE_ADDED_1_0_0_4 = 0x02
    NEW_DATA = 0x0A
    END = 0x0B
    NODE_ADDED_1_0_0_5 = 0x0C
    NODE_ADDED = 0x0D


class Stream(IntEnum):
    """Stream types, with the node types of the file format as values."""

    DEPTH = 2
    COLOR = 3


@dataclass
class Images:
    """Node and image counts of a stream."""

    node: int  # node id of this stream's records
    count: int = 0  # number of complete images
    last: int = 0  # number of the last complete image, from 1


@dataclass(frozen=True)
class OniContents:
    """Contents of a recording."""

    path: Path
    streams: Mapping[Stream, Images]  # for depth and color
    end: int  # bytes, file position after the last complete record
    cut_off: bool  # True if the recording has no end record
    largest_node: int
    wide: bool  # True = 64-bit file positions; False = 32-bit
    table_notes: tuple[int, ...]  # file positions of the fields that point to the seek tables


def read_contents(path: Path) -> OniContents:
    """Read the streams and image counts of a recording without decoding the images.

    Raises:
        DataError: The file is not an OpenNI recording, or it has no depth images or no color images.
    """
    check_regular(path)
    try:
        with path.open("rb") as file:
            return _read_contents(path, file)
    except OSError as error:
        raise DataError(f"{path}: expected a readable file, got an error ({error.strerror or error})") from error


@contextmanager
def playable(contents: OniContents, scratch: Path) -> Iterator[Path]:
    """Yield the path of a recording that OpenNI can play.

    OpenNI rejects a truncated recording, because the seek tables at the end are missing. In this case, the result is a
    repaired copy in `scratch`. The copy has no seek tables and ends with an end record.
    """
    if not contents.cut_off:
        yield contents.path
        return
    position, record_header = _layouts(contents.wide)
    with TemporaryDirectory(prefix=".", dir=scratch) as folder:
        copy = Path(folder) / "repaired.oni"
        shutil.copyfile(contents.path, copy)
        with copy.open("r+b") as file:
            file.seek(LARGEST_NODE_AT)  # missing from the header if the recorder was killed
            file.write(struct.pack("<I", contents.largest_node))
            for note in contents.table_notes:
                file.seek(note)
                file.write(position.pack(0))  # 0 = no table
            file.seek(contents.end)
            file.write(record_header.pack(RECORD_MAGIC, OniRecord.END, 0, record_header.size, 0, 0))
        yield copy


class _Record(NamedTuple):
    kind: int  # record type, usually an OniRecord
    node: int  # node id
    fields: bytes
    fields_end: int  # bytes, file position after the fields
    end: int  # bytes, file position after the record


def _read_contents(path: Path, file: BinaryIO) -> OniContents:
    wide = _read_version(path, file) >= FIRST_WIDE
    position, record_header = _layouts(wide)
    streams: dict[Stream, Images] = {}
    notes = []
    end, cut_off, largest_node = FILE_HEADER.size, True, 0
    for record in _records(file, record_header):
        end = record.end
        if record.kind == OniRecord.END:
            cut_off = False
            break
        largest_node = max(largest_node, record.node)
        if record.kind in (OniRecord.NODE_ADDED_1_0_0_4, OniRecord.NODE_ADDED_1_0_0_5, OniRecord.NODE_ADDED):
            stream = _added_stream(path, record)
            if stream is not None:
                streams.setdefault(stream, Images(record.node))
            if record.kind == OniRecord.NODE_ADDED:
                notes.append(record.fields_end - position.size)
        elif record.kind == OniRecord.NEW_DATA and len(record.fields) >= IMAGE_FIELDS.size:
            _time, number = IMAGE_FIELDS.unpack_from(record.fields)
            for images in streams.values():
                if images.node == record.node and number:
                    images.count += 1
                    images.last = number
    missing = [stream.name.lower() for stream in Stream if stream not in streams or not streams[stream].count]
    if missing:
        where = f" before the truncation or damage at byte {end}" if cut_off else ""
        raise DataError(f"{path}: expected depth and color images, got no {' and no '.join(missing)}{where}")
    return OniContents(path, streams, end, cut_off, largest_node, wide, tuple(notes))


def _layouts(wide: bool) -> tuple[struct.Struct, struct.Struct]:
    """Return the struct layouts of a file position and a record header."""
    # record header: magic number, record type, node id, sizes of the fields and the payload in bytes, file position
    position = "Q" if wide else "I"
    return struct.Struct(f"<{position}"), struct.Struct(f"<4s4I{position}")


def _read_version(path: Path, file: BinaryIO) -> tuple[int, ...]:
    header = file.read(FILE_HEADER.size)
    if len(header) < FILE_HEADER.size or not header.startswith(FILE_MAGIC):
        raise DataError(f"{path}: expected an OpenNI recording beginning with {FILE_MAGIC!r}, got {header[:4]!r}")
    _magic, *numbers, _time, largest_node = FILE_HEADER.unpack(header)
    version = tuple(numbers)
    if largest_node > LARGEST_NODE:
        raise DataError(f"{path}: header: expected at most {LARGEST_NODE} nodes, got {largest_node}; download it again")
    if not VERSIONS[0] <= version <= VERSIONS[1]:
        first, last, found = (".".join(map(str, one)) for one in (*VERSIONS, version))
        raise DataError(f"{path}: expected format version {first} to {last}, got {found}")
    return version


def _records(file: BinaryIO, header: struct.Struct) -> Iterator[_Record]:
    """Yield the records up to the end record or the first incomplete record."""
    size = file.seek(0, 2)
    position = FILE_HEADER.size
    while position + header.size <= size:
        file.seek(position)
        magic, kind, node, fields_size, payload_size, _undo = header.unpack(file.read(header.size))
        end = position + fields_size + payload_size
        if (
            magic != RECORD_MAGIC
            or not header.size <= fields_size <= LARGEST_FIELDS
            or end > size
            or (node > LARGEST_NODE and kind != OniRecord.END)  # OpenNI 1 ends with node 2^32 - 1, OpenNI 2 with 0
        ):
            return
        yield _Record(kind, node, file.read(fields_size - header.size), position + fields_size, end)
        position = end


def _added_stream(path: Path, record: _Record) -> Stream | None:
    """Return the stream type of an added node, or None for a node other than color or depth."""
    try:
        (name_size,) = struct.unpack_from("<I", record.fields)
        (node_type,) = struct.unpack_from("<I", record.fields, 4 + name_size)
    except struct.error as error:
        raise DataError(
            f"{path}: expected a complete record before byte {record.fields_end}, got a shorter one; download it again"
        ) from error
    return Stream(node_type) if node_type in list(Stream) else None

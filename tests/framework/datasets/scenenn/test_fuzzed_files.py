"""Fuzz tests for every file format. A damaged file must be read, or raise a one-line error with file and position.

The following command tries 5000 cases per format:

    INSTANCEMAP_FUZZ=5000 pytest tests/framework/datasets/scenenn/test_fuzzed_files.py
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from framework.datasets.scenenn.scene_files import read_intrinsics, read_timestamps, read_trajectory_log
from framework.datasets.scenenn.scenenn_annotation import read_annotation
from framework.files.image_files import read_color, read_uint16
from framework.files.ply import read_ply
from tests.support.recordings.damaged_files import EXAMPLES, check, damaged

pytestmark = pytest.mark.integration

PLACE = re.compile(r"(line|byte) \d+")

PLY_HEADER = b"""ply
format %s 1.0
comment two triangles, a square, and an unknown element
element vertex 5
property float x
property double y
property float z
property uchar red
property int label
element face 3
property list uchar int vertex_indices
element edge 1
property short vertex1
property list int float weights
end_header
"""
PLY_ROWS = b"""0 0 0 255 7
1 0 0.5 3 -1
0 1 1e-3 0 934338
1 1 0 12 0
2 2 2 1 1
3 0 1 2
4 0 1 3 2
3 2 1 4
9 2 0.5 1
"""
PLY_TOKENS = (
    b"element vertex 999999999999\n",
    b"element face 1000\n",
    b"property list float int odd\n",
    b"property list uint double odd\n",
    b"property double odd\n",
    b"end_header\n",
    b"comment " + b"x" * 70000,
    b"\r",
)
ANNOTATION = b"""<?xml version="1.0" encoding="utf-8"?>
<annotation>
  <label id="3" color="255 0 0" text="a &lt;b&gt;" nyu_class="chair" aabbox="0 0 0 1 1 1" obbox="0 0 0 1 1 1 0 0 0 1"/>
  <label id="934338" color="0 12 3" text="" nyu_class=""/>
</annotation>
"""
XML_TOKENS = (
    b'<!DOCTYPE a [<!ENTITY b "cccc"><!ENTITY d "&b;&b;&b;&b;">]>',
    b'<!DOCTYPE a [<!ATTLIST label id CDATA "3">]>',
    b'<!DOCTYPE a SYSTEM "file:///etc/passwd">',
    b"&b;",
    b"&#0;",
    b"<![CDATA[",
    b"<!--",
    b"<a>" * 20000,
    b"<label id='5'>",
    b" text='" + b"y" * 100000 + b"'",
    b" xmlns='z'",
    b'encoding="utf-16"',
    b'encoding="hex"',
)
TRAJECTORY = b"""0 0 1
1 0 0 -1.60032
0 1 0 0.995107
0 0 1 -0.243516
0.000000 0.000000 0.000000 1.000000
6 6 7
-0.999735 -0.0221085 -0.00642794 -1.60032
0.0228115 -0.913277 -0.406701 0.995107
0.00312105 -0.406739 0.913539 -0.243516
0.000000 0.000000 0.000000 1.000000
"""
INTRINSICS = b"# asus\ndepth_width 640\nfx 544.47329\nfy = 544.47329\n[center]\ncx: 320\ncy 240\n"


def binary_ply(order: str) -> bytes:
    rows = [(0, 0, 0, 255, 7), (1, 0, 0.5, 3, -1), (0, 1, 1e-3, 0, 934338), (1, 1, 0, 12, 0), (2, 2, 2, 1, 1)]
    faces = [(3, 0, 1, 2), (4, 0, 1, 3, 2), (3, 2, 1, 4)]
    body = b"".join(struct.pack(f"{order}fdfBi", *row) for row in rows)
    body += b"".join(struct.pack(f"{order}B{len(face) - 1}i", *face) for face in faces)
    name = b"binary_little_endian" if order == "<" else b"binary_big_endian"
    return PLY_HEADER % name + body + struct.pack(f"{order}hiff", 9, 2, 0.5, 1)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


COLOR = np.random.default_rng(0).integers(0, 256, (7, 9, 3)).astype(np.uint8)
FORMATS: dict[str, tuple[Callable[[Path], object], bytes, tuple[bytes, ...]]] = {
    "ascii.ply": (read_ply, PLY_HEADER % b"ascii" + PLY_ROWS, PLY_TOKENS),
    "little.ply": (read_ply, binary_ply("<"), PLY_TOKENS),
    "big.ply": (read_ply, binary_ply(">"), PLY_TOKENS),
    "011.xml": (read_annotation, ANNOTATION, XML_TOKENS),
    "trajectory.log": (read_trajectory_log, TRAJECTORY, (b"\n", b"6 6 7\n", b"\r\n", b"0 0 0 0\n")),
    "timestamp.txt": (read_timestamps, b"1 0 0\n2 33312 33333\n3 66700 66667\n", (b"\n", b"3 1 1\n")),
    "asus.ini": (read_intrinsics, INTRINSICS, (b"fx", b"=", b"#", b"cy = 3\n")),
    "color.png": (read_color, png(COLOR), (b"IDAT", b"\x00\x00\x00\x00IEND\xaeB`\x82")),
    "color.jpg": (read_color, cv2.imencode(".jpg", COLOR)[1].tobytes(), (b"\xff\xd9", b"\xff\xc0", b"\xff\xda")),
    "depth.png": (read_uint16, png(COLOR[..., 0].astype(np.uint16) * 20), (b"IHDR",)),
}


@pytest.mark.parametrize("name", FORMATS)
def test_reader_undamaged_file_is_read(name: str, tmp_path: Path) -> None:
    read, content, _ = FORMATS[name]
    assert check(read, tmp_path / name, content) == ""


@pytest.mark.parametrize("name", FORMATS)
def test_reader_damaged_file_is_read_or_raises_one_line_error(name: str, tmp_path: Path) -> None:
    read, content, tokens = FORMATS[name]

    @settings(max_examples=EXAMPLES, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
    @given(damaged(content, tokens))
    def refuse(found: bytes) -> None:
        check(read, tmp_path / name, found)

    refuse()


@pytest.mark.parametrize("name", ["ascii.ply", "little.ply", "big.ply", "011.xml", "trajectory.log"])
def test_reader_truncated_file_error_gives_position(name: str, tmp_path: Path) -> None:
    read, content, _ = FORMATS[name]
    for length in range(len(content.rstrip()) - 1):
        line = check(read, tmp_path / name, content[:length])
        if name != "trajectory.log":
            assert PLACE.search(line), (length, line)


@pytest.mark.parametrize("name", ["color.png", "depth.png"])
def test_png_with_flipped_bit_raises(name: str, tmp_path: Path) -> None:
    read, content, _ = FORMATS[name]
    for k in range(len(content)):
        assert check(read, tmp_path / name, content[:k] + bytes([content[k] ^ 1 << k % 8]) + content[k + 1 :]), k


@settings(max_examples=EXAMPLES, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_png_damaged_with_valid_crc_is_read_or_raises(tmp_path_factory, data: st.DataObject) -> None:
    content = FORMATS["color.png"][1]
    chunks, position = [], 8
    while position < len(content):
        length = int.from_bytes(content[position : position + 4], "big")
        chunks.append((content[position + 4 : position + 8], content[position + 8 : position + 8 + length]))
        position += length + 12
    k = data.draw(st.integers(0, len(chunks) - 1))
    chunks[k] = chunks[k][0], data.draw(damaged(chunks[k][1] or b"\0", (b"\0" * 1000, b"IDAT")))
    if data.draw(st.booleans()):
        chunks.insert(data.draw(st.integers(0, len(chunks))), chunks[data.draw(st.integers(0, len(chunks) - 1))])
    built = content[:8] + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    )
    check(read_color, tmp_path_factory.mktemp("png") / "color.png", built)


def test_image_reader_oversized_header_raises_before_decoding(tmp_path: Path) -> None:
    content = FORMATS["color.png"][1]
    header = b"IHDR" + struct.pack(">II", 100000, 100000) + content[24:29]
    huge = content[:12] + header + struct.pack(">I", zlib.crc32(header)) + content[33:]
    assert "got 100000x100000 px" in check(read_color, tmp_path / "huge.png", huge)
    start = FORMATS["color.jpg"][1].index(b"\xff\xc0") + 5
    jpg = FORMATS["color.jpg"][1]
    huge = jpg[:start] + struct.pack(">HH", 60000, 60000) + jpg[start + 4 :]
    assert "got 60000x60000 px" in check(read_color, tmp_path / "huge.jpg", huge)

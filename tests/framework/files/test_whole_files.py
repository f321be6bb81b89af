"""What every reader of whole files does with one that is too large, or begins with a byte order mark."""

from __future__ import annotations

from codecs import BOM_UTF8
from collections.abc import Callable
from pathlib import Path

import pytest

from framework.datasets.camera_json import read_json_object
from framework.datasets.scannet.scannet_annotation import read_label_table
from framework.datasets.scenenn.intrinsics import read_intrinsics
from framework.datasets.scenenn.scenenn_annotation import read_annotation
from framework.datasets.scenenn.timestamps import read_timestamps
from framework.datasets.scenenn.trajectory_log import read_trajectory_log
from framework.detection.coco_results import CategoryIds, read_results
from framework.errors import DataError, FrameError
from framework.files.image_files import read_color, read_uint16
from framework.files.matrix_file import read_matrix_lines
from framework.files.ply import read_ply
from framework.files.tum_trajectory import read_tum
from framework.files.whole_files import read_text
from framework.label_spaces import COCO, read_labels


@pytest.mark.parametrize(
    ("read", "most"),
    [
        (read_text, 2**28),
        (read_tum, 2**28),
        (read_matrix_lines, 2**28),
        (read_timestamps, 2**28),
        (read_trajectory_log, 2**28),
        (read_json_object, 2**28),
        (read_ply, 2**32),
        (read_color, 2**28),
        (read_uint16, 2**28),
    ],
)
def test_a_file_that_is_too_large_is_refused_before_it_is_read(
    tmp_path: Path, read: Callable[[Path], object], most: int
) -> None:
    with (tmp_path / "large").open("wb") as file:
        file.truncate(most + 1)
    with pytest.raises(DataError, match=rf"large has {most + 1} bytes, more than the {most} that") as caught:
        read(tmp_path / "large")
    assert isinstance(caught.value, FrameError) == (read in (read_color, read_uint16))


@pytest.mark.parametrize(
    ("read", "content"),
    [
        (read_text, b"of 2016\n"),
        (read_tum, b"0.5 1 2 3 0 0 0 1\n"),
        (read_matrix_lines, b"1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n"),
        (read_timestamps, b"1 0 0\n"),
        (read_trajectory_log, b"0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"),
        (read_intrinsics, b"fx 1\nfy 2\ncx 3\ncy 4\n"),
        (read_json_object, b'{"width": 3}'),
        (read_label_table, b"raw_category\tnyu40class\ndesk\tdesk\n"),
        (read_annotation, b'<?xml version="1.0"?><annotation><label id="1"/></annotation>'),
        (lambda path: read_labels(str(path)), b"cup\nchair\n"),
        (lambda path: read_results(path, COCO, CategoryIds.FROM_ONE), b"[]"),
    ],
)
def test_a_byte_order_mark_is_left_out(tmp_path: Path, read: Callable[[Path], object], content: bytes) -> None:
    plain, marked = tmp_path / "plain", tmp_path / "marked"
    plain.write_bytes(content)
    marked.write_bytes(BOM_UTF8 + content)
    assert repr(read(marked)).replace("marked", "plain") == repr(read(plain))

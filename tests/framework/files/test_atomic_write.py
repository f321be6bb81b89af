"""Tests for atomic writes and for file readers."""

from __future__ import annotations

import errno
import os
from codecs import BOM_UTF8
from collections.abc import Callable
from pathlib import Path

import pytest

from framework.api import load_map
from framework.datasets.calibration.camera_json import read_json_object
from framework.datasets.scannet.scannet_annotation import read_label_table
from framework.datasets.scannet.sens_file import open_sens
from framework.datasets.scenenn.scene_files import read_intrinsics, read_timestamps, read_trajectory_log
from framework.datasets.scenenn.scenenn_annotation import read_annotation
from framework.detection.mask_rcnn.checkpoint import read_network
from framework.detection.mask_rcnn.detectron2_checkpoint import read_pickle
from framework.detection.stored.coco_results import read_results
from framework.errors import ConfigError, DataError, FrameError
from framework.files.atomic_write import atomic_write, make_folder, read_bytes, read_text
from framework.files.hashing import path_hash
from framework.files.image_files import read_color, read_uint16
from framework.files.json_file import read_json
from framework.files.number_lines import read_matrix_lines
from framework.files.ply import read_ply
from framework.files.tum_trajectory import read_tum
from framework.runs.stored_runs import read_yaml
from framework.runs.timings_file import read_timings
from framework.vocabulary.category_ids import CategoryIds
from framework.vocabulary.label_spaces import COCO, read_labels
from tests.support.failing_disk import FailingDisk, Fault


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
def test_reader_oversized_file_raises_before_reading(tmp_path: Path, read: Callable[[Path], object], most: int) -> None:
    with (tmp_path / "large").open("wb") as file:
        file.truncate(most + 1)
    with pytest.raises(DataError, match=rf"large: expected at most {most} bytes, got {most + 1}") as caught:
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
def test_reader_ignores_byte_order_mark(tmp_path: Path, read: Callable[[Path], object], content: bytes) -> None:
    plain, marked = tmp_path / "plain", tmp_path / "marked"
    plain.write_bytes(content)
    marked.write_bytes(BOM_UTF8 + content)
    assert repr(read(marked)).replace("marked", "plain") == repr(read(plain))


READERS = (
    *(read_text, read_tum, read_matrix_lines, read_timestamps, read_trajectory_log, read_json_object, read_ply),
    *(read_color, read_uint16, read_json, read_yaml, read_timings, read_annotation, read_intrinsics, path_hash),
    *(load_map, open_sens, read_network, read_pickle, lambda path: read_bytes(path, 10)),
    lambda path: read_results(path, COCO, CategoryIds.FROM_ONE),
)


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize("kind", ["pipe", "/dev/zero", "/dev/null", "folder"])
def test_reader_non_regular_file_raises_without_blocking(
    tmp_path: Path, read: Callable[[Path], object], kind: str
) -> None:
    """A pipe without a writer would block, and /dev/zero has no end."""
    path = tmp_path / "name"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        if read is path_hash:
            return  # path_hash accepts folders
        path.mkdir()
    else:
        path.symlink_to(kind)
    with pytest.raises(DataError, match=f"{path}: expected a regular file, got a") as caught:
        read(path)
    assert "\n" not in str(caught.value)


def test_read_labels_from_named_pipe_raises(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "labels.txt")
    with pytest.raises(ConfigError, match=r"label_space: expected one of .*, or a text file with one name per line"):
        read_labels(str(tmp_path / "labels.txt"))


@pytest.mark.parametrize("kind", ["pipe", "/dev/full", "/dev/null", "folder"])
def test_atomic_write_to_non_regular_file_raises(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "out.json"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to(kind)
    before = path.stat().st_mode
    with pytest.raises(DataError, match=": expected a regular file, got a"), atomic_write(path) as temporary:
        temporary.write_text("{}")
    assert path.stat().st_mode == before
    assert list(tmp_path.iterdir()) == [path]


def test_atomic_write_follows_symbolic_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    for target in (tmp_path / "real" / "there.txt", tmp_path / "real" / "not_yet.txt"):
        link = tmp_path / f"to_{target.name}"
        link.symlink_to(target)
        with atomic_write(link) as temporary:
            assert temporary.parent == target.parent
            temporary.write_text("new")
        assert link.is_symlink()
        assert target.read_text() == "new"
        assert not target.is_symlink()


def test_atomic_write_failure_names_requested_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The temporary file is not named, even if its removal fails on a read-only disk."""

    def refused(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "unlink", refused)
    with (
        pytest.raises(DataError, match=r"page\.html: expected a writable file, got an error \(Read-only"),
        atomic_write(tmp_path / "page.html"),
    ):
        refused()


def test_atomic_write_syncs_file_and_folder(tmp_path: Path) -> None:
    disk = FailingDisk(-1, Fault.FAILS)
    with disk.active(), atomic_write(tmp_path / "page.html") as temporary:
        temporary.write_text("new")
    operations = [name for name in disk.operations if name in ("fsync", "replace")]
    assert operations == ["fsync", "replace", "fsync"]


def test_make_folder_syncs_all_parents(tmp_path: Path) -> None:
    disk = FailingDisk(-1, Fault.FAILS)
    with disk.active():
        make_folder(tmp_path / "a" / "b")
        assert (tmp_path / "a" / "b").is_dir()
        assert disk.operations.count("fsync") == 2
        make_folder(tmp_path / "a" / "b")
    assert disk.operations.count("fsync") == 2


def test_atomic_write_invalid_unicode_error_names_file(tmp_path: Path) -> None:
    with (
        pytest.raises(DataError, match=r"table\.md: expected text that is valid Unicode, got '\\udcff'"),
        atomic_write(tmp_path / "table.md") as temporary,
    ):
        temporary.write_text("room \udcff", "utf-8")
    assert not [*tmp_path.iterdir()]

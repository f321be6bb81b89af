"""Tests for map files, including damaged files."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from framework.errors import DataError
from framework.files.manifest import Manifest, RunStatus
from framework.mapping.storage.map_file import map_contents, write_map
from framework.mapping.storage.map_header import MapHeader

RNG = np.random.default_rng(0)
HEADER = {"format": 7, "names": ["a", "b"], "none": None}
ARRAYS = {
    "noise": RNG.integers(-(2**15), 2**15, (300, 512), np.int16),
    "few": RNG.integers(0, 3, (64, 512, 4), np.int32),
    "zeros": np.zeros((1000, 512), np.float32),
    "strided": RNG.normal(0, 1, (40, 60)).astype(np.float32)[::2, ::3],
    "flags": np.array([True, False]),
    "empty": np.zeros((0, 512), np.uint8),
}
STORED = ("noise", "strided", "empty")


def read_map(path: Path, expected_format: int) -> tuple[MapHeader, dict[str, np.ndarray]]:
    with map_contents(path, expected_format, list(ARRAYS)) as contents:
        return contents


def with_manifest(path: Path) -> Path:
    """Add a manifest that lists the file."""
    Manifest(RunStatus.COMPLETE, {}, {}, {}).with_files(path.parent, [path.name]).write(path.parent)
    return path


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    write_map(tmp_path / "map.npz", HEADER, ARRAYS, stored=STORED)
    return tmp_path / "map.npz"


@pytest.mark.parametrize("prepared", [Path, with_manifest])
def test_map_file_round_trip_keeps_header_and_arrays(saved: Path, prepared: Callable[[Path], Path]) -> None:
    prepared(saved)
    header, arrays = read_map(saved, 7)
    assert header.values == HEADER
    with np.load(saved) as file:
        assert file.files == ["header", *ARRAYS]
        for name, array in ARRAYS.items():
            for found in (arrays[name], file[name]):
                assert found.dtype == array.dtype
                np.testing.assert_array_equal(found, array)


def test_map_file_is_reproducible(saved: Path, tmp_path: Path) -> None:
    write_map(tmp_path / "again.npz", HEADER, {name: array.copy() for name, array in ARRAYS.items()}, STORED)
    assert (tmp_path / "again.npz").read_bytes() == saved.read_bytes()
    with zipfile.ZipFile(saved) as archive:
        assert {info.date_time for info in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}, (
            "expected a fixed date, so that files are reproducible"
        )


def test_map_file_is_compressed_at_level_1(saved: Path) -> None:
    with zipfile.ZipFile(saved) as archive:
        sizes = {info.filename: info.compress_size for info in archive.infolist()}
        few = archive.read("few.npy")
    assert sizes["few.npy"] < len(few) / 4
    assert sizes["zeros.npy"] < 20000
    by_zlib = zlib.compressobj(1, wbits=-15)
    assert sizes["few.npy"] == len(by_zlib.compress(few) + by_zlib.flush())


def test_map_file_stored_arrays_are_not_compressed(saved: Path) -> None:
    with zipfile.ZipFile(saved) as archive:
        stored = {info.filename for info in archive.infolist() if info.compress_type == zipfile.ZIP_STORED}
    assert stored == {f"{name}.npy" for name in STORED}


@pytest.mark.parametrize("name", ["header", "noise", "few", "strided"])
def test_map_file_changed_byte_raises(saved: Path, name: str) -> None:
    content = bytearray(saved.read_bytes())
    with zipfile.ZipFile(saved) as archive:
        info = archive.getinfo(f"{name}.npy")
    data = info.header_offset + 30 + len(info.filename) + 20  # after the header with 64-bit sizes
    content[data + info.compress_size // 2] ^= 0x10
    saved.write_bytes(content)
    with pytest.raises(DataError, match=r"map\.npz"):
        read_map(saved, 7)


@pytest.mark.parametrize("name", ["header", *ARRAYS])
def test_map_file_changed_byte_is_reported_as_difference_from_manifest(saved: Path, name: str) -> None:
    changed = bytearray(with_manifest(saved).read_bytes())
    with zipfile.ZipFile(saved) as archive:
        changed[archive.getinfo(f"{name}.npy").header_offset + 70] ^= 0x10  # in the header of the array
    saved.write_bytes(changed)
    with pytest.raises(DataError, match=rf"^{saved}: expected the SHA-256 \w+ of manifest.json, got "):
        read_map(saved, 7)


def test_map_file_error_in_body_of_unchanged_file_contains_path(saved: Path) -> None:
    with (
        pytest.raises(DataError, match=rf"^{saved}: expected 3 classes; map again"),
        map_contents(with_manifest(saved), 7, []),
    ):
        raise DataError("expected 3 classes")


def test_map_file_of_other_format_raises(saved: Path) -> None:
    with pytest.raises(DataError, match="expected map format 8, got 7"):
        read_map(saved, 8)

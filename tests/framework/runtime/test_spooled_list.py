"""Tests for lists in a temporary file."""

from __future__ import annotations

import errno
import tempfile
import tracemalloc
from pathlib import Path

import pytest

from framework.runtime.spooled_list import CHUNK, Spool, SpooledList


@pytest.mark.parametrize("length", [0, 1, CHUNK, 3 * CHUNK + 5])
def test_spooled_lists_of_one_file_match_lists(tmp_path: Path, length: int) -> None:
    spool = Spool(tmp_path)
    found: tuple[SpooledList[tuple[int, str]], SpooledList[float]] = SpooledList(spool), SpooledList(spool)
    expected = [(k, f"stage {k}") for k in range(length)], [k / 3 for k in range(length)]
    for item, number in zip(*expected, strict=True):
        found[0].append(item)
        found[1].extend([number])
    for rows, plain in zip(found, expected, strict=True):
        assert len(rows) == length
        assert list(rows) == list(rows) == plain
        assert rows[5:-5:7] == plain[5:-5:7]
        assert [rows[k] for k in range(-length, length)] == [*plain, *plain]
        with pytest.raises(IndexError):
            rows[length]
    found[0].clear()
    found[0].append((1, ""))
    assert (list(found[0]), list(found[1])) == ([(1, "")], expected[1])
    assert not list(tmp_path.iterdir()), "expected an unnamed file"


def test_spooled_list_on_full_disk_stays_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The disk is full in the middle of the second chunk."""

    class SmallDisk:
        def __init__(self) -> None:
            self.file = tempfile.TemporaryFile(buffering=0, dir=tmp_path)  # noqa: SIM115
            self.room = 600

        def write(self, content: bytes) -> int:
            written = content[: min(self.room, 100)]
            self.room -= len(written)
            if not written:
                raise OSError(errno.ENOSPC, "No space left on device")
            return int(self.file.write(written))

        def __getattr__(self, name: str) -> object:
            return getattr(self.file, name)

    disk = SmallDisk()
    monkeypatch.setattr("tempfile.TemporaryFile", lambda **_: disk)
    rows: SpooledList[int] = SpooledList(Spool(tmp_path))
    rows.extend(range(4 * CHUNK + 1))
    assert list(rows) == list(range(4 * CHUNK + 1))
    [record] = caplog.records
    assert record.getMessage() == (
        f"{tmp_path}: expected a writable disk for the frame data of the run, got an error (No space left on device); "
        "keeping them in memory"
    )


def test_spooled_list_needs_no_memory_per_item(tmp_path: Path) -> None:
    rows: SpooledList[str] = SpooledList(Spool(tmp_path))
    rows.extend(str(k) for k in range(10 * CHUNK))
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    rows.extend(str(k) for k in range(1000 * CHUNK))
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 0.2 * 1000 * CHUNK

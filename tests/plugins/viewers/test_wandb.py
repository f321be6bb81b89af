"""Tests for viewer=wandb. The offline logs are read in the format of Weights & Biases."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.tracked_run import FRAMES, TrackedRun, tracked_run

wandb = pytest.importorskip("wandb", reason="requires wandb (extra wandb)")

pytestmark = pytest.mark.integration

BLOCK, HEADER = 32768, 7  # bytes, size of a block and of a chunk header in the log format of LevelDB
WHOLE, FIRST, MIDDLE, LAST = 1, 2, 3, 4  # kinds of chunks


def records(run: TrackedRun) -> Iterator[Any]:
    """Yield the records of the offline log, which has a header of 7 bytes and then the log format of LevelDB."""
    from wandb.proto import wandb_internal_pb2

    [file] = (run.directory / "wandb").glob("offline-run-*/run-*.wandb")
    data, k, message = file.read_bytes(), HEADER, b""
    while k + HEADER <= len(data):
        if BLOCK - k % BLOCK < HEADER:  # padding at the end of a block
            k += BLOCK - k % BLOCK
            continue
        _, length, kind = struct.unpack("<IHB", data[k : k + HEADER])
        message = (b"" if kind in (WHOLE, FIRST) else message) + data[k + HEADER : k + HEADER + length]
        k += HEADER + length
        if kind in (WHOLE, LAST):
            record = wandb_internal_pb2.Record()
            record.ParseFromString(message)
            yield record


def items(entries: Any) -> dict[str, Any]:
    return {entry.key or ".".join(entry.nested_key): json.loads(entry.value_json) for entry in entries}


@pytest.mark.parametrize(("capacity", "steps", "exit_code"), [(100, FRAMES, 0), (1, 1, 1)])
def test_wandb_log_contains_frames_and_metrics(tmp_path: Path, capacity: int, steps: int, exit_code: int) -> None:
    run = tracked_run(tmp_path, "viewer=wandb", f"fuser.capacity={capacity}", returncode=3 if exit_code else 0)
    found = list(records(run))
    rows = [items(record.history.item) for record in found if record.HasField("history")]
    series: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        for key in filter(lambda key: key.startswith("frame/"), row):
            series.setdefault(key, []).append((row["_step"], row[key]))
    summary: dict[str, Any] = {}
    for record in found:
        if record.HasField("summary"):
            summary |= items(record.summary.update)
    run.check(series, summary, steps)
    assert summary["run/status"].startswith("fuser.capacity: expected at most" if exit_code else "completed")
    [start] = [record.run for record in found if record.HasField("run")]
    assert (start.project, start.display_name, start.run_group) == ("instancemap", "run", tmp_path.name)
    assert items(start.config.update)["dataset.frames"] == FRAMES
    assert [record.exit.exit_code for record in found if record.HasField("exit")] == [exit_code]
    assert any(key.startswith("run/overview") for row in rows for key in row)

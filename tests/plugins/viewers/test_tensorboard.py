"""Tests for viewer=tensorboard. The logs are read with TensorBoard."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from framework.errors import ConfigError
from plugins.viewers import tensorboard as plugin
from tests.support.tracked_run import FRAMES, tracked_run

pytestmark = pytest.mark.integration


def read(folder: Path) -> Any:
    pytest.importorskip("tensorboard", reason="requires tensorboard (extra tensorboard)")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    return events


def series_of(events: Any, prefix: str) -> dict[str, list[tuple[int, float]]]:
    tags = [tag for tag in events.Tags()["scalars"] if tag.startswith(prefix)]
    return {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in tags}


def status_of(events: Any) -> str:
    [text] = events.Tensors("run/status/text_summary")[-1].tensor_proto.string_val
    return str(text.decode())


def test_tensorboard_reads_frames_and_metrics_of_last_run(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="requires tensorboard (extra tensorboard)")
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

    for _ in range(2):  # the second run replaces the first one
        run = tracked_run(tmp_path, "viewer=tensorboard")
    events = read(run.directory / "tensorboard")
    last = {tag: values[-1][1] for tag, values in series_of(events, "run/").items()}
    run.check(series_of(events, "frame/"), last, FRAMES)
    assert status_of(events) == "completed"
    assert events.Tags()["images"] == ["run/overview"]
    content = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    parameters = HParamsPluginData.FromString(content).session_start_info.hparams
    assert parameters["dataset.frames"].number_value == FRAMES
    assert parameters["dataset._target_"].string_value == "tests.support.scenes.corner_room.CornerRoom"


def test_tensorboard_reads_reason_for_partial_run(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="requires tensorboard (extra tensorboard)")
    run = tracked_run(tmp_path, "viewer=tensorboard", "fuser.capacity=1", returncode=3)
    events = read(run.directory / "tensorboard")
    run.check(series_of(events, "frame/"), {tag: values[-1][1] for tag, values in series_of(events, "run/").items()}, 1)
    assert status_of(events).startswith("fuser.capacity: expected at most 1 frames")


def test_tensorboard_missing_package_error_names_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(ConfigError, match=r"^viewer: expected the package tensorboard, .*'instancemap\[tensorboard]'$"):
        plugin.TensorBoardViewer()

"""Tests for run sources, which read the sequence of a stored run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from framework.geometry import inverse
from framework.reporting.run_contents import RunContents
from framework.reporting.run_source import MIN_CLARITY, Footage, RunSource, TruePath
from framework.runs.provenance import config_hash
from framework.runtime.run_log import STAGES
from tests.support.reported_run import unverified_copy, write_run
from tests.support.scenes.corner_room import pose_at

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("fakes_registered")]


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture
def directory(mapped: Path, tmp_path: Path) -> Path:
    """Return a copy of a run of six frames."""
    return unverified_copy(mapped, tmp_path / "run")


def change_config(directory: Path, **dataset: Any) -> None:
    """Replace the dataset in the stored config, and update the config hash."""
    config = OmegaConf.load(directory / "config.yaml")
    config.dataset = dataset
    OmegaConf.save(config, directory / "config.yaml")
    metrics = json.loads((directory / "metrics.json").read_text())
    metrics["config_hash"] = config_hash(OmegaConf.to_container(config))
    (directory / "metrics.json").write_text(json.dumps(metrics))


def test_run_source_frames_match_poses_after_skipped_frame(tmp_path: Path) -> None:
    contents = RunContents.read(write_run(tmp_path / "run", unreadable=2, frames=6))
    assert contents.tracked_frames == (0, 1, 3, 4, 5)
    recording = RunSource.of(contents)
    assert recording.why_not == ""
    frames = [recording.frame(k) for k in range(5)]
    assert [frame.index for frame in frames if frame is not None] == [0, 1, 3, 4, 5]


def test_run_contents_frames_without_pose_are_lost(directory: Path) -> None:
    lines = (directory / "timings.csv").read_text().splitlines()
    after_tracking = tuple(f"2,{stage}" for stage in STAGES[STAGES.index("lifting") :])
    stopped = [line for line in lines if not line.startswith(after_tracking)]
    (directory / "timings.csv").write_text("\n".join(stopped) + "\n")
    poses = (directory / "trajectory.txt").read_text().splitlines()
    (directory / "trajectory.txt").write_text("\n".join(poses[:2] + poses[3:]) + "\n")
    contents = RunContents.read(directory)
    assert (contents.tracked_frames, contents.lost_frames) == ((0, 1, 3, 4, 5), (2,))
    frame = RunSource.of(contents).frame(2)
    assert frame is not None
    assert frame.index == 3


@pytest.mark.parametrize(
    ("dataset", "message"),
    [
        ({"_target_": "tests.support.scenes.corner_room.LiveRoom"}, "the run mapped a live camera"),
        (
            {"_target_": "tests.support.scenes.corner_room.CornerRoom", "start": 1},
            "the first frame differs from the first frame of the run",
        ),
        ({"_target_": "os.system"}, "expected the _target_ of a registered option of"),
        (
            {"_target_": "tests.support.scenes.corner_room.CornerRoom", "scene": "${oc.env:HOME}"},
            "expected a resolved value",
        ),
    ],
)
def test_run_source_other_dataset_is_rejected_with_reason(directory: Path, dataset: dict, message: str) -> None:
    change_config(directory, **dataset)
    recording = RunSource.of(RunContents.read(directory))
    assert message in recording.why_not
    assert recording.frame(0) is None
    assert recording.camera is None
    truth, why = recording.scene_truth()
    assert truth is None
    assert message in why


def test_run_source_changed_truth_is_rejected_with_reason(directory: Path) -> None:
    contents = RunContents.read(directory)
    assert RunSource.of(contents).scene_truth()[0] is not None
    metrics = json.loads((directory / "metrics.json").read_text()) | {"truth_sha256": "0" * 64}
    (directory / "metrics.json").write_text(json.dumps(metrics))
    truth, why = RunSource.of(RunContents.read(directory)).scene_truth()
    assert truth is None
    assert "the ground-truth instances differ from those used in the run" in why


def test_footage_has_images_true_poses_and_sharpness(mapped: Path) -> None:
    recording = RunSource.of(RunContents.read(mapped))
    assert recording.camera is not None
    footage = Footage.of(recording, [0, 3], recording.camera)
    assert footage.frames == {0: 0, 3: 3}
    np.testing.assert_array_equal(footage.true_positions[3], pose_at(3)[:3, 3])
    assert all(MIN_CLARITY <= value <= 1 for value in footage.clarity.values())
    assert max(footage.clarity.values()) == 1
    assert footage.images[0].shape == (*footage.camera.shape, 3)


def test_true_path_is_aligned_to_trajectory() -> None:
    true = np.array([pose_at(20 * k) for k in range(6)])
    T_map_world = pose_at(77)
    poses = np.array([T_map_world @ T for T in true])
    path = TruePath.of(poses, {k: true[k][:3, 3] for k in (0, 1, 3, 5)})
    assert path is not None
    assert path.chosen == [0, 1, 3, 5]
    np.testing.assert_allclose(path.errors, 0, atol=1e-9)
    np.testing.assert_allclose(path.positions, poses[path.chosen, :3, 3], atol=1e-9)
    assert np.abs(inverse(T_map_world)[:3, 3]).max() > 0.1, "expected different world frames"
    assert TruePath.of(poses, {0: true[0][:3, 3], 1: true[1][:3, 3]}) is None

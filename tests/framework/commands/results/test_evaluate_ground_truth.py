"""Tests for runs that use the map of another run as ground truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from omegaconf import OmegaConf

from framework.commands.results.evaluate import evaluate_runs
from framework.commands.running.run import run
from framework.config import composition
from framework.evaluation.instances import Transfer
from framework.figures.experiment_figure import _truth
from framework.files.ply import read_ply, write_ply
from framework.files.tum_trajectory import read_tum, write_tum
from framework.reporting.run_contents import RunContents
from framework.reporting.run_source import RunSource
from framework.runs.inputs import inputs_sha256
from framework.runs.stored_runs import read_record
from framework.testing.corner_room import CAMERA, RATE, frame_at, pose_at
from tests.support import reported_run
from tests.support.reported_run import unverified_copy

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("fakes_registered")]
FRAMES = 6


def write_folder(root: Path) -> None:
    """Write the corner room as an RGB-D folder without poses or annotation."""
    for name in ("color", "depth"):
        (root / name).mkdir(parents=True)
    camera = {key: getattr(CAMERA, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    (root / "camera.json").write_text(json.dumps(camera | {"depth_scale": 10000}))
    for k in range(FRAMES):
        frame = frame_at(k)
        cv2.imwrite(str(root / f"color/{k:06d}.png"), frame.color[..., ::-1])
        cv2.imwrite(str(root / f"depth/{k:06d}.png"), np.rint(frame.depth * 10000).astype(np.uint16))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the run `reference`, made with true masks and poses, and two recordings of its frames."""
    place = tmp_path_factory.mktemp("truth")
    reported_run.write_run(place / "reference")
    for name in ("posed", "unposed"):
        write_folder(place / name)
    write_tum(place / "posed" / "poses.txt", [k / RATE for k in range(FRAMES)], [pose_at(k) for k in range(FRAMES)])
    return place


def mapped(directory: Path, root: Path, **changes: Any) -> dict[str, Any]:
    """Map the recording in `root` into the run directory `directory` and return the metrics."""
    dataset = {"_target_": "framework.datasets.rgbd_folder.RgbdFolder", "root": str(root)}
    config = reported_run.CONFIG | {
        "dataset": dataset | changes.pop("dataset", {}),
        "detector": {"_target_": "plugins.detectors.ground_truth.GroundTruthDetector"},
        **changes,
    }
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(composition, "_added", [reported_run.FAKES])
        run(OmegaConf.create(config), directory, {})
    return metrics_of(directory)


def metrics_of(directory: Path) -> dict[str, Any]:
    metrics: dict[str, Any] = json.loads((directory / "metrics.json").read_text())
    return metrics


def evaluated(directory: Path, ground_truth: Path | None) -> int:
    named = None if ground_truth is None else str(ground_truth)
    return evaluate_runs([directory], Transfer.TO_TRUTH, write=True, ground_truth=named)


def tracker(made: Path) -> dict[str, str]:
    """Return the config of a tracker that returns the poses of the reference run."""
    path = made / "reference" / "trajectory.txt"
    return {"_target_": "plugins.trackers.trajectory_file.TrajectoryFile", "path": str(path)}


@pytest.mark.parametrize("name", ["posed", "unposed"])
def test_ground_truth_of_another_run_gives_metrics(made: Path, tmp_path: Path, name: str) -> None:
    named = {"ground_truth": str(made / "reference")}
    changes = {"tracker": tracker(made)} if name == "unposed" else {}
    metrics = mapped(tmp_path / "run", made / name, dataset=named, **changes)
    assert metrics["instances.ap50"] == 1.0
    assert metrics["instances.mean_iou"] > 0.9
    assert metrics["annotation_release"] == "reference/mesh.ply"


def test_ground_truth_run_aligns_unposed_map(made: Path, tmp_path: Path) -> None:
    """The world frame of the reference is shifted by 0.5 m along x."""
    reference = unverified_copy(made / "reference", tmp_path / "reference")
    shift = np.eye(4)
    shift[0, 3] = 0.5
    ply, (times, poses) = read_ply(reference / "mesh.ply"), read_tum(reference / "trajectory.txt")
    moved = (ply.vertices + shift[:3, 3]).astype(np.float32)
    write_ply(reference / "mesh.ply", moved, ply.triangles, ply.properties, ply.comments)
    write_tum(reference / "trajectory.txt", times, shift @ poses)
    named = {"ground_truth": str(reference)}
    assert mapped(tmp_path / "run", made / "unposed", dataset=named, tracker=tracker(made))["instances.ap50"] == 1.0
    write_tum(reference / "trajectory.txt", times, poses)  # the poses no longer match the mesh
    assert evaluated(tmp_path / "run", reference) == 0
    assert metrics_of(tmp_path / "run")["instances.ap50"] == 0.0


def test_evaluate_changes_ground_truth_of_finished_run(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The new ground truth is stored, so later evaluations, reports and figures use it."""
    fake = {"_target_": "plugins.detectors.none.NoDetections"}
    directory = tmp_path / "run"
    assert "instances.ap50" not in mapped(directory, made / "posed", detector=fake)
    assert evaluated(directory, None) == 0
    assert "instances.ap50" not in metrics_of(directory)
    assert evaluated(directory, made / "reference") == 0
    first = metrics_of(directory)
    assert (first["instances.ap50"], first["instances.true_count"]) == (0.0, 2)
    assert first["evaluation.ground_truth"] == str(made / "reference")
    capsys.readouterr()
    assert evaluated(directory, None) == 0
    assert capsys.readouterr().out == f"{directory}: unchanged\n"
    assert metrics_of(directory) == first
    truth, why = RunSource.of(RunContents.read(directory)).scene_truth()
    assert (truth is not None, why) == (True, "")
    drawn = _truth(read_record(directory))
    assert drawn is not None
    np.testing.assert_array_equal(drawn.instance_ids, truth.instance_ids)


def test_evaluate_unusable_ground_truth_is_one_line_error(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = tmp_path / "run"
    mapped(directory, made / "posed", dataset={"ground_truth": str(made / "reference")})
    before = (directory / "metrics.json").read_bytes()
    assert evaluated(directory, tmp_path / "nowhere") == 1
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    assert "dataset.ground_truth: expected a labeled mesh (PLY) or a run directory, got" in error
    assert (directory / "metrics.json").read_bytes() == before


def test_evaluate_repeated_gives_identical_metrics(made: Path, tmp_path: Path) -> None:
    reference = made / "reference"
    before = mapped(tmp_path / "run", made / "unposed", dataset={"ground_truth": str(reference)}, tracker=tracker(made))
    assert evaluated(tmp_path / "run", None) == 0
    after = metrics_of(tmp_path / "run")
    assert {key: value for key, value in after.items() if not key.startswith("evaluation.")} == before


def test_inputs_hash_includes_ground_truth_files(made: Path, tmp_path: Path) -> None:
    mesh, names = tmp_path / "mesh.ply", tmp_path / "instances.json"
    mesh.write_text("a mesh")
    names.write_text("{}")
    config = {"dataset": {"root": str(made / "posed"), "ground_truth": str(mesh)}}
    before = inputs_sha256(config)
    names.write_text('{"1": {"class": "cup"}}')
    assert inputs_sha256(config) != before
    names.unlink()
    assert inputs_sha256(config) != before

"""Tests for the command `raycast`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from framework.commands.results import raycast
from framework.data import View
from framework.figures import raycast_figure
from framework.files.tum_trajectory import read_tum, write_tum
from framework.reporting.run_source import RunSource
from framework.reporting.visibility import NOT_CAMERA
from tests.support.command_call import call_command
from tests.support.reported_run import unverified_copy, write_run

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("fakes_registered")]

Command = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture
def stored(mapped: Path, tmp_path: Path) -> Path:
    """Return the directory of a run that is lost in frame 2."""
    run = unverified_copy(mapped, tmp_path / "run")
    timestamps, poses = read_tum(run / "trajectory.txt")
    write_tum(run / "trajectory.txt", np.delete(timestamps, 2), np.delete(poses, 2, axis=0))
    lines = (run / "timings.csv").read_text().splitlines(keepends=True)
    of_tracking = ("2,reading", "2,detection", "2,tracking")
    kept = [line for line in lines if not line.startswith("2,") or line.startswith(of_tracking)]
    (run / "timings.csv").write_text("".join(kept))
    return run


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Return a function that runs the command in this process and returns the status, stdout and stderr."""

    def start(*arguments: object) -> tuple[int, str, str]:
        return call_command(raycast, arguments, monkeypatch, capsys)

    return start


@pytest.fixture
def views(monkeypatch: pytest.MonkeyPatch) -> list[tuple[View, str]]:
    """Return a list that collects each drawn view and its note."""
    drawn: list[tuple[View, str]] = []
    write = raycast_figure.write_raycast

    def noted(path: Path, view: View, names: dict[int, str], centers: dict[int, np.ndarray], note: str) -> None:
        drawn.append((view, note))
        write(path, view, names, centers, note)

    monkeypatch.setattr(raycast_figure, "write_raycast", noted)
    return drawn


def test_raycast_draws_middle_frame_by_default(stored: Path, command: Command, views: list[tuple[View, str]]) -> None:
    status, out, err = command(stored)
    assert (status, err) == (0, "")
    assert out == f"{stored / 'raycast.png'}\n"
    assert (stored / "raycast.png").read_bytes()[1:4] == b"PNG"
    [(view, note)] = views
    assert "frame 3," in note, "expected the middle one of the mapped frames 0, 1, 3, 4 and 5"
    np.testing.assert_allclose(view.T_world_camera, read_tum(stored / "trajectory.txt")[1][2])
    assert (view.depth > 0).mean() > 0.5
    assert view.instance_ids.any()


def test_raycast_draws_chosen_frame_or_pose(
    stored: Path, command: Command, views: list[tuple[View, str]], tmp_path: Path
) -> None:
    assert command(stored, "--frame", 4, "--out", tmp_path / "frame.png")[0] == 0
    line = (stored / "trajectory.txt").read_text().splitlines()[3].split()
    assert command(stored, "--pose", *line[1:], "--out", tmp_path / "pose.png")[0] == 0
    assert "frame 4," in views[0][1]
    assert "pose " in views[1][1]
    np.testing.assert_allclose(views[0][0].T_world_camera, views[1][0].T_world_camera, atol=1e-9)
    np.testing.assert_array_equal(views[0][0].instance_ids, views[1][0].instance_ids)
    assert not (stored / "raycast.png").exists()


def test_raycast_without_sequence_uses_kinect_camera(
    stored: Path,
    command: Command,
    views: list[tuple[View, str]],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(RunSource, "of", classmethod(lambda cls, contents: cls(contents, None, "its folder is gone")))
    assert command(stored)[0] == 0
    assert "camera of the run unknown (its folder is gone); rendering with the intrinsics of a Kinect" in caplog.text
    assert views[0][0].camera == NOT_CAMERA


FAR = ("--pose", 0, 0, -50, 0, 1, 0, 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--frame", 2], "--frame: expected a mapped frame, got 2 (a lost frame); use the nearest one, --frame 1"),
        (["--frame", 6], "--frame: expected a frame number from 0 to 5, got 6"),
        (["--frame", -1], "--frame: expected a frame number from 0 to 5, got -1"),
        (["--pose", 0, 0, 0, 0, 0, 0, 2], "--pose: expected a quaternion qx qy qz qw of length 1, got 2"),
        (["--pose", "nan", 0, 0, 0, 0, 0, 1], "--pose: expected a finite pose, got nan 0 0 0 0 0 1"),
        (
            FAR,
            "--pose: expected a pose with the map in view, got an empty view from pose 0 0 -50 0 1 0 0; set another "
            "--frame or --pose",
        ),
        (["--out", "view.jpg"], "--out: expected a name with the suffix .png, got view.jpg"),
    ],
)
def test_raycast_error_is_one_line(stored: Path, command: Command, arguments: list[object], message: str) -> None:
    assert command(stored, *arguments) == (1, "", f"error: {message}\n")


def test_raycast_without_map_is_one_line_error(stored: Path, command: Command, tmp_path: Path) -> None:
    (stored / "map.npz").unlink()
    for run in (stored, tmp_path / "nowhere"):
        status, output, error = command(run)
        assert (status, output, error.count("\n")) == (1, "", 1)
        assert error.startswith("error: raycast: expected a run directory with map.npz, got")


def test_raycast_without_mapped_frames_is_one_line_error(stored: Path, command: Command) -> None:
    (stored / "trajectory.txt").write_text("")
    status, _, err = command(stored)
    assert status == 1
    assert err == f"error: {stored}: expected at least one mapped frame, got none; set --pose\n"

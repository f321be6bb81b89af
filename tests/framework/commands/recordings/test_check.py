"""Tests for the command `check`."""

from __future__ import annotations

import subprocess
from pathlib import Path

import cv2
import pytest

from framework.geometry import inverse
from tests.framework.checking.test_recording_check import DESK
from tests.support.forked_commands import completed
from tests.support.recordings.damaged import write_damaged

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[4]


def checked(place: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return completed(place, "check", *arguments)


@pytest.fixture(scope="module")
def inverted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_damaged(tmp_path_factory.mktemp("desk") / "inverted", DESK, pose=inverse)


@pytest.mark.acceptance
def test_check_suggested_setting_corrects_recording(inverted: Path, tmp_path: Path) -> None:
    asked = ("dataset=rgbd_folder", f"dataset.root={inverted}")
    done = checked(tmp_path, *asked)
    assert done.returncode == 1
    assert "WRONG  poses: stored as T_camera_world" in done.stdout
    assert "; set dataset.pose_kind=T_CAMERA_WORLD" in done.stdout
    assert (
        "ERROR   dataset: expected a usable sequence, got 1 error (listed above); set dataset.pose_kind=T_CAMERA_WORLD"
        in done.stderr
    )
    assert "Traceback" not in done.stderr
    picture = cv2.imread(str(tmp_path / "outputs" / "check.png"))
    assert picture is not None
    assert [path.name for path in tmp_path.rglob("*.png")] == ["check.png"]
    fixed = checked(tmp_path, *asked, "dataset.pose_kind=T_CAMERA_WORLD", "out=fixed.png")
    assert (fixed.returncode, "WRONG" in fixed.stdout) == (0, False), fixed.stderr
    assert (tmp_path / "fixed.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("out=2024",), "out: expected a name with the suffix"),
        (("out=check.jpg",), "out: expected a name with the suffix"),
        (("out=nowhere/check.png",), "out: expected an existing parent folder, got none"),
        (("dataset=rgbd_folder", "dataset.root=nowhere"), "dataset.root: expected an existing folder, got nowhere"),
        (("dataset=rgbd_folder", "dataset.root=.", "dataset.camera_axes=UNITY"), "camera_axes"),
    ],
)
def test_check_invalid_arguments_are_one_line_errors(tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    done = checked(tmp_path, *arguments)
    assert done.returncode == 1
    assert message in done.stderr
    assert "Traceback" not in done.stderr

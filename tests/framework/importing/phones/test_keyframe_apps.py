"""Tests for exports of Polycam and 3D Scanner App, which store each frame in separate files."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import DataError
from framework.geometry import exp_se3
from framework.importing.folder_writer import Writing, write_folder
from framework.importing.formats import open_source
from tests.support.recordings.phone_exports import check_imported, room_frames, write_polycam, write_scanner_app

FRAMES = room_frames()
DRIFT = exp_se3([0.05, 0.02, 0.01, 0.03, -0.02, 0.01])
WRITERS = {"3D Scanner App": write_scanner_app, "Polycam": write_polycam}


@pytest.fixture(params=WRITERS)
def export(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path]:
    WRITERS[request.param](tmp_path / "export", FRAMES)
    return request.param, tmp_path / "export"


def write(path: Path, tmp_path: Path, least: int = 1) -> list[str]:
    return write_folder(open_source(path), tmp_path / "out", Writing(confidence=least)).errors


@pytest.mark.parametrize("least", [0, 1, 2])
def test_keyframe_apps_export_matches_room_geometry(export: tuple[str, Path], tmp_path: Path, least: int) -> None:
    name, path = export
    source = open_source(path)
    assert (source.format, source.count) == (name, len(FRAMES))
    assert not write(path, tmp_path, least)
    check_imported(tmp_path / "out", FRAMES, least=least)


def test_polycam_optimized_poses_and_images_are_used(tmp_path: Path) -> None:
    drifted = [replace(frame, T_world_camera=DRIFT @ frame.T_world_camera, color=255 - frame.color) for frame in FRAMES]
    write_polycam(tmp_path / "export", drifted)
    write_polycam(tmp_path / "export", FRAMES, "corrected_")
    assert not write(tmp_path / "export/keyframes", tmp_path)
    check_imported(tmp_path / "out", FRAMES, tells_up=False)
    for frame, seen in zip(drifted, RgbdFolder(tmp_path / "out"), strict=True):  # up in the world frame of ARKit
        np.testing.assert_allclose(frame.T_world_camera[:3, :3] @ seen.up, [0, 1, 0], atol=1e-6)


@pytest.mark.parametrize("missing", [(0,), (1,), (-1,), (0, 1), range(1, len(FRAMES))], ids=str)
def test_polycam_partial_optimized_poses_are_ignored(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, missing: Sequence[int]
) -> None:
    """Optimized and recorded poses have different world frames, so that a mixture maps surfaces twice."""
    drifted = [replace(frame, T_world_camera=DRIFT @ frame.T_world_camera) for frame in FRAMES]
    write_polycam(tmp_path / "export", drifted)
    write_polycam(tmp_path / "export", FRAMES, "corrected_")
    cameras = sorted((tmp_path / "export/keyframes/corrected_cameras").iterdir(), key=lambda path: int(path.stem))
    for k in missing:
        cameras[k].unlink()
    assert not write(tmp_path / "export", tmp_path)
    for frame, seen in zip(drifted, RgbdFolder(tmp_path / "out"), strict=True):
        np.testing.assert_allclose(frame.T_world_camera, seen.T_world_camera, atol=1e-5)
    found = f"poses for only {len(FRAMES) - len(missing)} of {len(FRAMES)} frames; using the poses of cameras/"
    assert found in caplog.text


def test_polycam_optimized_poses_without_images_are_used(tmp_path: Path) -> None:
    """These exports have optimized poses, but neither optimized images nor optimized intrinsics."""
    drifted = [replace(frame, T_world_camera=DRIFT @ frame.T_world_camera) for frame in FRAMES]
    write_polycam(tmp_path / "export", drifted)
    write_polycam(tmp_path / "export", FRAMES, "corrected_")
    for path in (tmp_path / "export/keyframes/corrected_images").iterdir():
        path.unlink()
    for path in (tmp_path / "export/keyframes/corrected_cameras").iterdir():
        content = json.loads(path.read_text())
        path.write_text(json.dumps({key: value for key, value in content.items() if key.startswith("t_")}))
    assert not write(tmp_path / "export", tmp_path)
    check_imported(tmp_path / "out", FRAMES, tells_up=False)


def test_scanner_app_frames_without_color_are_dropped(tmp_path: Path) -> None:
    write_scanner_app(tmp_path / "export", FRAMES)
    (tmp_path / "export/frame_00001.jpg").unlink()
    assert open_source(tmp_path / "export").count == 3
    for path in (tmp_path / "export").glob("depth_*"):
        path.unlink()
    with pytest.raises(
        DataError, match=r"expected frames with frame_00000\.jpg and depth_00000\.png, got none; in the app"
    ):
        open_source(tmp_path / "export")


def test_scanner_app_scan_without_times_uses_frame_number(tmp_path: Path) -> None:
    write_scanner_app(tmp_path / "export", FRAMES)
    for path in (tmp_path / "export").glob("frame_*.json"):
        change(path, lambda content: content.pop("time"))
    assert not write(tmp_path / "export", tmp_path)
    assert [frame.timestamp for frame in RgbdFolder(tmp_path / "out")] == pytest.approx([k / 30 for k in range(4)])


def test_polycam_export_without_depth_raises(tmp_path: Path) -> None:
    write_polycam(tmp_path / "export", FRAMES)
    (tmp_path / "export/keyframes/depth").rename(tmp_path / "depth")
    with pytest.raises(
        DataError, match=r"expected camera files .* and a folder depth/, got no folder depth/; record with"
    ):
        open_source(tmp_path / "export")


def change(path: Path, how: Callable[[dict[str, Any]], Any]) -> None:
    content = json.loads(path.read_text())
    how(content)
    path.write_text(json.dumps(content))


def second(folder: Path, pattern: str) -> Path:
    """Return the file of the second frame."""
    return sorted(folder.rglob(pattern))[1]


SPOILT_CAMERAS = {
    "3D Scanner App": [
        (lambda c: c.pop("intrinsics"), "intrinsics: expected a list of 9 numbers"),
        (lambda c: c.update(cameraPoseARFrame=[0] * 16), "pose: expected the last row 0 0 0 1"),
        (lambda c: c.update(cameraPoseARFrame=[1, 2]), "cameraPoseARFrame: expected a list of 16 numbers"),
        (
            lambda c: c.update(intrinsics=[0] * 9),
            "Camera: expected positive fx, fy and finite cx, cy, got fx, fy, cx, cy =",
        ),
        (lambda c: c.update(time="now"), "time: expected a number, got 'now'"),
    ],
    "Polycam": [
        (lambda c: c.pop("fx"), "expected a key 'fx'"),
        (lambda c: c.update(t_00=3), "pose: expected a rigid transform, got |R R^T - I| ="),
        (lambda c: c.update(t_23=None), "t_23: expected a number, got None"),
        (lambda c: c.update(fx=-1), "Camera: expected positive fx, fy and finite cx, cy, got fx, fy, cx, cy ="),
    ],
}


@pytest.mark.parametrize(
    ("app", "how", "message"), [(app, *case) for app, cases in SPOILT_CAMERAS.items() for case in cases]
)
def test_keyframe_apps_damaged_camera_skips_one_frame(tmp_path: Path, app: str, how, message: str) -> None:
    WRITERS[app](tmp_path / "export", FRAMES)
    change(second(tmp_path / "export", "frame_*.json" if app == "3D Scanner App" else "cameras/*.json"), how)
    [fault] = write(tmp_path / "export", tmp_path)
    assert re.search(message, fault), fault
    assert len(RgbdFolder(tmp_path / "out")) == 3


@pytest.mark.parametrize(
    ("app", "pattern"),
    [
        *(("3D Scanner App", pattern) for pattern in ("frame_*.json", "frame_*.jpg", "depth_*.png", "conf_*.png")),
        *(("Polycam", f"{kind}/*") for kind in ("cameras", "images", "depth", "confidence")),
    ],
)
def test_keyframe_apps_truncated_file_skips_one_frame(tmp_path: Path, app: str, pattern: str) -> None:
    WRITERS[app](tmp_path / "export", FRAMES)
    path = second(tmp_path / "export", pattern)
    path.write_bytes(path.read_bytes()[:-10])
    [fault] = write(tmp_path / "export", tmp_path)
    assert path.name in fault

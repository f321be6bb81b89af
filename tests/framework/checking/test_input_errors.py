"""Tests for errors of inputs that have other errors as consequences. Only the cause must be reported."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from framework.checking import Finding, Verdict
from framework.checking.image_geometry import check_camera
from framework.checking.recording_check import RecordingCheck, check, warn_of_images
from framework.data import Camera, Float64
from framework.datasets.frames.conventions import DepthReading, Mirror, PoseReading
from framework.datasets.replica_nice_slam import ReplicaNiceSlam
from framework.datasets.rgbd_folder import RgbdFolder
from framework.datasets.tum_rgbd import TumRgbd
from framework.errors import DataError
from framework.files.tum_trajectory import write_tum
from framework.geometry import inverse
from tests.support.recordings.damaged import write_damaged

pytestmark = pytest.mark.integration
REPEATED = pytest.mark.acceptance  # the same rule with other values

FARTHEST = 5.0  # m
DESK = TumRgbd(Path("data/desk"), scene="rgbd_dataset_freiburg1_rpy")
FRAMES = 14


def errors(found: RecordingCheck) -> list[Finding]:
    return [finding for finding in found.findings if finding.verdict is Verdict.ERROR]


@cache
def desk_files() -> dict[str, bytes]:
    """Return the content of the undistorted images of the desk, keyed by path."""
    files = {}
    for k in range(FRAMES):
        frame = DESK[2 * k]
        images = {"color": frame.color[..., ::-1], "depth": np.rint(1000 * frame.depth).astype(np.uint16)}
        files |= {f"{name}/{k:06d}.png": cv2.imencode(".png", image)[1].tobytes() for name, image in images.items()}
    return files


def desk(place: Path, poses: bool = True, pose: Callable[[Float64], Float64] = lambda T: T) -> Path:
    """Write every second frame of the desk as undistorted images, with depth in mm."""
    for name in ("color", "depth"):
        (place / name).mkdir(parents=True)
    for name, content in desk_files().items():
        (place / name).write_bytes(content)
    write_camera(place, 1, 1)
    if poses:
        given = [DESK.contents.frames[2 * k].T_world_camera for k in range(FRAMES)]
        write_tum(place / "poses.txt", [k / 15 for k in range(FRAMES)], [pose(T) for T in given if T is not None])
    return place


def write_camera(place: Path, x: float, y: float, camera: Camera = DESK.camera) -> None:
    content = {"width": camera.width, "height": camera.height, "depth_scale": 1000}
    content |= {"fx": x * camera.fx, "fy": y * camera.fy, "cx": x * camera.cx, "cy": y * camera.cy}
    (place / "camera.json").write_text(json.dumps(content))


# Depth normalized frame by frame


def normalized(depth: np.ndarray, kind: str) -> np.ndarray:
    valid = depth > 0
    if kind == "inverse":
        depth = np.where(valid, 1 / np.maximum(depth, 0.1), 0)
    low, high = depth[valid].min(), depth[valid].max()
    unit = np.where(valid, (depth - low) / (high - low), 0)
    return {
        "16 bits": np.rint(unit * 65535),
        "8 bits times 257": np.rint(unit * 255) * 257,
        "8 bits times 256": np.rint(unit * 255) * 256,
        "8 bits": np.rint(unit * 255),
        "inverse": np.rint(unit * 65535),
        "by maximum": np.rint(np.where(valid, depth / high, 0) * 65535),
        "to 10 m": np.rint(unit * 10_000),
    }[kind].astype(np.uint16)


KINDS = ["16 bits", "8 bits", "inverse"]
MORE_KINDS = ["8 bits times 257", "8 bits times 256", "by maximum", "to 10 m"]


@pytest.mark.parametrize("kind", [*KINDS, *(pytest.param(kind, marks=REPEATED) for kind in MORE_KINDS)])
def test_check_of_normalized_depth_names_it_alone(tmp_path: Path, kind: str) -> None:
    place = desk(tmp_path / "room", poses=kind != "inverse")
    for path in (place / "depth").iterdir():
        cv2.imwrite(str(path), normalized(cv2.imread(str(path), cv2.IMREAD_UNCHANGED) / 1000, kind))
    scale = 13107.0 if "16" in kind or "257" in kind else 0.0
    [finding] = errors(check(RgbdFolder(place, depth_reading=DepthReading(depth_scale=scale)), FARTHEST))
    assert (finding.subject, finding.setting) == ("depth", "")
    assert finding.text.startswith("normalized frame by frame")


@pytest.mark.parametrize("scale", [1000, pytest.param(13107, marks=REPEATED), pytest.param(256, marks=REPEATED)])
def test_check_of_clipped_depth_in_fixed_unit_is_not_normalized(tmp_path: Path, scale: int) -> None:
    """Depth beyond the range of uint16 is clipped to 65535 or removed."""
    place = desk(tmp_path / "room")
    for path in (place / "depth").iterdir():
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) / 1000
        cv2.imwrite(str(path), np.minimum(np.rint(scale * depth), 65535).astype(np.uint16))
    found = check(RgbdFolder(place, depth_reading=DepthReading(depth_scale=float(scale))), FARTHEST)
    assert not any("normalized" in finding.text for finding in found.findings)
    assert not errors(found)


# Intrinsics of another resolution


@pytest.mark.parametrize(
    ("x", "y", "fix"),
    [
        (2, 2, "multiply fx, fy, cx, cy by 0.5"),
        (3, 3, "multiply fx, fy, cx, cy by 0.3333"),
        (0.5, 0.5, "multiply fx, fy, cx, cy by 2"),
        (0.25, 0.25, "multiply fx, fy, cx, cy by 4"),
        (3, 2.25, "multiply fx, cx by 0.3333 and fy, cy by 0.4444"),
        (1.5, 1.5, "multiply fx, fy, cx, cy by 0.6667"),
    ],
)
def test_principal_point_of_other_resolution_names_factor(x: float, y: float, fix: str) -> None:
    for cx, cy in ((318.6, 235.3), (322.0, 246.0)):
        finding = check_camera(Camera(640, 480, 517 * x, 517 * y, cx * x, cy * y))
        assert finding is not None
        assert fix in finding.text


@pytest.mark.parametrize(("cx", "cy"), [(319.5, 239.5), (318.6, 255.3), (300, 270), (365, 205), (639 / 2 + 100, 240)])
def test_principal_point_near_center_has_no_error(cx: float, cy: float) -> None:
    assert check_camera(Camera(640, 480, 517, 517, cx, cy)) is None


@pytest.mark.parametrize("factor", [2, pytest.param(0.5, marks=REPEATED)])
def test_check_of_double_intrinsics_names_camera_alone(
    tmp_path: Path, factor: float, caplog: pytest.LogCaptureFixture
) -> None:
    place = desk(tmp_path / "room")
    write_camera(place, factor, factor)
    [finding] = errors(check(RgbdFolder(place), FARTHEST))
    assert finding.subject == "camera"
    assert f"multiply fx, fy, cx, cy by {1 / factor:g}" in finding.text
    assert warn_of_images(RgbdFolder(place))
    assert "principal point" in caplog.text


@pytest.mark.parametrize(
    ("change", "fix"),
    [
        (lambda c: {"fx": 1.25 * c.fx, "fy": 1.25 * c.fy, "cx": 1.25 * c.cx, "cy": 1.25 * c.cy}, "800x600 px"),
        (lambda c: {"fx": 2 * c.fx, "fy": 1.5 * c.fy, "cx": 2 * c.cx, "cy": 1.5 * c.cy}, "1280x720 px"),
        (lambda c: {"cx": c.cy, "cy": c.cx}, "cx and cy are swapped"),
        (lambda c: {"cx": c.cx + 320, "cy": c.cy + 120}, "subtract the margins of the cropped images, about 319 px"),
        pytest.param(
            lambda c: {"cx": 0.0, "cy": 0.0}, "set cx and cy to the image center, 319.5 and 239.5 px", marks=REPEATED
        ),
        pytest.param(lambda c: {"fx": 2 * c.fx, "fy": 2 * c.fy}, "multiply fx, fy by 0.5", marks=REPEATED),
        (lambda c: {"fy": 2 * c.fy}, "set fy to 517.3"),
    ],
)
def test_check_of_other_intrinsics_names_fix(tmp_path: Path, change: Callable[..., dict[str, float]], fix: str) -> None:
    place = desk(tmp_path / "room", poses=False)
    write_camera(place, 1, 1, replace(DESK.camera, **change(DESK.camera)))
    [finding] = errors(check(RgbdFolder(place), FARTHEST))
    assert finding.subject == "camera"
    assert fix in finding.text


# Other images than depth along z


def along_ray(depth: np.ndarray) -> np.ndarray:
    c = DESK.camera
    v, u = np.mgrid[: c.height, : c.width]
    return depth * np.sqrt(1 + ((u - c.cx) / c.fx) ** 2 + ((v - c.cy) / c.fy) ** 2)


def disparity(units: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda depth: np.where(depth > 0, units / np.maximum(depth, 100), 0)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (along_ray, "got distances to the camera center"),
        pytest.param(lambda depth: 5 * along_ray(depth), "got distances to the camera center", marks=REPEATED),
        (disparity(1.5e6), "got inverse depth or disparities"),
        pytest.param(disparity(8 * 4e4), "got inverse depth or disparities", marks=REPEATED),
        pytest.param(disparity(1e7), "got inverse depth or disparities", marks=REPEATED),
        (lambda depth: np.full(depth.shape, 1500), "constant: all readings of an image are equal"),
        pytest.param(
            lambda depth: np.where(depth > 0, 1, 0), "constant: all readings of an image are equal", marks=REPEATED
        ),
        (lambda depth: depth / 1000, "rounded to 3 different values per image"),
        pytest.param(lambda depth: depth / 100, "rounded to 2", marks=REPEATED),
    ],
)
def test_check_of_other_depth_names_it_alone(tmp_path: Path, change: Callable[..., np.ndarray], text: str) -> None:
    place = desk(tmp_path / "room")
    for path in (place / "depth").iterdir():
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float64)
        cv2.imwrite(str(path), np.rint(change(depth)).astype(np.uint16))
    [finding] = errors(check(RgbdFolder(place), FARTHEST))
    assert (finding.subject, finding.setting) == ("depth", "")
    assert text in finding.text


@pytest.mark.parametrize("part", [2, pytest.param(3, marks=REPEATED)])
def test_check_of_some_normalized_frames_names_depth(tmp_path: Path, part: int) -> None:
    """An export that normalizes only some frames, such as those with an outlier."""
    place = desk(tmp_path / "room")
    for path in sorted((place / "depth").iterdir())[::part]:
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) / 1000
        cv2.imwrite(str(path), normalized(depth, "16 bits"))
    [finding] = errors(check(RgbdFolder(place), FARTHEST))
    assert finding.text.startswith("normalized frame by frame")


# Depth scale


def test_check_of_wrong_depth_scale_does_not_blame_poses(tmp_path: Path) -> None:
    place = desk(tmp_path / "room")
    reading = DepthReading(depth_scale=5000.0)
    found = errors(check(RgbdFolder(place, stop=12, stride=2, depth_reading=reading), FARTHEST))
    assert [finding.setting for finding in found] == ["dataset.depth_scale=1000"]


@pytest.mark.parametrize("unit", [0.001, pytest.param(0.01, marks=REPEATED)])
def test_check_of_poses_in_other_unit_names_setting(tmp_path: Path, unit: float) -> None:
    """The camera mainly rotates, so the ratio of translations is uncertain."""
    place = desk(tmp_path / "room", pose=lambda T: in_units(T, unit))
    [finding] = errors(check(RgbdFolder(place), FARTHEST))
    assert finding.setting == f"dataset.pose_unit={unit:g}"


def in_units(T: Float64, unit: float) -> Float64:
    scaled = T.copy()
    scaled[:3, 3] /= unit
    return scaled


# Repeated images


@pytest.mark.parametrize(
    ("folder", "poses"),
    [
        ("color", True),
        ("depth", False),
        pytest.param("color", False, marks=REPEATED),
        pytest.param("depth", True, marks=REPEATED),
    ],
)
def test_check_of_repeated_images_names_them(tmp_path: Path, folder: str, poses: bool) -> None:
    place = desk(tmp_path / "room", poses)
    for k in range(1, FRAMES, 2):
        shutil.copy(place / f"{folder}/{k - 1:06d}.png", place / f"{folder}/{k:06d}.png")
    found = check(RgbdFolder(place), FARTHEST)
    [finding] = [finding for finding in found.findings if finding.subject == "frames"]
    assert f"{folder} images are repeated in" in finding.text
    assert errors(found) == ([finding] if poses else [])


def test_check_of_single_repeated_frame_is_uncertain(tmp_path: Path) -> None:
    """One view does not show whether depth is registered."""
    place = desk(tmp_path / "room", poses=False)
    for folder in ("color", "depth"):
        for k in range(1, FRAMES):
            shutil.copy(place / f"{folder}/000000.png", place / f"{folder}/{k:06d}.png")
    found = check(RgbdFolder(place), FARTHEST)
    assert not errors(found)
    assert any("are repeated in 11 of 11 pairs" in finding.text for finding in found.findings)


# Timestamps


@pytest.mark.parametrize(
    ("unit", "start"),
    [(1e-9, 1305031102.0), pytest.param(1e-6, 0.0, marks=REPEATED), pytest.param(1e-3, 5.0, marks=REPEATED)],
)
def test_check_of_times_in_other_unit_names_setting(tmp_path: Path, unit: float, start: float) -> None:
    place = desk(tmp_path / "room")
    lines = [line.split(maxsplit=1) for line in (place / "poses.txt").read_text().splitlines()]
    text = "".join(f"{(float(time) + start) / unit:.0f} {rest}\n" for time, rest in lines)
    (place / "poses.txt").write_text(text)
    found = check(RgbdFolder(place), FARTHEST)
    assert [finding.setting for finding in errors(found)] == [f"dataset.time_unit={unit:g}"]
    corrected = RgbdFolder(place, time_unit=unit)
    assert corrected[3].timestamp == pytest.approx(start + 3 / 15, abs=1e-2)
    assert not errors(check(corrected, FARTHEST))


# Mirrored worlds


@pytest.mark.parametrize(
    ("axis", "inverted"),
    [
        ("X", False),
        ("Y", True),
        pytest.param("Z", False, marks=REPEATED),
        pytest.param("Z", True, marks=REPEATED),
    ],
)
def test_check_of_mirrored_poses_names_setting(tmp_path: Path, axis: str, inverted: bool) -> None:
    S = np.diag([1.0 - 2 * (name == axis) for name in "XYZ"] + [1.0])
    place = desk(tmp_path / "room", pose=lambda T: inverse(S @ T @ S) if inverted else S @ T @ S)
    kind = " dataset.pose_kind=T_CAMERA_WORLD" if inverted else ""
    [finding] = errors(check(RgbdFolder(place), FARTHEST))
    assert finding.setting == f"dataset.mirrored={axis}{kind}"


def replica(place: Path, pose: Callable[[Float64], Float64]) -> ReplicaNiceSlam:
    """Write the desk in the layout of Replica, with poses as matrices."""
    desk(place / "desk", poses=False)
    (place / "room/results").mkdir(parents=True)
    for k in range(FRAMES):
        color = cv2.imread(str(place / f"desk/color/{k:06d}.png"))
        cv2.imwrite(str(place / f"room/results/frame{k:06d}.jpg"), color)
        (place / f"desk/depth/{k:06d}.png").rename(place / f"room/results/depth{k:06d}.png")
    c = DESK.camera
    content = {"w": 640, "h": 480, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "scale": 1000}
    (place / "cam_params.json").write_text(json.dumps({"camera": content}))
    poses = [pose(DESK[2 * k].T_world_camera).ravel() for k in range(FRAMES)]
    (place / "room/traj.txt").write_text("\n".join(" ".join(map(str, T)) for T in poses))
    return ReplicaNiceSlam(place, scene="room")


@pytest.mark.parametrize(
    ("flips", "side", "mirrored"),
    [
        ((1, -1, 1), "world", "WORLD"),
        pytest.param((-1, -1, -1), "world", "WORLD", marks=REPEATED),
        ((1, -1, 1), "camera", "CAMERA"),
    ],
)
def test_check_of_poses_with_negative_determinant_names_setting(
    tmp_path: Path, flips: tuple[int, int, int], side: str, mirrored: str
) -> None:
    S = np.diag([*flips, 1.0])
    sequence = replica(tmp_path, (lambda T: S @ T) if side == "world" else (lambda T: T @ S))
    [finding] = errors(check(sequence, FARTHEST))
    assert finding.setting == f"dataset.mirrored={mirrored}"
    assert "left-handed world" in finding.text
    reading = PoseReading(mirrored=Mirror[mirrored])
    corrected = ReplicaNiceSlam(tmp_path, scene="room", pose_reading=reading)
    assert not errors(check(corrected, FARTHEST))


@pytest.mark.parametrize("mirror", [Mirror.WORLD, Mirror.CAMERA])
def test_mirrored_setting_of_rigid_poses_raises(mirror: Mirror) -> None:
    with pytest.raises(DataError, match=r"set dataset\.mirrored=NONE"):
        PoseReading(mirrored=mirror).pose(np.eye(4))
    with pytest.raises(DataError, match=r"set dataset\.mirrored=WORLD"):
        PoseReading().pose(np.diag([1.0, -1.0, 1.0, 1.0]))


# Rotated and mirrored images


TURNS = {
    "-flop": lambda image: image[:, ::-1],
    "-flip": lambda image: image[::-1],
    "-rotate 180": lambda image: image[::-1, ::-1],
}


@pytest.mark.parametrize(
    ("folder", "turn", "poses"),
    [
        ("color", "-flop", True),
        ("depth", "-flip", False),
        ("depth", "-rotate 180", True),
        pytest.param("color", "-flop", False, marks=REPEATED),
        pytest.param("depth", "-flip", True, marks=REPEATED),
        pytest.param("depth", "-rotate 180", False, marks=REPEATED),
    ],
)
def test_check_of_mirrored_images_names_command(tmp_path: Path, poses: bool, folder: str, turn: str) -> None:
    place = desk(tmp_path / "room", poses)
    turn_images(place / folder, turn)
    [finding] = errors(check(RgbdFolder(place), FARTHEST))
    assert finding.subject == "color"
    assert f"for example with mogrify {turn} {place}/color/*.png" in finding.text


def test_check_of_color_and_depth_upside_down_names_rotation(tmp_path: Path) -> None:
    place = desk(tmp_path / "room")
    for folder in ("color", "depth"):
        turn_images(place / folder, "-rotate 180")
    [finding] = errors(check(RgbdFolder(place), FARTHEST))
    assert (finding.subject, finding.setting) == ("poses", "tracker=voxel_hashing_icp")
    assert "images are rotated by 180 degrees relative to the poses" in finding.text
    assert "rotate color and depth by 180 degrees clockwise" in finding.text


def turn_images(folder: Path, turn: str) -> None:
    for path in folder.iterdir():
        cv2.imwrite(str(path), TURNS[turn](cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))


# EXIF orientation


@pytest.mark.parametrize(
    ("tag", "poses"),
    [
        (2, True),
        (3, False),
        pytest.param(3, True, marks=REPEATED),
        pytest.param(4, True, marks=REPEATED),
        pytest.param(4, False, marks=REPEATED),
    ],
)
def test_check_of_images_with_orientation_names_it_alone(tmp_path: Path, poses: bool, tag: int) -> None:
    place = desk(tmp_path / "room", poses)
    for path in list((place / "color").iterdir()):
        color = cv2.imread(str(path))[..., ::-1]
        stored = {2: color[:, ::-1], 3: color[::-1, ::-1], 4: color[::-1]}[tag]
        write_tagged(path, stored, tag)
    [finding] = errors(check(RgbdFolder(place), FARTHEST))
    assert finding.subject == "color"
    assert f"EXIF orientation {tag}" in finding.text


@pytest.mark.parametrize("tag", [1, pytest.param(3, marks=REPEATED), 6])
def test_check_of_upright_pixels_with_orientation_has_no_error(tmp_path: Path, tag: int) -> None:
    place = desk(tmp_path / "room")
    for path in list((place / "color").iterdir()):
        write_tagged(path, cv2.imread(str(path))[..., ::-1], tag)
    found = check(RgbdFolder(place), FARTHEST)
    assert not errors(found)
    assert any("EXIF" in finding.text for finding in found.findings) == (tag != 1)


def test_size_error_names_orientation(tmp_path: Path) -> None:
    place = desk(tmp_path / "room")
    for path in list((place / "color").iterdir()):
        write_tagged(path, np.rot90(cv2.imread(str(path))[..., ::-1]), 6)
    with pytest.raises(DataError, match=r"got 480x640 px with the EXIF orientation 6"):
        RgbdFolder(place)


def write_tagged(path: Path, color: np.ndarray, tag: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = tag
    Image.fromarray(np.ascontiguousarray(color)).save(path.with_suffix(".jpg"), exif=exif, quality=95)
    path.unlink()


def test_valid_recording_logs_no_warning(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    with caplog.at_level(logging.WARNING):
        assert not warn_of_images(DESK)
        assert not warn_of_images(RgbdFolder(write_damaged(tmp_path / "desk", DESK, frames=20)))
    assert not caplog.records

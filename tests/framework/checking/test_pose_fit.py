"""Tests for the detection of pose conventions."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.checking import Verdict
from framework.checking.matched_pairs import MatchedPair
from framework.checking.pose_fit import fit, judge, motion_of, readings
from framework.data import Camera, Float64, Frame
from framework.datasets.frames.conventions import CameraAxes, PoseKind, PoseReading
from framework.geometry import inverse, project, transform

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
X_FORWARD = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # camera axes of ROS
BLANK = np.zeros((240, 320, 3), np.uint8), np.zeros((240, 320), np.float32)


def pair(
    T_world_first: Float64, T_world_second: Float64, stored: Callable[[Float64], Float64], seed: int
) -> MatchedPair:
    """Return a matched pair of frames that see the same random points.

    `stored` converts the true poses to the stored ones.
    """
    chosen = np.random.default_rng(seed)
    points = np.column_stack([chosen.uniform(-0.6, 0.6, (60, 2)), chosen.uniform(1.5, 3, 60)])
    T_second_first = inverse(T_world_second) @ T_world_first
    first, second = (Frame(k, k / 30, *BLANK, CAMERA, stored(T)) for k, T in enumerate((T_world_first, T_world_second)))
    pixels = project(CAMERA, points).astype(np.float32)
    moved = project(CAMERA, transform(T_second_first, points)).astype(np.float32)
    return MatchedPair(first, second, points.astype(np.float32), pixels, moved, T_second_first)


def walk(seed: int, pan_only: bool = False) -> list[Float64]:
    chosen = np.random.default_rng(seed)
    poses = []
    for k in range(12):
        T = np.eye(4)
        turn = (0, 0.08 * k, 0) if pan_only else chosen.normal(scale=0.1, size=3)
        T[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
        T[:3, 3] = 0 if pan_only else chosen.normal(scale=0.15, size=3)
        poses.append(T)
    return poses


def pairs_of(poses: list[Float64], stored: Callable[[Float64], Float64] = lambda T: T) -> list[MatchedPair]:
    return [pair(a, b, stored, k) for k, (a, b) in enumerate(pairwise(poses))]


def test_pose_fit_of_correct_poses_has_no_error() -> None:
    for one in pairs_of(walk(0)):
        np.testing.assert_allclose(motion_of(one, PoseReading()), one.T_second_first, atol=1e-12)
    exact = fit(pairs_of(walk(0)), PoseReading())
    assert exact.error == pytest.approx(0, abs=1e-3)
    assert exact.depth_factor == pytest.approx(1, abs=1e-9)
    assert exact.factor_within == pytest.approx(1.07, abs=0.01)


@pytest.mark.parametrize("reading", list(readings()), ids=repr)
def test_pose_fit_identifies_reading_from_moving_camera(reading: PoseReading) -> None:
    def stored(T_world_camera: Float64) -> Float64:
        """Return the stored pose for T_world_camera in the convention of `reading`."""
        T = T_world_camera.copy()
        T[:3, :3] = T[:3, :3] @ reading.camera_axes.R_axes_camera.T
        if reading.pose_kind is PoseKind.T_CAMERA_WORLD:
            T = inverse(T)
        if reading.quaternion_order.name == "WXYZ":
            T[:3, :3] = Rotation.from_quat(np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1)).as_matrix()
        return T

    judged = judge(pairs_of(walk(1), stored), PoseReading(), 1000.0, 2.0)
    assert judged.best is not None
    assert judged.best.reading == reading
    assert judged.findings[0].verdict is (Verdict.FINE if reading == PoseReading() else Verdict.ERROR)
    assert "equally well" not in judged.findings[0].text


def test_pose_fit_reports_ambiguous_axes_of_pan() -> None:
    """If the camera only pans, inverted poses and poses in OpenGL axes describe the same motion."""
    judged = judge(pairs_of(walk(2, pan_only=True), inverse), PoseReading(), 1000.0, 2.0)
    [fault] = judged.findings
    assert fault.verdict is Verdict.ERROR
    assert fault.setting in ("dataset.pose_kind=T_CAMERA_WORLD", "dataset.camera_axes=OPENGL")
    other = {"dataset.pose_kind=T_CAMERA_WORLD", "dataset.camera_axes=OPENGL"} - {fault.setting}
    assert f"{other.pop()}" in fault.text
    assert "fits this camera motion equally well" in fault.text


@pytest.mark.parametrize("factor", [0.2, 5.0, 1000.0])
def test_pose_fit_measures_wrong_unit(factor: float) -> None:
    def stored(T: Float64) -> Float64:
        scaled = T.copy()
        scaled[:3, 3] *= factor
        return scaled

    judged = judge(pairs_of(walk(3), stored), PoseReading(), 1000.0 * factor, 2.0 / factor)
    assert judged.best is not None
    assert judged.best.depth_factor == pytest.approx(factor, rel=1e-6)
    assert judged.findings[-1].setting == "dataset.depth_scale=1000"


def test_pose_fit_in_configured_axes_is_correct() -> None:
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    of_opengl = pairs_of(walk(4), lambda T: T @ flip)
    judged = judge(of_opengl, PoseReading(camera_axes=CameraAxes.OPENGL), 1000.0, 2.0)
    assert [finding.verdict for finding in judged.findings] == [Verdict.FINE]
    wrong = judge(pairs_of(walk(4)), PoseReading(camera_axes=CameraAxes.OPENGL), 1000.0, 2.0)
    assert wrong.findings[0].setting == "dataset.camera_axes=OPENCV"


def test_pose_fit_keeps_configured_unit_in_axes_search() -> None:
    """The stored poses are inverted and in millimeters. With the correct unit, only the inversion is reported."""

    def stored(T: Float64) -> Float64:
        inverted = inverse(T)
        inverted[:3, 3] *= 1000
        return inverted

    [fault] = judge(pairs_of(walk(5), stored), PoseReading(pose_unit=0.001), 1000.0, 2.0).findings
    assert fault.setting == "dataset.pose_kind=T_CAMERA_WORLD"
    wrong_unit = judge(pairs_of(walk(6)), PoseReading(pose_unit=0.001), 1000.0, 2.0)
    assert wrong_unit.findings[-1].setting == "dataset.pose_unit=1"


@pytest.mark.parametrize("unit", [1e-3, 1e-2, 0.0254])
@pytest.mark.parametrize(
    ("convert", "settings"),
    [
        (lambda T: T, []),
        (lambda T: T @ np.diag([1, -1, -1, 1.0]), ["dataset.camera_axes=OPENGL"]),
        (lambda T: np.diag([1, -1, 1, 1.0]) @ T @ np.diag([1, -1, 1, 1.0]), ["dataset.mirrored=Y"]),
        (lambda T: np.diag([1, -1, 1, 1.0]) @ T @ X_FORWARD @ np.diag([1, -1, 1, 1.0]), ["dataset.mirrored=Z", "ROS"]),
        (inverse, ["dataset.pose_kind=T_CAMERA_WORLD"]),
    ],
    ids=["opencv", "opengl", "unity", "unreal", "inverse"],
)
def test_judge_in_other_unit_names_unit_and_convention(
    convert: Callable[[Float64], Float64], settings: list[str], unit: float
) -> None:
    def stored(T_world_camera: Float64) -> Float64:
        T = convert(T_world_camera).copy()
        T[:3, 3] /= unit
        return T

    found = judge(pairs_of(walk(4), stored), PoseReading(), 1000.0, 2.2)
    named = " ".join(finding.setting for finding in found.findings)
    assert named.split()[-1] == f"dataset.pose_unit={unit:g}"
    assert ("mirrored" in named) == ("mirrored" in " ".join(settings))
    assert found.best is not None
    assert found.best.error < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_judge_of_random_errors_suggests_no_scale(seed: int) -> None:
    """Random translations are longer than those in the images, but no scale corrects them."""
    chosen = np.random.default_rng(seed)

    def noisy(T_world_camera: Float64) -> Float64:
        T = T_world_camera.copy()
        T[:3, 3] += chosen.normal(scale=0.6, size=3)
        return T

    [finding] = judge(pairs_of(walk(seed), noisy), PoseReading(), 1000.0, 2.2).findings
    assert finding.verdict is Verdict.ERROR
    assert finding.setting == "tracker=voxel_hashing_icp"

"""Tests for the self-calibration of depth: its equations against numeric derivatives, and a known distortion."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from framework.data import Camera, Float32, Float64, Frame, Pose, UInt8
from framework.geometry import exp_se3, inverse
from framework.pose_graph import depth_calibration
from framework.pose_graph.depth_calibration import (
    MAX_DISTANCE,
    MIN_COSINE,
    NOISE,
    STRIDE,
    CalibrationView,
    DepthCalibration,
    estimated,
    mean_squared_distance,
)
from framework.pose_graph.depth_calibration_kernels import linearize_pairs
from framework.sensors.depth_distortion import NODES, DepthDistortion
from framework.testing.corner_room import look

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
ARRAYS = ("depth", "normals", "T_world_view")  # of a view
PATTERN = 0.01 * np.outer(np.cos(np.linspace(0, 3, NODES[0])), np.sin(np.linspace(0, 5, NODES[1])))
PATTERN -= PATTERN.mean()  # which is not observable


def pose(k: int) -> Float64:
    """Return a pose that turns and moves, so that each surface is in different parts of the image."""
    turn = np.array([0.3 * np.sin(k), 0.2 * np.cos(2 * k), -0.4 * np.sin(k / 2), 0, 0, 0])
    return exp_se3(turn) @ exp_se3(np.array([0, 0, 0, 0.25 * np.sin(k / 3), 0.35 * np.cos(k / 4), 0.3 * np.sin(k / 5)]))


@functools.cache
def seen(k: int) -> tuple[Float32, UInt8]:
    depth, _, color, _ = look(CAMERA, pose(k))
    return depth, color


def frame(k: int, distortion: Float64 | None = None) -> Frame:
    """Return a frame of the room. Its depth needs the correction `distortion`."""
    depth, color = seen(k)
    if distortion is not None:
        corrections = DepthDistortion(distortion, CAMERA.shape).corrections.astype(np.float64)
        # z with z + d z^2 = depth
        depth = (2 * depth / (1 + np.sqrt(1 + 4 * corrections * depth))).astype(np.float32)
    return Frame(k, k / 30, color, depth, CAMERA)


def views(count: int, distortion: Float64 | None = None) -> list[CalibrationView]:
    return [CalibrationView.of(frame(k, distortion), pose(k)) for k in range(count)]


class _Residuals:
    """The residuals of a pair of views with fixed correspondences, computed slowly."""

    def __init__(self, first: CalibrationView, second: CalibrationView, nodes: Float64) -> None:
        self.first, self.second, self.nodes = first, second, nodes
        self.matches = [
            match
            for v in range(STRIDE // 2, first.camera.height, STRIDE)
            for u in range(STRIDE // 2, first.camera.width, STRIDE)
            if (match := self._matched(v, u)) is not None
        ]

    def _point(self, view: CalibrationView, v: int, u: int, nodes: Float64) -> Float64:
        c = view.camera
        z = float(DepthDistortion(nodes, c.shape).corrections.astype(np.float64)[v, u])
        depth = float(view.depth[v, u])
        return np.array([(u - c.cx) / c.fx, (v - c.cy) / c.fy, 1.0]) * (depth + z * depth**2)

    def _matched(self, v: int, u: int) -> tuple[int, int, int, int] | None:
        c = self.first.camera
        if self.first.depth[v, u] <= 0:
            return None
        T = inverse(self.second.T_world_view) @ self.first.T_world_view
        q = T[:3, :3] @ self._point(self.first, v, u, self.nodes) + T[:3, 3]
        if q[2] <= 0.1:
            return None
        j, i = round(c.fy * q[1] / q[2] + c.cy), round(c.fx * q[0] / q[2] + c.cx)
        if not (0 <= j < c.height and 0 <= i < c.width) or self.second.depth[j, i] <= 0:
            return None
        n = self.second.normals[j, i].astype(np.float64)
        if n @ T[:3, :3] @ self.first.normals[v, u] < MIN_COSINE:
            return None
        r = n @ (q - self._point(self.second, j, i, self.nodes))
        return None if abs(r) > max(MAX_DISTANCE, 4 * self._sigma(v, u, j, i)) else (v, u, j, i)

    def _sigma(self, v: int, u: int, j: int, i: int) -> float:
        return NOISE[0] + NOISE[1] * max(float(self.first.depth[v, u]), float(self.second.depth[j, i])) ** 2

    def __call__(self, x: Float64) -> Float64:
        """Return the residuals (N,) after a step x (12 + R C,) of both poses and the nodes."""
        nodes = self.nodes + x[12:].reshape(NODES)
        T = inverse(self.second.T_world_view @ exp_se3(x[6:12])) @ self.first.T_world_view @ exp_se3(x[:6])
        return np.array(
            [
                self.second.normals[j, i]
                @ (T[:3, :3] @ self._point(self.first, v, u, nodes) + T[:3, 3] - self._point(self.second, j, i, nodes))
                for v, u, j, i in self.matches
            ]
        )

    def weights(self) -> Float64:
        """Return the weights (N,) of a Cauchy distribution."""
        sigmas = np.array([self._sigma(*match) for match in self.matches])
        return 1 / sigmas**2 / (1 + (self(np.zeros(12 + self.nodes.size)) / (2 * sigmas)) ** 2)


def test_linearize_pairs_equals_numeric_derivatives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(depth_calibration, "SIDE", 40)  # few points
    pair = views(2, PATTERN)
    nodes = np.random.default_rng(1).normal(0, 0.002, NODES)
    n, c = nodes.size, pair[0].camera
    A, b, A_nodes, b_nodes = np.zeros((1, 12, 12)), np.zeros((1, 12)), np.zeros((1, n, n)), np.zeros((1, n))
    A_cross, errors = np.zeros((1, 12, n)), np.zeros((1, 2))
    linearize_pairs(
        np.array([[0, 1]], np.int32), *(np.stack([getattr(view, name) for view in pair]) for name in ARRAYS),
        (c.fx, c.fy, c.cx, c.cy), STRIDE, nodes.ravel(), NODES[1], NOISE, MAX_DISTANCE, MIN_COSINE,
        A, b, A_nodes, b_nodes, A_cross, errors,
    )  # fmt: skip
    residuals = _Residuals(*pair, nodes)
    assert errors[0, 0] == len(residuals.matches) > 50
    step = 1e-5 * np.eye(12 + n)
    J = np.stack([(residuals(x) - residuals(-x)) / 2e-5 for x in step], axis=1)
    weights, r = residuals.weights(), residuals(np.zeros(12 + n))
    expected = J.T @ (weights[:, None] * J)
    scale = np.abs(expected).max()
    for found, part in ((A, expected[:12, :12]), (A_cross, expected[:12, 12:]), (A_nodes, expected[12:, 12:])):
        np.testing.assert_allclose(found[0], part, atol=1e-5 * scale)
    gradient = J.T @ (weights * r)
    np.testing.assert_allclose(np.concatenate([b[0], b_nodes[0]]), gradient, atol=1e-5 * np.abs(gradient).max())
    assert errors[0, 1] == pytest.approx(weights @ r**2, rel=1e-5)


def test_estimated_distortion_is_close_to_true_one() -> None:
    found = estimated(views(24, PATTERN))
    assert np.sqrt(((found - PATTERN) ** 2).mean()) < 0.25 * PATTERN.std()
    assert abs(found.mean()) < 1e-5


def test_mean_squared_distance_is_smaller_with_true_distortion() -> None:
    distorted = views(12, PATTERN)
    assert mean_squared_distance(distorted, PATTERN) < 0.2 * mean_squared_distance(distorted, np.zeros(NODES))


@pytest.mark.parametrize("distortion", [None, PATTERN])
def test_depth_calibration_corrects_only_distorted_depth(distortion: Float64 | None) -> None:
    calibration = DepthCalibration(calibration_frames=24)
    for k in range(24):
        calibration.add(frame(k, distortion), Pose(pose(k)))
    found = calibration.distortion()
    assert (found is None) == (distortion is None)
    if found is not None:
        assert found.shape == CAMERA.shape
        corrected, true = found.corrected(frame(3, distortion).depth), frame(3).depth
        assert np.abs(corrected - true).mean() < 0.3 * np.abs(frame(3, distortion).depth - true).mean()


def test_depth_calibration_with_few_views_corrects_nothing() -> None:
    calibration = DepthCalibration(calibration_frames=600)  # every tenth frame is a view
    for k in range(190):
        calibration.add(frame(k % 40, PATTERN), Pose(pose(k % 40)))
    assert calibration.distortion() is None


def test_depth_calibration_does_not_depend_on_blas_threads() -> None:
    """In `estimated` itself, the last digits differ."""
    found = []
    for threads in (1, 2):
        calibration = DepthCalibration(calibration_frames=24)
        for k in range(24):
            calibration.add(frame(k, PATTERN), Pose(pose(k)))
        with threadpool_limits(threads, "blas"):
            distortion = calibration.distortion()
        assert distortion is not None
        found.append(distortion.nodes.tobytes())
    assert found[0] == found[1]


def test_depth_calibration_without_overlap_corrects_nothing() -> None:
    calibration = DepthCalibration(calibration_frames=20)
    for k in range(20):
        calibration.add(frame(k, PATTERN), Pose(exp_se3(np.array([10.0 * k, 0, 0, 0, 0, 0]))))
    assert calibration.distortion() is None


def test_depth_calibration_of_short_sequence_needs_no_frames() -> None:
    calibration = DepthCalibration(calibration_frames=300)
    assert [calibration.frames(available) for available in (95, 96, 1000)] == [0, 96, 300]
    assert DepthCalibration(calibration_frames=0).frames(1000) == 0


def test_depth_calibration_omits_frames_of_other_cameras() -> None:
    other = replace(CAMERA, fx=140.0)
    calibration = DepthCalibration(calibration_frames=20)
    for k in range(20):
        own = frame(k, PATTERN)
        calibration.add(own if k % 2 else replace(own, camera=other), Pose(pose(k)))
    assert calibration.distortion() is None  # 10 views are too few


def test_calibration_view_has_normals_of_surface_and_no_points_at_edges() -> None:
    depth, normals_world, color, _ = look(CAMERA, pose(5))
    depth[50:60, 70:80] = 0
    view = CalibrationView.of(Frame(0, 0.0, color, depth, CAMERA), pose(5))
    assert not view.depth[49:61, 69:81].any()
    usable = view.depth > 0
    normals = view.normals[usable] @ pose(5)[:3, :3].T
    cosines = np.einsum("ni,ni->n", normals, normals_world[usable])
    assert np.median(np.abs(cosines)) > 0.999
    assert usable.mean() > 0.7

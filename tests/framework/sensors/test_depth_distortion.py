"""Tests for the distortion of depth, against slow interpolation."""

from __future__ import annotations

import numpy as np

from framework.sensors.depth_distortion import NODES, DepthDistortion


def slow_correction(nodes: np.ndarray, shape: tuple[int, int], v: int, u: int) -> float:
    """Return the bilinear interpolation of the nodes at a pixel."""
    y, x = v * (nodes.shape[0] - 1) / (shape[0] - 1), u * (nodes.shape[1] - 1) / (shape[1] - 1)
    j, i = min(int(y), nodes.shape[0] - 2), min(int(x), nodes.shape[1] - 2)
    b, a = y - j, x - i
    upper = (1 - a) * nodes[j, i] + a * nodes[j, i + 1]
    lower = (1 - a) * nodes[j + 1, i] + a * nodes[j + 1, i + 1]
    return float((1 - b) * upper + b * lower)


def test_depth_distortion_corrects_readings_and_keeps_missing_ones() -> None:
    rng = np.random.default_rng(0)
    nodes, shape = rng.normal(0, 0.01, NODES), (25, 33)
    depth = rng.uniform(0.5, 4, shape).astype(np.float32)
    depth[3:6, 8] = 0
    corrected = DepthDistortion(nodes, shape).corrected(depth)
    for v in range(shape[0]):
        for u in range(shape[1]):
            z = depth[v, u]
            assert abs(corrected[v, u] - (z + slow_correction(nodes, shape, v, u) * z**2)) < 1e-5
    assert not corrected[3:6, 8].any()
    assert corrected.dtype == np.float32


def test_depth_distortion_returns_no_negative_depth() -> None:
    depth = np.full((7, 9), 4.0, np.float32)
    assert not DepthDistortion(np.full(NODES, -0.5), (7, 9)).corrected(depth).any()


def test_depth_distortion_keeps_images_of_another_size() -> None:
    depth = np.ones((4, 4), np.float32)
    assert DepthDistortion(np.ones(NODES), (7, 9)).corrected(depth) is depth

"""Tests for refiner=connected.

Parts behind a depth step are removed. Parts that are separated by an occluder are kept.
"""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest

from framework.data import Bool, Camera, Detections, Float32, Frame, PointClusters, Pose
from framework.refinement.lifting import lift
from plugins.refiners.connected import Connected
from plugins.refiners.largest_component import LargestComponent

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
U = np.arange(CAMERA.width)[None, :] + np.zeros((CAMERA.height, 1), np.int64)


def clusters_of(masks: list[Bool], frame: Frame) -> PointClusters:
    n = len(masks)
    ones = np.ones(n, np.float32)
    found = Detections(np.stack(masks), np.zeros((n, 4), np.float32), ones, np.ones((n, 1), np.float32), ("couch",))
    return lift(found, frame, Pose(np.eye(4)))


def frame_of(depth: Float32, camera: Camera = CAMERA) -> Frame:
    return Frame(0, 0.0, np.zeros((*depth.shape, 3), np.uint8), depth.astype(np.float32), camera)


def kept(refiner: Connected | LargestComponent, mask: Bool, depth: Float32) -> Bool:
    """Return the pixels (H, W) of the mask that are kept."""
    frame = frame_of(depth)
    after = refiner.refine(clusters_of([mask], frame), frame)
    image = np.zeros(mask.shape, np.bool_)
    image[after.pixels[:, 1], after.pixels[:, 0]] = True
    return image


def test_connected_occluder_does_not_split_object() -> None:
    """A pole at 2 m, which is not in the mask, divides a couch at 3 m. LargestComponent removes the smaller half."""
    pole = (U >= 20) & (U < 24)
    depth = np.where(pole, 2.0, 3.0)
    assert (kept(Connected(), ~pole, depth) == ~pole).all()
    assert (kept(LargestComponent(), ~pole, depth) == (U >= 24)).all()


@pytest.mark.parametrize("neighbor_depth", [4.5, 1.5])
def test_connected_object_ends_at_depth_step(neighbor_depth: float) -> None:
    """The mask covers a wall behind the object or a table in front of the object."""
    depth = np.where(U < 6, neighbor_depth, 3.0)
    assert (kept(Connected(), np.ones(depth.shape, np.bool_), depth) == (U >= 6)).all()


def test_connected_missing_depth_does_not_split_object() -> None:
    depth = np.where((U >= 20) & (U < 26), 0.0, 3.0)
    assert (kept(Connected(), depth > 0, depth) == (depth > 0)).all()


def test_connected_removes_background_between_slats() -> None:
    slat = U % 8 < 4
    depth = np.where(slat, 1.5, 2.5)
    assert (kept(Connected(), np.ones(depth.shape, np.bool_), depth) == slat).all()


def test_connected_keeps_slanted_surface_behind_occluder() -> None:
    """The depth slope is 0.8 m per m, so the depth on both sides of the pole differs like at a step."""
    x = (U - CAMERA.cx) / CAMERA.fx
    slanted = 2.0 / (1 - 0.8 * x)  # z = 2 + 0.8 x z
    pole = (U >= 20) & (U < 30)
    assert (kept(Connected(max_gap=0.02), ~pole, np.where(pole, 0.7, slanted)) == ~pole).all()
    assert not kept(Connected(max_gap=0.02, max_depth_slope=0.1), ~pole, np.where(pole, 0.7, slanted))[:, :20].any()


@pytest.mark.parametrize("seed", range(6))
def test_connected_refiner_matches_reference(seed: int) -> None:
    """All points are samples, because the clusters are small."""
    rng = np.random.default_rng(seed)
    camera = Camera(16, 12, 20.0, 20.0, 7.5, 5.5)
    coarse = rng.choice([1.0, 1.05, 1.3, 2.0], (3, 4))
    depth = np.kron(coarse, np.ones((4, 4))) + rng.normal(0, 0.01, (12, 16))
    depth = np.where(rng.random(depth.shape) < 0.1, 0.0, depth).astype(np.float32)
    frame = frame_of(depth, camera)
    mask = rng.random(depth.shape) < 0.7
    refiner = Connected(max_gap=0.06, min_piece_ratio=0.0 if seed % 2 else 0.2, max_depth_slope=1.0)
    after = refiner.refine(clusters_of([mask], frame), frame)
    assert set(map(tuple, after.pixels.tolist())) == _slowly(refiner, mask & (depth > 0), depth, camera)


def _slowly(refiner: Connected, mask: Bool, depth: Float32, camera: Camera) -> set[tuple[int, int]]:
    points = [(int(u), int(v)) for v, u in np.argwhere(mask)]
    left, pieces = set(points), []
    for start in points:
        if start in left:
            left.remove(start)
            piece, ahead = [start], deque([start])
            while ahead:
                u, v = ahead.popleft()
                for near in [(a, b) for a, b in left if max(abs(a - u), abs(b - v)) <= refiner.connection_radius]:
                    z, other = depth[v, u], depth[near[1], near[0]]
                    if abs(z - other) < refiner.max_gap + refiner.gap_per_depth * min(z, other):
                        left.remove(near)
                        piece.append(near)
                        ahead.append(near)
            pieces.append(piece)
    largest = max(pieces, key=len)
    unchanged = sorted(largest, key=lambda p: (p[1], p[0]))
    for piece in sorted(pieces, key=len, reverse=True):
        if piece is largest or len(piece) < refiner.min_piece_ratio * len(largest):
            continue
        near = 0
        for u, v in piece:
            a, b = min(unchanged, key=lambda p: (p[0] - u) ** 2 + (p[1] - v) ** 2)
            z, other = depth[v, u], depth[b, a]
            aside = np.hypot(a - u, b - v) / camera.fx
            allowed = refiner.max_gap + (refiner.gap_per_depth + refiner.max_depth_slope * aside) * min(z, other)
            near += abs(z - other) <= allowed
        if 2 * near > len(piece):
            unchanged += sorted(piece, key=lambda p: (p[1], p[0]))
    return set(unchanged)

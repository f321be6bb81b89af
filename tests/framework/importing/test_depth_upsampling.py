"""Tests for the upsampling of depth to the size of the color image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from framework.data import Camera
from framework.importing.depth_resampling import upsampled
from framework.importing.depth_resampling_kernels import COLOR_SIGMA, ONE_SURFACE
from tests.support.scenes.corner_room import look

COLOR = Camera(320, 240, 300.0, 300.0, 157.0, 118.0)
ONE = np.full((240, 320, 3), 90, np.uint8)


def loops(depth, guide, u, v, color):
    """Upsample pixel by pixel, as described in `_upsample`."""
    found = np.zeros((len(v), len(u)))
    h, w = depth.shape
    for row, column in np.ndindex(found.shape):
        if not (-0.5 <= u[column] <= w - 0.5 and -0.5 <= v[row] <= h - 0.5):
            continue
        x, y = np.clip(u[column], 0, w - 1), np.clip(v[row], 0, h - 1)
        corners = [(i, j) for i in {int(y), min(int(y) + 1, h - 1)} for j in {int(x), min(int(x) + 1, w - 1)}]
        if depth[int(y + 0.5), int(x + 0.5)] == 0:
            continue
        weights = {(i, j): (1 - abs(y - i)) * (1 - abs(x - j)) for i, j in corners}
        z = [depth[at] for at in corners]
        if min(z) > 0 and max(z) <= (1 + ONE_SURFACE) * min(z):
            found[row, column] = sum(weights.values()) / sum(weights[at] / depth[at] for at in corners)
            continue

        def likeness(at, weights=weights, row=row, column=column):
            difference = ((guide[at].astype(float) - color[row, column].astype(float)) ** 2).sum()
            return weights[at] * np.exp(-difference / (2 * COLOR_SIGMA**2))

        found[row, column] = depth[max((at for at in corners if depth[at] > 0), key=likeness)]
    return found


def test_depth_upsampling_matches_reference_loops() -> None:
    rng = np.random.default_rng(0)
    depth = rng.choice([0, 1.0, 1.02, 2.0], (9, 12)).astype(np.float32)
    camera, target = Camera(48, 36, 40.0, 40.0, 23.1, 17.2), Camera(31, 25, 27.3, 26.0, 15.0, 12.5)
    color = rng.integers(0, 60, (36, 48, 3)).astype(np.uint8)
    target_color = rng.integers(0, 60, (25, 31, 3)).astype(np.uint8)
    found = upsampled(depth, color, camera, target, target_color)
    guide = cv2.resize(color, (12, 9), interpolation=cv2.INTER_AREA)
    u = ((np.arange(31) - 15.0) * 40 / 27.3 + 23.1 + 0.5) / 4 - 0.5
    v = ((np.arange(25) - 12.5) * 40 / 26.0 + 17.2 + 0.5) / 4 - 0.5
    expected = loops(depth, guide, u, v, target_color)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert (found == 0).mean() == pytest.approx((expected == 0).mean())
    assert 0.1 < (found > 0).mean() < 0.9


@pytest.mark.parametrize("factor", [0.25, 0.5, 0.8])
def test_depth_upsampling_is_exact_on_planes_and_sharp_at_edges(factor: float) -> None:
    coarse = COLOR.scaled(factor)
    truth, _, color, ids = look(COLOR, np.eye(4))
    depth = look(coarse, np.eye(4))[0].astype(np.float32)
    found = upsampled(depth, color, COLOR, COLOR, color)
    steps = cv2.dilate(truth, np.ones((15, 15))) > 1.03 * cv2.erode(truth, np.ones((15, 15)))
    plain = (ids == 0) & ~steps
    plain[[0, 1, -1, -2]] = plain[:, [0, 1, -1, -2]] = False  # beyond the outermost centers of coarse pixels
    assert plain.mean() > 0.2
    assert np.abs(found - truth)[plain].max() < 1e-4
    lowest, highest = cv2.erode(truth, np.ones((15, 15))), cv2.dilate(truth, np.ones((15, 15)))
    assert (found > 0).all()
    assert ((found > lowest - 1e-3) & (found < highest + 1e-3)).all()
    assert (np.abs(found - truth) > 0.05).mean() < 0.02 / factor


def test_depth_upsampling_selects_surface_by_color_at_edge() -> None:
    """The depth step is inside a coarse pixel. Without color, the step is displaced by up to half a coarse pixel."""
    camera = Camera(40, 40, 40.0, 40.0, 19.5, 19.5)
    truth = np.where(np.arange(40) < 22, 1.0, 2.0)[None].repeat(40, axis=0)
    color = np.where(truth == 1, 40, 200)[..., None].repeat(3, axis=-1).astype(np.uint8)
    depth = np.where((np.arange(10) + 0.5) * 4 < 22, 1.0, 2.0)[None].repeat(10, axis=0).astype(np.float32)
    found = upsampled(depth, color, camera, camera, color)
    wrong = upsampled(depth, np.zeros_like(color), camera, camera, np.zeros_like(color)) != truth
    assert set(np.unique(found)) == {1.0, 2.0}
    assert (found != truth).mean() < wrong.mean()


def test_depth_upsampling_preserves_holes() -> None:
    camera = COLOR
    depth = np.full((60, 80), 2.0, np.float32)
    depth[20:30, 40:60] = 0
    found = upsampled(depth, ONE, camera, camera, ONE)
    expected = np.full((240, 320), 2.0, np.float32)
    expected[80:120, 160:240] = 0
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_depth_upsampling_at_color_size_is_identity() -> None:
    depth = np.random.default_rng(0).choice([0, 1, 2, 2.01, 3.5], (240, 320)).astype(np.float32)
    np.testing.assert_allclose(upsampled(depth, ONE, COLOR, COLOR, ONE), depth, rtol=1e-6)


def test_depth_upsampling_outside_depth_view_is_zero() -> None:
    wider = Camera(320, 240, 150.0, 150.0, 157.0, 118.0)
    found = upsampled(np.full((60, 80), 1.0, np.float32), ONE, COLOR, wider, ONE)
    assert (found > 0).mean() == pytest.approx(0.25, abs=0.01)
    assert found[118, 157] == 1
    assert found[0, 0] == 0

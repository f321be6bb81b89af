"""Tests for one step of the alignment between two exact views of a scene."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from framework.data import Frame
from framework.geometry import exp_se3, inverse
from framework.sensors.noise_models import SensorKind
from framework.tracking.alignment import LinearWeights, ModelView, NormalEquations, Weights, linearize, smoothed
from framework.tracking.depth_scale import DepthScale
from framework.tracking.pyramid import PyramidLevel, build_pyramid, intrinsics, model_intensities
from plugins.trackers.voxel_hashing_icp import _solved
from tests.support.scenes.analytic_scene import CAMERA, Scene, pose

WALL = Scene(planes=[(np.array([0.0, 0.0, -1.0]), -1.5)], contrast=1.0)
COLOR = Weights(*map(np.float32, (0.1, 0.05, 0.7, 4.0, 4.0, 0.05, 1.0, 0.0)))
DEPTH = Weights(*map(np.float32, (0.1, 0.05, 0.7, 4.0, 4.0, 0.05, 0.0, 1.0)))
T_VIEW = pose(0.02, -0.03, 0.01, (0.01, 0.02, -0.01))


def step(
    scene: Scene,
    frame: Frame,
    level: int,
    T_view_camera: np.ndarray,
    weights: Weights,
    brightness: float = 0.0,
    seen: Callable[[ModelView], ModelView] = lambda model: model,
) -> tuple[np.ndarray, NormalEquations]:
    """Return the Gauss-Newton step (6,) from T_view_camera at a pyramid level, and its normal equations.

    The model is the view from T_VIEW.
    """
    model, intensities = model_of(scene)
    pyramid = build_pyramid(CAMERA, frame.depth, frame.color, 1.0, 3)
    equations = linearize(pyramid[level], seen(model), intensities[level], T_view_camera, weights, brightness)
    return _solved(equations.A, equations.b), equations


def model_of(scene: Scene) -> tuple[ModelView, list[np.ndarray]]:
    """Return the planes of the scene as a model view from T_VIEW, and its intensities at three levels."""
    view_frame = scene.frame(T_VIEW)
    depth = view_frame.depth
    gap = inverse(T_VIEW)[:3, :3]
    _, _, surface = scene.render(CAMERA, T_VIEW)
    normals = np.zeros((*depth.shape, 3), np.float32)
    for k, (n, _) in enumerate(scene.planes, start=1):
        normals[surface == k] = gap @ n
    depth = np.where(surface <= len(scene.planes), depth, 0).astype(np.float32)
    model = ModelView(depth, np.ascontiguousarray(normals.transpose(2, 0, 1)), *intrinsics(CAMERA))
    view = dataclasses.make_dataclass("Seen", ["color", "depth"])(view_frame.color, depth)
    return model, model_intensities(view, 3)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_color_alignment_at_true_pose_has_zero_step(level: int) -> None:
    """If a level were shifted by half a pixel, the step would be several millimeters."""
    T = pose(0.03, -0.02, 0.01, (0.01, 0.02, -0.01))
    xi, equations = step(WALL, WALL.frame(T), level, inverse(T_VIEW) @ T, COLOR)
    assert equations.matched > 0.5 * CAMERA.width * CAMERA.height / 4**level
    assert np.abs(xi[:2] + 1.5 * np.array([xi[4], -xi[3]])).max() < 2e-3, "expected a shift on the wall below 2 mm"


@pytest.mark.parametrize("level", [0, 1, 2])
def test_color_alignment_step_recovers_small_motion(level: int) -> None:
    T = pose(0.026, -0.026, 0.01, (0.01, 0.02, -0.01))
    truth = inverse(T_VIEW) @ T
    xi, _ = step(WALL, WALL.frame(T), level, np.eye(4), COLOR)
    error = exp_se3(xi) @ np.array([0, 0, 1.5, 1]) - truth @ np.array([0, 0, 1.5, 1])
    before = np.array([0, 0, 1.5, 1]) - truth @ np.array([0, 0, 1.5, 1])
    assert np.linalg.norm(error[:2]) < 0.3 * np.linalg.norm(before[:2])


def test_color_alignment_compensates_exposure_change() -> None:
    T = pose(0.03, -0.02, 0.01, (0.01, 0.02, -0.01))
    frame = WALL.frame(T)
    brighter = dataclasses.replace(frame, color=np.clip(frame.color * 0.8 + 40.0, 0, 255).astype(np.uint8))
    darker = dataclasses.replace(frame, color=(frame.color * 0.8).astype(np.uint8))
    truth = inverse(T_VIEW) @ T
    _, plain = step(WALL, darker, 0, truth, COLOR)
    _, first = step(WALL, brighter, 0, truth, COLOR)
    assert first.brightness - plain.brightness == pytest.approx(40 / 255, abs=0.003)
    _, second = step(WALL, brighter, 0, truth, COLOR, first.brightness)
    _, alike = step(WALL, darker, 0, truth, COLOR, plain.brightness)
    assert second.brightness == first.brightness
    assert second.matched == pytest.approx(alike.matched, rel=0.01), (
        "expected the same matches: a uniform brightness change is no outlier"
    )
    np.testing.assert_allclose(second.A, alike.A, rtol=0.05, atol=0.01 * np.abs(alike.A).max())


@pytest.mark.parametrize("level", [0, 1, 2])
def test_depth_alignment_step_recovers_motion_between_planes(level: int) -> None:
    corner = Scene(
        planes=[(np.array([0, 0, -1.0]), -1.8), (np.array([0, -0.8, -0.6]), -1.2), (np.array([0.8, 0, -0.6]), -1.4)]
    )
    T = T_VIEW @ exp_se3(np.array([0.01, -0.005, 0.008, 0.004, -0.003, 0.005]))
    truth = inverse(T_VIEW) @ T
    xi, equations = step(corner, corner.frame(T), level, np.eye(4), DEPTH)
    left = inverse(exp_se3(xi)) @ truth
    assert np.linalg.norm(left[:3, 3]) < 0.15 * np.linalg.norm(truth[:3, 3])
    assert equations.matched > 0.8 * equations.visible


def test_depth_alignment_rejects_points_with_different_normals() -> None:
    """The frame shows a wall that is rotated by 60 degrees. Some of its points are close to the wall of the model."""
    n = np.array([np.sin(np.pi / 3), 0.0, -np.cos(np.pi / 3)])
    turned = Scene(planes=[(n, n @ np.array([0.0, 0.0, 1.5]))])
    _, equations = step(WALL, turned.frame(T_VIEW), 0, np.eye(4), DEPTH)
    assert equations.visible > 1000
    assert equations.matched == 0
    _, open_gate = step(WALL, turned.frame(T_VIEW), 0, np.eye(4), DEPTH._replace(min_normal_dot=np.float32(0.3)))
    assert open_gate.matched > 100


def with_noisy_normals(model: ModelView) -> ModelView:
    """Return the model with noisy normals, like those of a distant surface in a map of a single frame."""
    noisy = model.normals + np.random.default_rng(0).normal(0, 0.5, model.normals.shape).astype(np.float32)
    noisy /= np.linalg.norm(noisy, axis=0)
    return model._replace(normals=np.where(model.depth > 0, noisy, 0).astype(np.float32))


@pytest.mark.parametrize("level", [1, 2])
def test_smoothed_normals_allow_motion_along_wall(level: int) -> None:
    """Only the slanted wall at the image border constrains the motion along the frontal wall."""
    room = Scene(planes=[(np.array([0, 0, -1.0]), -2.0), (np.array([-0.8, 0, -0.6]), -1.95)])
    T = T_VIEW @ exp_se3(np.array([0.02, 0, 0, 0, 0, 0]))
    weights = DEPTH._replace(max_distance=np.float32(0.3), geometric_scale=np.float32(16))

    def share_found(seen: Callable[[ModelView], ModelView]) -> float:
        xi, _ = step(room, room.frame(T), level, np.eye(4), weights, seen=seen)
        return float(xi[0] / 0.02)

    assert share_found(lambda model: model) == pytest.approx(1, abs=0.02)
    assert share_found(with_noisy_normals) < 0.8, "expected a shorter step with noisy normals"
    assert share_found(lambda model: smoothed(with_noisy_normals(model), level)) == pytest.approx(1, abs=0.1)


def test_smoothed_normals_are_box_means_without_unmapped_pixels() -> None:
    rng = np.random.default_rng(1)
    normals = rng.normal(0, 1, (3, 12, 17)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=0)
    hole = rng.random((12, 17)) < 0.3
    normals[:, hole] = 0
    model = ModelView((~hole).astype(np.float32), normals, *map(np.float32, (9, 9, 8, 6)))
    assert smoothed(model, 0) is model
    for level, reach in ((1, 1), (2, 3)):
        found = smoothed(model, level)
        np.testing.assert_array_equal(found.depth, model.depth)
        for v in range(reach, 12 - reach):
            for u in range(reach, 17 - reach):
                total = normals[:, v - reach : v + reach + 1, u - reach : u + reach + 1].sum(axis=(1, 2))
                np.testing.assert_allclose(found.normals[:, v, u], total / np.linalg.norm(total), atol=1e-4)


BOTH = COLOR._replace(depth_weight=np.float32(1), color_weight=np.float32(0.1))


def enlarged(
    scale: float, offset: np.ndarray, weights: Weights, linear: LinearWeights | None = None
) -> NormalEquations:
    """Return the normal equations in a scene enlarged by `scale`, at the twist `offset` (6,) from the true pose."""
    frame = CORNER.frame(T_VIEW)
    model, intensities = model_of(CORNER)
    large = model._replace(depth=np.float32(scale) * model.depth)
    level = build_pyramid(CAMERA, np.float32(scale) * frame.depth, frame.color, 1.0, 3)[0]
    return linearize(level, large, intensities[0], exp_se3(offset), weights, 0.0, linear)


@pytest.mark.parametrize("weights", [DEPTH, COLOR, BOTH], ids=["depth", "color", "both"])
def test_alignment_beyond_range_is_scale_invariant(weights: Weights) -> None:
    """All depths are beyond 5 m. The scales are powers of two, which cause no rounding."""
    motion = np.array([0.4, -0.3, 0.5, 0.002, -0.003, 0.001])
    units = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    near, far = (enlarged(scale, motion * np.where(units, scale / 16, 1), weights) for scale in (16, 64))
    assert near.matched > 1000
    assert (far.visible, far.matched, far.close, far.behind) == (near.visible, near.matched, near.close, near.behind)
    for A, A_far in ((near.A, far.A), (near.A_color, far.A_color)):
        A = DepthScale(16.0).without_units(A)
        np.testing.assert_allclose(
            DepthScale(64.0).without_units(A_far), A, rtol=1e-4, atol=1e-4 * np.abs(near.A).max()
        )
    assert far.energy == pytest.approx(near.energy, rel=1e-3)


def test_distance_gate_beyond_range_increases_with_depth() -> None:
    """The default gate increases from 0.1 m to more than 0.3 m at 17 to 23 m. The gate of VoxelHashing is constant."""
    backward = np.array([0, 0, 0.3, 0, 0, 0])
    assert enlarged(16, backward, DEPTH).matched > 1000
    assert enlarged(16, backward, DEPTH, LinearWeights(np.float32(60), np.float32(0.1))).matched == 0
    assert enlarged(1, backward, DEPTH).matched == 0


def test_equations_are_sums_of_separate_terms() -> None:
    offset = np.array([0.004, -0.003, 0.002, 0.002, 0.001, -0.002])
    both, depth, color = (
        enlarged(1, offset, weights) for weights in (BOTH, DEPTH, COLOR._replace(color_weight=np.float32(0.1)))
    )
    np.testing.assert_allclose(both.A, depth.A + color.A)
    np.testing.assert_allclose(both.b, depth.b + color.b)
    np.testing.assert_allclose(both.A_color, color.A)
    assert (both.energy, both.color_energy) == pytest.approx((depth.energy, color.color_energy))
    assert both.matched_colors == color.matched


CORNER = Scene(
    planes=[(np.array([0, 0, -1.0]), -1.8), (np.array([0, -0.8, -0.6]), -1.2), (np.array([0.8, 0, -0.6]), -1.4)],
    contrast=1.0,
)
VOXEL_HASHING = Weights(*map(np.float32, (0.15, 0.05, 0.97, 4.0, 4.0, 0.05, 0.7, 0.5)))
MAXIMA = LinearWeights(np.float32(4.0), np.float32(0.1))


def slow_equations(
    level: PyramidLevel, model: ModelView, intensity: np.ndarray, T: np.ndarray, weights: Weights, linear: LinearWeights
) -> NormalEquations:
    """Return the equations with linear weights, computed with finite differences in double precision."""
    height, width = model.depth.shape
    v, u = np.nonzero(level.depth)
    z = level.depth[v, u].astype(np.float64)
    rays = np.stack([(u - level.camera.cx) / level.camera.fx, (v - level.camera.cy) / level.camera.fy, np.ones(len(u))])
    p = T[:3, :3] @ (rays * z) + T[:3, 3:]
    mu, mv = model.fx * p[0] / p[2] + model.cx + 0.5, model.fy * p[1] / p[2] + model.cy + 0.5
    column, row = np.floor(mu).astype(int), np.floor(mv).astype(int)
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    depth = np.where(inside, model.depth[row, column], 0).astype(np.float64)
    q = depth * np.stack([(column - model.cx) / model.fx, (row - model.cy) / model.fy, np.ones(len(u))])
    n = model.normals[:, row, column].astype(np.float64)
    distance = np.linalg.norm(p - q, axis=0)
    same = (n * (T[:3, :3] @ level.normals[:, v, u])).sum(0) > weights.min_normal_dot
    matched = (depth > 0) & (distance <= weights.max_distance) & same
    w = matched * np.maximum(0, ((1 - distance / weights.max_distance) + (1 - z / linear.max_depth)) / 2)

    scale = width / intensity.shape[1]
    left, top = (np.floor(m / scale - 0.5).astype(int) for m in (mu, mv))
    compared = matched & (left >= 1) & (top >= 1) & (left < intensity.shape[1] - 2) & (top < intensity.shape[0] - 2)
    left, top = np.where(compared, left, 0), np.where(compared, top, 0)
    corners = [intensity[top + j, left + i].astype(np.float64) for j in (0, 1) for i in (0, 1)]
    compared &= np.min(corners, axis=0) >= 0

    def errors(xi: np.ndarray) -> np.ndarray:
        """Return the distances from the planes, m, and the intensity differences (2, P) after a twist."""
        moved = exp_se3(xi)[:3, :3] @ p + exp_se3(xi)[:3, 3:]
        a = (model.fx * moved[0] / moved[2] + model.cx + 0.5) / scale - 0.5 - left
        b = (model.fy * moved[1] / moved[2] + model.cy + 0.5) / scale - 0.5 - top
        i00, i10, i01, i11 = corners
        seen = (1 - b) * ((1 - a) * i00 + a * i10) + b * ((1 - a) * i01 + a * i11)
        return np.stack([(n * (moved - q)).sum(0), seen - level.intensity[v, u]])

    r = errors(np.zeros(6))
    J = np.stack([(errors(h) - errors(-h)) / 2e-6 for h in 1e-6 * np.eye(6)])
    x = compared * np.maximum(0, 1 - np.abs(r[1]) / linear.max_intensity_difference)
    weight = np.stack([w * weights.depth_weight, x * weights.color_weight])
    A = np.einsum("iep,jep,ep->ij", J, J, weight)
    return NormalEquations(
        A, np.einsum("iep,ep->i", J, weight * r), int((depth > 0).sum()), int((w > 0).sum()), 0, 0,
        np.zeros((6, 6)), 0.0, 0.0, 0, 0.0,
    )  # fmt: skip


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("dropped", [{}, {"color_weight": 0}, {"depth_weight": 0}], ids=["both", "depth", "color"])
def test_linear_weights_match_slow_reference(level: int, dropped: dict[str, int]) -> None:
    """Some points exceed each maximum. No projection is on a pixel border."""
    weights = VOXEL_HASHING._replace(**{name: np.float32(value) for name, value in dropped.items()})
    T = exp_se3(np.array([0.011, -0.007, 0.06, 0.003, -0.005, 0.002]))
    frame = CORNER.frame(T_VIEW @ exp_se3(np.array([0.05, -0.03, 0.02, 0.02, -0.03, 0.01])))
    model, intensities = model_of(CORNER)
    pyramid = build_pyramid(CAMERA, frame.depth, frame.color, 1.0, 3)
    arguments = pyramid[level], model, intensities[level], T, weights
    found = linearize(*arguments, 0.0, MAXIMA)
    expected = slow_equations(*arguments, MAXIMA)
    assert found.visible == pytest.approx(expected.visible, rel=1e-3)
    if weights.depth_weight > 0:
        assert found.matched == pytest.approx(expected.matched, rel=1e-3)
        assert 100 / 4**level < expected.matched < 0.95 * expected.visible
    np.testing.assert_allclose(found.A, expected.A, rtol=2e-3, atol=2e-3 * np.abs(expected.A).max())
    np.testing.assert_allclose(found.b, expected.b, rtol=2e-3, atol=2e-3 * np.abs(expected.b).max())


def test_linear_weight_is_zero_at_maximum_depth() -> None:
    """The wall is 1.5 m away. All distances are 0, because the pose is exact."""
    frame = WALL.frame(T_VIEW)
    model, intensities = model_of(WALL)
    level = build_pyramid(CAMERA, frame.depth, frame.color, 1.0, 3)[0]
    weights = VOXEL_HASHING._replace(color_weight=np.float32(0))
    sums = {}
    for max_depth in (0.7, 1.5, 3.0, np.inf):
        linear = LinearWeights(np.float32(max_depth), np.float32(0.1))
        sums[max_depth] = linearize(level, model, intensities[0], np.eye(4), weights, 0.0, linear).A[2, 2]
    ratios = [sums[max_depth] / sums[np.inf] for max_depth in (3.0, 1.5)]
    assert ratios == pytest.approx([0.75, 0.5], rel=0.03)
    assert sums[0.7] == 0


def test_linear_weights_require_matching_normals_for_color() -> None:
    n = np.array([np.sin(np.pi / 3), 0.0, -np.cos(np.pi / 3)])
    frame = Scene(planes=[(n, n @ np.array([0.0, 0.0, 1.5]))]).frame(T_VIEW)
    model, intensities = model_of(WALL)
    level = build_pyramid(CAMERA, frame.depth, frame.color, 1.0, 3)[0]
    weights = COLOR._replace(max_distance=np.float32(1))
    by_color = [
        linearize(level, model, intensities[0], np.eye(4), weights, 0.0, linear)
        for linear in (None, LinearWeights(np.float32(4), np.float32(1)))
    ]
    assert by_color[0].matched > 100
    assert by_color[1].matched == 0


@pytest.mark.parametrize("kind", SensorKind)
def test_geometric_weight_is_inverse_variance_of_sensor(kind: SensorKind) -> None:
    """For the translation along z, a point with normal n has the information (n_z / sigma)^2."""
    frame = WALL.frame(T_VIEW)
    model, intensities = model_of(WALL)
    level = build_pyramid(CAMERA, frame.depth, frame.color, 1.0, 3, kind)[0]
    A = linearize(level, model, intensities[0], np.eye(4), DEPTH, 0.0).A
    matched = level.normals.any(axis=0) & (model.depth > 0)
    information = (model.normals[2, matched].astype(float) / kind.sigma(level.depth[matched].astype(float))) ** 2
    assert A[2, 2] == pytest.approx(information.sum(), rel=1e-3)

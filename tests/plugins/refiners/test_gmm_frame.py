"""Tests for refiner=gmm_frame, compared with a slow reference in float64."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from framework.data import Camera, Float32, Float64, Frame, Int32, PointClusters
from framework.errors import ConfigError
from plugins.refiners.gmm_frame import ForeignPoints, GmmFrame, Initialization
from tests.support.thread_counts import by_one_thread_and_two

CAMERA = Camera(80, 60, 60.0, 60.0, 39.5, 29.5)
FRAME = Frame(0, 0.0, np.zeros((60, 80, 3), np.uint8), np.ones((60, 80), np.float32), CAMERA)
CLASSES = ("chair", "bed")


def clusters_of(points: Float32, masks: Int32, scores: tuple[float, ...], pixels: Int32 | None = None) -> PointClusters:
    """Return the points as clusters. By default, all pixels are different."""
    n = np.arange(len(points))
    return PointClusters(
        points_world=points,
        pixels=np.stack([n % 80, n // 80], axis=1).astype(np.int32) if pixels is None else pixels,
        cluster=masks,
        class_probabilities=np.full((len(scores), 2), 0.5, np.float32),
        scores=np.array(scores, np.float32),
        classes=CLASSES,
    )


def three_objects(seed: int, bleed: float = 0.15) -> tuple[Float32, Int32, Int32]:
    """Return the points (S, 3), m, of three curved objects, their masks (S,) with errors, and the true objects (S,)."""
    rng = np.random.default_rng(seed)
    centers = np.array([[0.0, 0.0, 2.0], [0.5, 0.1, 2.2], [0.1, 0.6, 1.7]])
    truth = np.sort(rng.integers(0, 3, 900))
    spread = rng.normal(size=(900, 3)) * [0.14, 0.1, 0.02]
    spread[:, 2] += 3 * spread[:, 0] ** 2
    masks = np.where(rng.random(900) < bleed, rng.integers(0, 3, 900), truth)
    order = np.argsort(masks, kind="stable")
    return (centers[truth] + spread)[order].astype(np.float32), masks[order].astype(np.int32), truth[order]


# Reference


@dataclasses.dataclass
class Gaussian:
    weight: float
    mean: Float64
    Sigma: Float64
    mask: int

    def log_density(self, points: Float64) -> Float64:
        return np.log(self.weight) + np.asarray(multivariate_normal(self.mean, self.Sigma).logpdf(points))


def floored(Sigma: Float64, floor: float) -> Float64:
    values, vectors = np.linalg.eigh(Sigma)
    return np.asarray((vectors * np.maximum(values, floor)) @ vectors.T)


def m_step(points: Float64, gamma: Float64, masks: list[int], floor: float) -> list[Gaussian]:
    """Return the Gaussians of the M-step, eqs. (3) and (4)."""
    found = []
    for k, mask in enumerate(masks):
        N_k = gamma[:, k].sum()
        if N_k < 4:
            continue
        mean = gamma[:, k] @ points / N_k
        Sigma = (gamma[:, k, None] * (points - mean)).T @ (points - mean) / N_k
        found.append(Gaussian(N_k / len(points), mean, floored(Sigma, floor), mask))
    return found


def em(points: Float64, gaussians: list[Gaussian], refiner: GmmFrame) -> list[Gaussian]:
    """Return the Gaussians of the EM algorithm, eqs. (2) to (4)."""
    previous = -np.inf
    for _ in range(refiner.max_iterations):
        logs = np.stack([gaussian.log_density(points) for gaussian in gaussians], axis=1)
        total = np.logaddexp.reduce(logs, axis=1)
        gamma = np.exp(logs - total[:, None])
        gaussians = m_step(points, gamma, [gaussian.mask for gaussian in gaussians], refiner.std_floor**2)
        if total.mean() - previous < refiner.tolerance:
            break
        previous = total.mean()
    return gaussians


def split(node: Gaussian, points: Float64, refiner: GmmFrame) -> list[Gaussian]:
    """Return the children of a node, or only the node if it has too few points.

    The sum of the children's weights is the weight of the node.
    """
    if len(points) < 32:
        return [node]
    values, vectors = np.linalg.eigh(node.Sigma)
    axes = {2: [2], 4: [1, 2], 8: [0, 1, 2]}[refiner.children]
    start = []
    for corner in np.ndindex(*[2] * len(axes)):
        offset = sum((1 - 2 * side) * np.sqrt(values[a]) * vectors[:, a] for side, a in zip(corner, axes, strict=True))
        start.append(Gaussian(1 / refiner.children, node.mean + offset, node.Sigma / 4, node.mask))
    kept = [child for child in em(points, start, refiner) if child.weight * node.weight >= refiner.min_support]
    total = sum(child.weight for child in kept)
    return [dataclasses.replace(child, weight=child.weight / total * node.weight) for child in kept] or [node]


def slow_masks(refiner: GmmFrame, points: Float32, masks: Int32, count: int) -> Int32:
    """Return the mask (S,) of the most probable leaf of each point."""
    x = points.astype(np.float64)
    first = m_step(x, np.eye(count)[masks], list(range(count)), refiner.std_floor**2)
    leaves = em(x, first, refiner)
    for _ in range(1, refiner.levels):
        best = np.stack([leaf.log_density(x) for leaf in leaves]).argmax(axis=0)
        leaves = [child for j, leaf in enumerate(leaves) for child in split(leaf, x[best == j], refiner)]
    best = np.stack([leaf.log_density(x) for leaf in leaves]).argmax(axis=0)
    return np.array([leaf.mask for leaf in leaves], np.int32)[best]


@pytest.mark.parametrize("children", [2, 4, 8])
@pytest.mark.parametrize("levels", [1, 2])
@pytest.mark.parametrize("seed", [0, 1])
def test_gmm_frame_point_assignment_matches_reference(levels: int, children: int, seed: int) -> None:
    refiner = GmmFrame(levels=levels, children=children, min_points=1)
    points, masks, truth = three_objects(seed)
    refined = refiner.refine(clusters_of(points, masks, (0.9, 0.8, 0.7)), FRAME)
    expected = slow_masks(refiner, points, masks, 3)
    found = np.empty(len(points), np.int32)
    found[refined.pixels[:, 0] + 80 * refined.pixels[:, 1]] = refined.cluster
    assert len(refined.cluster) == len(points)
    assert (found != expected).mean() < 0.005  # ties can be resolved differently in single precision
    assert (found == truth).mean() > 0.93 > (masks == truth).mean()
    assert (np.diff(refined.cluster) >= 0).all()


@pytest.mark.parametrize("treatment", ForeignPoints)
def test_gmm_frame_foreign_points_are_moved_dropped_or_kept(treatment: ForeignPoints) -> None:
    points, masks, _ = three_objects(2)
    clusters = clusters_of(points, masks, (0.9, 0.8, 0.7))
    expected = slow_masks(GmmFrame(), points, masks, 3)
    refined = GmmFrame(foreign_points=treatment).refine(clusters, FRAME)
    sizes = np.bincount(refined.cluster, minlength=3)
    moved = np.bincount(expected, minlength=3)
    stayed = np.bincount(masks[expected == masks], minlength=3)
    by_treatment = {
        ForeignPoints.MOVE: moved, ForeignPoints.DROP: stayed, ForeignPoints.STAY: np.bincount(masks, minlength=3),
    }  # fmt: skip
    np.testing.assert_allclose(sizes, by_treatment[treatment], atol=4)


def test_gmm_frame_shared_pixel_is_assigned_by_mask_score() -> None:
    points, masks, _ = three_objects(3, bleed=0.0)
    n = np.arange(len(points))
    pixels = np.stack([n % 80, n // 80], axis=1).astype(np.int32)
    again = np.flatnonzero(masks == 1)  # mask 2 covers mask 1 and has the higher score
    clusters = clusters_of(
        np.concatenate([points, points[again]]),
        np.concatenate([masks, np.full(len(again), 2, np.int32)]),
        (0.9, 0.4, 0.7),
        np.concatenate([pixels, pixels[again]]),
    )
    refined = GmmFrame(foreign_points=ForeignPoints.STAY).refine(clusters, FRAME)
    assert len(np.unique(refined.pixels, axis=0)) == len(refined.pixels) == len(points)
    assert set(np.unique(refined.cluster)) == {0, 2}
    equal = dataclasses.replace(clusters, scores=np.float32([0.9, 0.7, 0.7]))
    assert set(np.unique(GmmFrame(foreign_points=ForeignPoints.STAY).refine(equal, FRAME).cluster)) == {0, 1, 2}


def test_gmm_frame_small_cluster_is_dropped() -> None:
    points, masks, _ = three_objects(4, bleed=0.0)
    kept = (masks != 1) | (np.cumsum(masks == 1) <= 20)
    clusters = clusters_of(points[kept], masks[kept], (0.9, 0.8, 0.7))
    for min_points, left in ((10, {0, 1, 2}), (30, {0, 2})):
        refined = GmmFrame(min_points=min_points, foreign_points=ForeignPoints.STAY).refine(clusters, FRAME)
        assert set(np.unique(refined.cluster)) == left
        assert len(refined) == 3, "expected one cluster per detection"


def test_gmm_frame_k_means_start_finds_objects() -> None:
    points, masks, truth = three_objects(5)
    clusters = clusters_of(points, masks, (0.9, 0.8, 0.7))
    by_masks, by_k_means = (
        GmmFrame(levels=1, initialization=start, max_iterations=1).refine(clusters, FRAME).cluster
        for start in Initialization
    )
    assert not np.array_equal(by_masks, by_k_means)
    refined = GmmFrame(initialization=Initialization.K_MEANS).refine(clusters, FRAME)
    found = np.empty(len(points), np.int32)
    found[refined.pixels[:, 0] + 80 * refined.pixels[:, 1]] = refined.cluster
    assert (found == truth).mean() > 0.93


def test_gmm_frame_several_gaussians_per_mask_form_object() -> None:
    points, masks, truth = three_objects(6)
    refined = GmmFrame(levels=1, gaussians_per_mask=3).refine(clusters_of(points, masks, (0.9, 0.8, 0.7)), FRAME)
    found = np.empty(len(points), np.int32)
    found[refined.pixels[:, 0] + 80 * refined.pixels[:, 1]] = refined.cluster
    assert (found == truth).mean() > 0.9


def test_gmm_frame_fit_on_subset_assigns_all_points() -> None:
    points, masks, truth = three_objects(7)
    refined = GmmFrame(max_points=200).refine(clusters_of(points, masks, (0.9, 0.8, 0.7)), FRAME)
    assert len(refined.cluster) == len(points)
    assert abs(np.bincount(refined.cluster) - np.bincount(truth)).max() < 40


def test_gmm_frame_empty_mask_or_frame_gives_no_points() -> None:
    points, masks, _ = three_objects(8)
    refined = GmmFrame().refine(clusters_of(points, masks * 2, (0.9, 0.8, 0.7, 0.6, 0.5)), FRAME)
    assert set(np.unique(refined.cluster)) == {0, 2, 4}
    nothing = clusters_of(points[:0], masks[:0], (0.9,))
    assert len(GmmFrame().refine(nothing, FRAME).cluster) == 0


def test_gmm_frame_does_not_depend_on_thread_count() -> None:
    points, masks, _ = three_objects(9)
    clusters = clusters_of(points, masks, (0.9, 0.8, 0.7))
    by_one, by_two = by_one_thread_and_two(lambda: GmmFrame().refine(clusters, FRAME).cluster.tobytes())
    assert by_one == by_two


def test_gmm_frame_invalid_children_count_raises() -> None:
    with pytest.raises(ConfigError, match="children: expected 2, 4 or 8, got 3"):
        GmmFrame(children=3)

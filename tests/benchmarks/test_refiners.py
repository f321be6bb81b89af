"""Speed of the refiners on ten masks at 640x480.

The mixtures of gmm_em are compared with scikit-learn and with gmm_tree. Run with `python -m pytest
tests/benchmarks/test_refiners.py -s`.
"""

from __future__ import annotations

import time

import numba
import numpy as np
import pytest
from sklearn.mixture import GaussianMixture

from framework.data import Camera, Detections, Frame, PointClusters, Pose
from framework.interfaces import ClusterRefiner
from framework.refinement.lifting import lift
from framework.refinement.mixtures import mixture, mixture_tree
from framework.refinement.mixtures.mixture_kernels import EmSettings, Mixtures
from framework.refinement.neighborhood import Ring, surroundings
from plugins.refiners.chain import Chain
from plugins.refiners.connected import Connected
from plugins.refiners.dbscan import Dbscan
from plugins.refiners.geometric import Geometric
from plugins.refiners.gmm_em import GmmEm
from plugins.refiners.gmm_tree import GmmTree
from plugins.refiners.identity import Identity
from plugins.refiners.kmeans import KMeans
from plugins.refiners.largest_component import LargestComponent
from plugins.refiners.plane_removal import PlaneRemoval
from plugins.refiners.rank_order import RankOrder
from tests.support.tree_densities import leaves, log_likelihoods

MASKS = 10
CAMERA = Camera(640, 480, 540.0, 540.0, 319.5, 239.5)


def ten_masks() -> tuple[PointClusters, Frame]:
    """Return the clusters and the noisy frame of ten ellipsoids in front of a wall.

    The masks bleed onto the wall by 8 px.
    """
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:480, :640]
    depth = 2.5 + 0.001 * u
    masks = np.zeros((MASKS, 480, 640), np.bool_)
    for k in range(MASKS):
        cu, cv, radius = 70 + 125 * (k % 5), 120 + 240 * (k // 5), rng.uniform(30, 100)
        distance = np.hypot(u - cu, v - cv)
        bulge = 1.5 + 0.3 * k / MASKS - 0.2 * np.sqrt(np.clip(1 - (distance / radius) ** 2, 0, 1))
        depth = np.where(distance < radius, bulge, depth)
        masks[k] = distance < radius + 8
    depth += rng.normal(0, 0.0019, depth.shape) * depth**2
    frame = Frame(0, 0.0, np.zeros((480, 640, 3), np.uint8), depth.astype(np.float32), CAMERA)
    ones = np.ones(MASKS, np.float32)
    detections = Detections(masks, np.zeros((MASKS, 4), np.float32), ones, ones[:, None], ("thing",))
    return lift(detections, frame, Pose(np.eye(4))), frame


def default_chain() -> Chain:
    """Return the refiner of conf/refiner/chain.yaml. Its time budget is 10 ms on 2 cores."""
    return Chain({"plane_removal": PlaneRemoval(), "gmm_em": GmmEm(), "connected": Connected()})


@pytest.mark.parametrize(
    "refiner",
    [
        default_chain(),
        Identity(),
        GmmEm(),
        GmmTree(),
        KMeans(),
        LargestComponent(),
        Connected(),
        PlaneRemoval(),
        Dbscan(),
        RankOrder(),
        Geometric(),
    ],
    ids=lambda r: type(r).__name__,
)
def test_refine_ten_masks_speed(benchmark, refiner: ClusterRefiner):
    clusters, frame = ten_masks()
    refiner.refine(clusters, frame)
    refined = benchmark(refiner.refine, clusters, frame)
    assert len(refined) == MASKS
    benchmark.extra_info["points"] = len(clusters.cluster)
    benchmark.extra_info["points left"] = len(refined.cluster)
    benchmark.extra_info["threads"] = numba.get_num_threads()


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_gmm_em_agrees_with_scikit_learn(benchmark):
    iterations, components = 8, 8
    clusters, frame = ten_masks()
    sample = surroundings(clusters, frame, Ring()).sampled(1000)
    # scikit-learn rejects initial labels with empty groups
    labels = (np.arange(len(sample.points_camera)) * 7 // 3 % components).astype(np.int32)

    def ours() -> Mixtures:
        return mixture.fit(
            sample.points_camera, sample.starts, labels, components, EmSettings(iterations, -np.inf, 1e-6, 0.0),
        )  # fmt: skip

    def theirs() -> np.ndarray:
        lower_bounds = np.zeros(MASKS)
        for k in range(MASKS):
            own = slice(sample.starts[k], sample.starts[k + 1])
            points, own_labels = sample.points_camera[own].astype(np.float64), labels[own]
            groups = [points[own_labels == j] for j in range(components)]
            reference = GaussianMixture(
                components,
                max_iter=iterations,
                tol=0.0,
                reg_covar=0.0,
                weights_init=np.array([len(group) for group in groups]) / len(points),
                means_init=np.array([group.mean(axis=0) for group in groups]),
                precisions_init=np.array([np.linalg.inv(np.cov(group.T, bias=True)) for group in groups]),
            )
            lower_bounds[k] = reference.fit(points).lower_bound_
        return lower_bounds

    ours()
    fitted = benchmark(ours)
    begin = time.perf_counter()
    lower_bounds = theirs()
    their_seconds = time.perf_counter() - begin
    np.testing.assert_allclose(fitted.log_likelihoods, lower_bounds, rtol=1e-3)
    ratio = their_seconds / benchmark.stats.stats.median
    benchmark.extra_info["times faster than scikit-learn"] = ratio
    print(f"\nEM of {MASKS} mixtures: {1e3 * benchmark.stats.stats.median:.1f} ms, scikit-learn "
          f"{1e3 * their_seconds:.0f} ms: {ratio:.0f} times faster")  # fmt: skip
    assert ratio > 5


@pytest.mark.parametrize(("levels", "components"), [(2, 64), (3, 512)])
def test_gmm_tree_fit_is_faster_than_flat_mixture(benchmark, levels: int, components: int):
    """Both fits have the same points, initialization, iterations and number of Gaussians."""
    clusters, frame = ten_masks()
    sample = surroundings(clusters, frame, Ring()).sampled(10_000)
    points, starts = sample.points_camera, sample.starts
    em = EmSettings(8, 1e-3, 0.01**2, 0.02)

    def tree() -> mixture_tree.MixtureTree:
        return mixture_tree.fit(points, starts, em, levels=levels, children=8, min_support=0.0, min_points=32)

    def flat() -> Mixtures:
        return mixture.fit(points, starts, mixture_tree.cut(points, starts, components), components, em)

    tree(), flat()
    grown = benchmark.pedantic(tree, rounds=9)
    seconds = []
    for _ in range(5):
        begin = time.perf_counter()
        fitted = flat()
        seconds.append(time.perf_counter() - begin)
    ratio = float(np.median(seconds)) / benchmark.stats.stats.median
    benchmark.extra_info["times faster than flat"] = ratio
    count = sum(len(rows) for _, rows in leaves(grown, levels)) / MASKS
    likelihood = float(log_likelihoods(grown, points, starts).mean())
    tree_ms, flat_ms = 1e3 * benchmark.stats.stats.median, 1e3 * float(np.median(seconds))
    print(f"\n{MASKS} mixtures of {components} ({count:.0f} leaves): tree {tree_ms:.0f} ms, flat {flat_ms:.0f} ms, "
          f"{ratio:.1f} times faster; log p {likelihood:.2f} and {fitted.log_likelihoods.mean():.2f}")  # fmt: skip
    assert count > 0.8 * components
    assert ratio > 1

"""Tests for Gaussian mixtures, compared with scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.mixture import GaussianMixture

from framework.refinement.mixtures import mixture
from framework.refinement.mixtures.mixture_kernels import EmSettings, Mixtures


def blobs(seed: int, count: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of four overlapping Gaussians far from the origin, and start labels that are half wrong."""
    rng = np.random.default_rng(seed)
    true = rng.integers(0, 4, count)
    mixing = rng.normal(0, 0.2, (4, 3, 3)) + 0.1 * np.eye(3)
    points = rng.normal(size=(count, 3))
    points = np.einsum("nij,nj->ni", mixing[true], points) + rng.normal([0, 0, 3], 0.4, (4, 3))[true]
    labels = np.where(rng.random(count) < 0.5, rng.integers(0, 4, count), true)
    return points.astype(np.float32), labels.astype(np.int32)


def sklearn_from(points: np.ndarray, labels: np.ndarray, iterations: int, floor: float = 0.0) -> GaussianMixture:
    """Return the mixture of scikit-learn after an M-step with `labels`."""
    covariances = np.array([np.cov(points[labels == j].T, bias=True) for j in range(4)], np.float64)
    reference = GaussianMixture(
        4,
        max_iter=iterations,
        tol=0.0,
        reg_covar=floor,
        weights_init=np.bincount(labels, minlength=4) / len(labels),
        means_init=np.array([points[labels == j].mean(axis=0) for j in range(4)], np.float64),
        precisions_init=np.linalg.inv(covariances),
    )
    return reference.fit(points.astype(np.float64))


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("iterations", [1, 8])
def test_mixture_fit_matches_scikit_learn(iterations):
    sets = [blobs(seed, 2000 + 500 * seed) for seed in range(3)]
    points, labels = np.concatenate([p for p, _ in sets]), np.concatenate([label for _, label in sets])
    starts = np.cumsum([0] + [len(p) for p, _ in sets])
    ours = mixture.fit(
        points, starts, labels, 4, EmSettings(iterations, -np.inf, 1e-12, 0.0),
    )  # fmt: skip
    for k, (own_points, own_labels) in enumerate(sets):
        reference = sklearn_from(own_points, own_labels, iterations)
        assert ours.iterations[k] == iterations
        np.testing.assert_allclose(ours.weights[k], reference.weights_, atol=1e-4)
        np.testing.assert_allclose(ours.means[k], reference.means_, atol=1e-4)
        np.testing.assert_allclose(ours.covariances[k], reference.covariances_, atol=1e-4)
        assert ours.log_likelihoods[k] == pytest.approx(reference.lower_bound_, abs=1e-5)
        posterior = reference.predict_proba(own_points.astype(np.float64))[:, :2].sum(axis=1)
        claimed = mixture.likely_members(points, starts[:-1], starts[1:], ours, own_components=2, min_posterior=0.5)
        claimed = claimed[starts[k] : starts[k + 1]]
        clear = np.abs(posterior - 0.5) > 1e-3
        np.testing.assert_array_equal(claimed[clear], posterior[clear] > 0.5)


@pytest.mark.parametrize("bound", [0.1, 0.5, 0.9])
def test_likely_members_match_analytic_posterior(bound):
    """The object is a Gaussian at x = -1. The background is a Gaussian at x = 1 and a uniform density."""
    ours = Mixtures(
        weights=np.array([[0.3, 0.6]]),
        means=np.array([[[-1.0, 0, 0], [1.0, 0, 0]]]),
        covariances=np.array([[np.eye(3), np.eye(3)]]),
        outlier_weights=np.array([0.1]),
        outlier_densities=np.array([0.01]),
        log_likelihoods=np.zeros(1),
        iterations=np.zeros(1, np.int64),
    )
    points = np.zeros((400, 3), np.float32)
    points[:, 0] = np.linspace(-6, 6, 400)
    odds = np.linspace(2, -2, 400).astype(np.float32)
    normal = [np.exp(-0.5 * (points[:, 0] - mu) ** 2) / (2 * np.pi) ** 1.5 for mu in (-1, 1)]
    own = 0.3 * normal[0] * np.exp(odds)
    posterior = own / (own + 0.6 * normal[1] + 0.1 * 0.01)
    claimed = mixture.likely_members(
        points, np.array([0]), np.array([400]), ours, own_components=1, min_posterior=bound, prior_log_odds=odds
    )
    np.testing.assert_array_equal(claimed, posterior > bound)
    nothing = np.array([0])
    assert not mixture.likely_members(points, nothing, nothing, ours, own_components=1, min_posterior=bound).any()


@pytest.mark.parametrize("components", [1, 3, 8])
def test_likely_members_match_full_posterior(components):
    """Points far from the decision boundary are decided without computing all densities."""
    rng = np.random.default_rng(components)
    n = components + 2
    ours = Mixtures(
        weights=rng.dirichlet(np.ones(n + 1), 2)[:, :n],
        means=rng.normal(0, 0.5, (2, n, 3)),
        covariances=np.tile(0.3**2 * np.eye(3), (2, n, 1, 1)),
        outlier_weights=np.array([0.1, 0.0]),
        outlier_densities=np.array([0.05, 0.05]),
        log_likelihoods=np.zeros(2),
        iterations=np.zeros(2, np.int64),
    )
    points = rng.normal(0, 1, (10_000, 3)).astype(np.float32)
    odds = rng.uniform(-2, 2, 10_000).astype(np.float32)
    starts = np.array([0, 5100, 10_000])
    claimed = mixture.likely_members(
        points, starts[:-1], starts[1:], ours, own_components=2, min_posterior=0.4, prior_log_odds=odds
    )
    for k in range(2):
        own = slice(starts[k], starts[k + 1])
        squares = ((points[own, None].astype(np.float64) - ours.means[k]) ** 2).sum(axis=-1) / 0.3**2
        densities = ours.weights[k] * np.exp(-0.5 * squares) / ((2 * np.pi) ** 1.5 * 0.3**3)
        object_part = densities[:, :2].sum(axis=1) * np.exp(odds[own])
        others = densities[:, 2:].sum(axis=1) + ours.outlier_weights[k] * ours.outlier_densities[k]
        posterior = object_part / (object_part + others)
        clear = np.abs(posterior - 0.4) > 1e-4
        assert clear.mean() > 0.99
        np.testing.assert_array_equal(claimed[own][clear], posterior[clear] > 0.4)


def test_mixture_fit_likelihood_increases_until_tolerance():
    points, labels = blobs(5)
    starts = np.array([0, len(points)])
    fits = [
        mixture.fit(points, starts, labels, 4, EmSettings(i, -np.inf, 1e-6, 0.02))
        for i in range(1, 20)
    ]  # fmt: skip
    assert (np.diff([fit.log_likelihoods[0] for fit in fits]) > -1e-4).all(), "expected decreases only by rounding"
    stopped = mixture.fit(points, starts, labels, 4, EmSettings(1000, 1e-3, 1e-6, 0.02))
    assert stopped.iterations[0] < 1000
    before = fits[stopped.iterations[0] - 2].log_likelihoods[0]
    assert stopped.log_likelihoods[0] - before < 1e-3
    total = stopped.weights.sum() + stopped.outlier_weights
    assert total == pytest.approx(1.0)


def test_mixture_fit_floors_only_small_eigenvalues():
    """All points are on a slanted plane, so the eigenvalue along the normal is below the minimum."""
    rng = np.random.default_rng(0)
    plane = rng.normal(size=(5000, 2)) * [0.5, 0.3]
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = (plane @ axes[:2] + [0, 0, 2]).astype(np.float32)
    fitted = mixture.fit(
        points, np.array([0, 5000]), np.zeros(5000, np.int32), 1, EmSettings(1, 0.0, 0.02**2, 0.0),
    )  # fmt: skip
    sample = np.linalg.eigvalsh(np.cov(points.T.astype(np.float64), bias=True))
    assert sample[0] < 1e-9
    np.testing.assert_allclose(np.linalg.eigvalsh(fitted.covariances[0, 0]), [0.02**2, sample[1], sample[2]], rtol=1e-6)
    assert abs(axes[2] @ fitted.covariances[0, 0] @ axes[2] - 0.02**2) < 1e-9


def test_mixture_fit_assigns_outliers_to_uniform_component():
    rng = np.random.default_rng(1)
    cluster, noise = rng.normal(0, 0.02, (2000, 3)), rng.uniform(-1, 1, (200, 3))
    points = np.concatenate([cluster, noise]).astype(np.float32)
    starts, labels = np.array([0, 2200]), np.zeros(2200, np.int32)
    fitted = mixture.fit(points, starts, labels, 1, EmSettings(50, 1e-6, 1e-6, 0.05))
    assert fitted.outlier_weights[0] == pytest.approx(200 / 2200, rel=0.05)
    np.testing.assert_allclose(fitted.covariances[0, 0], 0.02**2 * np.eye(3), atol=1e-4)
    claimed = mixture.likely_members(points, starts[:-1], starts[1:], fitted, own_components=1, min_posterior=0.5)
    assert claimed[:2000].mean() > 0.99
    assert claimed[2000:].mean() < 0.02


def test_mixture_fit_small_sets_stay_finite():
    points = np.ones((6, 3), np.float32)
    fitted = mixture.fit(
        points, np.array([0, 0, 2, 6]), np.zeros(6, np.int32), 2, EmSettings(5, 0.0, 1e-4, 0.0),
    )  # fmt: skip
    assert fitted.weights.tolist() == [[0, 0], [0, 0], [1, 0]]
    assert np.isfinite(fitted.log_likelihoods).all()
    starts = np.array([0, 0, 2, 6])
    assert mixture.likely_members(points, starts[:-1], starts[1:], fitted, own_components=1, min_posterior=0.5).all()


def test_mixture_fit_prior_separates_equal_components():
    """The two components are equal at the start, so the first means depend only on the prior."""
    points = np.zeros((200, 3), np.float32)
    points[:, 0] = np.linspace(-1, 1, 200)
    odds = np.where(points[:, 0] < 0, np.log(4), -np.log(4)).astype(np.float32)
    fitted = mixture.fit(
        points, np.array([0, 200]), (np.arange(200) // 2 % 2).astype(np.int32), 2, EmSettings(1, 0.0, 1e3, 0.0),
        prior_log_odds=odds,
    )  # fmt: skip
    mean = float(np.abs(points[:, 0]).mean())
    np.testing.assert_allclose(fitted.means[0, :, 0], [-0.6 * mean, 0.6 * mean], atol=1e-3)

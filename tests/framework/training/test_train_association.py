"""Tests for the training of the learned association."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from framework.mapping.instances.learned_association import FEATURES, AssociationScorer, CandidatePairs
from framework.training.association_samples import Sample, record_room, stacked
from framework.training.train_association import (
    fit,
    initial_weights,
    log_losses,
    log_odds,
    match_best,
    quality,
    train,
)


def random_sample(seed: int, clusters: int = 5, instances: int = 4) -> Sample:
    """Return a sample in which the first feature determines the correct pairs."""
    rng = np.random.default_rng(seed)
    n, m = np.nonzero(rng.uniform(size=(clusters, instances)) < 0.7)
    features = rng.uniform(size=(len(n), len(FEATURES)))
    best = np.zeros((clusters, instances))
    best[n, m] = features[:, 0]
    is_correct = (features[:, 0] == best.max(axis=1)[n]) & (features[:, 0] > 0.5)
    return Sample(
        pairs=CandidatePairs(n, m, features),
        shape=(clusters, instances),
        is_correct=is_correct,
        new_is_correct=best.max(axis=1) <= 0.5,
    )


def test_scorer_matches_network_in_torch() -> None:
    weights = initial_weights(0)
    sample = random_sample(0)
    scorer = AssociationScorer({name: weight.detach().double().numpy() for name, weight in weights.items()})
    scores = scorer.scores(sample.pairs, sample.shape)
    features, cluster, instance, *_ = (torch.from_numpy(one) for one in stacked([sample]))
    expected = log_odds(weights, features.float(), cluster, instance).detach().numpy()
    assert scores[sample.pairs.clusters, sample.pairs.instances] == pytest.approx(expected, abs=1e-4)
    assert np.isneginf(scores).sum() == scores.size - len(expected)


def test_log_losses_are_negative_log_probabilities() -> None:
    score = torch.tensor([1.0, -2.0, 0.5])
    cluster = torch.tensor([0, 0, 2])
    found = log_losses(
        score, cluster, torch.tensor([False, True, False]), torch.tensor([False, True, True])
    )  # cluster 1 has no pairs
    expected = [-np.log(np.exp(-2) / (1 + np.exp(1) + np.exp(-2))), -np.log(1 / (1 + np.exp(0.5)))]
    assert found.tolist() == pytest.approx(expected, rel=1e-5)


def test_stacked_samples_are_scored_independently() -> None:
    samples, weights = [random_sample(1), random_sample(2)], initial_weights(0)
    together = log_odds(weights, *_tensors(samples))
    separate = torch.cat([log_odds(weights, *_tensors([sample])) for sample in samples])
    assert torch.allclose(together, separate, atol=1e-5)


def _tensors(samples: list[Sample]) -> list[torch.Tensor]:
    features, cluster, instance, *_ = stacked(samples)
    return [torch.from_numpy(features).float(), torch.from_numpy(cluster), torch.from_numpy(instance)]


@pytest.mark.integration
def test_fit_is_reproducible() -> None:
    samples = [random_sample(k) for k in range(8)]
    first, second, other = fit(samples, 0, epochs=2), fit(samples, 0, epochs=2), fit(samples, 1, epochs=2)
    assert all((first[name] == second[name]).all() for name in first)
    assert (first["pair.weight"] != other["pair.weight"]).any()


@pytest.mark.integration
def test_fit_learns_rule() -> None:
    weights = fit([random_sample(k) for k in range(200)], 0, epochs=30)
    scorer = AssociationScorer({name: weight.astype(np.float64) for name, weight in weights.items()})
    held_out = [random_sample(k) for k in range(1000, 1050)]
    found = quality(scorer, held_out)
    assert found.accuracy > 0.75 > found.accuracy_of_rule
    assert found.decisions == sum(len(sample.decided) for sample in held_out)
    assert found.log_loss < found.log_loss_of_rule


def test_match_best_allows_shared_columns() -> None:
    preference = np.array([[0.3, 0.9], [0.1, 0.8], [0.7, 0.2]])
    assert match_best(preference > 0.25, preference).tolist() == [1, 1, 0]
    assert match_best(preference > 0.85, preference).tolist() == [1, -1, -1]
    assert match_best(np.zeros((2, 0), np.bool_), np.zeros((2, 0))).tolist() == [-1, -1]


@pytest.mark.integration
def test_recorded_room_is_reproducible() -> None:
    first, second = record_room(1, frames=4, runs=1), record_room(1, frames=4, runs=1)
    assert len(first) == len(second) > 0
    for a, b in zip(first, second, strict=True):
        assert a.pairs.features.tobytes() == b.pairs.features.tobytes()
        assert a.is_correct.tolist() == b.is_correct.tolist()
    # each cluster with pairs has a correct decision
    for sample in first:
        of_pair = np.bincount(sample.pairs.clusters[sample.is_correct], minlength=sample.shape[0]) > 0
        assert (of_pair | sample.new_is_correct)[sample.decided].all()


@pytest.mark.integration
def test_train_writes_usable_weights(tmp_path: Path) -> None:
    found = train(tmp_path / "weights.safetensors", seed=0, rooms=1, held_out=1, frames=6)
    assert found.decisions > 0
    scorer = AssociationScorer.load(tmp_path / "weights.safetensors")
    assert np.isfinite(scorer.scores(random_sample(0).pairs, random_sample(0).shape)).any()

"""Calibration of instance probabilities: measurement, and learning from runs with ground truth.

Learn the calibration of a detector from completed runs, and write its file:

    python -m tests.acceptance.instance_calibration learn plugins/detectors/NAME.calibration.json RUN_DIR...

Print the calibration of scenes that it has not seen (leave one scene out). The runs of one network are in one folder:

    python -m tests.acceptance.instance_calibration check RUN_DIR...
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from framework.api import load_scene
from framework.data import Float64
from framework.evaluation.calibration import Forecasts
from framework.evaluation.instances import judge_class_agnostic
from framework.mapping.instances.calibration import (
    Calibration,
    Features,
    Probabilities,
    class_terms,
    existence_terms,
    iou_terms,
)
from framework.mapping.instances.instance_list import InstanceTableMap
from framework.runs.reevaluation import Truth, classes_of, read_predictions
from framework.runs.stored_runs import MAP, read_record

RIDGE = 3.0  # weight of the squared distance to the prior weights, as a number of instances


@dataclass(frozen=True)
class Sample:
    """An instance of a run with its comparison with the ground truth."""

    scene: str
    features: Features
    today: tuple[float, float]  # confidence and largest class probability, without calibration
    exists: bool
    class_is_right: bool
    iou: float


def samples(directory: Path) -> Iterator[Sample]:
    """Yield the instances of a completed run that the evaluation does not ignore."""
    record = read_record(directory)
    truth = Truth.of(record.dataset).in_world_of(record)
    assert truth is not None
    compared = classes_of(record).compare(read_predictions(record), truth)
    scene = load_scene(directory / MAP)
    assert isinstance(scene, InstanceTableMap)
    evidence = scene.class_evidence()
    for key, (exists, right, iou) in judge_class_agnostic(compared.predictions, compared.truth).items():
        one, table = scene.table.records[key], scene.table
        features = one.features(table.discounted_class_probability(one, evidence[key]))
        today = one.confidence, float(table.distribution(evidence[key]).max())
        yield Sample(scene_name(directory), features, today, exists, right, iou)


def scene_name(directory: Path) -> str:
    return directory.name.partition(".")[2] or directory.name


def logistic(terms: Sequence[Sequence[float]], outcomes: Sequence[bool], prior: Sequence[float]) -> tuple[float, ...]:
    """Return the constant and the weights of a logistic model.

    They maximize the likelihood, less RIDGE / 2 times the squared distance to the prior.
    """
    if not terms:
        return tuple(prior)
    x, y, around = _with_constant(terms), np.array(outcomes, np.float64), np.array(prior, np.float64)

    def loss(weights: Float64) -> tuple[float, Float64]:
        z, offset = x @ weights, weights - around
        value = np.logaddexp(0.0, z).sum() - y @ z + 0.5 * RIDGE * offset @ offset
        return float(value), x.T @ (expit(z) - y) + RIDGE * offset

    found = minimize(loss, around, jac=True, method="BFGS", options={"gtol": 1e-8})
    return tuple(found.x.tolist())


def linear(terms: Sequence[Sequence[float]], values: Sequence[float], prior: Sequence[float]) -> tuple[float, ...]:
    """Return the constant and the weights of a linear model.

    They minimize the squared error, plus RIDGE times the squared distance to the prior.
    """
    if not terms:
        return tuple(prior)
    x, around = _with_constant(terms), np.array(prior, np.float64)
    residual = x.T @ (np.array(values, np.float64) - x @ around)
    return tuple((around + np.linalg.solve(x.T @ x + RIDGE * np.eye(x.shape[1]), residual)).tolist())


def _with_constant(terms: Sequence[Sequence[float]]) -> Float64:
    return np.array([[1.0, *row] for row in terms], np.float64)


START = Calibration((0.0, 1.0, 0.0), (0.0, 1.0, 0.0), (0.75, 0.0))
"""Prior of the generic calibration, in which the confidence and the scaled evidence are probabilities."""


def learn(known: Sequence[Sample], prior: Calibration = START) -> Calibration:
    """Return the calibration that fits the samples, given a prior."""
    existing = [one for one in known if one.exists]
    return Calibration(
        exists=logistic([existence_terms(one.features) for one in known], [one.exists for one in known], prior.exists),
        class_probability=logistic(
            [class_terms(one.features) for one in existing],
            [one.class_is_right for one in existing],
            prior.class_probability,
        ),
        expected_iou=linear(
            [iou_terms(one.features) for one in existing], [one.iou for one in existing], prior.expected_iou
        ),
    )


def leave_one_scene_out(runs: Mapping[str, Sequence[Sample]]) -> list[tuple[Sample, Probabilities]]:
    """Return each sample with the probabilities of a calibration that has not seen its scene with any network.

    Args:
        runs: The samples of each network.
    """
    scenes = sorted({one.scene for known in runs.values() for one in known})
    found = []
    for scene in scenes:
        unseen = {name: [one for one in known if one.scene != scene] for name, known in runs.items()}
        generic = learn([one for known in unseen.values() for one in known])
        for name, known in runs.items():
            calibration = learn(unseen[name], generic)
            found += [(one, calibration.probabilities(one.features)) for one in known if one.scene == scene]
    return found


def forecasts(pairs: Iterable[tuple[Sample, tuple[float, float]]]) -> dict[str, Forecasts]:
    """Return the forecasts of existence and of the class, given both probabilities of each sample."""
    listed = list(pairs)
    return {
        "exists": Forecasts.of((values[0], one.exists) for one, values in listed),
        "class": Forecasts.of((values[1], one.class_is_right) for one, values in listed if one.exists),
    }

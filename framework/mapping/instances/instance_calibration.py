"""Calibrated probabilities of an instance, from the statistics of its detections and views.

The evidence of the detections of an instance is correlated, because a detector makes the same errors in similar frames.
The sum of their log-likelihoods is therefore too large. It is scaled to the number of views (see viewing.py).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from framework.errors import DataError
from framework.files.json_file import read_json

EDGE = 0.01  # probabilities are limited to [EDGE, 1 - EDGE] before their logit
NO_OUTLINE = 0.5  # outline agreement of an instance that was detected only once
MIN_IOU = 0.5  # minimum IoU of an instance that exists
MANY = 30  # number of observations above which more have no effect, so that long sequences are no extrapolation
MAX_WEIGHT = 100.0  # maximum absolute value of a weight


class InstanceFeatures(NamedTuple):
    """The statistics of an instance that its probabilities depend on."""

    confidence: float  # mean score of its detections times its detection rate in frames with the instance in view
    observations: int  # number of frames with a detection
    score: float  # mean score of its detections
    outline: float  # mean IoU of a detection and the visible instance
    class_probability: float  # probability of the most likely class, with the evidence scaled to the number of views


class InstanceProbabilities(NamedTuple):
    """The calibrated probabilities of an instance."""

    exists: float  # probability that it matches an object at IoU 0.5
    class_probability: float  # probability that its most likely class is right, if it exists
    expected_iou: float  # expected IoU with the object, if it exists


@dataclass(frozen=True)
class InstanceCalibration:
    """Weights of logistic models of existence and class, and of a linear model of the IoU.

    The defaults were learned for several networks together (see docs/results/calibration.md). They are used for
    detectors without a calibration of their own.
    """

    exists: tuple[float, ...] = (-0.383, 1.433, 0.427)  # constant and weights of `existence_terms`
    class_probability: tuple[float, ...] = (-0.185, 0.937, 0.559)  # constant and weights of `class_terms`
    expected_iou: tuple[float, ...] = (0.684, 0.041)  # constant and weights of `iou_terms`

    def __post_init__(self) -> None:
        for name, count in (("exists", 3), ("class_probability", 3), ("expected_iou", 2)):
            weights = getattr(self, name)
            if len(weights) != count or not all(abs(weight) <= MAX_WEIGHT for weight in weights):  # rejects NaN
                raise DataError(
                    f"calibration.{name}: expected {count} numbers in [-{MAX_WEIGHT:g}, {MAX_WEIGHT:g}], got "
                    f"{weights!s:.60}"
                )

    @classmethod
    def of(cls, found: object, where: object = "calibration") -> InstanceCalibration:
        """Return the calibration for a JSON object.

        Raises:
            DataError: The object is invalid. The message contains `where`.
        """
        if not isinstance(found, Mapping) or found.keys() != asdict(cls()).keys():
            raise DataError(f"{where}: expected the keys {', '.join(asdict(cls()))}, got {found!r:.60}")
        return cls(**{name: _numbers(f"{where}: {name}", values) for name, values in found.items()})

    @classmethod
    def read(cls, path: Path) -> InstanceCalibration:
        """Read the calibration of a detector.

        Raises:
            DataError: The file is missing or invalid.
        """
        return cls.of(read_json(path), path)

    def probabilities(self, features: InstanceFeatures) -> InstanceProbabilities:
        """Return the probabilities of an instance."""
        iou = _sum(self.expected_iou, iou_terms(features))
        return InstanceProbabilities(
            exists=_logistic(_sum(self.exists, existence_terms(features))),
            class_probability=_logistic(_sum(self.class_probability, class_terms(features))),
            expected_iou=min(max(iou, MIN_IOU), 1.0),
        )


def existence_terms(features: InstanceFeatures) -> tuple[float, ...]:
    """Return the terms of the log-odds that an instance exists."""
    return logit(features.confidence), math.log(min(max(features.observations, 1), MANY))


def class_terms(features: InstanceFeatures) -> tuple[float, ...]:
    """Return the terms of the log-odds that the class of an instance is right."""
    return logit(features.class_probability), logit(features.score)


def iou_terms(features: InstanceFeatures) -> tuple[float, ...]:
    """Return the terms of the expected IoU of an instance."""
    return (features.outline,)


def logit(probability: float) -> float:
    """Return the log-odds of a probability, which is first limited to [EDGE, 1 - EDGE]."""
    limited = min(max(probability, EDGE), 1 - EDGE)
    return math.log(limited / (1 - limited))


def _sum(weights: Sequence[float], terms: Sequence[float]) -> float:
    return weights[0] + math.fsum(weight * term for weight, term in zip(weights[1:], terms, strict=True))


def _logistic(log_odds: float) -> float:
    return 1 / (1 + math.exp(-min(max(log_odds, -50.0), 50.0)))


def _numbers(where: str, values: Any) -> tuple[float, ...]:
    if not isinstance(values, list) or any(isinstance(v, bool) or not isinstance(v, int | float) for v in values):
        raise DataError(f"{where}: expected a list of numbers, got {values!r:.60}")
    return tuple(map(float, values))

"""Calibration of instance probabilities: measurement, and learning from runs with ground truth.

Each run directory is named NETWORK.SCENE. This command prints the calibration on scenes that it has not seen (leave one
scene out), and draws the reliability diagrams of docs/results/calibration.md:

    python -m tests.acceptance.instance_calibration check RUN_DIR...

This command learns the calibration of all networks together, and that of each network, which it writes to
plugins/detectors/NETWORK.calibration.json:

    python -m tests.acceptance.instance_calibration learn RUN_DIR...
"""

from __future__ import annotations

import functools
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from framework.api import load_scene
from framework.data import Float64
from framework.detection.calibration_files import LEARNED, SUFFIX
from framework.evaluation.calibration import Forecasts
from framework.evaluation.instances import judge_class_agnostic
from framework.files.json_file import write_json
from framework.mapping.instances.instance_calibration import (
    InstanceCalibration,
    InstanceFeatures,
    InstanceProbabilities,
    class_terms,
    existence_terms,
    iou_terms,
)
from framework.mapping.instances.instance_list import InstanceTableMap
from framework.reporting.charts import reliability_figure
from framework.runs.reevaluation import Truth, classes_of, read_predictions
from framework.runs.stored_runs import MAP, read_record
from tests.acceptance.runner import CHECKOUT

SHARED = CHECKOUT.parent / "shared"
FREIBURG = SHARED / "data" / "tum_fr1_rpy_a"
SCENES = {
    "replica_floor2": ("dataset=rgbd_folder", f"dataset.root={SHARED / 'data' / 'replica_floor2'}"),
    "redkitchen": ("dataset=rgbd_folder", f"dataset.root={SHARED / 'data' / 'redkitchen'}"),
    "scene0000_00": (
        "dataset=scannet",
        f"dataset.root={SHARED / 'data' / 'scannet_scene0000'}",
        "dataset.scene=scene0000_00",
    ),
    "freiburg1_rpy": (
        "dataset=tum_rgbd",
        f"dataset.root={FREIBURG / 'rgbd_dataset_freiburg1_rpy'}",
        f"dataset.ground_truth={FREIBURG / 'annotation' / 'mesh.ply'}",
    ),
}
DETECTORS = {
    "maskrcnn2go_int8": ("detector=maskrcnn2go",),
    "yolo11n_seg": (
        "detector=onnx_segmentation",
        f"detector.weights={SHARED / 'weights' / 'yolo11n_seg' / 'yolo11n_seg.onnx'}",
    ),
}
FIGURES = CHECKOUT / "docs" / "results"
RIDGE = 3.0  # weight of the squared distance to the prior weights


@dataclass(frozen=True)
class Sample:
    """An instance of a run with its comparison with the ground truth."""

    scene: str
    features: InstanceFeatures
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
        yield Sample(directory.name.partition(".")[2], features, today, exists, right, iou)


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


START = InstanceCalibration((0.0, 1.0, 0.0), (0.0, 1.0, 0.0), (0.75, 0.0))
"""Prior of the generic calibration, in which the confidence and the scaled evidence are probabilities."""


def learn(known: Sequence[Sample], prior: InstanceCalibration = START) -> InstanceCalibration:
    """Return the calibration that fits the samples, given a prior."""
    existing = [one for one in known if one.exists]
    return InstanceCalibration(
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


def leave_one_scene_out(runs: Mapping[str, Sequence[Sample]]) -> list[tuple[Sample, InstanceProbabilities]]:
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


def samples_by_network(directories: Iterable[Path]) -> dict[str, list[Sample]]:
    """Return the samples of each network from its completed runs, which are named NETWORK.SCENE."""
    found: dict[str, list[Sample]] = {}
    for directory in directories:
        found.setdefault(directory.name.partition(".")[0], []).extend(samples(directory))
    return found


@dataclass(frozen=True)
class Comparison:
    """The forecasts of one event without calibration, and those of a calibration that has not seen the scene."""

    today: Forecasts
    calibrated: Forecasts

    def row(self, name: str) -> str:
        """Return a row of a Markdown table with ECE, Brier score and AUROC, each with its bootstrap interval."""
        cells = [name, str(len(self.today))]
        for metric in (Forecasts.ece, Forecasts.brier, Forecasts.auroc):
            cells += [_with_interval(one, metric) for one in (self.today, self.calibrated)]
        low, high = self.calibrated.paired_interval(self.today, lambda new, old: new.brier() - old.brier())
        difference = self.calibrated.brier() - self.today.brier()
        cells += [f"{difference:+.3f} ({low:+.3f} to {high:+.3f})", f"{self.calibrated.ece_if_calibrated():.3f}"]
        return f"| {' | '.join(cells)} |"


HEADER = (
    "| event | n | ECE today | ECE | Brier today | Brier | AUROC today | AUROC | change of Brier "
    "| ECE if calibrated |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)


def _with_interval(one: Forecasts, metric: Callable[[Forecasts], float]) -> str:
    low, high = one.interval(metric)
    return f"{metric(one):.3f} ({low:.3f} to {high:.3f})"


def comparisons(pairs: Iterable[tuple[Sample, InstanceProbabilities]]) -> dict[str, Comparison]:
    """Return the comparison of each event, given the calibrated probabilities of each sample."""
    listed = list(pairs)
    today = forecasts((one, one.today) for one, _ in listed)
    calibrated = forecasts((one, (found.exists, found.class_probability)) for one, found in listed)
    return {event: Comparison(today[event], calibrated[event]) for event in today}


def iou_error(pairs: Iterable[tuple[Sample, InstanceProbabilities]]) -> float:
    """Return the mean absolute error of the expected IoU of the instances that exist."""
    return float(np.mean([abs(found.expected_iou - one.iou) for one, found in pairs if one.exists]))


@functools.cache
def unseen_scenes() -> dict[str, Comparison]:
    """Map the real scenes with each network and given poses, and return the comparison of each event over all runs."""
    with tempfile.TemporaryDirectory() as folder:
        directories = []
        for network, detector in DETECTORS.items():
            for scene, dataset in SCENES.items():
                directories.append(Path(folder, f"{network}.{scene}"))
                overrides = [*dataset, *detector, "tracker=ground_truth", "detection_cache=read_write"]
                command = [sys.executable, "-m", "framework", *overrides, f"hydra.run.dir={directories[-1]}"]
                subprocess.run(command, cwd=CHECKOUT, check=True)
        return check(directories)


def check(directories: Iterable[Path]) -> dict[str, Comparison]:
    """Print the calibration on unseen scenes, also for each network, and return the total."""
    runs = samples_by_network(directories)
    pairs = leave_one_scene_out(runs)
    total = comparisons(pairs)
    print(HEADER)
    for event, comparison in total.items():
        print(comparison.row(event))
    for network, known in runs.items():
        own = {id(one) for one in known}
        for event, comparison in comparisons(pair for pair in pairs if id(pair[0]) in own).items():
            print(comparison.row(f"{event}, {network}"))
    print(f"mean absolute error of the expected IoU: {iou_error(pairs):.3f}", flush=True)
    return total


def check_and_draw(directories: Iterable[Path]) -> None:
    """Print the calibration on unseen scenes, and draw its reliability diagrams with and without calibration."""
    total = check(directories)
    named = {"Exists": total["exists"], "Class correct": total["class"]}
    for name in ("today", "calibrated"):
        figure = reliability_figure({title: getattr(one, name) for title, one in named.items()}, background="white")
        figure.savefig(FIGURES / f"calibration_{name}.png", dpi=144)


def learn_all(directories: Iterable[Path]) -> None:
    """Print the calibration of all networks together, and write that of each network."""
    runs = samples_by_network(directories)
    generic = learn([one for known in runs.values() for one in known])
    print(rounded(generic))
    for network, known in runs.items():
        write_json(LEARNED / f"{network}{SUFFIX}", asdict(rounded(learn(known, generic))))


def rounded(calibration: InstanceCalibration) -> InstanceCalibration:
    return InstanceCalibration(
        **{name: tuple(round(one, 3) for one in values) for name, values in asdict(calibration).items()}
    )


if __name__ == "__main__":
    {"check": check_and_draw, "learn": learn_all}[sys.argv[1]](map(Path, sys.argv[2:]))

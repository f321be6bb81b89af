"""Re-evaluation of the instances of stored runs."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from framework.data import SceneTruth
from framework.errors import DataError
from framework.evaluation.compared_classes import ComparedClasses
from framework.evaluation.instances import PredictedInstances
from framework.evaluation.scannet_benchmark import BenchmarkScene
from framework.evaluation.truth_alignment import in_map_world
from framework.files.folders.directory_lock import locked
from framework.files.folders.staged_files import staged_files
from framework.files.json_file import write_json
from framework.files.manifest import MANIFEST, Manifest
from framework.files.tum_trajectory import read_tum
from framework.interfaces import RGBDVideo
from framework.registry import build
from framework.runs.metrics import (
    ANNOTATED,
    CLASS_NAMES,
    LABEL_SPACE,
    OF_FILE,
    TRUTH,
    evaluated,
    is_evaluation,
)
from framework.runs.provenance import code_version
from framework.runs.stored_map import read_objects
from framework.runs.stored_runs import (
    CONFIG,
    EVALUATION,
    GROUND_TRUTH,
    MERGED_POSES,
    METRICS,
    TRAJECTORY,
    Record,
    check_resolved,
    read_record,
)

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Truth:
    """The ground truth of a dataset."""

    scene: SceneTruth | None  # None = not labeled
    annotation: str  # release of the ground truth
    named: str | None = None  # path in dataset.ground_truth; None = the default ground truth of the dataset

    @classmethod
    def of(cls, dataset: Mapping[str, Any]) -> Truth:
        """Read the ground truth of a dataset.

        Args:
            dataset: The resolved config of the dataset.

        Raises:
            InstanceMapError: The config contains an interpolation, or the dataset cannot be read.
        """
        if "_target_" not in dataset:
            raise DataError(
                f"{CONFIG}: expected a dataset to compare with, got none; import the map again with dataset=NAME"
            )
        check_resolved({"dataset": dataset})
        video = build(RGBDVideo, OmegaConf.create(dict(dataset)))
        named = dataset.get("ground_truth")
        return cls(video.scene_truth(), video.annotation, None if named is None else str(named))

    def in_world_of(self, record: Record) -> SceneTruth | None:
        """Return the ground truth in the world frame of a run, or None for an unlabeled dataset.

        An imported map is in the world frame of the ground truth.

        Raises:
            DataError: The trajectory of the run cannot be read, or has no time in common with the ground truth.
        """
        if record.is_imported:
            return self.scene
        # the poses of the second run of `instancemap merge` have other times
        own = slice(record.metrics.get(MERGED_POSES))
        return self.scene and in_map_world(self.scene, *(one[own] for one in read_tum(record.directory / TRAJECTORY)))


@dataclass(frozen=True)
class Reevaluation:
    """A stored run and its new metrics."""

    record: Record
    metrics: Mapping[str, Any]  # new contents of metrics.json
    scene: BenchmarkScene | None = None  # overlaps for ScanNet's metrics over several scenes; None = no label space

    @classmethod
    def of(
        cls, record: Record, truth: Truth, allow_changed: bool = False, classes: ComparedClasses | None = None
    ) -> Reevaluation:
        """Evaluate the instances of a run again.

        All other metrics of the run are kept.

        Args:
            record: The stored run.
            truth: The ground truth of its dataset.
            allow_changed: Accept a ground truth that has changed since the run.
            classes: The label space; None = the label space of the last evaluation.

        Raises:
            DataError: The files of the run are inconsistent, or the ground truth is missing or has changed.
        """
        if truth.scene is None:
            if any(map(is_evaluation, record.metrics)):
                raise DataError(
                    f"{record.directory}: expected ground-truth instances of the dataset (as in {METRICS}), got none; "
                    "set --ground-truth"
                )
            return cls(record, record.metrics)
        aligned = truth.in_world_of(record)
        assert aligned is not None
        chosen = classes_of(record) if classes is None else classes
        found, scene = evaluated(read_predictions(record), truth.scene, aligned, truth.annotation, chosen)
        for key in (TRUTH, ANNOTATED):
            if not allow_changed and record.metrics.get(key) not in (None, found.get(key)):
                raise DataError(
                    f"{record.directory}: expected the ground truth of the run ({key} {record.metrics[key]!s:.8}), got "
                    f"{found.get(key)!s:.8} from {record.dataset['_target_']}; check the dataset and a relative "
                    "dataset.root, or set --allow-changed-ground-truth to evaluate anyway"
                )
        metrics: dict[str, Any] = {}
        for key, value in record.metrics.items():
            if not is_evaluation(key) and not key.startswith(EVALUATION):
                metrics[key] = value
            if key == "instances.count":
                metrics |= found | {EVALUATION + name: value for name, value in code_version().items()}
        if truth.named != record.config["dataset"].get("ground_truth"):
            metrics[GROUND_TRUTH] = truth.named
        return cls(record, metrics, scene)

    @property
    def changed(self) -> dict[str, tuple[Any, Any]]:
        """Old and new value of each changed metric, by key. Undefined values are None."""
        old, new = self.record.metrics, self.metrics
        return {
            key: (value, new.get(key)) for key, value in old.items() if is_evaluation(key) and new.get(key) != value
        }

    @property
    def added(self) -> list[str]:
        """Keys of the metrics that the stored run does not have."""
        return [key for key in self.metrics if is_evaluation(key) and key not in self.record.metrics]

    def write(self) -> None:
        """Replace metrics.json and manifest.json at once, but keep the modification time of metrics.json.

        Tables use the modification time to select the latest of several runs.

        Raises:
            DataError: The run has been restarted, or a file cannot be written.
        """
        with locked(self.record.directory):  # a new run in this directory waits
            self.write_locked()

    def write_locked(self) -> None:
        """Replace the files as `write` does, in a directory that this process has locked."""
        directory = self.record.directory
        path = directory / METRICS
        try:
            before = path.stat()
        except OSError:
            before = None
        if before is None or before.st_mtime != self.record.written:
            raise DataError(
                f"{path}: expected an unchanged file, got a file of a restarted run; evaluate it after the run ends"
            )
        with staged_files(directory) as folder:
            write_json(folder / METRICS, self.metrics)
            os.utime(folder / METRICS, ns=(before.st_atime_ns, before.st_mtime_ns))
            if (directory / MANIFEST).exists():
                Manifest.read(directory).with_files(folder, [METRICS]).write(folder)


def read_predictions(record: Record) -> PredictedInstances:
    """Return the instances of a stored run for evaluation. The probabilities of imported maps are unknown.

    Raises:
        DataError: The mesh or the instances are missing, invalid or from different runs.
    """
    mesh, instances = read_objects(record)
    return PredictedInstances.on_mesh(
        mesh,
        [instance.id for instance in instances],
        [instance.confidence for instance in instances],
        [instance.class_name for instance in instances],
        {} if record.is_imported else {instance.id: instance.probabilities for instance in instances},
    )


def classes_of(record: Record) -> ComparedClasses:
    """Return the label space of the last evaluation of a run.

    Raises:
        ConfigError: The label space of a run without evaluation does not exist.
        DataError: The stored label space is invalid.
    """
    if LABEL_SPACE not in record.metrics:  # a run of an older version, or without ground truth
        return ComparedClasses.of(record.config)
    space, names, classes = (record.metrics.get(key) for key in (LABEL_SPACE, CLASS_NAMES, OF_FILE))
    try:
        table = {} if names is None else dict(json.loads(names))
        if classes is not None:
            return ComparedClasses(str(space), tuple(map(str, json.loads(classes))), table)
    except (TypeError, ValueError) as error:
        raise DataError(
            f"{record.directory}: expected {CLASS_NAMES} and {OF_FILE} as JSON, got {names!r:.60} and {classes!r:.60}; "
            "set --label-space"
        ) from error
    return ComparedClasses.of({"evaluation": {"label_space": space, "names": table}})


def evaluate_as_configured(directory: Path, config: Mapping[str, Any]) -> None:
    """Evaluate a completed run again if its last evaluation has another label space than a resolved config.

    This process must have locked the directory.

    Raises:
        InstanceMapError: The run or its ground truth cannot be read.
    """
    record, classes = read_record(directory), ComparedClasses.of(config)
    if LABEL_SPACE in record.metrics and classes_of(record) != classes:
        log.info("%s: evaluated again in the label space %s", directory, classes.label_space)
        Reevaluation.of(record, Truth.of(record.dataset), classes=classes).write_locked()


def dataset_of(record: Record, ground_truth: str | None = None) -> dict[str, Any]:
    """Return the dataset config of a run, optionally with another ground truth.

    Args:
        record: The stored run.
        ground_truth: The new value of the key `ground_truth`. An empty text selects the default ground truth of the
            dataset, and None keeps the value.
    """
    return record.dataset | ({} if ground_truth is None else {"ground_truth": ground_truth or None})

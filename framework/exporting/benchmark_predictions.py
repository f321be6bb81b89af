"""Export of a map as predictions for ScanNet's benchmarks and scripts that use their rules.

The predictions are labels of given points, such as the vertices of ScanNet's mesh, in their order. Each point gets the
instance of the nearest map vertex within MAX_DISTANCE. Files of the format `scannet`, for the scene NAME:

    scannet/instances/NAME.txt                       predicted_masks/NAME_000.txt 5 0.93 (mask, class id, confidence)
    scannet/instances/predicted_masks/NAME_000.txt   one line per point: 1 = part of the instance, otherwise 0
    scannet/semantics/NAME.txt                       one line per point: class id, 0 = none
    scannet/ground_truth/NAME.txt                    one line per point: 1000 * class id + instance, 0 = none

Ground truth is written only if the points are those of the ground truth. Files of the format `npz`, for scripts that
evaluate ScanNet200 and Replica with masks in an array:

    NAME.npz    pred_masks (V, K) bool, pred_scores (K,) float32, pred_classes (K,) int64
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from framework.data import Int32, Int64, SceneTruth
from framework.errors import DataError
from framework.evaluation.compared_classes import Compared, ComparedClasses, listed
from framework.files.atomic_write import atomic_write
from framework.runs.external_maps.external_map import read_surface
from framework.runs.reevaluation import Truth, classes_of, read_predictions
from framework.runs.stored_runs import Record, read_record
from framework.vocabulary.label_spaces import AGNOSTIC, BENCHMARK_IDS, OBJECT, read_class_ids

log = logging.getLogger(__name__)

SCANNET20 = "scannet20"  # default label space
PER_CLASS = 1000  # factor of the class id in ground-truth files; instance numbers are below


@dataclass(frozen=True)
class BenchmarkPredictions:
    """The predictions of one scene for V points. Only instances of a class of the benchmark are included."""

    scene: str
    instance_ids: Int32  # (V,) instance of each point, 0 = no instance
    ids: Sequence[int]  # (K,) in increasing order
    class_ids: Sequence[int]  # (K,)
    confidences: Sequence[float]  # (K,)
    ground_truth: Int64 | None  # (V,) as in the file; None = points without ground truth

    @classmethod
    def of(cls, run: Path, label_space: str | None = None, points: Path | None = None) -> BenchmarkPredictions:
        """Return the predictions of a run.

        Args:
            run: The run directory.
            label_space: nyu40, scannet20, scannet200, agnostic, or a JSON file with the name of each class id. None =
                the label space of the evaluation if it is one of these names, otherwise scannet20.
            points: PLY or NPY file with the points in the world frame of the dataset; None = ground-truth points.

        Raises:
            InstanceMapError: The run or a file is invalid, or the dataset has no ground truth.
        """
        record = read_record(run)
        evaluated = classes_of(record)
        space = label_space or evaluated.label_space or SCANNET20
        if label_space is None and space not in (*BENCHMARK_IDS, AGNOSTIC):
            space = SCANNET20
        names_by_id = {1: OBJECT} if space == AGNOSTIC else read_class_ids(space, "label_space")
        if (least := min(names_by_id)) < 1:
            raise DataError(
                f"label_space: expected {', '.join([*BENCHMARK_IDS, AGNOSTIC])} or a JSON file with class ids of at "
                f"least 1, got the id {least} in {space}; write a JSON file with the name of each id"
            )
        names = evaluated.names if evaluated.label_space == space else {}
        classes = ComparedClasses(space, tuple(names_by_id.values()), names)
        predictions = read_predictions(record)
        truth = _truth(record, points)
        compared = classes.compare(predictions, truth)
        id_of = {name: key for key, name in names_by_id.items()}
        found = compared.predictions.class_names
        if compared.ignored_predictions:
            log.warning(
                "%s: instances outside of %s are left out: %s", run, space, listed(compared.ignored_predictions)
            )
        kept = [k for k in np.argsort(predictions.ids).tolist() if found[k] in classes.object_classes]
        if not kept:
            raise DataError(f"{run}: expected an instance with a class of {space}, got none; set another label_space")
        return cls(
            scene=re.sub(r"[^\w.-]", "_", str(record.metrics["sequence"])),  # scripts split lines at spaces
            instance_ids=compared.predicted_ids(),
            ids=predictions.ids[kept].tolist(),
            class_ids=[id_of[found[k]] for k in kept],
            confidences=predictions.confidences[kept].tolist(),
            ground_truth=_encoded(compared, [id_of[name] for name in classes.classes]) if points is None else None,
        )

    def write_scannet(self, directory: Path) -> list[Path]:
        """Write the files of the format `scannet`, and return the paths of all files except the masks."""
        instances, semantics = directory / "scannet" / "instances", directory / "scannet" / "semantics"
        lines = []
        for k, (key, class_id, confidence) in enumerate(zip(self.ids, self.class_ids, self.confidences, strict=True)):
            mask = f"predicted_masks/{self.scene}_{k:03d}.txt"
            _write_column(instances / mask, self.instance_ids == key)
            lines.append(f"{mask} {class_id} {confidence!r}\n")
        _write_text(instances / f"{self.scene}.txt", "".join(lines))
        _write_column(semantics / f"{self.scene}.txt", self._point_classes())
        written = [instances / f"{self.scene}.txt", semantics / f"{self.scene}.txt"]
        if self.ground_truth is not None:
            written.append(directory / "scannet" / "ground_truth" / f"{self.scene}.txt")
            _write_column(written[-1], self.ground_truth)
        return written

    def write_npz(self, directory: Path) -> list[Path]:
        """Write the file of the format `npz`, and return its path."""
        path = directory / f"{self.scene}.npz"
        masks = self.instance_ids[:, None] == np.array(self.ids, np.int32)[None, :]
        scores, classes = np.array(self.confidences, np.float32), np.array(self.class_ids, np.int64)
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, pred_masks=masks, pred_scores=scores, pred_classes=classes)
        return [path]

    def _point_classes(self) -> Int32:
        """Return the class id (V,) of each point, 0 = none."""
        found = np.zeros(len(self.instance_ids), np.int32)
        for key, class_id in zip(self.ids, self.class_ids, strict=True):
            found[self.instance_ids == key] = class_id
        return found


def _truth(record: Record, points: Path | None) -> SceneTruth:
    """Return the ground truth of a run, or points without labels in its place, in the world frame of the map."""
    if points is None:
        truth = Truth.of(record.dataset)
        found = truth.in_world_of(record)
        if found is None:
            raise DataError(f"{record.directory}: expected ground-truth instances of the dataset, got none; set points")
        return found
    vertices = read_surface(points).vertices
    unlabeled = SceneTruth(vertices, np.zeros(len(vertices), np.int32))
    if record.is_imported:
        return unlabeled
    truth = Truth.of({**record.dataset, "ground_truth": None})  # of the dataset, to which the points belong
    if truth.scene is not None:
        return (
            replace(truth, scene=replace(unlabeled, trajectory=truth.scene.trajectory)).in_world_of(record) or unlabeled
        )
    if record.metrics.get("pose_source") != "ground_truth":
        raise DataError(
            f"{record.directory}: expected given poses or ground-truth instances to align {points} with the map, got "
            "neither; repeat the run with tracker=ground_truth"
        )
    return unlabeled


def _encoded(compared: Compared, class_ids: Sequence[int]) -> Int64:
    """Return the class and the instance of each ground-truth point (V,) as one number, 0 = no class."""
    ids = compared.truth.instance_ids
    present = np.unique(ids[ids > 0])
    if len(present) >= PER_CLASS:
        raise DataError(
            f"ground truth: expected at most {PER_CLASS - 1} instances for the format scannet, got {len(present)}; "
            "export npz"
        )
    numbers = np.where(ids > 0, 1 + np.searchsorted(present, ids), 0)
    of_class = np.append(np.array(class_ids, np.int64), 0)[compared.true_classes]
    return np.where(of_class > 0, PER_CLASS * of_class + numbers, 0)


def _write_column(path: Path, values: Int32 | Int64) -> None:
    _write_text(path, "".join(f"{value}\n" for value in values.astype(np.int64).tolist()))


def _write_text(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        temporary.write_text(text, "utf-8")

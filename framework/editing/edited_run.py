"""Edited copies of stored runs."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Float64
from framework.editing.edited_map import EditedMap
from framework.editing.edits import Edit, write_edits
from framework.editing.opened_run import OVERVIEW, OpenedRun, check_empty, directory_next_to
from framework.errors import DataError, InstanceMapError
from framework.files.folders.staged_files import staged_files
from framework.files.json_file import write_json
from framework.files.manifest import Manifest
from framework.mapping.instance_map import InstanceMap
from framework.rendering.overview import InstanceState, write_comparison, write_overview
from framework.runs.instances_file import write_instances
from framework.runs.mesh_file import write_mesh
from framework.runs.metrics import TRUTH, is_evaluation
from framework.runs.reevaluation import Reevaluation, Truth, classes_of
from framework.runs.run_directory import caption, likely_labels
from framework.runs.stored_runs import (
    EDITED_FROM,
    EVALUATION,
    INSTANCES,
    MAP,
    MESH,
    METRICS,
    Record,
)
from framework.vocabulary.label_spaces import label_space_of

log = logging.getLogger(__name__)

EDITS = "edits.json"
PREVIEW = "edits.png"
REWRITTEN = (INSTANCES, MESH, MAP, OVERVIEW, EDITS, METRICS)  # listed files that depend on the instances


@dataclass(frozen=True)
class EditedRun:
    """A stored run and its edited map."""

    record: Record
    manifest: Manifest
    poses: Float64  # (F, 4, 4) T_world_camera of the mapped frames
    before: InstanceState
    scene: InstanceMap
    edits: tuple[Edit, ...]
    changes: tuple[str, ...]  # description of the result of each edit

    @classmethod
    def of(cls, run: Path, edits: Sequence[Edit]) -> EditedRun:
        """Apply edits in order to the map of a completed run. The stored run is not changed.

        Raises:
            DataError: The run is incomplete or changed, its map has no label evidence, or an edit is invalid.
        """
        opened = OpenedRun.of(run)
        scene = opened.scene
        if not scene.instances():
            raise DataError(f"{run}: expected a map with instances, got none")
        edited = EditedMap(scene)
        before = _state("before", scene)
        changes = []
        for number, edit in enumerate(edits, start=1):
            try:
                changes.append(edited.apply(edit))
            except DataError as error:
                raise DataError(f"edit {number}, {json.dumps(edit.entry)}: {error}") from error
        return cls(opened.record, opened.manifest, opened.poses, before, scene, tuple(edits), tuple(changes))

    def write_preview(self, path: Path) -> None:
        """Write an image of the instances before and after the edits as a PNG file."""
        states = [self.before, _state("after", self.scene)] if self.edits else [replace(self.before, title="instances")]
        write_comparison(path, self.scene.mesh(), states, self.poses)

    def write(self, out: Path) -> None:
        """Write the run directory of the edited map. After an error, it has no files.

        It contains the files of the stored run that do not depend on the instances, such as the trajectory. The metrics
        of the instances are evaluated again if the stored run was evaluated.

        Raises:
            DataError: The directory is not empty, or a file cannot be read or written.
        """
        check_empty(out)
        mesh, found = self.scene.mesh(), self.scene.instances()
        with staged_files(out) as folder:
            copied = [name for name in self.manifest.files if name not in REWRITTEN]
            for name in copied:
                shutil.copyfile(self.record.directory / name, folder / name)
            write_edits(folder / EDITS, self.edits)
            write_instances(folder / INSTANCES, mesh, found, self.scene.classes)
            write_mesh(folder / MESH, mesh)
            self.scene.save(folder / MAP)
            self.write_preview(folder / PREVIEW)
            metrics = self._metrics(folder, len(found))
            title = f"{caption(metrics)} | edited"
            write_overview(folder / OVERVIEW, mesh, likely_labels(found, self.scene.classes), self.poses, title)
            write_json(folder / METRICS, metrics)
            self.manifest.with_files(folder, [*copied, *REWRITTEN]).write(folder)

    def _metrics(self, out: Path, instances: int) -> Mapping[str, Any]:
        """Return the metrics of the stored run, with the number and the evaluation of the edited instances."""
        metrics = {
            key: value
            for key, value in self.record.metrics.items()
            if not is_evaluation(key) and not key.startswith(EVALUATION)
        }
        metrics |= {
            "label_space": label_space_of(self.scene.classes),
            "instances.count": instances,
            EDITED_FROM: str(self.record.directory.resolve()),
        }
        if TRUTH not in self.record.metrics:
            return metrics
        try:
            return Reevaluation.of(
                replace(self.record, directory=out, metrics=metrics),
                Truth.of(self.record.dataset),
                classes=classes_of(self.record),
            ).metrics
        except (InstanceMapError, OSError) as error:
            log.warning("instances are not evaluated: %s", error)
            return metrics


def default_directory(run: Path) -> Path:
    """Return the default directory of the edited run, next to the stored run."""
    return directory_next_to(run, "edited")


def _state(title: str, scene: InstanceMap) -> InstanceState:
    classes = scene.most_likely_classes()
    ids = scene.mesh().instance_ids
    names = {k: f"{k} {scene.classes[classes[k][0]]}" for k in np.unique(ids).tolist() if k > 0}
    return InstanceState(f"{title}: {len(names)} instances", ids, names)

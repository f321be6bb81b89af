"""Edits of a voxel map with label evidence."""

from __future__ import annotations

import logging
from copy import copy
from dataclasses import replace
from itertools import count

import numpy as np
from scipy.spatial import KDTree

from framework.data import Bool, Float32, Int32
from framework.editing.edits import Delete, Edit, Merge, Rename, Split
from framework.editing.mesh_parts import parts_of
from framework.errors import DataError
from framework.mapping.instance_map import InstanceMap
from framework.mapping.instances.instance_list import Confirmation, vertices_by_id
from framework.mapping.labels.class_slots import NO_CLASS
from framework.mapping.labels.evidence_rows import Storage
from framework.mapping.labels.label_evidence import MAX_SCORE, Evidence
from framework.mapping.labels.label_rule import EXACT_BITS
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_SIDE
from framework.vocabulary.label_spaces import with_similar

log = logging.getLogger(__name__)

CERTAIN = 1e6  # class evidence of a renamed instance; exceeds the evidence of any sequence of detections
LISTED = 20  # maximum number of ids in an error message


class EditedMap:
    """A voxel map whose instances are edited.

    The map contains exactly its confirmed instances, and each voxel belongs to at most one of them. Tentative instances
    and the evidence of a voxel for other instances are removed. This does not change the mesh.
    """

    def __init__(self, scene: InstanceMap) -> None:
        """Take over a map, which is modified."""
        self.scene = scene
        kept = [*scene.instances()]
        self._used = set(kept)  # ids that a new instance cannot have
        self._keep_most_likely(kept)
        for key in scene.table.records.keys() - set(kept):
            scene.table.remove(key)
        scene.confirmation = Confirmation(min_observations=1, min_confidence=0.0, min_area=0.0)
        scene.relabel()

    def apply(self, edit: Edit) -> str:
        """Apply an edit, and return a description of its result.

        Raises:
            DataError: An instance is unknown or cannot be split, or the map has too many classes for a new one.
        """
        match edit:
            case Merge(ids):
                self._check_ids(ids)
                for dropped in ids[1:]:
                    self.scene.merge(ids[0], dropped)
                return f"merge {_listed(ids)}: {self._described(ids[0])}"
            case Split(key, by):
                self._check_ids([key])
                new = self._split(edit)
                shown = ", ".join(self._described(one) for one in (key, *new))
                return f"split {key} by {by.value}: {shown}; new: {_listed(new)}"
            case Rename(key, name):
                self._check_ids([key])
                self._rename(key, name)
                return f"rename {key}: {self._described(key)}"
            case Delete(ids):
                self._check_ids(ids)
                for key in ids:
                    self._assign(self._voxels_of(key), 0)
                    self.scene.table.remove(key)
                return f"delete {_listed(ids)}"

    def _check_ids(self, ids: tuple[int, ...] | list[int]) -> None:
        known = [*vertices_by_id(self.scene.mesh().instance_ids)]
        unknown = [key for key in ids if key not in known]
        if unknown:
            rest = ", ..." if len(known) > LISTED else ""
            raise DataError(f"expected an instance out of {_listed(known[:LISTED])}{rest}, got {unknown[0]}")

    def _described(self, key: int) -> str:
        class_id, _ = self.scene.most_likely_classes()[key]
        count = np.count_nonzero(self.scene.mesh().instance_ids == key)
        return f"{key} ({self.scene.classes[class_id]}, {count} vertices)"

    def _keep_most_likely(self, kept: list[int]) -> None:
        """Remove the evidence of each voxel for all instances except its most likely confirmed one.

        The voxels of confirmed instances that are not in `kept`, because they are too small, become background.
        """
        saved = self.scene.labels.in_use()
        confirmed = self.scene.confirmation.counts(self.scene.table)
        value = np.where(confirmed[saved.instance_ids], np.maximum(saved.instance_value, 0), 0)
        best = value.max(axis=1, keepdims=True)
        tied = (value == best) & (best > 0)  # ties go to the smaller id, as in the mesh
        ids = np.where(tied, saved.instance_ids, np.iinfo(np.int32).max).min(axis=1, keepdims=True)
        is_kept = np.isin(ids, kept)
        ids, best = np.where(is_kept, ids, 0).astype(np.int32), np.where(is_kept, best, 0).astype(np.float32)
        self.scene.labels.fill(Evidence(saved.labeled, ids, best, saved.class_ids, saved.class_value))

    def _voxels_of(self, key: int) -> Bool:
        """Return a Boolean array (L,), True for the labeled voxels of an instance."""
        return np.asarray(self.scene.labels.in_use().instance_ids[:, 0] == key)

    def _assign(self, voxels: Bool | Int32, key: int) -> None:
        """Assign labeled voxels to an instance, 0 = background."""
        evidence = self.scene.labels.in_use()
        evidence.instance_ids[voxels, 0] = key
        if key == 0:
            evidence.instance_value[voxels, 0] = 0
        self.scene.relabel()

    def _rename(self, key: int, name: str) -> None:
        if name not in self.scene.classes:
            log.warning("rename %d: new class %s", key, with_similar(name, self.scene.classes))
            self.scene.add_class(name)
        classes = self.scene.classes
        k, evidence, voxels = classes.index(name), self.scene.labels.in_use(), self._voxels_of(key)
        self.scene.table.records[key].class_evidence = CERTAIN * np.eye(len(classes))[k]
        slots = np.full(evidence.class_ids.shape[1], NO_CLASS, evidence.class_ids.dtype)
        score = MAX_SCORE
        if self.scene.labels.storage is Storage.EXACT:  # every class has a slot
            slots[1:] = np.delete(np.arange(1, len(slots) + 1), k)
            score <<= EXACT_BITS
        slots[0] = k + 1
        evidence.class_ids[voxels] = slots
        evidence.class_value[voxels] = np.where(np.arange(len(slots)) == 0, score, 0)
        self.scene.relabel()

    def _split(self, edit: Split) -> list[int]:
        """Split an instance, and return the ids of the new instances."""
        table = self.scene.table
        part = self.scene.mesh().of(self.scene.instances()[edit.id])
        part_ids = parts_of(part, edit.by, self.scene.volume.voxel_size)
        kept = part_ids >= 0
        voxels = np.flatnonzero(self._voxels_of(edit.id)).astype(np.int32)
        _, nearest = KDTree(part.vertices[kept]).query(self._positions()[voxels])
        voxel_parts = part_ids[kept][nearest]
        new = []
        for number in range(1, int(part_ids.max()) + 1):
            key = next(one for one in count(1) if one not in self._used)
            self._used.add(key)
            record = table.records[edit.id]
            copies = {name: copy(getattr(record, name)) for name in ("observed_in", "in_view", "viewing")}
            table.add(replace(record, id=key, **copies))
            self._assign(voxels[voxel_parts == number], key)
            new.append(key)
        return new

    def _positions(self) -> Float32:
        """Return the positions (L, 3) of the labeled voxels in the world frame, m."""
        labels, voxels = self.scene.labels.in_use().labeled, self.scene.volume.voxels
        blocks = np.flatnonzero(voxels.grid.label_row[: voxels.block_count] >= 0)
        corners = np.empty((len(labels), 3), np.int32)
        corners[voxels.grid.label_row[blocks]] = BLOCK_SIDE * voxels.grid.block_coords[blocks]
        rows, numbers = np.nonzero(labels >= 0)
        local = np.stack(np.unravel_index(numbers, (BLOCK_SIDE,) * 3)[::-1], axis=1)  # x varies fastest
        positions = np.empty((len(rows), 3), np.float32)
        positions[labels[rows, numbers]] = (corners[rows] + local) * self.scene.volume.voxel_size
        return positions


def _listed(ids: tuple[int, ...] | list[int]) -> str:
    return ", ".join(map(str, ids))

"""Voxel map of object instances."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from framework.data import (
    LIKELY,
    Bool,
    Camera,
    Float32,
    Float64,
    Frame,
    InstanceMesh,
    Int32,
    Structure,
    SurfaceView,
    View,
    check_label_space,
)
from framework.errors import DataError
from framework.interfaces import Gravity, MapStatistics, SubmapChange, SubmapSurfaces
from framework.mapping.instances.association import Association, agreed_classes
from framework.mapping.instances.association_kernels import look_up_instances
from framework.mapping.instances.instance_list import Confirmation, InstanceClass, InstanceTableMap, ListedInstances
from framework.mapping.instances.instance_table import InstanceTable
from framework.mapping.instances.object_embedding import agreed_space
from framework.mapping.labels.dense_crf import DenseCrf
from framework.mapping.labels.evidence_rows import EvidenceRows, Storage
from framework.mapping.labels.packed_evidence import PackedEvidence, checked_evidence, pack_evidence
from framework.mapping.labels.vertex_labels import VertexLabels
from framework.mapping.storage.map_file import (
    CLASS_EVIDENCE,
    check_known,
    check_memory,
    map_contents,
    plain_table,
    table_arrays,
    table_of,
    write_map,
)
from framework.mapping.structure import VertexStructure, is_building, separate_instances
from framework.mapping.submaps.layer import Layer
from framework.mapping.submaps.resampling import resampled
from framework.mapping.submaps.submaps import Submaps, remaining
from framework.mapping.voxels.integration import SeenBlocks
from framework.mapping.voxels.integration_parameters import pinhole
from framework.mapping.voxels.meshing import UnlabeledMesh
from framework.mapping.voxels.raycasting import render, tiles_around
from framework.mapping.voxels.tsdf_volume import NO_BLOCKS, VOLUME_ARRAYS, TsdfVolume
from framework.mapping.voxels.voxel_grid import MAX_BLOCKS
from framework.sensors.noise_models import SensorKind
from framework.vocabulary.flat_objects import is_flat

FORMAT = 10  # format of the map file; increment it when the meaning of the contents changes, see test_released_maps.py
SAVED_ARRAYS = (*VOLUME_ARRAYS, *PackedEvidence._fields, CLASS_EVIDENCE)
LARGEST_SCALE = 2**40  # maximum score_scale of a map file (quantized class score for evidence of 1)


class InstanceMap(InstanceTableMap):
    """A TSDF volume with instance and class evidence in its voxels.

    Only fusers modify its parts.
    """

    def __init__(
        self,
        volume: TsdfVolume,
        labels: EvidenceRows,
        logarithmic: bool,  # True = the evidence consists of log-likelihoods
        confirmation: Confirmation,
        instance_class: InstanceClass = InstanceClass.DETECTIONS,
        crf: DenseCrf | None = None,  # smoothing of the instances in the mesh; None = off
    ) -> None:
        self.classes: tuple[str, ...] = ()
        self.volume = volume
        self.labels = labels
        self.table = InstanceTable(labels.combine, logarithmic)
        self.confirmation = confirmation
        self.instance_class = instance_class
        self.crf = crf or DenseCrf()
        self.listed = ListedInstances()
        self.vertex_labels = VertexLabels()
        self._structure = VertexStructure()
        self._merged: set[int] = set()  # instances that were merged into others since the last mesh
        self.submaps = Submaps(volume, labels, self.table)
        self._changes = 0  # number of changes to submaps or labels
        self._whole: tuple[tuple[int, int], InstanceMap] | None = None  # fusion of all submaps, and its state

    @property
    def statistics(self) -> MapStatistics:
        size = self.volume.voxels.byte_count + self.labels.byte_count + self.submaps.byte_count
        voxels = self.volume.voxel_count + self.submaps.voxel_count
        return MapStatistics(voxels, size, self.labels.evicted)

    @property
    def depth_range(self) -> tuple[float, float]:
        return self.volume.sensor.depth_range

    def begin(self, classes: tuple[str, ...]) -> None:
        if not self.classes:
            self.labels.begin(len(classes))
        super().begin(classes)

    def integrate(self, frame: Frame, T_world_camera: Float64, near: float) -> SeenBlocks:
        """Integrate one frame into the volume and the current submap.

        See `TsdfVolume.integrate`.
        """
        seen = self.volume.integrate(frame, T_world_camera, near)
        self.submaps.observe(seen.blocks)
        return seen

    def renew_colors(self) -> None:
        """Mark all colors, so that the next observation of each voxel replaces its color."""
        self.volume.renew_colors()
        self.submaps.renew_colors()

    def instances_seen(self, frame: Frame, T_world_camera: Float64, stride: int) -> Int32:
        """Return the most likely instance at every stride-th pixel of a frame, 0 = none.

        See `LabeledMap.instances_seen`.
        """
        instance_ids = np.empty(tuple(-(-side // stride) for side in frame.depth.shape), np.int32)
        view = pinhole(frame.camera, T_world_camera)
        look_up_instances(self.volume.voxels.grid, self.labels.evidence, frame.depth, view, stride, instance_ids)
        return instance_ids

    def class_evidence(self) -> dict[int, Float64]:
        """Return the class evidence (C,) of each confirmed instance by id.

        The source of the evidence is set by `instance_class`.
        """
        if self.instance_class is InstanceClass.DETECTIONS:
            return super().class_evidence()
        counts = self.confirmation.counts(self.table)
        evidence = self.whole().labels.classes_of_instances(counts, len(self.classes))
        return {int(k): evidence[k] for k in np.flatnonzero(counts)}

    def merge(self, kept: int, dropped: int) -> None:
        """Merge instance `dropped` into instance `kept`."""
        self.table.merge(kept, dropped)
        self.labels.merge_instances(kept, dropped)
        self.submaps.merged(kept, dropped)
        self._merged.add(dropped)
        self.volume.changed(NO_BLOCKS)

    def remove(self, instance_ids: Sequence[int]) -> None:
        """Remove instances and their evidence in the voxels."""
        relabeled = self._merged | {k for k in instance_ids if self.vertex_labels.shows(k)}
        self.volume.changed(self.labels.blocks_with(relabeled))  # not known after the removal
        self._merged = set()
        for k in instance_ids:
            self.table.remove(k)
        self.labels.remove_instances(instance_ids)

    def add_class(self, name: str) -> None:
        """Add a class to a map with classes. The class distributions of the instances do not change.

        Raises:
            DataError: The map has the maximum number of classes.
        """
        check_label_space((*self.classes, name))
        self.classes += (name,)
        self.labels.add_class(len(self.classes), self.table.logarithmic)
        self.table.add_class()
        self.volume.changed(NO_BLOCKS)

    def correct(self, change: SubmapChange, association: Association) -> dict[int, int]:
        """Change the submaps, and associate the instances of submaps that become visible.

        Returns:
            The remaining instance by merged instance.

        Raises:
            MapFullError: If the volume needs too many blocks.
        """
        merged: dict[int, int] = {}
        try:
            self.submaps.move(change.motions)
            for number in sorted(change.shown):
                self._merge_pairs(self.submaps.show(number, association.min_overlap, association.create_points), merged)
            self.submaps.hide(change.hidden)
        finally:
            self.submaps.current = change.submap
            self.relabel()
        return {k: remaining(k, merged) for k in merged}

    def absorb(self, other: InstanceMap, T_world_other: Float64, association: Association) -> dict[int, int]:
        """Add another map, which must not be used afterwards, and associate its instances.

        The instances of this map keep their ids. The frames of the other map follow the frames of this map.

        Args:
            other: The other map.
            T_world_other: The pose (4, 4) of its world frame.
            association: The rule of the data association.

        Returns:
            The id in this map of each instance of the other map.

        Raises:
            DataError: If the maps have different parameters, classes or embeddings. This map is then unchanged.
            MapFullError: If the volume needs too many blocks.
        """
        self.check_compatible(other)
        for one, classes in ((self, other.classes), (other, self.classes)):
            if classes:
                one.begin(classes)
        layer = other.whole().submaps.visible
        if not np.array_equal(T_world_other, np.eye(4)):
            layer = resampled(layer, T_world_other)
        offset = self.table.absorb(other.table, T_world_other)
        layer.labels.renumber_instances(offset)
        pairs = self.submaps.add(self.submaps.current, layer, association.min_overlap, association.create_points)
        merged = self._merge_pairs(pairs, {})
        self.volume.integrator.frames += other.volume.integrator.frames
        self.volume.gravity_estimator.absorb(other.volume.gravity_estimator, T_world_other[:3, :3])
        self.labels.evicted += other.labels.evicted
        self.relabel()
        return {k: remaining(k + offset, merged) for k in other.table.records}

    def check_compatible(self, other: InstanceMap) -> None:
        """Raise DataError unless another map can be added: it has the same parameters, classes and embeddings."""
        own, theirs = ({**one.parameters(), "fuser": one.label_rule} for one in (self, other))
        for name, value in own.items():
            if theirs[name] != value:
                raise DataError(
                    f"{name}: expected {value} (as in the first map), got {theirs[name]}; map both with the same fuser"
                )
        if self.classes and other.classes:
            agreed_classes(self.classes, other.classes)
        if other.embedding_space:
            agreed_space(self.embedding_space, other.embedding_space)

    def parameters(self) -> dict[str, str]:
        """Return the values of the fuser's parameters that the map cannot change, by config key."""
        sensor = {f"fuser.{name}": f"{value:g}" for name, value in self.volume.sensor._asdict().items()}
        return {"fuser.voxel_size": f"{self.volume.voxel_size:g}", "fuser.storage": self.labels.storage.name, **sensor}

    @property
    def label_rule(self) -> str:
        """Description of the label rule."""
        table, scale = self.table, self.labels.score_scale
        return f"combine={table.combine.name}, logarithmic={table.logarithmic}, score_scale={scale}"

    def _merge_pairs(self, pairs: Iterable[tuple[int, int]], merged: dict[int, int]) -> dict[int, int]:
        """Merge pairs of instances, of which the older one remains, and add them to `merged`."""
        for pair in pairs:
            kept, dropped = sorted(remaining(k, merged) for k in pair)
            if kept != dropped:
                self.merge(kept, dropped)
                merged[dropped] = kept
        return merged

    def whole(self) -> InstanceMap:
        """Return the fusion of all submaps, which is the map itself if no submap is hidden."""
        if not self.submaps.hidden:
            return self
        if self._whole is None or self._whole[0] != self._state():
            volume = self.volume.like(MAX_BLOCKS)
            labels = self.labels.like(volume.voxels)
            logarithmic, confirmation = self.table.logarithmic, self.confirmation
            whole = InstanceMap(volume, labels, logarithmic, confirmation, self.instance_class, self.crf)
            whole.classes, whole.table = self.classes, self.table
            self.submaps.fuse_into(Layer(volume.voxels, labels))
            volume.voxels.max_blocks = max(self.volume.voxels.max_blocks, volume.voxels.block_count)
            labels.evicted = self.labels.evicted
            self._whole = self._state(), whole
        return self._whole[1]

    def _state(self) -> tuple[int, int]:
        """Return the numbers of integrated frames and of changes to submaps or labels."""
        return self.volume.integrator.frames, self._changes

    def render(self, camera: Camera, T_world_camera: Float64) -> View:
        return self.whole().render_visible(camera, T_world_camera)

    def render_visible(self, camera: Camera, T_world_camera: Float64) -> View:
        volume = self.volume
        return render(volume.voxels, self.labels.evidence, volume.sensor, camera, T_world_camera)

    def hidden_surfaces(self) -> SubmapSurfaces:
        return self.submaps.surfaces()

    def instance_at(self, u: int, v: int, camera: Camera, T_world_camera: Float64) -> int:
        part, u, v = tiles_around(camera, u, v)
        return int(self.render(part, T_world_camera).instance_ids[v, u])

    def render_near(
        self, camera: Camera, T_world_camera: Float64, depth: Float32, sensor: SensorKind = SensorKind.KINECT_V1
    ) -> SurfaceView:
        return self.volume.render_near(camera, T_world_camera, depth, sensor)

    def mesh(self) -> InstanceMesh:
        whole = self.whole()
        return whole.volume.mesh(whole._labeled)

    def relabel(self) -> None:
        """Discard the labels of the mesh after a change to the label evidence of any voxel."""
        self._changes += 1
        self.vertex_labels = VertexLabels()
        self.volume.changed(NO_BLOCKS)

    def _labeled(self, surface: UnlabeledMesh) -> InstanceMesh:
        grid, counts = self.volume.voxels.grid, self.confirmation.counts(self.table)
        starts, changed = self.volume.nets.take_changed()
        relabeled = self._merged | self.vertex_labels.changed_ids(counts)
        changed[self.labels.blocks_with(relabeled)] = True
        self._merged = set()
        labels = self.vertex_labels.update(grid, self.labels.evidence, counts, surface, starts, changed)
        if self.crf.crf_weight > 0:
            labels = self.crf.smoothed(grid, self.labels.evidence, counts, surface, labels, self._best_classes())
        planes = self._structure.of(surface, self.volume.gravity().up)
        instance_ids = separate_instances(labels.instance_ids, planes, self._flat())
        too_small = self.confirmation.too_small(instance_ids, self.volume.voxel_size)
        instance_ids = np.where(too_small, np.int32(0), instance_ids)
        class_ids = np.where(instance_ids == labels.instance_ids, labels.class_ids, np.int32(-1))
        structure = planes.of_vertices
        structure = np.where((instance_ids > 0) & is_building(structure), np.uint8(Structure.NONE), structure)
        return InstanceMesh(
            surface.vertices, surface.triangles, labels.colors, instance_ids, class_ids, self.classes, structure
        )

    def _best_classes(self) -> Int32:
        """Return the most likely class (last id + 1,) of each confirmed instance, -1 = none."""
        best = np.full(self.table.last_id + 1, -1, np.int32)
        for k, (class_id, _) in self.most_likely_classes().items():
            best[k] = class_id
        return best

    def _flat(self) -> Bool:
        """Return a Boolean array, True for the ids of likely instances that can be in the plane of a floor or a wall.

        Detectors often take an empty wall for a piece of furniture, with a low score.
        """
        flat = np.zeros(self.table.last_id + 1, np.bool_)
        for k, (class_id, exists) in self.most_likely_classes().items():
            flat[k] = exists >= LIKELY and is_flat(self.classes[class_id])
        return flat

    def gravity(self) -> Gravity:
        return self.whole().volume.gravity()

    def save(self, path: Path | str) -> None:
        if self.submaps.hidden:
            self.whole().save(path)
            return
        voxels, arrays = self.volume.saved()
        header = {
            "format": FORMAT,
            **voxels,
            "confirmation": asdict(self.confirmation),
            "storage": self.labels.storage.name,
            "score_scale": self.labels.score_scale,
            "instance_class": self.instance_class.name,
            "crf": asdict(self.crf),
            "classes": self.classes,
            "evicted": self.labels.evicted,
            "table": plain_table(self.table),
        }
        arrays |= pack_evidence(self.labels.in_use())._asdict()
        arrays |= table_arrays(self.table, len(self.classes))
        write_map(path, header, arrays, stored=arrays)  # compression would save a tenth of the size

    @classmethod
    def load(cls, path: Path | str) -> InstanceMap:
        with map_contents(path, FORMAT, SAVED_ARRAYS) as (header, arrays):
            classes, storage = header.classes(), header.option("storage", Storage)
            table = table_of(header.part("table"), len(classes), arrays)
            volume = TsdfVolume.load(header, arrays, len(arrays["labeled"]))
            labels = EvidenceRows(volume.voxels, table.combine, storage, header.whole("score_scale", 1, LARGEST_SCALE))
            confirmation = Confirmation.of(header.part("confirmation"))
            instance_class = header.option("instance_class", InstanceClass)
            crf = DenseCrf.of(header.part("crf"))
            scene = cls(volume, labels, table.logarithmic, confirmation, instance_class, crf)
            scene.begin(classes)
            packed = checked_evidence(arrays, scene.labels.evidence, scene.labels.max_instance_slots)
            check_known("class_ids", packed.class_ids, range(1, len(classes) + 1))
            check_known("instance_ids", packed.instance_ids, [0, *table.records])
            check_memory(volume.voxels.byte_count + scene.labels.unpacked_bytes(packed))
            scene.labels.unpack(packed)
            scene.labels.evicted = header.whole("evicted")
            scene.table = scene.submaps.table = table
        return scene

"""What our fusers share: integration, association, the table of instances. They differ in the label rule."""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from framework.data import Float32, Float64, Frame, Int32, PointClusters, Pose
from framework.errors import DataError
from framework.interfaces import MapFuser
from framework.mapping.association import (
    OverlapRule,
    Overlaps,
    PixelLists,
    class_agreement,
    count_overlaps,
    cover_another,
    list_points_by_pixel,
    look_up_instances,
    match_one_to_one,
)
from framework.mapping.evidence import MOST_UNITS, Combine, Measurement, Storage, named_classes
from framework.mapping.instance_map import InstanceMap
from framework.mapping.integration import Integrator
from framework.mapping.sensor import Sensor, pinhole
from framework.parameters import check_bounds

EXACT_BITS = 16  # by which exact storage's units are finer
VOTES_ACROSS = 320  # pixels of an image row that vote in association: more cost time and tell the same


@dataclass(frozen=True)
class FrameEvidence:
    """What a frame's N clusters say of the instances that they are matched with and of the C classes, by some rule."""

    instances: Float32  # (N,) for the matched instance, over any other
    classes: Float64  # (N, C) for each class
    absence: float = 0.0  # not above 0: for a matched instance, where it is not seen


def only_best(clusters: PointClusters, weights: npt.NDArray[np.floating]) -> Float64:
    """(N, C) the weight (N,) of each cluster at its most likely class, 0 elsewhere."""
    votes = np.zeros(clusters.class_probabilities.shape)
    if len(clusters):
        votes[np.arange(len(clusters)), clusters.class_probabilities.argmax(axis=1)] = weights
    return votes


@dataclass
class InstanceFuser(MapFuser):
    """A TSDF whose voxels carry evidence for instances and classes. A subclass says what counts as evidence."""

    voxel_size: float = 0.01  # m, > 0
    truncation: float = 4.0  # voxels, >= 1: the width of the band at depth 0
    truncation_slope: float = 0.01  # m more for each m of depth, >= 0: noise grows with depth (VoxelHashing's value)
    min_depth: float = 0.2  # m, > 0
    max_depth: float = 5.0  # m, > min_depth: beyond it a structured-light sensor is off by voxels
    max_weight: float = 200.0  # observations, 1 to 255: how slowly an old surface gives way
    full_weight_depth: float = 1.5  # m, > 0: farther readings weigh (full_weight_depth / depth)^2
    max_blocks: int = 400_000  # blocks of 8^3 voxels, > 0: 1.7 GB, about 1000 m^2 of surface at 1 cm
    label_band: float = 2.0  # voxels, >= 1: label evidence goes to voxels within this distance of the measured surface
    overlap: float = 0.35  # in (0, 1): a cluster updates an instance above this overlap
    overlap_rule: OverlapRule = OverlapRule.SMALLER  # what an overlap is counted over
    class_gate: float = 0.0  # in [0, 1]: and if their classes agree so much (Bhattacharyya coefficient); 0 = whatever
    create_score: float = 0.3  # in [0, 1]: a detection needs this to create an instance; any may update one
    create_points: int = 50  # pixels, >= 1: and this many; overlaps with less of an instance are counted over this many
    duplicate_overlap: float = 0.6  # in (0, 1]: a cluster that shares this with a better one creates nothing
    merge_overlap: float = 0.5  # in (0, 1]: two instances under one cluster above this are one object ...
    merge_frames: int = 3  # frames, >= 1: ... when seen so in this many more frames than apart
    min_observations: int = 3  # frames, >= 1: before that an instance is tentative
    min_confidence: float = 0.05  # in [0, 1]: likewise
    min_vertices: int = 30  # mesh vertices, >= 1: of an instance that counts
    storage: Storage = Storage.COMPACT  # COMPACT: the best few labels a voxel; EXACT: all of them, for comparison

    combine = Combine.SUM  # how new evidence for a label meets the old one
    logarithmic = True  # whether evidence is the logarithm of what it says, or proportional to it
    units = 64  # that class evidence of 1 has in compact storage

    def __post_init__(self) -> None:
        check_bounds(
            self,
            voxel_size=(1e-4, 1.0),
            truncation=(1.0, 100.0),
            truncation_slope=(0.0, 1.0),
            min_depth=(1e-3, 100.0),
            max_depth=(self.min_depth, 1000.0),
            max_weight=(1.0, 255.0),
            full_weight_depth=(1e-3, 1000.0),
            max_blocks=(1, 2**31 // 512),
            label_band=(1.0, self.truncation),
            overlap=(0.0, 1.0),
            class_gate=(0.0, 1.0),
            create_score=(0.0, 1.0),
            create_points=(1, 2**31),
            duplicate_overlap=(0.0, 1.0),
            merge_overlap=(0.0, 1.0),
            merge_frames=(1, 2**31),
            min_observations=(1, 2**31),
            min_confidence=(0.0, 1.0),
            min_vertices=(1, 2**31),
        )
        sensor = Sensor(
            truncation=np.float32(self.truncation * self.voxel_size),
            truncation_slope=np.float32(self.truncation_slope),
            min_depth=np.float32(self.min_depth),
            max_depth=np.float32(self.max_depth),
            max_weight=np.float32(self.max_weight),
            full_weight_depth=np.float32(self.full_weight_depth),
        )
        self.scene: InstanceMap = InstanceMap(
            self.voxel_size,
            sensor,
            self.max_blocks,
            self.min_observations,
            self.min_confidence,
            self.min_vertices,
            self.combine,
            self.logarithmic,
            self.storage,
        )
        self._integrator = Integrator(self.scene.voxels, sensor)
        self._together: Counter[tuple[int, int]] = Counter()  # frames that see two instances as one, less those as two

    @abstractmethod
    def evidence(self, clusters: PointClusters) -> FrameEvidence:
        """What the clusters say, before it is known which instances they are matched with."""

    def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters) -> None:
        self._agree_on_classes(clusters.classes)
        points = list_points_by_pixel(clusters, frame.depth.shape)
        overlaps = self._look_up(frame, pose, clusters)
        instance_ids = self._associate(overlaps, clusters, points, frame)
        band = self.label_band * self.voxel_size
        seen = self._integrator.integrate(frame, pose.T_world_camera, band)
        evidence = self.evidence(clusters)
        self._observe(overlaps, clusters.scores, evidence.classes, instance_ids, frame)
        self.scene.labels.update(seen, self._measurement(evidence, clusters, points, instance_ids))
        self._merge_instances(overlaps, instance_ids)
        self.scene.changed(seen.blocks)

    def _agree_on_classes(self, classes: tuple[str, ...]) -> None:
        """The first frame's label space becomes the map's."""
        if not self.scene.classes:
            self.scene.begin(classes)
        elif self.scene.classes != classes:
            raise DataError(
                f"the map has {len(self.scene.classes)} classes and this frame's clusters have {len(classes)} "
                "others; use one detector, or map them to one label space"
            )

    def _look_up(self, frame: Frame, pose: Pose, clusters: PointClusters) -> Overlaps:
        """How the clusters lie on the instances that the map has at the measured surface."""
        stride = max(1, frame.camera.width // VOTES_ACROSS)
        instance_ids = np.empty(tuple(-(-side // stride) for side in frame.depth.shape), np.int32)
        view = pinhole(frame.camera, pose.T_world_camera)
        look_up_instances(self.scene.voxels.grid, self.scene.labels.evidence, frame.depth, view, stride, instance_ids)
        return count_overlaps(clusters, instance_ids, stride)

    def _associate(self, overlaps: Overlaps, clusters: PointClusters, points: PixelLists, frame: Frame) -> Int32:
        """(N,) the instance of each cluster, an old or a new one; 0 = none."""
        overlap = overlaps.by(self.overlap_rule, self.create_points)
        if self.class_gate > 0 and overlap.size:
            table = self.scene.table
            known = np.stack([table.class_probabilities(table.records[int(k)]) for k in overlaps.instance_ids])
            overlap[class_agreement(clusters.class_probabilities, known) < self.class_gate] = 0
        match = match_one_to_one(overlap, self.overlap)
        instance_ids = np.where(match >= 0, np.append(overlaps.instance_ids, 0)[match], 0).astype(np.int32)
        may_create = (
            (instance_ids == 0) & (clusters.scores >= self.create_score) & (overlaps.sizes >= self.create_points)
        )
        if may_create.any():
            may_create &= ~cover_another(clusters, points, self.duplicate_overlap)
        for k in np.flatnonzero(may_create):
            instance_ids[k] = self.scene.table.create(len(clusters.classes), frame.index).id
        return instance_ids

    def _observe(
        self, overlaps: Overlaps, scores: Float32, class_evidence: Float64, instance_ids: Int32, frame: Frame
    ) -> None:
        """Brings the table of instances up to date with what this frame saw."""
        for k in np.flatnonzero(instance_ids):
            self.scene.table.observe(int(instance_ids[k]), class_evidence[k], float(scores[k]), frame.index)
        in_view = set(overlaps.instance_ids[overlaps.visible >= self.create_points].tolist())
        for instance_id in in_view | set(instance_ids[instance_ids > 0].tolist()):
            self.scene.table.records[instance_id].visible += 1

    def _measurement(
        self, evidence: FrameEvidence, clusters: PointClusters, points: PixelLists, instance_ids: Int32
    ) -> Measurement:
        """The evidence, as the voxels take it."""
        matched = np.zeros(self.scene.table.last_id + 1, np.bool_)
        matched[instance_ids] = True
        class_gain, named = named_classes(evidence.classes, self.logarithmic)
        compact = self.storage is Storage.COMPACT
        units = self.units if compact else self.units << EXACT_BITS
        return Measurement(
            first_point=points.first,
            next_point=points.next,
            cluster=clusters.cluster,
            instance_id=instance_ids,
            instance_gain=evidence.instances,
            absence=np.float32(evidence.absence),
            matched=matched,
            class_gain=np.rint(class_gain * units).astype(np.int64),
            named_classes=named,
            combine=int(self.combine),
            most_units=MOST_UNITS if compact else 1 << 62,
        )

    def _merge_instances(self, overlaps: Overlaps, instance_ids: Int32) -> None:
        """Merges two instances that keep lying under one cluster and are hardly ever seen as two (after Voxblox++)."""
        matched = sorted(set(instance_ids[instance_ids > 0].tolist()))
        self._together.subtract(combinations(matched, 2))
        for k, row in enumerate(overlaps.over_smaller(self.create_points)):
            kept = int(instance_ids[k])
            covered = overlaps.instance_ids[row > self.merge_overlap].tolist() if kept else []
            for other in set(covered) - set(matched):
                pair = (min(kept, other), max(kept, other))
                self._together[pair] += 1
                if self._together[pair] >= self.merge_frames:
                    self.scene.merge(*pair)
                    self._forget(pair[1])
                    return  # overlaps are out of date now; what else is to be merged will be seen again

    def _forget(self, instance_id: int) -> None:
        self._together = Counter({pair: n for pair, n in self._together.items() if instance_id not in pair})

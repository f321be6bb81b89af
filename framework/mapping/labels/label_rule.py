"""What detections say of instances and classes, and how a rule writes that into the voxels of a map."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Bool, Float32, Float64, PointClusters
from framework.errors import ConfigError
from framework.interfaces import SceneMap
from framework.mapping.instance_map import InstanceMap
from framework.mapping.instances.association import Matches, class_agreement
from framework.mapping.instances.instance_list import Confirmation
from framework.mapping.instances.instance_table import InstanceTable
from framework.mapping.labels.evidence_rows import Storage
from framework.mapping.labels.label_evidence import MOST_GAIN, MOST_UNITS, Measurement, class_said, named_classes
from framework.mapping.labels.label_evidence_kernels import Combine
from framework.mapping.labels.pixel_lists import PixelLists, keep_on_top, leave_to_others
from framework.mapping.voxels.integration_parameters import Sensor
from framework.mapping.voxels.tsdf import VoxelHashing
from framework.mapping.voxels.tsdf_volume import NO_BLOCKS

OTHER_CLASS = 0.3  # Bhattacharyya coefficient of two distributions below which they are of different things
EXACT_BITS = 16  # by which exact storage's units are finer


class LabelRule(NamedTuple):
    """How what is said of a label is kept."""

    combine: Combine  # how new evidence for a label meets the old one
    logarithmic: bool  # whether evidence is the logarithm of what it says, or proportional to it
    units: int = 64  # that class evidence of 1 has in compact storage


class DetectionEvidence(NamedTuple):
    """What a frame's N clusters say."""

    instances: Float32  # (N,) for the instance that each is matched with, over any other
    classes: Float64  # (N, C) of each class
    absence: float = 0.0  # not above 0: for a matched instance, where it is not seen


def floored_log(class_probabilities: Float32, floor: float) -> Float64:
    """(N, C) log P(O_u = c | I_t) of eq. [7], the uniform distribution mixed in by a share of `floor`.

    No zero of a detector kills a class for good: sums of these are the product of the distributions.
    """
    p = class_probabilities.astype(np.float64)
    return np.asarray(np.log((1 - floor) * p + floor / max(p.shape[1], 1)))


def vote_for_best(clusters: PointClusters, weights: Float32) -> DetectionEvidence:
    """Each cluster counts with its weight (N,) for its instance and for its most likely class, and for nothing else."""
    classes = np.zeros(clusters.class_probabilities.shape)
    if len(clusters):
        classes[np.arange(len(clusters)), clusters.class_probabilities.argmax(axis=1)] = weights
    return DetectionEvidence(weights, classes)


def check_same(name: str, was: object, now: object) -> None:
    """Raises ConfigError unless a map from before was made with the parameter that it is to be gone on with."""
    if was != now:
        raise ConfigError(f"the map was made with {name} {was}, and cannot be gone on with by {now}")


@dataclass
class LabeledVoxels:
    """Our own voxels, with labels as evidence."""

    hashing: VoxelHashing = field(default_factory=VoxelHashing)
    confirmation: Confirmation = field(default_factory=Confirmation)
    occlusion_area_ratio: float = (
        0.25  # in [0, 1]: where clusters overlap, one smaller than this share of another takes the pixels
    )
    support_overlap: float = (
        0.6  # in [0, 1]: an instance covered so much by a cluster of another class lies on it; 1 = off
    )
    storage: Storage = Storage.COMPACT  # COMPACT: the best few labels a voxel; EXACT: all of them, for comparison

    def __post_init__(self) -> None:
        check_bounds(self, occlusion_area_ratio=(0.0, 1.0), support_overlap=(0.0, 1.0))

    def new_map(self, rule: LabelRule) -> InstanceMap:
        """An empty one for labels by this rule."""
        return InstanceMap(self.hashing.new_volume(), self.confirmation, rule.combine, rule.logarithmic, self.storage)

    def continued(self, scene: SceneMap, rule: LabelRule) -> InstanceMap:
        """A map from before, to be written with these parameters. Raises ConfigError unless it was made with them."""
        if not isinstance(scene, InstanceMap):
            raise ConfigError(f"a {type(scene).__name__} cannot be gone on with; the map is of another kind of fuser")
        own = self.new_map(rule)
        check_same("fuser.voxel_size", f"{scene.volume.voxel_size:g}", f"{own.volume.voxel_size:g}")
        for name, was, now in zip(Sensor._fields, scene.volume.sensor, own.volume.sensor, strict=True):
            check_same(f"fuser.{name}", f"{was:g}", f"{now:g}")
        check_same("fuser.storage", scene.labels.storage.name, self.storage.name)
        kept = scene.table.combine.name, scene.table.logarithmic
        check_same("a fuser that keeps labels as", kept, (rule.combine.name, rule.logarithmic))
        scene.confirmation = self.confirmation
        scene.volume.voxels.max_blocks = self.hashing.max_blocks
        scene.volume.changed(NO_BLOCKS)
        scene.table.begin_recording()
        return scene

    def measurement(
        self, table: InstanceTable, points: PixelLists, matches: Matches, evidence: DetectionEvidence, rule: LabelRule
    ) -> Measurement:
        """What a frame's clusters, in the lists of each pixel, say of the voxels by this rule."""
        points = keep_on_top(points, matches.instance_ids, self.occlusion_area_ratio)
        others = self.lying_on_clusters(table, matches)
        if others.any():
            points = leave_to_others(points, others, matches.overlaps.seen, matches.overlaps.stride)
        matched = np.zeros(table.last_id + 1, np.bool_)
        matched[matches.instance_ids] = True
        class_gain, named, bits = named_classes(evidence.classes, rule.logarithmic)
        compact = self.storage is Storage.COMPACT
        units = rule.units if compact else rule.units << EXACT_BITS
        if compact and rule.combine is Combine.SUM:
            class_gain = np.clip(class_gain, -MOST_GAIN / units, MOST_GAIN / units)
        return Measurement(
            of_pixel=points.of_pixel,
            first=points.first,
            cluster=points.cluster,
            instance_id=matches.instance_ids,
            instance_gain=evidence.instances,
            absence=np.float32(evidence.absence),
            matched=matched,
            class_said=class_said(class_gain, units, bits, np.int32 if compact else np.int64),
            named_classes=named,
            combine=int(rule.combine),
            most_units=MOST_UNITS if compact else 1 << 62,
        )

    def lying_on_clusters(self, table: InstanceTable, matches: Matches) -> Bool:
        """(N, ids + 1) which instances lie on what each cluster is of, as a book does on a table.

        Such an instance counts, is of another class, and most of what is seen of it is under the cluster, at most half
        of the cluster's pixels. A network draws a large mask over the small things that lie on the object: that mask
        says nothing about them.
        """
        overlaps, clusters = matches.overlaps, matches.clusters
        lying = np.zeros((len(clusters), table.last_id + 1), np.bool_)
        if self.support_overlap >= 1 or not len(overlaps.instance_ids):
            return lying
        covered = overlaps.votes >= self.support_overlap * np.maximum(overlaps.visible, 1)
        small = 2 * overlaps.visible <= overlaps.sizes[:, None]
        other = matches.instance_ids[:, None] != overlaps.instance_ids
        under = covered & small & other
        if not under.any():  # as a rule
            return lying
        records = [table.records[int(k)] for k in overlaps.instance_ids]
        counts = np.array([self.confirmation.is_met(record) for record in records])
        known = np.stack([table.class_probabilities(record) for record in records])
        other_class = class_agreement(clusters.class_probabilities, known) < OTHER_CLASS
        lying[:, overlaps.instance_ids] = counts & other_class & under
        return lying

"""Label rules: the evidence of detections for instances and classes, and its combination in the voxels."""

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
from framework.mapping.instances.instance_list import Confirmation, InstanceClass
from framework.mapping.instances.instance_table import InstanceTable
from framework.mapping.labels.dense_crf import DenseCrf
from framework.mapping.labels.evidence_rows import EvidenceRows, Storage
from framework.mapping.labels.label_evidence import (
    LARGEST_SCORE,
    MAX_CLUSTER_SCORE,
    MAX_SCORE,
    Measurement,
    named_classes,
    pack_class_scores,
)
from framework.mapping.labels.label_evidence_kernels import Combine
from framework.mapping.labels.pixel_lists import PixelLists, keep_on_top, remove_supports
from framework.mapping.voxels.tsdf_volume import NO_BLOCKS, VoxelHashing

OTHER_CLASS = 0.3  # maximum Bhattacharyya coefficient of the class distributions of objects of different classes
EXACT_BITS = 16  # additional bits of class scores in exact storage


class LabelRule(NamedTuple):
    """Rule for combining the evidence for labels."""

    combine: Combine  # rule for combining new evidence with old evidence
    logarithmic: bool  # True = log-likelihoods; False = evidence proportional to probability, such as votes
    score_scale: int = 64  # quantized class score for evidence of 1 in compact storage

    def quantization(self, storage: Storage) -> int:
        """Return the quantized class score for evidence of 1 in the given storage."""
        return self.score_scale if storage is Storage.COMPACT else self.score_scale << EXACT_BITS


class DetectionEvidence(NamedTuple):
    """The evidence of the N clusters of a frame."""

    instances: Float32  # (N,) evidence for the matched instance of each cluster, relative to any other instance
    classes: Float64  # (N, C) evidence for each class
    absence: float = 0.0  # evidence for a matched instance outside its mask, <= 0


def floored_log(class_probabilities: Float32, floor: float) -> Float64:
    """Return the class log-likelihoods (N, C) of the detections.

    Each distribution is mixed with a fraction `floor` of the uniform distribution, so that a probability of 0 does not
    exclude a class.
    """
    p = class_probabilities.astype(np.float64)  # log P(O_u = c | I_t) of eq. (7) in docs/method.md
    return np.asarray(np.log((1 - floor) * p + floor / max(p.shape[1], 1)))


def vote_for_best(clusters: PointClusters, weights: Float32) -> DetectionEvidence:
    """Return one vote per cluster for its instance and its most likely class, with the given weights (N,)."""
    classes = np.zeros(clusters.class_probabilities.shape)
    if len(clusters):
        classes[np.arange(len(clusters)), clusters.class_probabilities.argmax(axis=1)] = weights
    return DetectionEvidence(weights, classes)


@dataclass
class LabeledVoxels:
    """Parameters of a voxel map with label evidence."""

    hashing: VoxelHashing = field(default_factory=VoxelHashing)
    confirmation: Confirmation = field(default_factory=Confirmation)
    # maximum area ratio (smaller / larger) of two overlapping clusters whose common pixels belong to the smaller one
    # only, in [0, 1]; 0 = off
    occlusion_area_ratio: float = 0.25
    # minimum fraction of an instance inside a larger mask of another class for the mask not to update the instance
    # (e.g. a book on a table), in [0, 1]; 1 = off
    support_overlap: float = 0.6
    # True = clusters without a matched instance also update the class distributions of voxels
    update_unmatched: bool = False
    # source of an instance's class: DETECTIONS (its matched detections) or VOXELS (sum of the class evidence of its
    # voxels)
    instance_class: InstanceClass = InstanceClass.DETECTIONS
    # labels stored per voxel: COMPACT (top few labels) or EXACT (all labels, for comparison)
    storage: Storage = Storage.COMPACT
    crf: DenseCrf = field(default_factory=DenseCrf)

    def __post_init__(self) -> None:
        check_bounds(self, occlusion_area_ratio=(0.0, 1.0), support_overlap=(0.0, 1.0))

    def new_map(self, rule: LabelRule) -> InstanceMap:
        """Return an empty map for the given label rule."""
        volume = self.hashing.new_volume()
        labels = EvidenceRows(volume.voxels, rule.combine, self.storage, rule.quantization(self.storage))
        return InstanceMap(volume, labels, rule.logarithmic, self.confirmation, self.instance_class, self.crf)

    def continued(self, scene: SceneMap, rule: LabelRule) -> InstanceMap:
        """Return the stored map, prepared for new frames.

        Raises:
            ConfigError: If its parameters or its label rule differ from the current ones.
        """
        if not isinstance(scene, InstanceMap):
            raise ConfigError(
                f"fuser: expected a stored map of this fuser, got a map of type {type(scene).__name__}; choose the "
                "fuser that made the map"
            )
        own = self.new_map(rule)
        given = own.parameters()
        for name, stored in scene.parameters().items():
            if stored != given[name]:
                raise ConfigError(
                    f"{name}: expected {stored} (as in the stored map), got {given[name]}; set {name}={stored}, or map "
                    "into an empty folder"
                )
        if scene.label_rule != own.label_rule:
            raise ConfigError(
                f"fuser: expected the label rule of the stored map ({scene.label_rule}), got {own.label_rule}; choose "
                "the fuser that made the map"
            )
        scene.confirmation = self.confirmation
        scene.instance_class = self.instance_class
        scene.crf = self.crf
        scene.volume.voxels.max_blocks = self.hashing.max_blocks
        scene.volume.changed(NO_BLOCKS)
        scene.table.begin_recording()
        return scene

    def measurement(
        self, table: InstanceTable, points: PixelLists, matches: Matches, evidence: DetectionEvidence, rule: LabelRule
    ) -> Measurement:
        """Return the evidence of the clusters of a frame for the voxel update.

        A cluster has no effect at the pixels where the occlusion order or the support rule excludes it.
        """
        updating = np.ones_like(matches.instance_ids) if self.update_unmatched else matches.instance_ids
        points = keep_on_top(points, updating, self.occlusion_area_ratio)
        supported = self.supported_instances(table, matches)
        if supported.any():
            overlaps = matches.overlaps
            points = remove_supports(points, supported, overlaps.instance_ids, overlaps.seen, overlaps.stride)
        relative, named, bits = named_classes(evidence.classes, rule.logarithmic)
        compact = self.storage is Storage.COMPACT
        scale = rule.quantization(self.storage)
        if compact and rule.combine is Combine.SUM:
            relative = np.clip(relative, -MAX_CLUSTER_SCORE / scale, MAX_CLUSTER_SCORE / scale)
        return Measurement(
            list_ids=points.list_ids,
            offsets=points.offsets,
            clusters=points.clusters,
            instance_id=matches.instance_ids,
            instance_log_odds=evidence.instances,
            absence=np.float32(evidence.absence),
            matched=table.flags(matches.instance_ids),
            class_scores=pack_class_scores(relative, scale, bits, np.int32 if compact else np.int64),
            named_classes=named,
            combine=int(rule.combine),
            max_score=MAX_SCORE if compact else LARGEST_SCORE,
        )

    def supported_instances(self, table: InstanceTable, matches: Matches) -> Bool:
        """Return a Boolean array (N, M), True where the object of a cluster supports a visible instance.

        For example, a table supports a book. The mask of the table may cover the book, but is not evidence for its
        voxels. The supported instance is confirmed, has another class, is much smaller and is mostly inside the mask.
        """
        overlaps, clusters = matches.overlaps, matches.clusters
        if self.support_overlap >= 1 or not len(overlaps.instance_ids):
            return np.zeros(overlaps.votes.shape, np.bool_)
        covered = overlaps.votes >= self.support_overlap * np.maximum(overlaps.visible, 1)
        small = 2 * overlaps.visible <= overlaps.sizes[:, None]
        other = matches.instance_ids[:, None] != overlaps.instance_ids
        under = covered & small & other
        if not under.any():  # usual case
            return np.asarray(under)
        records = [table.records[int(k)] for k in overlaps.instance_ids]
        counts = np.array([self.confirmation.is_met(record) for record in records])
        known = np.stack([table.class_probabilities(record) for record in records])
        other_class = class_agreement(clusters.class_probabilities, known) < OTHER_CLASS
        return np.asarray(counts & other_class & under)

"""What every fuser that keeps instances does: association, the table of instances, merging. How a frame is written
into the map, and what a detection says of classes, is the subclass's.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from framework.data import Bool, Float32, Float64, Frame, Int32, PointClusters, Pose
from framework.mapping.association import (
    OverlapRule,
    Overlaps,
    PixelLists,
    class_agreement,
    count_overlaps,
    cover_another,
    list_points_by_pixel,
    match_one_to_one,
)
from framework.mapping.instance_list import Confirmation
from framework.mapping.labeled_map import LabeledMap
from framework.mapping.tsdf_fuser import TsdfFuser, require_same_classes
from framework.parameters import check_bounds

VOTES_ACROSS = 320  # pixels of an image row that vote in association: more cost time and tell the same


def floored_log(class_probabilities: Float32, floor: float) -> Float64:
    """(N, C) log P(O_u = c | I_t) of eq. [7], the uniform distribution mixed in by a share of `floor`.

    No zero of a detector kills a class for good: sums of these are the product of the distributions.
    """
    p = class_probabilities.astype(np.float64)
    return np.asarray(np.log((1 - floor) * p + floor / max(p.shape[1], 1)))


@dataclass
class InstanceFuser(TsdfFuser):
    """A TSDF whose voxels are labelled with instances: a frame's clusters update those that the map has, or make new
    ones.
    """

    overlap: float = 0.35  # in [0, 1]: a cluster updates an instance above this overlap
    overlap_rule: OverlapRule = OverlapRule.SMALLER  # what an overlap is counted over
    class_gate: float = 0.0  # in [0, 1]: and if their classes agree so much (Bhattacharyya coefficient); 0 = whatever
    create_score: float = 0.3  # in [0, 1]: a detection needs this to create an instance; any may update one
    create_points: int = 50  # pixels, >= 1: and this many; overlaps with less of an instance are counted over this many
    duplicate_overlap: float = 0.6  # in [0, 1]: a cluster that shares this with a better one creates nothing
    split: bool = True  # whether two clusters on one instance split it: the better one keeps it, the other is new
    merge_overlap: float = 0.5  # in [0, 1]: two instances under one cluster above this are one object ...
    merge_frames: int = 3  # frames, >= 1: ... when seen so in this many more frames than apart
    min_observations: int = 3  # frames, >= 1: before that an instance is tentative
    min_confidence: float = 0.1  # in [0, 1]: likewise

    def __post_init__(self) -> None:
        super().__post_init__()
        check_bounds(
            self,
            overlap=(0.0, 1.0),
            class_gate=(0.0, 1.0),
            create_score=(0.0, 1.0),
            create_points=(1, 2**31),
            duplicate_overlap=(0.0, 1.0),
            merge_overlap=(0.0, 1.0),
            merge_frames=(1, 2**31),
            min_observations=(1, 2**31),
            min_confidence=(0.0, 1.0),
        )
        self.scene: LabeledMap  # which a subclass makes
        self._together: Counter[tuple[int, int]] = Counter()  # frames that see two instances as one, less those as two

    @property
    def confirmation(self) -> Confirmation:
        """When an instance counts, for a subclass to make its map with."""
        return Confirmation(self.min_observations, self.min_confidence, self.min_area)

    @abstractmethod
    def class_evidence(self, clusters: PointClusters) -> Float64:
        """(N, C) what each cluster says of each class, as the table of instances combines it."""

    @abstractmethod
    def integrate(
        self, frame: Frame, pose: Pose, clusters: PointClusters, points: PixelLists, instance_ids: Int32
    ) -> None:
        """Writes surface and labels into the map. `instance_ids` (N,) are the clusters' instances, 0 = none.

        Raises MapFullError when the map's block budget is reached.
        """

    def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters) -> None:
        self._agree_on_classes(clusters.classes)
        points = list_points_by_pixel(clusters, frame.depth.shape)
        overlaps = self._look_up(frame, pose, clusters)
        instance_ids = self._associate(overlaps, clusters, points, frame)
        self.integrate(frame, pose, clusters, points, instance_ids)
        self._observe(overlaps, clusters, instance_ids, frame)
        self._merge_instances(overlaps, instance_ids)

    def _agree_on_classes(self, classes: tuple[str, ...]) -> None:
        """The first frame's label space becomes the map's."""
        if not self.scene.classes:
            self.scene.begin(classes)
        require_same_classes(self.scene.classes, classes)

    def _look_up(self, frame: Frame, pose: Pose, clusters: PointClusters) -> Overlaps:
        """How the clusters lie on the instances that the map has at the measured surface."""
        stride = max(1, frame.camera.width // VOTES_ACROSS)
        return count_overlaps(clusters, self.scene.instances_seen(frame, pose.T_world_camera, stride), stride)

    def _associate(self, overlaps: Overlaps, clusters: PointClusters, points: PixelLists, frame: Frame) -> Int32:
        """(N,) the instance of each cluster, an old or a new one; 0 = none."""
        allowed = overlaps.by(self.overlap_rule, self.create_points) > self.overlap
        allowed &= self._agree(clusters, overlaps.instance_ids)
        match = match_one_to_one(allowed, overlaps.over_union(self.create_points))
        instance_ids = np.where(match >= 0, np.append(overlaps.instance_ids, 0)[match], 0).astype(np.int32)
        may_create = (
            (instance_ids == 0) & (clusters.scores >= self.create_score) & (overlaps.sizes >= self.create_points)
        )
        if not self.split:
            may_create &= ~allowed.any(axis=1)
        if may_create.any():
            may_create &= ~cover_another(clusters, points, self.duplicate_overlap)
        for k in np.flatnonzero(may_create):
            instance_ids[k] = self.scene.table.create(len(clusters.classes), frame.index).id
        return instance_ids

    def _agree(self, clusters: PointClusters, instance_ids: Int32) -> Bool:
        """(N, M) whether a cluster may be the same thing as an instance, by their classes."""
        if self.class_gate == 0 or not len(instance_ids):
            return np.ones((len(clusters), len(instance_ids)), np.bool_)
        table = self.scene.table
        known = np.stack([table.class_probabilities(table.records[int(k)]) for k in instance_ids])
        return class_agreement(clusters.class_probabilities, known) >= self.class_gate

    def _observe(self, overlaps: Overlaps, clusters: PointClusters, instance_ids: Int32, frame: Frame) -> None:
        """Brings the table of instances up to date with what this frame saw."""
        evidence = self.class_evidence(clusters)
        for k in np.flatnonzero(instance_ids):
            self.scene.table.observe(int(instance_ids[k]), evidence[k], float(clusters.scores[k]), frame.index)
        in_view = set(overlaps.instance_ids[overlaps.visible >= self.create_points].tolist())
        for instance_id in in_view | set(instance_ids[instance_ids > 0].tolist()):
            self.scene.table.records[instance_id].visible += 1

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

"""Data association between the clusters of a frame and the instances of the map.

Each pixel of a cluster votes for the instance of the map at this pixel. The instances are looked up in the voxels at
the measured surface or in a ray-cast view. The ray-cast view is our interpretation of section 3.3 of the paper.

A cluster and an instance can match if their overlap is large enough. By default, the overlap is relative to the smaller
of the two, so that a part of an object matches the whole. Matching is one to one, in order of decreasing IoU. The
learned association replaces overlap and IoU by the log-odds of a match. A cluster with a low score matches a smaller
instance only if their IoU is high. Otherwise, a keyboard could absorb the table under it. An unmatched cluster creates
a new instance. Most instances of false detections stay tentative. They are removed after some time, so that their
number does not grow in a known place.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from enum import Enum
from itertools import combinations
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from framework.config.validation import check_bounds
from framework.data import Bool, Camera, Float32, Float64, Frame, Int32, PointClusters, Pose, View, check_label_space
from framework.detection.true_instances import true_objects
from framework.errors import DataError
from framework.mapping.instances.cluster_shapes import cluster_centers
from framework.mapping.instances.instance_table import Condition, InstanceTable
from framework.mapping.instances.learned_association import WEIGHTS, AssociationScorer, pairs_of
from framework.mapping.instances.object_embedding import ObjectEmbedding, agreed_space
from framework.mapping.instances.overlaps import OverlapRule, Overlaps, count_overlaps
from framework.mapping.labels.pixel_lists import PixelLists, list_points_by_pixel

VOTES_ACROSS = 320  # approximate number of voting pixels per image row; more take longer without improving the result
MIN_PAIRS = 1024  # number of pairs with votes up to which those of removed instances are kept


class InstanceSource(Enum):
    """Source of the instances that are compared with the clusters."""

    SURFACE_LOOKUP = "voxels at the measured surface"
    RAYCAST = "object indices of the map, ray-cast from the pose of the frame"
    GROUND_TRUTH = "true object of each cluster, an upper bound of association accuracy"
    LEARNED = "voxels at the measured surface, matched by a network instead of the overlap"


def class_agreement(clusters: Float32, instances: Float32) -> npt.NDArray[np.float64]:
    """Return the Bhattacharyya coefficients (N, M) between class distributions (N, C) and (M, C), 1 = equal."""
    return np.asarray(np.sqrt(clusters.astype(np.float64)) @ np.sqrt(instances.astype(np.float64)).T)


def match_one_to_one(allowed: Bool, preference: npt.NDArray[np.float64]) -> Int32:
    """Return the matched column (N,) of each row, -1 = unmatched.

    Pairs are matched greedily in order of decreasing preference. Ties go to the smaller column, then to the smaller
    row.

    Args:
        allowed: A Boolean array (N, M), True for pairs that can match.
        preference: The preference (N, M) of each pair.
    """
    match = np.full(len(allowed), -1, np.int32)
    rows, columns = np.nonzero(allowed)
    taken = np.zeros(allowed.shape[1], np.bool_)
    for i in np.lexsort((rows, columns, -preference[rows, columns])):
        row, column = rows[i], columns[i]
        if match[row] < 0 and not taken[column]:
            match[row] = column
            taken[column] = True
    return match


def vote_stride(camera: Camera) -> int:
    """Return the distance between voting pixels along rows and columns, px."""
    return max(1, camera.width // VOTES_ACROSS)


class LabeledMap(Protocol):
    """A map with an instance table and instance labels in its voxels."""

    table: InstanceTable

    @property
    def confirmation(self) -> Condition:
        """The condition for an instance to be confirmed."""

    def instances_seen(self, frame: Frame, T_world_camera: Float64, stride: int) -> Int32:
        """Return the most likely instance at the measured surface at every stride-th pixel of a frame, 0 = none.

        The result (ceil(H / stride), ceil(W / stride)) is looked up at the depth readings. Unlike ray casting, the
        look-up never returns an instance that is hidden behind a new object.
        """

    def render_visible(self, camera: Camera, T_world_camera: Float64) -> View:
        """Return the ray-cast view of the visible part of the map."""

    def merge(self, kept: int, dropped: int) -> None:
        """Merge instance `dropped` into instance `kept`."""

    def remove(self, instance_ids: Sequence[int]) -> None:
        """Remove instances and their evidence."""


@dataclass(frozen=True)
class Matches:
    """The instances matched with the N clusters of a frame."""

    frame_index: int
    clusters: PointClusters
    overlaps: Overlaps  # overlaps with the instances of the map before this frame
    instance_ids: Int32  # (N,) id of an existing or a new instance of each cluster, 0 = none
    camera_center: Float64  # (3,) m, in the world frame


def observe(table: InstanceTable, matches: Matches, class_evidence: Float64, min_pixels: int) -> None:
    """Add the matched clusters of a frame to the instance table.

    Frames on which the detector did not run are ignored.

    Args:
        table: The instance table.
        matches: The matches of the frame.
        class_evidence: The class evidence (N, C) of the clusters.
        min_pixels: The minimum number of visible pixels of an instance in view. Detected instances are always in view.
    """
    if not matches.clusters.detected:
        return
    table.frames_detected += 1
    instance_ids, scores = matches.instance_ids, matches.clusters.scores
    embeddings = weighted_embeddings(matches.clusters)
    if any(instance_ids[k] for k in embeddings):
        table.embedding_space = agreed_space(table.embedding_space, matches.clusters.embedding_space)
    for k in np.flatnonzero(instance_ids):
        score, embedding = float(scores[k]), embeddings.get(int(k))
        table.observe(int(instance_ids[k]), class_evidence[k], score, matches.frame_index, embedding)
    visible = matches.overlaps.instance_ids[matches.overlaps.visible >= min_pixels]
    in_view = set(visible.tolist()) | set(instance_ids[instance_ids > 0].tolist())
    table.see(in_view, matches.frame_index)
    _observe_views(table, matches, in_view, min_pixels)


def _observe_views(table: InstanceTable, matches: Matches, in_view: Set[int], min_pixels: int) -> None:
    """Add a frame to the statistics of the views of the instances in view."""
    overlaps, instance_ids = matches.overlaps, matches.instance_ids
    outlines, centers = overlaps.over_union(min_pixels), cluster_centers(matches.clusters)
    columns = {k: column for column, k in enumerate(overlaps.instance_ids.tolist())}
    for cluster in np.flatnonzero(instance_ids).tolist():
        viewing = table.records[int(instance_ids[cluster])].viewing
        if (column := columns.get(int(instance_ids[cluster]))) is not None:
            viewing.detect(float(outlines[cluster, column]))
        if np.isfinite(centers[cluster]).all():
            viewing.locate(tuple(centers[cluster].tolist()))
    camera = tuple(matches.camera_center.tolist())
    for k in in_view:
        table.records[k].viewing.see(camera)


def weighted_embeddings(clusters: PointClusters) -> Mapping[int, ObjectEmbedding]:
    """Return the embedding of each cluster by index, weighted by its score.

    Clusters without an embedding or with a score of 0 are omitted.
    """
    if clusters.embeddings is None:
        return {}
    embedded = np.flatnonzero(clusters.embeddings.any(axis=1) & (clusters.scores > 0))
    return {int(k): ObjectEmbedding.of(clusters.embeddings[k], float(clusters.scores[k])) for k in embedded}


@dataclass
class Association:
    """Association of clusters with instances, and merging of instances that are parts of one object."""

    # source of the instances that clusters are compared with: SURFACE_LOOKUP (voxels at the depth readings), RAYCAST
    # (rendered view), GROUND_TRUTH (true object of each cluster, an upper bound) or LEARNED (voxels at the depth
    # readings; a network replaces min_overlap, overlap_rule and extend_iou)
    association: InstanceSource = InstanceSource.SURFACE_LOOKUP
    association_weights: Path = WEIGHTS  # weights file of the network of LEARNED
    min_overlap: float = 0.35  # minimum overlap of a cluster and an instance to match, in [0, 1]
    overlap_rule: OverlapRule = OverlapRule.SMALLER  # denominator of the overlap
    # minimum Bhattacharyya coefficient of the class distributions of a cluster and an instance to match, in [0, 1]; 0 =
    # any classes match
    min_class_agreement: float = 0.0
    create_score: float = 0.2  # minimum score of a detection to create an instance, in [0, 1]; no minimum for updates
    # minimum score of a detection to match a smaller instance without a minimum IoU, in [0, 1]; 0 = no minimum
    extend_score: float = 0.3
    extend_iou: float = 0.5  # minimum IoU of a detection below extend_score and a smaller instance to match, in [0, 1]
    # minimum number of points of a cluster to create an instance, >= 1; also the minimum denominator of the overlap
    create_points: int = 50
    # True = create an instance for the second of two clusters that match the same instance; False = ignore the second
    # cluster
    split_instances: bool = True
    # minimum overlap of two instances with one cluster to merge them, in [0, 1]; 1 = no merging
    merge_overlap: float = 1.0
    # minimum number of frames in which two instances share a cluster, minus the frames in which they match separate
    # clusters, for a merge, >= 1
    merge_frames: int = 3
    # minimum Bhattacharyya coefficient of the class distributions of two instances to merge them, in [0, 1]; 0 = any
    # classes are merged
    merge_agreement: float = 0.1
    # number of frames with detections after which a tentative instance is removed if none of them detects it, >= 0;
    # 0 = never
    tentative_max_age: int = 1000

    def __post_init__(self) -> None:
        check_bounds(
            self,
            min_overlap=(0.0, 1.0),
            min_class_agreement=(0.0, 1.0),
            create_score=(0.0, 1.0),
            extend_score=(0.0, 1.0),
            extend_iou=(0.0, 1.0),
            create_points=(1, 2**31),
            merge_overlap=(0.0, 1.0),
            merge_frames=(1, 2**31),
            merge_agreement=(0.0, 1.0),
            tentative_max_age=(0, 2**31),
        )
        self._merge_votes: Counter[tuple[int, int]] = Counter()  # votes by pair of instances; see merge_frames
        self._max_pairs = MIN_PAIRS
        is_learned = self.association is InstanceSource.LEARNED
        self._scorer = AssociationScorer.load(self.association_weights) if is_learned else None  # None = overlap
        self._instance_of: dict[int, int] = {}  # instance by true object, for GROUND_TRUTH
        self.matches: Matches | None = None  # of the last frame; None = no frame

    def match(self, scene: LabeledMap, frame: Frame, pose: Pose, clusters: PointClusters) -> tuple[PixelLists, Matches]:
        """Return the clusters at each pixel, and their matches with existing and new instances."""
        points = list_points_by_pixel(clusters, frame.depth.shape)
        overlaps = self.look_up(scene, frame, pose, points)
        center = pose.T_world_camera[:3, 3]
        if self.association is InstanceSource.GROUND_TRUTH:
            self.matches = self.associate_objects(scene.table, overlaps, clusters, frame, center)
        else:
            self.matches = self.associate(scene.table, overlaps, clusters, frame.index, center)
        return points, self.matches

    def look_up(self, scene: LabeledMap, frame: Frame, pose: Pose, points: PixelLists) -> Overlaps:
        """Return the overlaps of the clusters with the instances of the map."""
        stride = vote_stride(frame.camera)
        if self.association is InstanceSource.RAYCAST:
            view = scene.render_visible(frame.camera, pose.T_world_camera)
            return count_overlaps(points, np.ascontiguousarray(view.instance_ids[::stride, ::stride]), stride)
        return count_overlaps(points, scene.instances_seen(frame, pose.T_world_camera, stride), stride)

    def associate(
        self,
        table: InstanceTable,
        overlaps: Overlaps,
        clusters: PointClusters,
        frame_index: int,
        camera_center: Float64,
    ) -> Matches:
        """Match clusters with instances, and create instances for unmatched clusters.

        A cluster creates an instance only if it meets `create_score` and `create_points`.
        """
        frame_index = table.number_of(frame_index)
        if self._scorer is None:
            allowed = overlaps.by(self.overlap_rule, self.create_points) > self.min_overlap
            preference = overlaps.over_union(self.create_points)
            allowed &= ~self._extends(clusters, overlaps) | (preference > self.extend_iou)
        else:
            preference = self._scorer.scores(pairs_of(table, overlaps, clusters, frame_index), overlaps.votes.shape)
            allowed = preference > 0
        allowed &= self._agree(table, clusters, overlaps.instance_ids)
        match = match_one_to_one(allowed, preference)
        instance_ids = np.where(match >= 0, np.append(overlaps.instance_ids, 0)[match], 0).astype(np.int32)
        may_create = (instance_ids == 0) & self._may_create(clusters, overlaps)
        if not self.split_instances:
            may_create &= ~allowed.any(axis=1)
        for k in np.flatnonzero(may_create):
            instance_ids[k] = table.create(len(clusters.classes), frame_index).id
        return Matches(frame_index, clusters, overlaps, instance_ids, camera_center)

    def associate_objects(
        self, table: InstanceTable, overlaps: Overlaps, clusters: PointClusters, frame: Frame, camera_center: Float64
    ) -> Matches:
        """Match clusters with the instances of their true objects, and create the missing instances.

        Clusters without a true object are matched with each other by `associate`.
        """
        objects = true_objects(clusters, frame)
        of_objects = {key: k for key, k in self._instance_of.items() if k in table.records}
        without_object = replace(
            overlaps,
            votes=np.where(
                (objects[:, None] > 0) | np.isin(overlaps.instance_ids, list(of_objects.values())), 0, overlaps.votes
            ).astype(np.int32),
            sizes=np.where(objects > 0, 0, overlaps.sizes).astype(np.int32),
        )
        matches = self.associate(table, without_object, clusters, frame.index, camera_center)
        for k in np.flatnonzero(objects):
            if int(objects[k]) not in of_objects and self._may_create(clusters, overlaps)[k]:
                of_objects[int(objects[k])] = table.create(len(clusters.classes), matches.frame_index).id
            matches.instance_ids[k] = of_objects.get(int(objects[k]), 0)
        self._instance_of = of_objects
        return replace(matches, overlaps=overlaps)

    def _may_create(self, clusters: PointClusters, overlaps: Overlaps) -> Bool:
        """Return a Boolean array (N,), True for clusters that may create an instance."""
        return np.asarray((clusters.scores >= self.create_score) & (overlaps.sizes >= self.create_points))

    def _extends(self, clusters: PointClusters, overlaps: Overlaps) -> Bool:
        """Return a Boolean array (N, M), True where a cluster with a low score would extend an instance."""
        larger = overlaps.sizes[:, None] > overlaps.visible[None, :]
        return np.asarray(larger & (clusters.scores < self.extend_score)[:, None])

    def _agree(self, table: InstanceTable, clusters: PointClusters, instance_ids: Int32) -> Bool:
        """Return a Boolean array (N, M), True where the class distributions allow a match."""
        if self.min_class_agreement == 0 or not len(instance_ids):
            return np.ones((len(clusters), len(instance_ids)), np.bool_)
        known = np.stack([table.class_probabilities(table.records[int(k)]) for k in instance_ids])
        return class_agreement(clusters.class_probabilities, known) >= self.min_class_agreement

    def observe(self, table: InstanceTable, matches: Matches, class_evidence: Float64) -> None:
        """Add the matched clusters of a frame to the instance table."""
        observe(table, matches, class_evidence, self.create_points)

    def merge(self, scene: LabeledMap, matches: Matches) -> None:
        """Merge two instances that often share a cluster and are rarely detected separately.

        The rule follows Voxblox++. At most one pair is merged per frame.
        """
        if self.merge_overlap >= 1:
            return
        matched = sorted(set(matches.instance_ids[matches.instance_ids > 0].tolist()))
        self._merge_votes.subtract(combinations(matched, 2))
        for k, row in enumerate(matches.overlaps.over_smaller(self.create_points)):
            kept = int(matches.instance_ids[k])
            covered = matches.overlaps.instance_ids[row > self.merge_overlap].tolist() if kept else []
            for other in set(covered) - set(matched):
                pair = (min(kept, other), max(kept, other))
                self._merge_votes[pair] += 1
                if self._merge_votes[pair] >= self.merge_frames and self._same_class(scene.table, *pair):
                    scene.merge(*pair)
                    del self._merge_votes[pair]
                    return  # the overlaps are now outdated; other pairs can be merged in later frames
        self._forget_removed(scene.table)

    def _forget_removed(self, table: InstanceTable) -> None:
        """Discard the votes of removed instances, when the number of pairs has doubled."""
        if len(self._merge_votes) > self._max_pairs:
            known = table.records.keys()
            self._merge_votes = Counter({pair: n for pair, n in self._merge_votes.items() if known >= {*pair}})
            self._max_pairs = max(2 * len(self._merge_votes), MIN_PAIRS)

    def _same_class(self, table: InstanceTable, a: int, b: int) -> bool:
        """Return True if the class distributions of two instances allow a merge."""
        known = [table.class_probabilities(table.records[k])[None] for k in (a, b)]
        return bool(class_agreement(*known)[0, 0] >= self.merge_agreement)

    def expire(self, scene: LabeledMap) -> None:
        """Remove the tentative instances that have reached `tentative_max_age`."""
        if self.tentative_max_age:
            expired = scene.table.undetected(scene.confirmation, self.tentative_max_age)
            if expired:
                scene.remove(expired)


def agreed_classes(known: tuple[str, ...], found: tuple[str, ...]) -> tuple[str, ...]:
    """Return the label space of the map, which is set by its first frame.

    Args:
        known: The label space of the map, or () before the first frame.
        found: The label space of the current frame.

    Raises:
        DataError: If the two differ, or if the map cannot store the label space.
    """
    if not known:
        check_label_space(found)
    elif known != found:
        raise DataError(
            f"detector: expected the label space of the map (length {len(known)}), got a different label space "
            f"(length {len(found)}); use one detector, or map all detectors to one label space"
        )
    return found

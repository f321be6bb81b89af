"""Data association: which instance of the map is each cluster of the frame?

A cluster's pixels vote for the instances that the map holds at the surface measured there. Which pairs may match is
said by their overlap, by default over the smaller of the two, so that a part of an object still finds the whole; among
those, one cluster gets at most one instance and the reverse, best IoU first, so that a table does not get the book that
lies on it. A cluster that finds none there looks for one among the next likeliest ones, before it makes another.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from itertools import combinations
from typing import Protocol

import numpy as np
import numpy.typing as npt

from framework.config.validation import check_bounds
from framework.data import Bool, Camera, Float32, Float64, Frame, Int32, PointClusters, Pose
from framework.errors import DataError
from framework.mapping.instances.association_kernels import count_votes, find_seen
from framework.mapping.instances.instance_table import InstanceTable
from framework.mapping.instances.object_embedding import ObjectEmbedding, agreed_space
from framework.mapping.labels.pixel_lists import PixelLists, cover_another
from framework.mapping.labels.pixel_lists_kernels import CHUNKS

VOTES_ACROSS = 320  # pixels of an image row that vote: more cost time and tell the same


class OverlapRule(Enum):
    """What shared pixels are compared with."""

    SMALLER = "the smaller of cluster and instance: a part of an object still finds the whole"
    IOU = "all pixels of either"
    CLUSTER = "the cluster: a small part of an object finds it, the whole may not"


@dataclass(frozen=True)
class Overlaps:
    """How N clusters lie on the M instances that the frame sees."""

    instance_ids: Int32  # (M,) ascending
    visible: Int32  # (M,) pixels that see each instance
    sizes: Int32  # (N,) pixels of each cluster
    votes: Int32  # (N, M) pixels of both
    seen: Int32  # (h, w) the instance at every `stride`-th pixel of every `stride`-th row, 0 = none
    stride: int
    hidden: Int32 | None = None  # (h, w) likewise the next likeliest ones; None = the map does not tell

    def by(self, rule: OverlapRule, least: int) -> npt.NDArray[np.float64]:
        """(N, M) overlaps in [0, 1] by one of the rules, with `least` as in `over_smaller`."""
        if rule is OverlapRule.CLUSTER:
            return np.asarray(self.votes / np.maximum(self.sizes[:, None], least))
        return self.over_smaller(least) if rule is OverlapRule.SMALLER else self.over_union(least)

    def over_union(self, least: int) -> npt.NDArray[np.float64]:
        """(N, M) shared pixels over those of cluster or visible instance, counted as at least `least`, in [0, 1]."""
        union = self.sizes[:, None] + self.visible[None, :] - self.votes
        return np.asarray(self.votes / np.maximum(union, least))

    def over_smaller(self, least: int) -> npt.NDArray[np.float64]:
        """(N, M) shared pixels over the smaller of cluster and visible instance, in [0, 1].

        The smaller one counts for at least `least` pixels: a few stray voxels of an instance under a cluster would
        otherwise overlap it completely, and win it from the instance that it belongs to.
        """
        return self.votes / np.maximum(np.minimum(self.sizes[:, None], self.visible[None, :]), least)


def count_overlaps(points: PixelLists, instance_ids: Int32, stride: int = 1) -> Overlaps:
    """Votes of the clusters' pixels on `instance_ids` (h, w), the instances seen at every stride-th pixel.

    Each sample counts for the stride^2 pixels that it stands for.
    """
    is_seen = np.zeros(instance_ids.max() + 1, np.bool_)
    find_seen(instance_ids, is_seen)
    seen = np.flatnonzero(is_seen)
    column = np.full(len(is_seen), len(seen), np.int32)  # of each id in votes; the last one stands for no instance
    column[seen] = np.arange(len(seen), dtype=np.int32)
    by_chunk = np.zeros((CHUNKS, points.cluster_count + 1, len(seen) + 1), np.int32)
    count_votes(points.of_pixel, points.first, points.cluster, instance_ids, stride, column, by_chunk)
    votes = by_chunk.sum(axis=0, dtype=np.int32) * np.int32(stride**2)
    return Overlaps(
        instance_ids=seen.astype(np.int32),
        visible=votes[-1, :-1],
        sizes=votes[:-1].sum(axis=1, dtype=np.int32),
        votes=votes[:-1, :-1],
        seen=instance_ids,
        stride=stride,
    )


def class_agreement(clusters: Float32, instances: Float32) -> npt.NDArray[np.float64]:
    """(N, M) how alike distributions (N, C) and (M, C) are: their Bhattacharyya coefficient, in [0, 1], 1 = equal."""
    return np.asarray(np.sqrt(clusters.astype(np.float64)) @ np.sqrt(instances.astype(np.float64)).T)


def match_one_to_one(allowed: Bool, preference: npt.NDArray[np.float64]) -> Int32:
    """(N,) the column that each row is matched with, -1 = none: of the `allowed` pairs (N, M) the most preferred first.

    Ties go to the smaller column, then to the smaller row.
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
    """Every so many pixels of every so many rows vote."""
    return max(1, camera.width // VOTES_ACROSS)


class LabeledMap(Protocol):
    """What association needs of a map: a table of its instances, and voxels that know to which of them they belong."""

    table: InstanceTable

    def instances_seen(self, frame: Frame, T_world_camera: Float64, stride: int) -> Int32:
        """(L, ceil(H / stride), ceil(W / stride)) the L likeliest instances at the measured surface, 0 = none.

        Looked up at every stride-th reading of every stride-th row of `frame.depth`. Unlike a ray-cast, this cannot see
        an instance behind an object that is new.
        """

    def merge(self, kept: int, dropped: int) -> None:
        """Makes instance `dropped` a part of `kept`, in the table and in every voxel."""


@dataclass(frozen=True)
class Matches:
    """Which instances a frame's N clusters are."""

    frame_index: int
    clusters: PointClusters
    overlaps: Overlaps  # with the instances that the map had before
    instance_ids: Int32  # (N,) an old or a new one, 0 = none


def observe(table: InstanceTable, matches: Matches, class_evidence: Float64, least: int) -> None:
    """Brings the table up to date: `class_evidence` (N, C) is what the clusters say, combined as the table does it.

    An instance is in view where at least `least` pixels see it, or where it was detected.
    """
    instance_ids, scores = matches.instance_ids, matches.clusters.scores
    embeddings = weighted_embeddings(matches.clusters)
    if any(instance_ids[k] for k in embeddings):
        table.embedding_space = agreed_space(table.embedding_space, matches.clusters.embedding_space)
    for k in np.flatnonzero(instance_ids):
        score, embedding = float(scores[k]), embeddings.get(int(k))
        table.observe(int(instance_ids[k]), class_evidence[k], score, matches.frame_index, embedding)
    in_view = set(matches.overlaps.instance_ids[matches.overlaps.visible >= least].tolist())
    for instance_id in in_view | set(instance_ids[instance_ids > 0].tolist()):
        table.records[instance_id].in_view.add(matches.frame_index)


def weighted_embeddings(clusters: PointClusters) -> Mapping[int, ObjectEmbedding]:
    """The clusters' embeddings by cluster, each with the detection's score for a weight, as far as they have any."""
    if clusters.embeddings is None:
        return {}
    there = np.flatnonzero(clusters.embeddings.any(axis=1) & (clusters.scores > 0))
    return {int(k): ObjectEmbedding.of(clusters.embeddings[k], float(clusters.scores[k])) for k in there}


@dataclass
class Association:
    """A frame's clusters update the instances that the map has, or make new ones; instances seen as one are merged."""

    min_overlap: float = 0.35  # in [0, 1]: a cluster updates an instance above this overlap
    overlap_rule: OverlapRule = OverlapRule.SMALLER  # what an overlap is counted over
    min_class_agreement: float = (
        0.0  # in [0, 1]: and if their classes agree so much (Bhattacharyya coefficient); 0 = whatever
    )
    create_score: float = 0.3  # in [0, 1]: a detection needs this to create an instance; any may update one
    create_points: int = 50  # pixels, >= 1: and this many; overlaps with less of an instance are counted over this many
    duplicate_overlap: float = 0.6  # in [0, 1]: a cluster that shares this with a better one creates nothing
    split_instances: bool = (
        True  # whether two clusters on one instance split it: the better one keeps it, the other is new
    )
    merge_overlap: float = 0.5  # in [0, 1]: two instances under one cluster above this are one object ...
    merge_frames: int = 3  # frames, >= 1: ... when seen so in this many more frames than apart ...
    merge_agreement: float = 0.1  # in [0, 1]: ... and if their classes agree so much (as in class_gate); so must those
    # of a cluster and of an instance that another one hides

    def __post_init__(self) -> None:
        check_bounds(
            self,
            min_overlap=(0.0, 1.0),
            min_class_agreement=(0.0, 1.0),
            create_score=(0.0, 1.0),
            create_points=(1, 2**31),
            duplicate_overlap=(0.0, 1.0),
            merge_overlap=(0.0, 1.0),
            merge_frames=(1, 2**31),
            merge_agreement=(0.0, 1.0),
        )
        self._merge_votes: Counter[tuple[int, int]] = Counter()  # frames that see two as one, less those that do not

    def look_up(self, scene: LabeledMap, frame: Frame, pose: Pose, points: PixelLists) -> Overlaps:
        """How the clusters over each pixel lie on the instances that the map has at the measured surface."""
        stride = vote_stride(frame.camera)
        seen, *hidden = scene.instances_seen(frame, pose.T_world_camera, stride)
        overlaps = count_overlaps(points, seen, stride)
        return replace(overlaps, hidden=hidden[0]) if hidden else overlaps

    def associate(
        self, table: InstanceTable, overlaps: Overlaps, clusters: PointClusters, points: PixelLists, frame_index: int
    ) -> Matches:
        """Matches each cluster with an instance that overlaps enough, or creates one where it is good enough."""
        frame_index = table.number_of(frame_index)
        allowed = overlaps.by(self.overlap_rule, self.create_points) > self.min_overlap
        allowed &= self._agree(table, clusters, overlaps.instance_ids)
        match = match_one_to_one(allowed, overlaps.over_union(self.create_points))
        instance_ids = np.where(match >= 0, np.append(overlaps.instance_ids, 0)[match], 0).astype(np.int32)
        may_create = (
            (instance_ids == 0) & (clusters.scores >= self.create_score) & (overlaps.sizes >= self.create_points)
        )
        if not self.split_instances:
            may_create &= ~allowed.any(axis=1)
        if may_create.any():
            may_create &= ~cover_another(points, clusters.scores, self.duplicate_overlap)
        if overlaps.hidden is not None and may_create.any():
            hidden = count_overlaps(points, overlaps.hidden, overlaps.stride)
            self._find_hidden(table, hidden, clusters, may_create, instance_ids)
        for k in np.flatnonzero(may_create & (instance_ids == 0)):
            instance_ids[k] = table.create(len(clusters.classes), frame_index).id
        return Matches(frame_index, clusters, overlaps, instance_ids)

    def _find_hidden(
        self, table: InstanceTable, hidden: Overlaps, clusters: PointClusters, may_create: Bool, instance_ids: Int32
    ) -> None:
        """Fills in instance_ids (N,) the instances of clusters that may create one, and have one under another already.

        A keyboard on a desk that was known before it is such an instance, until enough has been said for it. A new one
        in every frame would never get enough to be seen.
        """
        free = ~np.isin(hidden.instance_ids, instance_ids)
        allowed = may_create[:, None] & free & (hidden.by(self.overlap_rule, self.create_points) > self.min_overlap)
        if not allowed.any():
            return
        known = np.stack([table.class_probabilities(table.records[int(k)]) for k in hidden.instance_ids])
        allowed &= class_agreement(clusters.class_probabilities, known) >= max(
            self.min_class_agreement, self.merge_agreement
        )
        match = match_one_to_one(allowed, hidden.over_union(self.create_points))
        instance_ids[match >= 0] = hidden.instance_ids[match[match >= 0]]

    def _agree(self, table: InstanceTable, clusters: PointClusters, instance_ids: Int32) -> Bool:
        """(N, M) whether a cluster may be the same thing as an instance, by their classes."""
        if self.min_class_agreement == 0 or not len(instance_ids):
            return np.ones((len(clusters), len(instance_ids)), np.bool_)
        known = np.stack([table.class_probabilities(table.records[int(k)]) for k in instance_ids])
        return class_agreement(clusters.class_probabilities, known) >= self.min_class_agreement

    def observe(self, table: InstanceTable, matches: Matches, class_evidence: Float64) -> None:
        """Brings the table of instances up to date with what this frame saw."""
        observe(table, matches, class_evidence, self.create_points)

    def merge(self, scene: LabeledMap, matches: Matches) -> None:
        """Merges two instances that keep lying under one cluster and are hardly ever seen as two (after Voxblox++)."""
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
                    self._forget(pair[1])
                    return  # overlaps are out of date now; what else is to be merged will be seen again

    def _same_class(self, table: InstanceTable, a: int, b: int) -> bool:
        """Whether two instances may be one thing, by their classes: a book is not the table that it lies on.

        The default was chosen on replica_floor2 and ScanNet's scene0000_00, with maskrcnn2go and YOLO11n-seg: 0.1 and
        0.5 gave the same figures there, and AP50 was lower than without in none of 18 pairs.
        """
        known = [table.class_probabilities(table.records[k])[None] for k in (a, b)]
        return bool(class_agreement(*known)[0, 0] >= self.merge_agreement)

    def _forget(self, instance_id: int) -> None:
        self._merge_votes = Counter({pair: n for pair, n in self._merge_votes.items() if instance_id not in pair})


def agreed_classes(known: tuple[str, ...], found: tuple[str, ...]) -> tuple[str, ...]:
    """The map's label space, which is that of its first frame: `known` is () before.

    Raises DataError unless a frame's clusters have that of the map.
    """
    if known and known != found:
        raise DataError(
            f"the map has {len(known)} classes and this frame's clusters have {len(found)} "
            "others; use one detector, or map them to one label space"
        )
    return found

"""Instance table: the class evidence, observations and confidence of each instance.

An instance is tentative until it is confirmed for the first time.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import takewhile
from typing import Protocol

import numpy as np

from framework.data import Float32, Float64, Int32
from framework.mapping.instances.object_embedding import ObjectEmbedding, added
from framework.mapping.labels.label_evidence import UNSEEN
from framework.mapping.labels.label_evidence_kernels import Combine

PAGE = 4096  # number of frames of a page of a FrameSet


class FrameSet:
    """A set of frame indices with one bit for each frame, stored in pages."""

    def __init__(self, pages: Mapping[int, int] | None = None) -> None:
        self.pages = dict(pages or {})  # bits of the frames page * PAGE to page * PAGE + PAGE - 1, by page
        self._count = sum(bits.bit_count() for bits in self.pages.values())

    def __len__(self) -> int:
        return self._count

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FrameSet) and self.pages == other.pages

    def __or__(self, other: FrameSet) -> FrameSet:
        both = self.pages.keys() | other.pages.keys()
        return FrameSet({page: self.pages.get(page, 0) | other.pages.get(page, 0) for page in both})

    def add(self, frame: int) -> None:
        page, bit = divmod(frame, PAGE)
        bits = self.pages.get(page, 0)
        self._count += not bits >> bit & 1
        self.pages[page] = bits | 1 << bit

    def last(self) -> int:
        """Return the largest frame index, -1 if the set is empty."""
        page = max(self.pages, default=-1)
        return PAGE * page + self.pages[page].bit_length() - 1 if self.pages else -1


class Condition(Protocol):
    """Condition for an instance to be confirmed. Equal conditions give equal results."""

    def is_met(self, record: InstanceRecord) -> bool:
        """Return True if the condition is met."""


@dataclass
class InstanceRecord:
    """The history of one instance.

    `class_evidence` (C,) combines the evidence of all its detections.
    """

    id: int
    class_evidence: Float64
    first_frame: int = -1
    last_frame: int = -1
    observed_in: FrameSet = field(default_factory=FrameSet)  # frames with a detection
    in_view: FrameSet = field(default_factory=FrameSet)  # frames in which the instance is in view
    score_sum: float = 0.0  # sum of the scores of its detections
    detections: int = 0  # number of detections
    embedding: ObjectEmbedding | None = None  # sum of the embeddings of its detections, None = no embedding

    @property
    def observations(self) -> int:
        """Number of frames with a detection."""
        return len(self.observed_in)

    @property
    def visible(self) -> int:
        """Number of frames in which the instance is in view."""
        return len(self.in_view)

    @property
    def confidence(self) -> float:
        """Mean detection score times the detection rate in frames with the instance in view, in [0, 1]."""
        mean_score = self.score_sum / max(self.detections, 1)
        return mean_score * self.observations / max(self.visible, self.observations, 1)


class InstanceTable:
    """The instances of a map by id.

    Ids start at 1. The ids of tentative instances that are removed are used again, those of other instances never are.
    Class evidence is combined by the rule `combine`, as in the voxels. It consists of log-likelihoods if `logarithmic`
    is True, and of votes otherwise.
    """

    def __init__(self, combine: Combine = Combine.SUM, logarithmic: bool = True) -> None:
        self.records: dict[int, InstanceRecord] = {}
        self.last_id = 0
        self.free_ids: list[int] = []  # heap of the ids that are used again
        self.detected_frames = 0  # number of frames with detections since the map was created or loaded
        # `detected_frames` at the last detection of each tentative instance by id, in ascending order
        self.tentative: dict[int, int] = {}
        self._confirmed: frozenset[int] = frozenset()
        self._condition: Condition | None = None  # of `_confirmed`
        self._changed: set[int] = set()  # ids whose entry in `_confirmed` may be outdated
        self._last_before = -1  # last frame of the previous sequences
        self._offset = 0  # offset of the frame indices of this sequence
        self.combine = combine
        self.logarithmic = logarithmic
        self.embedding_space = ""  # space of the embeddings of the instances; "" = no embeddings

    def create(self, classes: int, frame_index: int) -> InstanceRecord:
        """Create an instance without observations.

        Args:
            classes: The number of classes.
            frame_index: The frame in which the instance is created.
        """
        instance_id = heappop(self.free_ids) if self.free_ids else self.last_id + 1
        record = InstanceRecord(instance_id, np.zeros(classes), first_frame=frame_index, last_frame=frame_index)
        self.add(record)
        self.tentative[instance_id] = self.detected_frames
        return record

    def add(self, record: InstanceRecord) -> None:
        """Add an instance with a new id."""
        self.records[record.id] = record
        self.last_id = max(self.last_id, record.id)
        self._changed.add(record.id)

    def remove(self, instance_id: int) -> None:
        """Remove an instance. Its id is not used again."""
        del self.records[instance_id]
        self.tentative.pop(instance_id, None)
        self._changed.add(instance_id)

    def release(self, instance_id: int) -> None:
        """Remove a tentative instance without evidence in the voxels. Its id is used again."""
        self.remove(instance_id)
        heappush(self.free_ids, instance_id)

    def unseen(self, frames: int) -> list[int]:
        """Return the tentative instances without a detection in the last `frames` frames with detections."""
        return [*takewhile(lambda k: self.detected_frames - self.tentative[k] >= frames, self.tentative)]

    def confirmed(self, condition: Condition) -> frozenset[int]:
        """Return the ids of the instances that meet the condition. Only changed instances are tested again."""
        if condition != self._condition:
            self._condition, self._changed = condition, {*self.records}
            self._confirmed = frozenset()
        if self._changed:
            met = {k for k in self._changed if k in self.records and condition.is_met(self.records[k])}
            for k in met:
                self.tentative.pop(k, None)
            if met != self._confirmed & self._changed:
                self._confirmed = self._confirmed - self._changed | met
            self._changed.clear()
        return self._confirmed

    def begin_recording(self) -> None:
        """Prepare for the frames of another sequence, whose indices may repeat those of previous sequences."""
        last = (max(record.in_view.last(), record.last_frame) for record in self.records.values())
        self._last_before = max(last, default=-1)
        self._offset = 0

    def number_of(self, frame_index: int) -> int:
        """Return the frame index plus an offset, so that it exceeds all frame indices of previous sequences."""
        if frame_index + self._offset <= self._last_before:
            self._offset = self._last_before + 1
        return frame_index + self._offset

    def observe(
        self,
        instance_id: int,
        class_evidence: Float64,
        score: float,
        frame_index: int,
        embedding: ObjectEmbedding | None = None,
    ) -> None:
        """Add one detection to an instance.

        Args:
            instance_id: The instance.
            class_evidence: The class evidence (C,) of the detection.
            score: The score of the detection.
            frame_index: The frame of the detection.
            embedding: The embedding of the detection.
        """
        record = self.records[instance_id]
        record.class_evidence = _combined(record.class_evidence, class_evidence, self.combine)
        record.last_frame = max(record.last_frame, frame_index)
        record.observed_in.add(frame_index)
        record.score_sum += score
        record.detections += 1
        record.embedding = added(record.embedding, embedding)
        self._changed.add(instance_id)
        self._detected(instance_id)

    def _detected(self, instance_id: int) -> None:
        """Move an instance to the end of the tentative instances, if it is one of them."""
        if self.tentative.pop(instance_id, None) is not None:
            self.tentative[instance_id] = self.detected_frames

    def see(self, instance_ids: Iterable[int], frame_index: int) -> None:
        """Record that instances are in view in a frame."""
        for k in instance_ids:
            self.records[k].in_view.add(frame_index)
            self._changed.add(k)

    def merge(self, kept: int, dropped: int) -> None:
        """Add the history of instance `dropped` to `kept`, and remove `dropped`. The caller moves its voxels."""
        a, b = self.records[kept], self.records[dropped]
        if dropped in self.tentative:
            self.release(dropped)
            self._detected(kept)
        else:
            self.remove(dropped)
            self.tentative.pop(kept, None)
        self._changed.add(kept)
        earlier, later = (a, b) if a.last_frame <= b.last_frame else (b, a)
        a.class_evidence = _combined(earlier.class_evidence, later.class_evidence, self.combine)
        a.observed_in |= b.observed_in
        a.in_view |= b.in_view
        a.score_sum += b.score_sum
        a.detections += b.detections
        a.embedding = added(a.embedding, b.embedding)
        a.first_frame = min(a.first_frame, b.first_frame)
        a.last_frame = max(a.last_frame, b.last_frame)

    def add_class(self) -> None:
        """Add a class with the probability 0 to all instances."""
        for record in self.records.values():
            unseen = record.class_evidence.max() - UNSEEN if self.logarithmic else 0.0
            record.class_evidence = np.append(record.class_evidence, unseen)

    def class_probabilities(self, record: InstanceRecord) -> Float32:
        """Return the class distribution (C,) of an instance from its detections."""
        return self.distribution(record.class_evidence)

    def distribution(self, evidence: Float64) -> Float32:
        """Return the class distribution (C,) for class evidence (C,)."""
        likelihood = np.exp(evidence - evidence.max()) if self.logarithmic else evidence
        total = likelihood.sum()
        return np.asarray(likelihood / total if total > 0 else np.full_like(evidence, 1 / len(evidence)), np.float32)

    def class_ids(self) -> Int32:
        """Return the most likely class (last id + 1,) of each instance, indexed by id, -1 = no such instance."""
        class_ids = np.full(self.last_id + 1, -1, np.int32)
        for record in self.records.values():
            class_ids[record.id] = record.class_evidence.argmax()
        return class_ids


def _combined(old: Float64, new: Float64, combine: Combine) -> Float64:
    if combine is Combine.SUM:
        return old + new
    return np.maximum(old, new) if combine is Combine.LARGEST else new.copy()

"""Instance table: the class evidence, observations and confidence of each instance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from framework.data import Float32, Float64, Int32
from framework.mapping.instances.object_embedding import ObjectEmbedding, added
from framework.mapping.labels.label_evidence import UNSEEN
from framework.mapping.labels.label_evidence_kernels import Combine


class FrameSet:
    """A set of frame indices, stored as spans of consecutive frames."""

    def __init__(self, spans: Iterable[list[int]] = ()) -> None:
        self.spans: list[list[int]] = []  # first and last frame of each span, ascending, with gaps between spans
        self._count = 0
        for first, last in sorted(spans):
            self._append(first, last)

    def __len__(self) -> int:
        return self._count

    def __or__(self, other: FrameSet) -> FrameSet:
        return FrameSet(self.spans + other.spans)

    def add(self, frame: int) -> None:
        if self.spans and frame < self.spans[-1][0]:
            merged = self | FrameSet([[frame, frame]])
            self.spans, self._count = merged.spans, len(merged)
        else:
            self._append(frame, frame)

    def _append(self, first: int, last: int) -> None:
        """Add a span that begins within or after the last span."""
        if not self.spans or first > self.spans[-1][1] + 1:
            self.spans.append([first, first - 1])
        self._count += max(last - self.spans[-1][1], 0)
        self.spans[-1][1] = max(last, self.spans[-1][1])


@dataclass
class InstanceRecord:
    """The history of one instance.

    `class_evidence` (C,) combines the evidence of all its detections.
    """

    id: int
    class_evidence: Float64
    first_frame: int = -1
    last_frame: int = -1
    observed_in: set[int] = field(default_factory=set)  # frames with a detection
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

    Ids start at 1 and are never reused. Class evidence is combined by the rule `combine`, as in the voxels. It consists
    of log-likelihoods if `logarithmic` is True, and of votes otherwise.
    """

    def __init__(self, combine: Combine = Combine.SUM, logarithmic: bool = True) -> None:
        self.records: dict[int, InstanceRecord] = {}
        self.last_id = 0
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
        self.last_id += 1
        record = InstanceRecord(self.last_id, np.zeros(classes), first_frame=frame_index, last_frame=frame_index)
        self.records[self.last_id] = record
        return record

    def begin_recording(self) -> None:
        """Prepare for the frames of another sequence, whose indices may repeat those of previous sequences."""
        spans = [span[1] for record in self.records.values() for span in record.in_view.spans[-1:]]
        self._last_before = max([*spans, *(record.last_frame for record in self.records.values())], default=-1)
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

    def merge(self, kept: int, dropped: int) -> None:
        """Add the history of instance `dropped` to `kept`, and remove `dropped`."""
        a, b = self.records[kept], self.records.pop(dropped)
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

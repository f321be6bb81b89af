"""Instance table: the class evidence, observations and confidence of each instance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import takewhile
from struct import Struct
from typing import Protocol

import numpy as np

from framework.data import Bool, Float32, Float64, Int32
from framework.mapping.instances.instance_calibration import (
    NO_OUTLINE,
    InstanceCalibration,
    InstanceFeatures,
    InstanceProbabilities,
)
from framework.mapping.instances.object_embedding import ObjectEmbedding, added
from framework.mapping.instances.viewing import Viewing
from framework.mapping.labels.label_evidence import UNSEEN
from framework.mapping.labels.label_evidence_kernels import Combine
from framework.runtime.spooled_list import Spool

PAGE = 1024  # number of frames of a page of a FrameSet
STORED = Struct(f"<qq{PAGE // 8}s")  # a page in the file: position of the page before it (-1 = none), number, bits


@dataclass(frozen=True)
class _Page:
    """A page of a FrameSet that cannot be written to the file."""

    before: int | _Page
    number: int
    bits: int


class FrameSet:
    """A set of frame indices with one bit for each frame, in pages.

    Only the page of the latest frames is in memory. Earlier pages are in a temporary file.
    """

    def __init__(self, spool: Spool, pages: Mapping[int, int] | None = None) -> None:
        """Create a set.

        Args:
            spool: The temporary file, which sets can share.
            pages: The bits of the frames k * PAGE to k * PAGE + PAGE - 1, by page number k. None = no frames.
        """
        self._spool = spool
        self._count = self._number = self._bits = 0  # number of frames; number and bits of the latest page
        self._before: int | _Page = -1  # the page before the latest one: position in the file, -1 = none, or in memory
        for number, bits in sorted((pages or {}).items()):
            self._begin(number)
            self._bits = bits
            self._count += bits.bit_count()

    def __reduce__(self) -> tuple[type[FrameSet], tuple[Spool, dict[int, int]]]:
        return FrameSet, (self._spool, self.pages())

    def __len__(self) -> int:
        return self._count

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FrameSet) and self.pages() == other.pages()

    def __or__(self, other: FrameSet) -> FrameSet:
        ours, theirs = self.pages(), other.pages()
        return FrameSet(self._spool, {k: ours.get(k, 0) | theirs.get(k, 0) for k in ours.keys() | theirs.keys()})

    def add(self, frame: int) -> None:
        number, bit = divmod(frame, PAGE)
        if self._count and number < self._number:  # frames are usually in ascending order
            vars(self).update(vars(self | FrameSet(self._spool, {number: 1 << bit})))
            return
        if number != self._number:
            self._begin(number)
        self._count += not self._bits >> bit & 1
        self._bits |= 1 << bit

    def last(self) -> int:
        """Return the largest frame index, -1 if the set is empty."""
        return PAGE * self._number + self._bits.bit_length() - 1

    def pages(self) -> dict[int, int]:
        """Return the bits of each page that is not empty, by number, in descending order."""
        pages = {self._number: self._bits} if self._bits else {}
        page = self._before
        while isinstance(page, _Page) or page >= 0:
            if isinstance(page, _Page):
                pages[page.number], page = page.bits, page.before
            else:
                page, number, bits = STORED.unpack(self._spool.opened(page).read(STORED.size))
                pages[number] = int.from_bytes(bits, "little")
        return pages

    def _begin(self, number: int) -> None:
        """Begin a page after the latest one."""
        if self._bits:
            before, content = self._before, self._bits.to_bytes(PAGE // 8, "little")
            start = self._spool.write(STORED.pack(before, self._number, content)) if isinstance(before, int) else None
            self._before = _Page(before, self._number, self._bits) if start is None else start
        self._number, self._bits = number, 0


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
    first_frame: int
    last_frame: int
    observed_in: FrameSet  # frames with a detection
    in_view: FrameSet  # frames in which the instance is in view
    score_sum: float = 0.0  # sum of the scores of its detections
    detections: int = 0  # number of detections
    embedding: ObjectEmbedding | None = None  # sum of the embeddings of its detections, None = no embedding
    viewing: Viewing = field(default_factory=Viewing)  # statistics of its views

    @property
    def observations(self) -> int:
        """Number of frames with a detection."""
        return len(self.observed_in)

    @property
    def visible(self) -> int:
        """Number of frames in which the instance is in view."""
        return len(self.in_view)

    @property
    def mean_score(self) -> float:
        """Mean score of its detections."""
        return self.score_sum / max(self.detections, 1)

    @property
    def confidence(self) -> float:
        """Mean detection score times the detection rate in frames with the instance in view, in [0, 1]."""
        return self.mean_score * self.observations / max(self.visible, self.observations, 1)

    def features(self, class_probability: float) -> InstanceFeatures:
        """Return the statistics for the calibrated probabilities.

        Args:
            class_probability: The probability of the most likely class, with discounted evidence.
        """
        outline = self.viewing.outline
        return InstanceFeatures(
            confidence=self.confidence,
            observations=self.observations,
            score=self.mean_score,
            outline=NO_OUTLINE if outline is None else outline,
            class_probability=class_probability,
        )


class InstanceTable:
    """The instances of a map by id.

    Ids start at 1 and are never reused. Class evidence is combined by the rule `combine`, as in the voxels. It consists
    of log-likelihoods if `logarithmic` is True, and of votes otherwise.
    """

    def __init__(self, combine: Combine = Combine.SUM, logarithmic: bool = True) -> None:
        self.records: dict[int, InstanceRecord] = {}
        self.last_id = 0
        self.frames_detected = 0  # number of frames with detections since the map was created or loaded
        # `frames_detected` when a tentative instance was last detected or became tentative, by id, in ascending order
        self.tentative: dict[int, int] = {}
        self._confirmed: frozenset[int] = frozenset()
        self._condition: Condition | None = None  # of `_confirmed`
        self._changed: set[int] = set()  # ids whose entries in `_confirmed` and `tentative` may be outdated
        self._flags = np.zeros(1, np.bool_)
        self._flagged = np.zeros(0, np.int32)
        self._spool = Spool()  # earlier pages of the frame sets
        self._last_before = -1  # last frame of the previous sequences
        self._offset = 0  # offset of the frame indices of this sequence
        self.combine = combine
        self.logarithmic = logarithmic
        self.merged: dict[int, int] = {}  # remaining instance of each merge since the map was loaded
        self.embedding_space = ""  # space of the embeddings of the instances; "" = no embeddings
        self.calibration = InstanceCalibration()  # of the detector

    def create(self, classes: int, frame_index: int) -> InstanceRecord:
        """Create an instance without observations.

        Args:
            classes: The number of classes.
            frame_index: The frame in which the instance is created.
        """
        evidence, observed_in, in_view = np.zeros(classes), self.frame_set(), self.frame_set()
        record = InstanceRecord(self.last_id + 1, evidence, frame_index, frame_index, observed_in, in_view)
        self.add(record)
        return record

    def frame_set(self, pages: Mapping[int, int] | None = None) -> FrameSet:
        """Return a set of frames, given the bits of its pages."""
        return FrameSet(self._spool, pages)

    def add(self, record: InstanceRecord) -> None:
        """Add an instance with a new id."""
        self.records[record.id] = record
        self.last_id = max(self.last_id, record.id)
        self._changed.add(record.id)

    def absorb(self, other: InstanceTable, T_world_other: Float64) -> int:
        """Add the instances of another table, and return the offset of their ids.

        Their frames follow the frames of this table. The distance is a multiple of PAGE. Embeddings of both tables must
        have the same space.

        Args:
            other: The other table.
            T_world_other: The pose (4, 4) of its world frame.
        """
        self.embedding_space = self.embedding_space or other.embedding_space
        self.begin_recording()
        first = min((record.first_frame for record in other.records.values()), default=0)
        pages = self._last_before // PAGE + 1 - first // PAGE
        offset, self.last_id = self.last_id, self.last_id + other.last_id
        for record in other.records.values():
            frames = [
                self.frame_set({number + pages: bits for number, bits in one.pages().items()})
                for one in (record.observed_in, record.in_view)
            ]
            first_frame, last_frame = record.first_frame + pages * PAGE, record.last_frame + pages * PAGE
            self.add(
                replace(
                    record,
                    id=record.id + offset,
                    first_frame=first_frame,
                    last_frame=last_frame,
                    observed_in=frames[0],
                    in_view=frames[1],
                    viewing=record.viewing.moved(T_world_other),
                )
            )
        since = self.frames_detected - other.frames_detected
        ages = self.tentative | {k + offset: frame + since for k, frame in other.tentative.items()}
        self.tentative = dict(sorted(ages.items(), key=lambda entry: entry[1]))
        self.begin_recording()
        return offset

    def remove(self, instance_id: int) -> None:
        """Remove an instance. The caller removes it from the voxels."""
        del self.records[instance_id]
        self.tentative.pop(instance_id, None)
        self._changed.add(instance_id)

    def confirmed(self, condition: Condition) -> frozenset[int]:
        """Return the ids of the instances that meet the condition. All others are tentative.

        Only instances that changed since the last call are tested again.
        """
        if condition != self._condition:
            self._condition, self._confirmed, self._changed = condition, frozenset(), {*self.records}
        if self._changed:
            met = {k for k in self._changed if k in self.records and condition.is_met(self.records[k])}
            for k in met:
                self.tentative.pop(k, None)
            for k in sorted((self._changed & self.records.keys()) - met):
                self.tentative.setdefault(k, self.frames_detected)
            if met != self._confirmed & self._changed:
                self._confirmed = self._confirmed - self._changed | met
            self._changed.clear()
        return self._confirmed

    def undetected(self, condition: Condition, frames: int) -> list[int]:
        """Return the instances that were tentative and undetected in the last `frames` frames with detections.

        Args:
            condition: The condition for an instance to be confirmed. All other instances are tentative.
            frames: The number of frames.
        """
        self.confirmed(condition)  # updates the tentative instances
        return [*takewhile(lambda k: self.frames_detected - self.tentative[k] >= frames, self.tentative)]

    def flags(self, instance_ids: Int32) -> Bool:
        """Return a Boolean array (last id + 1 or more,), True for these instances, valid until the next call."""
        self._flags[self._flagged] = False
        if len(self._flags) <= self.last_id:
            self._flags = np.zeros(2 * (self.last_id + 1), np.bool_)  # rarely, so that a frame takes constant time
        self._flags[instance_ids] = True
        self._flagged = instance_ids.copy()
        return self._flags

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
        self._detected(instance_id)

    def _detected(self, instance_id: int) -> None:
        """Move an instance to the end of the tentative instances."""
        self.tentative.pop(instance_id, None)
        self._changed.add(instance_id)

    def see(self, instance_ids: Iterable[int], frame_index: int) -> None:
        """Record that instances are in view in a frame."""
        for k in instance_ids:
            self.records[k].in_view.add(frame_index)
            self._changed.add(k)

    def merge(self, kept: int, dropped: int) -> None:
        """Add the history of instance `dropped` to `kept`, and remove `dropped`. The caller moves its voxels."""
        a, b = self.records[kept], self.records[dropped]
        self.remove(dropped)
        self.merged[dropped] = kept
        self._detected(kept)
        earlier, later = (a, b) if a.last_frame <= b.last_frame else (b, a)
        a.class_evidence = _combined(earlier.class_evidence, later.class_evidence, self.combine)
        a.observed_in |= b.observed_in
        a.in_view |= b.in_view
        a.score_sum += b.score_sum
        a.detections += b.detections
        a.embedding = added(a.embedding, b.embedding)
        a.viewing.merge(b.viewing)
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

    def probabilities(self, record: InstanceRecord, evidence: Float64) -> InstanceProbabilities:
        """Return the calibrated probabilities of an instance.

        Args:
            record: The history of the instance.
            evidence: The class evidence (C,) that determines its class.
        """
        return self.calibration.probabilities(record.features(self.discounted_class_probability(record, evidence)))

    def discounted_class_probability(self, record: InstanceRecord, evidence: Float64) -> float:
        """Return the probability of the most likely class, with the log-likelihoods scaled to the number of views.

        Votes are not scaled, because their sum does not saturate.
        """
        if self.logarithmic:
            views = record.viewing.views * record.observations / max(record.visible, record.observations, 1)
            evidence = evidence * min(1.0, max(views, 1.0) / max(record.detections, 1))
        return float(self.distribution(evidence).max(initial=0.0))

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

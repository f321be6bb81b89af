"""What the map knows about each instance beside its voxels: class evidence, observations, confidence."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from framework.data import Float32, Float64


@dataclass
class InstanceRecord:
    """One instance's history. `class_log` is the sum of log P(O = c | I_t) over its observations, (C,)."""

    id: int
    class_log: Float64
    first_frame: int = -1
    observed_in: set[int] = field(default_factory=set)  # frames in which it was detected
    visible: int = 0  # frames in which it was in view
    score_sum: float = 0.0  # over its detections
    detections: int = 0

    @property
    def observations(self) -> int:
        """Frames in which it was detected; a merged instance may have had two detections in one."""
        return len(self.observed_in)

    @property
    def class_probabilities(self) -> Float32:
        """(C,) the posterior: the product of the observed distributions, normalised."""
        likelihood = np.exp(self.class_log - self.class_log.max())
        return np.asarray(likelihood / likelihood.sum(), np.float32)

    @property
    def confidence(self) -> float:
        """Mean score of its detections times the share of frames in view in which it was detected, in [0, 1]."""
        mean_score = self.score_sum / max(self.detections, 1)
        return mean_score * self.observations / max(self.visible, self.observations, 1)


class InstanceTable:
    """All instances ever created, by id; ids count from 1 and are never used again."""

    def __init__(self) -> None:
        self.records: dict[int, InstanceRecord] = {}
        self.last_id = 0

    def create(self, classes: int, frame_index: int) -> InstanceRecord:
        """A new instance without observations."""
        self.last_id += 1
        record = InstanceRecord(self.last_id, np.zeros(classes), first_frame=frame_index)
        self.records[self.last_id] = record
        return record

    def observe(self, instance_id: int, log_probabilities: Float64, score: float, frame_index: int) -> None:
        """Counts one detection with log P(O = c | I_t) (C,)."""
        record = self.records[instance_id]
        record.class_log += log_probabilities
        record.observed_in.add(frame_index)
        record.score_sum += score
        record.detections += 1

    def merge(self, kept: int, dropped: int) -> None:
        """Adds the history of `dropped` to `kept` and forgets it."""
        a, b = self.records[kept], self.records.pop(dropped)
        a.class_log += b.class_log
        a.observed_in |= b.observed_in
        a.visible = max(a.visible, b.visible)  # the two were in view together, or they would not cover each other
        a.score_sum += b.score_sum
        a.detections += b.detections
        a.first_frame = min(a.first_frame, b.first_frame)

"""The recording that a run was made from, where it can still be read: its pictures and its true poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from omegaconf import OmegaConf

from framework.data import Camera, Float64, Frame, SceneTruth
from framework.errors import DataError, FrameError, InstanceMapError
from framework.evaluation.trajectory import umeyama
from framework.interfaces import RGBDSequence, RGBDVideo
from framework.registry import build
from framework.reporting.run_contents import RunContents
from framework.runs.metrics import TRUTH, truth_sha256
from framework.runs.provenance import leaves

SAME_TIME_S = 1e-5  # trajectories are stored with nine digits of a second, of which doubles of today's dates keep six


@dataclass(frozen=True)
class RunSource:
    """A run's video, and which of its frames were tracked."""

    contents: RunContents
    video: RGBDSequence | None
    why_not: str  # why there is no video, "" = there is one

    @classmethod
    def of(cls, contents: RunContents) -> RunSource:
        """Opened by the run's config. A video that cannot be read is none: a report is made without it."""
        config = contents.record.config
        if any("${" in str(value) for _, value in leaves({"dataset": config.get("dataset")})):
            return cls(contents, None, "its config is not resolved")
        try:
            video = build(RGBDVideo, OmegaConf.create(dict(config)).get("dataset"))
        except (InstanceMapError, OSError) as error:
            return cls(contents, None, str(error))
        if not isinstance(video, RGBDSequence):
            return cls(contents, None, "it was mapped as it came from a camera")
        found = cls(contents, video, "")
        if len(contents.poses) and found.frame(0) is None:
            return cls(contents, None, "the recording is not the one that was mapped: its first frame is another")
        return found

    @property
    def camera(self) -> Camera | None:
        return None if self.video is None else self.video.camera

    def frame(self, k: int) -> Frame | None:
        """The frame that pose k of the trajectory is of; None where it cannot be read any more."""
        numbers = self.contents.tracked_frames
        if self.video is None or not numbers or self.contents.times is None:
            return None
        first = int(np.searchsorted(self.contents.times.frames, numbers[k]))
        skipped = len(self.video) - len(self.contents.times.frames)  # frames without times may come before it
        for position in range(first, min(first + max(skipped, 0) + 1, len(self.video))):
            try:
                frame = self.video[position]
            except FrameError:
                continue
            if frame.index == numbers[k] and abs(frame.timestamp - self.contents.timestamps[k]) < SAME_TIME_S:
                return frame
            if frame.index > numbers[k]:
                return None
        return None

    def scene_truth(self) -> tuple[SceneTruth | None, str]:
        """The true instances that the run was compared with; None where there are none, then why, "" = never were."""
        expected = self.contents.record.metrics.get(TRUTH)
        if self.video is None:
            return None, self.why_not if expected else ""
        try:
            truth = self.video.scene_truth()
        except (InstanceMapError, OSError) as error:
            return None, str(error)
        if truth is None:
            return None, "the dataset has no true instances any more" if expected else ""
        if expected is not None and truth_sha256(truth) != expected:
            return None, "the true instances are no longer those that the run was compared with"
        return truth, ""


@dataclass(frozen=True)
class TruePath:
    """Where the camera really was, in the map's world: moved rigidly so that it fits the trajectory, as for ATE."""

    chosen: list[int]  # poses of the trajectory, n
    positions: Float64  # (n, 3) m
    errors: Float64  # (n,) m, from there to the trajectory's positions

    @classmethod
    def of(cls, poses: Float64, true_positions: Mapping[int, Float64]) -> TruePath | None:
        """From true positions (3,) by number of the pose; None where there are too few to be moved."""
        chosen = sorted(true_positions)
        if len(chosen) < 3:
            return None
        true, mine = np.array([true_positions[k] for k in chosen]), poses[chosen, :3, 3]
        try:
            R, t = umeyama(true, mine)
        except np.linalg.LinAlgError as error:
            raise DataError(f"the true poses cannot be compared with the trajectory: {error}") from error
        moved = true @ R.T + t
        return cls(chosen, moved, np.linalg.norm(moved - mine, axis=1))

"""Images and ground-truth poses of the sequence of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from omegaconf import OmegaConf

from framework.data import SAME_TIME, Camera, Float64, Frame, SceneTruth, UInt8
from framework.errors import DataError, FrameError, InstanceMapError
from framework.evaluation.trajectory import umeyama
from framework.evaluation.truth_alignment import in_map_world
from framework.interfaces import RGBDSequence, RGBDVideo
from framework.registry import build
from framework.reporting.run_contents import RunContents
from framework.runs.metrics import TRUTH, truth_sha256
from framework.runs.stored_runs import MERGED_FROM, check_resolved

MAX_WIDTH = 640  # px, of stored images
MIN_CLARITY = 0.3  # minimum clarity, so that a blurred close view of an object is preferred to a sharp distant view


@dataclass(frozen=True)
class RunSource:
    """The sequence of a run, with access to its tracked frames."""

    contents: RunContents
    video: RGBDSequence | None
    why_not: str  # reason why the sequence is unavailable, "" = available

    @classmethod
    def of(cls, contents: RunContents) -> RunSource:
        """Open the sequence of a run from its config. If it is unreadable, `video` is None."""
        dataset = contents.record.dataset
        if not dataset:
            return cls(contents, None, "the map was imported without a dataset")
        if MERGED_FROM in contents.record.metrics:
            return cls(contents, None, "the map was merged from the frames of several runs")
        try:
            check_resolved({"dataset": dataset})
            video = build(RGBDVideo, OmegaConf.create(dataset))
        except (InstanceMapError, OSError) as error:
            return cls(contents, None, str(error))
        if not isinstance(video, RGBDSequence):
            return cls(contents, None, "the run mapped a live camera")
        source = cls(contents, video, "")
        if len(contents.poses) and source.frame(0) is None:
            return cls(contents, None, "the first frame differs from the first frame of the run")
        return source

    @property
    def camera(self) -> Camera | None:
        return None if self.video is None else self.video.camera

    def frame(self, k: int) -> Frame | None:
        """Return the frame of pose `k` of the trajectory, or None if the frame cannot be read."""
        numbers = self.contents.tracked_frames
        if self.video is None or not numbers or self.contents.times is None:
            return None
        first = int(np.searchsorted(self.contents.times.frames, numbers[k]))
        # timings.csv may omit earlier frames, so the position may be larger than `first`
        skipped = len(self.video) - len(self.contents.times.frames)
        for position in range(first, min(first + max(skipped, 0) + 1, len(self.video))):
            try:
                frame = self.video[position]
            except FrameError:
                continue
            if frame.index == numbers[k] and abs(frame.timestamp - self.contents.timestamps[k]) < SAME_TIME:
                return frame
            if frame.index > numbers[k]:
                return None
        return None

    def scene_truth(self) -> tuple[SceneTruth | None, str]:
        """Return the ground-truth instances in the world frame of the map.

        Returns:
            The instances and "". If they are unavailable or have changed since the run, None and the reason. The reason
            is "" for a run without ground truth.
        """
        expected = self.contents.record.metrics.get(TRUTH)
        if self.video is None:
            return None, self.why_not if expected else ""
        try:
            truth = self.video.scene_truth()
        except (InstanceMapError, OSError) as error:
            return None, str(error)
        if truth is None:
            return None, "the dataset no longer has ground-truth instances" if expected else ""
        if expected is not None and truth_sha256(truth) != expected:
            return None, "the ground-truth instances differ from those used in the run"
        if self.contents.record.is_imported:
            return truth, ""
        try:
            return in_map_world(truth, self.contents.timestamps, self.contents.poses), ""
        except DataError as error:
            return None, str(error)


@dataclass(frozen=True)
class Footage:
    """Images and camera positions of selected frames of a sequence.

    The keys are indices of poses in the trajectory. Unreadable frames are missing.
    """

    camera: Camera  # camera of the images
    images: Mapping[int, UInt8]  # (H, W, 3) RGB
    frames: Mapping[int, int]  # frame numbers in the sequence
    true_positions: Mapping[int, Float64]  # (3,) m, ground-truth camera positions; missing without a ground-truth pose
    clarity: Mapping[int, float]  # sharpness in [MIN_CLARITY, 1], 1 = at least the median sharpness

    @classmethod
    def of(cls, source: RunSource, chosen: Sequence[int], camera: Camera) -> Footage:
        """Return the readable frames of the chosen poses.

        Args:
            source: Sequence of the run.
            chosen: Indices of poses in the trajectory.
            camera: Camera of the sequence.
        """
        small = camera.scaled(min(1.0, MAX_WIDTH / camera.width))
        images, frames, positions, sharpness = {}, {}, {}, {}
        for k in chosen:
            frame = source.frame(k)
            if frame is None:
                continue
            image = cv2.resize(frame.color, (small.width, small.height), interpolation=cv2.INTER_AREA)
            images[k], frames[k] = np.asarray(image), frame.index
            sharpness[k] = float(cv2.Laplacian(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.CV_32F).var())
            if frame.T_world_camera is not None:
                positions[k] = frame.T_world_camera[:3, 3]
        median = max(float(np.median(list(sharpness.values()))), 1e-9) if sharpness else 1.0
        clarity = {k: min(max(value / median, MIN_CLARITY), 1.0) for k, value in sharpness.items()}
        return cls(small, images, frames, positions, clarity)


@dataclass(frozen=True)
class TruePath:
    """The ground-truth camera path, aligned with the trajectory.

    The rigid alignment is the same as for the ATE.
    """

    chosen: list[int]  # indices of n poses in the trajectory
    positions: Float64  # (n, 3) m, in the world frame of the map
    errors: Float64  # (n,) m, distances to the positions of the trajectory

    @classmethod
    def of(cls, poses: Float64, true_positions: Mapping[int, Float64]) -> TruePath | None:
        """Return the aligned ground-truth path, or None for fewer than three positions.

        Args:
            poses: Camera poses (P, 4, 4) of the trajectory.
            true_positions: Ground-truth camera position (3,), m, by index of the pose in the trajectory.
        """
        chosen = sorted(true_positions)
        if len(chosen) < 3:
            return None
        true, estimated = np.array([true_positions[k] for k in chosen]), poses[chosen, :3, 3]
        try:
            R, t = umeyama(true, estimated)
        except np.linalg.LinAlgError as error:
            raise DataError(
                "ground truth: expected poses with a rigid alignment to the trajectory, "
                f"got {len(chosen)} poses without one; check the ground-truth poses of the dataset"
            ) from error
        aligned = true @ R.T + t
        return cls(chosen, aligned, np.linalg.norm(aligned - estimated, axis=1))

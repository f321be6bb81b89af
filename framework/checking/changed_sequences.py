"""Sequences with the frames of another sequence and with other poses or depth images."""

from __future__ import annotations

from dataclasses import dataclass, replace

from framework.data import Camera, Frame
from framework.errors import FrameError
from framework.interfaces import PoseTracker, RGBDSequence


@dataclass
class ChangedSequence(RGBDSequence):
    """A sequence with the camera and the length of another sequence."""

    sequence: RGBDSequence

    def __post_init__(self) -> None:
        self.camera: Camera = self.sequence.camera
        self.name = self.sequence.name

    def constant_color_delay(self) -> float | None:
        return self.sequence.constant_color_delay()

    def __len__(self) -> int:
        return len(self.sequence)


@dataclass
class PosedSequence(ChangedSequence):
    """The frames of a sequence with the given poses of a tracker."""

    tracker: PoseTracker

    def __getitem__(self, k: int) -> Frame:
        frame = self.sequence[k]
        return replace(frame, T_world_camera=self.tracker.given_pose(frame))


@dataclass
class DelayedDepth(ChangedSequence):
    """A sequence in which each frame has the depth image from `delay` frames later."""

    delay: int  # frames, may be negative

    def __getitem__(self, k: int) -> Frame:
        if not 0 <= k + self.delay < len(self.sequence):
            raise FrameError(f"frame {k}: expected a depth image at an offset of {self.delay} frames, got none")
        return replace(self.sequence[k], depth=self.sequence[k + self.delay].depth)


@dataclass
class FirstFrames(ChangedSequence):
    """The first frames of a sequence."""

    count: int  # number of frames

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, k: int) -> Frame:
        return self.sequence[k]

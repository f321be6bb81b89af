"""A sequence with the poses that a tracker reads from a file."""

from __future__ import annotations

from dataclasses import dataclass, replace

from framework.data import Camera, Frame
from framework.interfaces import PoseTracker, RGBDSequence


@dataclass
class PosedSequence(RGBDSequence):
    """The frames of a sequence with the given poses of a tracker."""

    sequence: RGBDSequence
    tracker: PoseTracker

    def __post_init__(self) -> None:
        self.camera: Camera = self.sequence.camera
        self.name = self.sequence.name

    def constant_color_delay(self) -> float | None:
        return self.sequence.constant_color_delay()

    def __len__(self) -> int:
        return len(self.sequence)

    def __getitem__(self, k: int) -> Frame:
        frame = self.sequence[k]
        return replace(frame, T_world_camera=self.tracker.given_pose(frame))

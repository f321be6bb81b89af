"""What there is to be shown of a run that goes on, and who draws it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from framework.data import Detections, Float64, Frame, InstanceMesh, Pose


@dataclass(frozen=True)
class FrameNote:
    """What is told of every frame."""

    index: int  # Frame.index
    timestamp: float  # s
    pose: Pose
    stage_ms: Mapping[str, float]  # by stage


@dataclass(frozen=True)
class FrameUpdate:
    """A frame with what was found in it."""

    frame: Frame
    detections: Detections
    pose: Pose


@dataclass(frozen=True)
class MapSnapshot:
    """The map after a frame. Nothing in it is written later."""

    index: int  # Frame.index of the last frame that is in it
    timestamp: float  # s
    mesh: InstanceMesh
    objects: Mapping[int, tuple[int, float]]  # SceneMap.most_likely_classes
    up: Float64 | None  # (3,), as it was last asked for


class Drawing(Protocol):
    """Where the news go; called in one thread, which reads no map."""

    def draw_frames(self, notes: Sequence[FrameNote], faults: Sequence[str], picture: FrameUpdate | None) -> None:
        """The frames since the last call, in order; why others were skipped; the newest picture, None = no new one."""

    def draw_map(self, snapshot: MapSnapshot) -> None:
        """The map as it is now."""

    def close(self) -> None:
        """Nothing comes any more."""

"""Tracked frames, whose poses the back end corrects."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import overload

import numpy as np

from framework.data import Float64, Pose
from framework.interfaces import SubmapChange
from framework.runtime.spooled_list import Spool, SpooledList


@dataclass(frozen=True)
class TrackedFrame:
    """The estimated and the ground-truth pose of a frame."""

    index: int  # Frame.index
    position: int  # position in the sequence, counting skipped frames
    timestamp: float  # s
    pose: Pose
    T_world_camera_truth: Float64 | None  # (4, 4); None = unknown


@dataclass
class _Part:
    """The frames between two changes of submaps."""

    start: int  # position of its first frame among the tracked frames
    submap: int
    T_new_old: Float64 | None = None  # (4, 4) motion since the frames were tracked; None = no motion
    T_world_last: Float64 | None = None  # (4, 4) corrected pose of the last frame; None = no frame

    def correct(self, change: SubmapChange) -> float:
        """Move the frames with their submap, and return the motion of the last camera position, m."""
        if self.submap not in change.motions:
            return 0.0
        self.T_new_old = change.moved(self.submap, np.eye(4) if self.T_new_old is None else self.T_new_old)
        if self.T_world_last is None:
            return 0.0
        before, self.T_world_last = self.T_world_last, change.moved(self.submap, self.T_world_last)
        return float(np.linalg.norm((self.T_world_last - before)[:3, 3]))

    def corrected(self, frame: TrackedFrame) -> TrackedFrame:
        if self.T_new_old is None:
            return frame
        pose = replace(frame.pose, T_world_camera=self.T_new_old @ frame.pose.T_world_camera)
        return replace(frame, pose=pose)


class CorrectedFrames(Sequence[TrackedFrame]):
    """The tracked frames with corrected poses. The frames themselves are in a temporary file and are not changed."""

    def __init__(self, spool: Spool) -> None:
        self.as_tracked: SpooledList[TrackedFrame] = SpooledList(spool)
        self._parts = [_Part(0, 0)]

    @property
    def submap(self) -> int:
        """Submap of the next frame."""
        return self._parts[-1].submap

    def append(self, frame: TrackedFrame) -> None:
        self.as_tracked.append(frame)
        self._parts[-1].T_world_last = frame.pose.T_world_camera

    def clear(self) -> None:
        """Remove all frames."""
        self.as_tracked.clear()
        self._parts = [_Part(0, self.submap)]

    def correct(self, change: SubmapChange) -> float:
        """Move the frames with their submaps, and return the largest motion of a camera position, m.

        Only the last position between two changes is compared.
        """
        largest = max(part.correct(change) for part in self._parts)
        self._parts.append(_Part(len(self), change.submap))
        return largest

    def __len__(self) -> int:
        return len(self.as_tracked)

    @overload
    def __getitem__(self, index: int) -> TrackedFrame: ...

    @overload
    def __getitem__(self, index: slice) -> list[TrackedFrame]: ...

    def __getitem__(self, index: int | slice) -> TrackedFrame | list[TrackedFrame]:
        if isinstance(index, slice):
            return list(self)[index]
        k = range(len(self))[index]
        part = self._parts[bisect_right(self._parts, k, key=lambda part: part.start) - 1]
        return part.corrected(self.as_tracked[k])

    def __iter__(self) -> Iterator[TrackedFrame]:
        frames = iter(self.as_tracked)
        ends = [*(part.start for part in self._parts[1:]), len(self)]
        for part, end in zip(self._parts, ends, strict=True):
            yield from map(part.corrected, islice(frames, end - part.start))

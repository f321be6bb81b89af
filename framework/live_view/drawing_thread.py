"""Thread that draws a run without blocking the pipeline.

The poses and times of all frames are drawn, but only the newest image and the newest map. The fuser may change the map
at any time, so the thread of the pipeline takes snapshots between two frames. Snapshots and drawing take at most fixed
fractions of the run time, regardless of the size of the map.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

import numba

from framework.data import Detections, Float64, Frame, InstanceMesh, Pose
from framework.errors import in_one_line
from framework.interfaces import SceneMap, SubmapChange, SubmapGraph

log = logging.getLogger(__name__)

SNAPSHOT_FRACTION = 0.02  # maximum fraction of the pipeline's time for snapshots of the map
FIRST_UP, UP_GROWTH = 2, 4  # the up direction is estimated at snapshots 2, 8, 32, ...; an estimate takes 0.1 s
PICTURE_FRACTION, MAP_FRACTION = 0.08, 0.08  # maximum fractions of a core's time for drawing images and maps
IDLE_S = 0.5  # delay before drawing pending data without a new frame
LAST_S = 30.0  # maximum wait for the last drawing at the end of a run


@dataclass(frozen=True)
class FrameNote:
    """The data that is drawn for every frame."""

    index: int  # Frame.index
    timestamp: float  # s
    pose: Pose
    stage_ms: Mapping[str, float]  # stage times by name, ms


@dataclass(frozen=True)
class CorrectionNote:
    """A change of the submaps after a frame, whose note is next."""

    change: SubmapChange
    graph: SubmapGraph | None  # None = unknown


@dataclass(frozen=True)
class FrameUpdate:
    """A frame with its detections."""

    frame: Frame
    detections: Detections
    pose: Pose


@dataclass(frozen=True)
class MapSnapshot:
    """An immutable copy of the map after a frame."""

    index: int  # Frame.index of the last integrated frame
    timestamp: float  # s, of the last integrated frame
    mesh: InstanceMesh
    objects: Mapping[int, tuple[int, float]]  # as returned by SceneMap.most_likely_classes
    up: Float64 | None  # (3,) last estimate of the up direction, world frame; None = unknown


class Drawing(Protocol):
    """Receiver of updates. All methods are called from one thread."""

    def draw_frames(
        self, notes: Sequence[FrameNote | CorrectionNote], skipped: Sequence[str], picture: FrameUpdate | None
    ) -> None:
        """Draw all frames since the last call.

        Args:
            notes: Data of the frames, and changes of the submaps.
            skipped: Reasons for skipped frames.
            picture: New image; None = no image.
        """

    def draw_map(self, snapshot: MapSnapshot) -> None:
        """Draw the current map."""

    def close(self) -> None:
        """Finish drawing."""


@dataclass
class _Pending:
    """Data for the next drawing."""

    notes: list[FrameNote | CorrectionNote] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    picture: FrameUpdate | None = None
    snapshot: MapSnapshot | None = None


class DrawingThread:
    """Thread that draws the images and the map of a run.

    It draws every `frame_interval`-th image. The map is drawn at intervals of at least `map_interval`, s.
    """

    def __init__(self, scene: SceneMap, drawing: Drawing, frame_interval: int, map_interval: float) -> None:
        self._scene, self._drawing, self._frame_interval = scene, drawing, frame_interval
        self._snapshots = Pace(map_interval, SNAPSHOT_FRACTION)
        self._taken, self._next_up = 0, FIRST_UP  # number of snapshots; next snapshot that estimates up
        self._pictures = Pace(0.0, PICTURE_FRACTION, time.thread_time)
        self._maps = Pace(map_interval, MAP_FRACTION, time.thread_time)
        self._frames = 0
        self._up: Float64 | None = None
        self._last: FrameNote | None = None  # note of the last integrated frame
        self._lock = threading.Lock()  # lock of the pending data
        self._pending = _Pending()
        self._ending = self._failed = False
        self._wanted = threading.Event()
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        """Add a frame. Only the thread that changes the map may call this method."""
        note = FrameNote(frame.index, frame.timestamp, pose, stage_ms)
        if not pose.lost:
            self._last = note
        with self._lock:
            if self._failed:
                return
            self._pending.notes.append(note)
            if self._frames % self._frame_interval == 0:
                self._pending.picture = FrameUpdate(frame, detections, pose)
        self._frames += 1
        if self._pending.snapshot is None and self._snapshots.due() and self._maps.due():
            self._take_snapshot()
        if self._pending.snapshot is not None or self._pictures.due():
            self._wanted.set()

    def skip(self, reason: str) -> None:
        """Add a skipped frame, with the reason."""
        with self._lock:
            if not self._failed:
                self._pending.skipped.append(reason)

    def correct(self, change: SubmapChange, graph: SubmapGraph | None) -> None:
        """Add a change of the submaps."""
        with self._lock:
            if not self._failed:
                self._pending.notes.append(CorrectionNote(change, graph))

    def end(self) -> None:
        """Draw pending data and the final map, and close the drawing."""
        self._next_up = self._taken + 1
        self._take_snapshot()
        self._ending = True
        self._wanted.set()
        self._thread.join(LAST_S)
        if self._thread.is_alive():
            log.warning("viewer: expected the last drawing within %g s, got a timeout; the view is incomplete", LAST_S)

    def _take_snapshot(self) -> None:
        if self._failed or self._last is None or not self._scene.statistics.voxels:
            return
        try:
            with self._snapshots.kept():
                mesh, objects = self._scene.mesh(), self._scene.most_likely_classes()
            self._taken += 1
            if self._taken == self._next_up:
                self._up = self._scene.gravity().up
                self._next_up *= UP_GROWTH
        except Exception as error:
            self._give_up(error)
            return
        snapshot = MapSnapshot(self._last.index, self._last.timestamp, mesh, objects, self._up)
        with self._lock:
            self._pending.snapshot = snapshot

    def _run(self) -> None:
        numba.set_num_threads(1)  # parallel kernels would compete with the pipeline
        try:
            while not self._ending:
                self._wanted.wait(IDLE_S)
                self._wanted.clear()
                self._draw()
            self._draw()
        except Exception as error:
            self._give_up(error)
        try:
            self._drawing.close()
        except Exception as error:  # a full disk may be reported on closing
            self._give_up(error)

    def _draw(self) -> None:
        with self._lock:
            pending, self._pending = self._pending, _Pending()
        if pending.notes or pending.skipped:
            with self._pictures.kept():
                self._drawing.draw_frames(pending.notes, pending.skipped, pending.picture)
        if pending.snapshot is not None:
            with self._maps.kept():
                self._drawing.draw_map(pending.snapshot)

    def _give_up(self, error: Exception) -> None:
        """Disable the viewer without ending the run."""
        if not self._failed:
            log.warning("viewer: disabled after an error; the run continues: %s", in_one_line(error))
        with self._lock:
            self._failed = True
            self._pending = _Pending()


class Pace:
    """Rate limiter of an operation.

    The operation runs at most once per interval. It takes at most the given fraction of the clock's time on average,
    except for the first time, which includes loading kernels.
    """

    def __init__(self, interval: float, fraction: float, clock: Callable[[], float] = time.perf_counter) -> None:
        self.interval = interval  # s
        self.fraction = fraction  # in (0, 1]
        self.clock = clock  # s; time.thread_time measures only the CPU time of the calling thread
        self._next = 0.0  # s, by time.perf_counter
        self._is_first = True

    def due(self) -> bool:
        return time.perf_counter() >= self._next

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Measure the duration of the operation in the `with` body, and delay the next operation accordingly."""
        began, before = time.perf_counter(), self.clock()
        self._next = began + self.interval
        yield
        if not self._is_first:
            self._next = began + max(self.interval, (self.clock() - before) / self.fraction)
        self._is_first = False

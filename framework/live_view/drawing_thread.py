"""A thread that draws what is new while the loop goes on.

The loop never waits for it: what came while it was drawing is drawn next, of pictures and maps only the newest. It
reads no map, which the fuser may be writing: the loop itself takes a snapshot between two frames, where one is due.
What that takes, and what drawing takes, is bounded by shares of the time, however large the map grows.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import numba

from framework.data import Detections, Float64, Frame, Pose
from framework.errors import in_one_line
from framework.interfaces import SceneMap
from framework.live_view.updates import Drawing, FrameNote, FrameUpdate, MapSnapshot

log = logging.getLogger(__name__)

SNAPSHOT_SHARE = 0.02  # of the loop's time, at most, for snapshots of the map
FIRST_UP, UP_GROWTH = 2, 4  # the map is asked what is up with snapshots 2, 8, 32 ...: that takes a tenth of a second
PICTURE_SHARE = 0.08  # of a core's time, at most, for drawing pictures ...
MAP_SHARE = 0.08  # ... and maps
IDLE_S = 0.5  # after which what is there is drawn where no frame follows
LAST_S = 30.0  # that the end of a run waits for the last drawing, at most


class Background:
    """Has `drawing` draw: of every `every`-th frame the picture, and the map once in `map_every` s or less often."""

    def __init__(self, scene: SceneMap, drawing: Drawing, every: int, map_every: float) -> None:
        self._scene, self._drawing, self._every = scene, drawing, every
        self._snapshots = Pace(map_every, SNAPSHOT_SHARE)
        self._taken, self._next_up = 0, FIRST_UP  # snapshots
        self._pictures = Pace(0.0, PICTURE_SHARE, time.thread_time)
        self._maps = Pace(map_every, MAP_SHARE, time.thread_time)
        self._frames = 0
        self._up: Float64 | None = None
        self._last: FrameNote | None = None  # of the frames that are in the map
        self._lock = threading.Lock()  # of what follows
        self._notes: list[FrameNote] = []
        self._faults: list[str] = []
        self._picture: FrameUpdate | None = None
        self._snapshot: MapSnapshot | None = None  # that nobody has begun to draw
        self._ending = self._failed = False
        self._wanted = threading.Event()
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        """Takes the news of one frame; called between two frames by who writes the map."""
        note = FrameNote(frame.index, frame.timestamp, pose, stage_ms)
        if not pose.lost:
            self._last = note
        with self._lock:
            if self._failed:
                return
            self._notes.append(note)
            if self._frames % self._every == 0:
                self._picture = FrameUpdate(frame, detections, pose)
        self._frames += 1
        if self._snapshot is None and self._snapshots.due() and self._maps.due():
            self._take_snapshot()
        if self._snapshot is not None or self._pictures.due():
            self._wanted.set()

    def skip(self, fault: str) -> None:
        """Takes the news of a frame that cannot be used."""
        with self._lock:
            if not self._failed:
                self._faults.append(fault)

    def end(self) -> None:
        """Draws what is left, the whole map included, and closes the drawing."""
        self._next_up = self._taken + 1
        self._take_snapshot()
        self._ending = True
        self._wanted.set()
        self._thread.join(LAST_S)
        if self._thread.is_alive():
            log.warning("viewer: not everything was drawn within %g s", LAST_S)

    def _take_snapshot(self) -> None:
        """Where anything is mapped."""
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
            self._snapshot = snapshot

    def _run(self) -> None:
        numba.set_num_threads(1)  # a kernel on the loop's cores would wait for the loop's, and these for it
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
        except Exception as error:  # a disk that is full says so when the file is closed
            self._give_up(error)

    def _draw(self) -> None:
        with self._lock:
            notes, faults, picture, snapshot = self._notes, self._faults, self._picture, self._snapshot
            self._notes, self._faults, self._picture, self._snapshot = [], [], None, None
        if notes or faults:
            with self._pictures.kept():
                self._drawing.draw_frames(notes, faults, picture)
        if snapshot is not None:
            with self._maps.kept():
                self._drawing.draw_map(snapshot)

    def _give_up(self, error: Exception) -> None:
        """A run goes on whatever becomes of its viewer."""
        if not self._failed:
            log.warning("viewer: it failed, and the run goes on without it: %s", in_one_line(error))
        with self._lock:
            self._failed = True
            self._notes, self._faults, self._picture, self._snapshot = [], [], None, None


class Pace:
    """At most once in `every` seconds, and so seldom that it takes at most `share` of the time, by `clock`."""

    def __init__(self, every: float, share: float, clock: Callable[[], float] = time.perf_counter) -> None:
        self.every = every  # s
        self.share = share  # in (0, 1]
        self.clock = clock  # s; time.thread_time counts what the calling thread computes, and not what it waits
        self._next = 0.0  # s, by time.perf_counter

    def due(self) -> bool:
        return time.perf_counter() >= self._next

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Around doing it."""
        began, before = time.perf_counter(), self.clock()
        self._next = began + self.every
        yield
        self._next = began + max(self.every, (self.clock() - before) / self.share)

"""Frame streams of recordings and live videos, and prefetching in threads."""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, closing, contextmanager
from functools import partial
from typing import TypeVar

import numba

from framework.errors import DataError, FrameError
from framework.interfaces import FrameReader, LiveVideo, RGBDSequence, RGBDVideo

POLL_INTERVAL_S = 0.1  # s, interval of checks for the end while waiting for a frame

_EPOCH = time.time() - time.monotonic()  # s since 1970, time at which the monotonic clock is 0

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


def steady_time() -> float:
    """Return the time, s since 1970. Later changes of the system clock have no effect."""
    return _EPOCH + time.monotonic()


class FrameStream(AbstractContextManager["FrameStream"]):
    """Stream of frame readers, in order. Any thread may take a reader."""

    max_prefetched: int | None = None  # maximum number of prefetched frames; None = no limit
    dropped: int = 0  # number of usable frames that a newer frame replaced before they were taken

    @abstractmethod
    def take(self) -> FrameReader | FrameError | None:
        """Return the reader of the next frame, the error of an unusable frame, or None at the end."""

    def reported(self, error: FrameError) -> None:
        """Record that the error of an unusable frame was counted."""

    def unreported(self) -> Sequence[FrameError]:
        """Return the errors of received unusable frames that were not counted. Called after the end of the stream."""
        return ()

    def dropped_of(self, frames: int) -> int:
        """Return the number of dropped frames after the end of the stream, given the number of processed frames."""
        return 0


def stream_of(video: RGBDVideo, ended: Callable[[], bool]) -> FrameStream:
    """Return the stream of a video. A live stream also ends when `ended` returns True."""
    if isinstance(video, LiveVideo):
        return LiveFrames(video, ended)
    if isinstance(video, RGBDSequence):
        return RecordedFrames(video)
    raise DataError(f"dataset: expected an RGBDSequence or a LiveVideo, got {type(video).__name__}")


class RecordedFrames(FrameStream):
    """Stream of all frames of a recording, in order."""

    def __init__(self, sequence: RGBDSequence) -> None:
        self._readers = (partial(sequence.__getitem__, k) for k in range(len(sequence)))

    def __exit__(self, *_: object) -> None:
        pass

    def take(self) -> FrameReader | None:
        return next(self._readers, None)


class LiveFrames(FrameStream):
    """Stream of the newest frames of a live video. Older frames are dropped, and unusable frames are reported.

    A thread receives the frames, so that they do not accumulate in the video source. Only one frame is prefetched.
    """

    max_prefetched = 1

    def __init__(self, video: LiveVideo, ended: Callable[[], bool]) -> None:
        self._video, self._ended = video, ended
        self._received = 0  # number of frames, including unusable frames
        self._newest: FrameReader | None = None
        self._unusable: deque[FrameError] = deque()
        self._unreported: list[FrameError] = []  # also those that were taken before the run was interrupted
        self._error: Exception | None = None
        self._over = False  # no more frames arrive or are needed
        self._changed = threading.Condition()
        self._listener = threading.Thread(target=self._listen, name="live-frames", daemon=True)

    def __enter__(self) -> LiveFrames:
        self._listener.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end(None)
        self._listener.join()

    def take(self) -> FrameReader | FrameError | None:
        """Wait for a frame and return its reader, or the error of an unusable frame.

        An error of the video is raised after all earlier frames.
        """
        with self._changed:
            while not (self._newest or self._unusable or self._over or self._ended()):
                self._changed.wait(POLL_INTERVAL_S)
            if self._ended():
                return None
            if self._unusable:
                return self._unusable.popleft()
            reader, self._newest = self._newest, None
        if reader is None and self._error is not None:
            raise self._error
        return reader

    def reported(self, error: FrameError) -> None:
        with self._changed:
            self._unreported = [one for one in self._unreported if one is not error]

    def unreported(self) -> Sequence[FrameError]:
        return self._unreported

    def dropped_of(self, frames: int) -> int:
        return self._received - frames

    def _listen(self) -> None:
        try:
            with closing(self._video.frames()) as readers:
                for found in readers:
                    if found is not None:
                        self._keep(found)  # also the frame that arrives at the end
                    if self._over:
                        break
        except Exception as error:
            self._end(error)
        else:
            self._end(None)

    def _keep(self, found: FrameReader | FrameError) -> None:
        with self._changed:
            self._received += 1
            if isinstance(found, FrameError):
                self._unusable.append(found)
                self._unreported.append(found)
            else:
                self.dropped += self._newest is not None
                self._newest = found
            self._changed.notify_all()

    def _end(self, error: Exception | None) -> None:
        with self._changed:
            self._error = self._error or error
            self._over = True
            self._changed.notify_all()


def prefetched_map(
    function: Callable[[Item], Outcome], items: Iterable[Item], prefetch: int, workers: int = 1
) -> Generator[Outcome]:
    """Yield the results of `map(function, items)`, computed in advance by threads.

    An error is raised in place of its result. Closing the generator ends the threads after their current items.

    Args:
        function: Function to call.
        items: Arguments of the calls.
        prefetch: Maximum number of items that are computed in advance; 0 = no threads.
        workers: Number of threads.
    """
    if prefetch == 0:
        yield from map(function, items)
        return
    # numba's thread count is per thread: the workers get the count of the consumer
    pool = ThreadPoolExecutor(workers, "prefetch", numba.set_num_threads, (numba.get_num_threads(),))
    pending: deque[Future[Outcome]] = deque()
    try:
        for item in items:
            pending.append(pool.submit(function, item))
            if len(pending) > prefetch:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


class Turns:
    """Lock that threads acquire in the order of their turn numbers, starting at 0."""

    def __init__(self) -> None:
        self._next = 0
        self._changed = threading.Condition()

    @contextmanager
    def turn(self, number: int) -> Iterator[None]:
        """Run the `with` body after all turns with smaller numbers have ended."""
        with self._changed:
            self._changed.wait_for(lambda: self._next == number)
        try:
            yield
        finally:
            with self._changed:
                self._next += 1
                self._changed.notify_all()

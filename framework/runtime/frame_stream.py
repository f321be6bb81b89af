"""The frames of a video one after the other: all of a recording, of a live video the newest."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, closing
from functools import partial

from framework.errors import DataError
from framework.interfaces import FrameReader, LiveVideo, RGBDSequence, RGBDVideo

PATIENCE_S = 0.1  # how long a wait for a frame goes on before it asks whether it shall end


class FrameStream(AbstractContextManager["FrameStream"]):
    """Readers of a video's frames in their order. Another thread than that of the `with` around it may take them."""

    most_ahead: int | None = None  # frames that may be taken before they are needed; None = any number
    dropped: int = 0  # frames so far that were not taken

    @abstractmethod
    def take(self) -> FrameReader | None:
        """The next frame; None at the end."""


def stream_of(video: RGBDVideo, ended: Callable[[], bool]) -> FrameStream:
    """The frames of a video; a live one also ends when somebody has `ended` it."""
    if isinstance(video, LiveVideo):
        return LiveFrames(video, ended)
    if isinstance(video, RGBDSequence):
        return RecordedFrames(video)
    raise DataError(f"{type(video).__name__} must be an RGBDSequence or a LiveVideo")


class RecordedFrames(FrameStream):
    """Every frame of a recording, in order."""

    def __init__(self, sequence: RGBDSequence) -> None:
        self._readers = (partial(sequence.__getitem__, k) for k in range(len(sequence)))

    def __exit__(self, *_: object) -> None:
        pass

    def take(self) -> FrameReader | None:
        return next(self._readers, None)


class LiveFrames(FrameStream):
    """The newest frame of a live video whenever one is asked for, taken once.

    A thread listens to the video, so that nothing waits in it, and keeps the last frame that came: whatever is slow, no
    frame gets older than the steps before it take, and no memory fills up. So only one is taken ahead.
    """

    most_ahead = 1

    def __init__(self, video: LiveVideo, ended: Callable[[], bool]) -> None:
        self._video, self._ended = video, ended
        self._newest: FrameReader | None = None
        self._fault: Exception | None = None
        self._over = False  # nothing more comes, or is wanted
        self._changed = threading.Condition()
        self._listener = threading.Thread(target=self._listen, name="live-frames", daemon=True)

    def __enter__(self) -> LiveFrames:
        self._listener.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end(None)
        self._listener.join()

    def take(self) -> FrameReader | None:
        """Waits for a frame. Raises what the video raises, once the last frame before that is taken."""
        with self._changed:
            while self._newest is None and not self._over and not self._ended():
                self._changed.wait(PATIENCE_S)
            if self._ended():
                return None
            reader, self._newest = self._newest, None
        if reader is None and self._fault is not None:
            raise self._fault
        return reader

    def _listen(self) -> None:
        try:
            with closing(self._video.frames()) as readers:
                for reader in readers:
                    if self._over:
                        break
                    if reader is not None:
                        self._keep(reader)
        except Exception as fault:
            self._end(fault)
        else:
            self._end(None)

    def _keep(self, reader: FrameReader) -> None:
        with self._changed:
            self.dropped += self._newest is not None
            self._newest = reader
            self._changed.notify_all()

    def _end(self, fault: Exception | None) -> None:
        with self._changed:
            self._fault = self._fault or fault
            self._over = True
            self._changed.notify_all()

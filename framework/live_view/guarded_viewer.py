"""A viewer whose faults are its own."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from framework.data import Detections, Frame, Pose
from framework.errors import in_one_line
from framework.interfaces import SceneMap, Viewer

log = logging.getLogger(__name__)


class GuardedViewer(Viewer):
    """Passes all on to another one until that raises something: a run goes on whatever becomes of its viewer.

    What `begin` raises is passed on, too: nothing is lost yet. `end` is always called, as it may give something back.
    """

    def __init__(self, viewer: Viewer) -> None:
        self._viewer = viewer
        self._failed = False

    def begin(self, scene: SceneMap, video: str, directory: Path) -> None:
        self._failed = False
        self._viewer.begin(scene, video, directory)

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        if not self._failed:
            with self._kept_apart():
                self._viewer.show(frame, detections, pose, stage_ms)

    def skip(self, reason: str) -> None:
        if not self._failed:
            with self._kept_apart():
                self._viewer.skip(reason)

    def end(self) -> None:
        with self._kept_apart():
            self._viewer.end()

    @contextmanager
    def _kept_apart(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            if not self._failed:
                log.warning("viewer: it failed, and the run goes on without it: %s", in_one_line(error))
            self._failed = True

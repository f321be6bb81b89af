"""Wrapper that prevents viewer errors from ending a run."""

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
    """Wrapper that disables a viewer after its first error. Errors of `begin` are raised; `end` is always called."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer = viewer
        self._failed = False

    def begin(self, scene: SceneMap, video: str, directory: Path) -> None:
        self._failed = False
        self._viewer.begin(scene, video, directory)

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        if not self._failed:
            with self._guard():
                self._viewer.show(frame, detections, pose, stage_ms)

    def skip(self, reason: str) -> None:
        if not self._failed:
            with self._guard():
                self._viewer.skip(reason)

    def end(self) -> None:
        with self._guard():
            self._viewer.end()

    @contextmanager
    def _guard(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            if not self._failed:
                log.warning("viewer: disabled after an error; the run continues: %s", in_one_line(error))
            self._failed = True

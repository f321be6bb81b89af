"""Wrapper that prevents viewer errors from ending a run."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from framework.data import Detections, Frame, Pose
from framework.errors import in_one_line
from framework.interfaces import SceneMap, SubmapChange, SubmapGraph, Viewer

log = logging.getLogger(__name__)


@dataclass
class RunOutcome:
    """The outcome of a run, for `Viewer.end_run`."""

    metrics: Mapping[str, Any] = field(default_factory=dict)
    error: str = ""


@contextmanager
def watched_run(viewer: Viewer, directory: Path, config: Mapping[str, Any]) -> Iterator[RunOutcome]:
    """Begin a run of the viewer, and end it after the `with` body, also after an error.

    The body sets the yielded outcome.
    """
    outcome = RunOutcome()
    viewer.begin_run(directory, config)
    try:
        yield outcome
    except BaseException as error:
        outcome.error = in_one_line(error)
        raise
    finally:
        viewer.end_run(outcome.metrics, outcome.error)


class GuardedViewer(Viewer):
    """Wrapper that disables a viewer after its first error.

    Errors of `begin_run` and `begin` are raised. The methods `end` and `end_run` are always called.
    """

    def __init__(self, viewer: Viewer) -> None:
        self._viewer = viewer
        self._failed = False

    def begin_run(self, directory: Path, config: Mapping[str, Any]) -> None:
        self._failed = False
        self._viewer.begin_run(directory, config)

    def begin(self, scene: SceneMap, video: str, directory: Path) -> None:
        self._viewer.begin(scene, video, directory)

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        if not self._failed:
            with self._guard():
                self._viewer.show(frame, detections, pose, stage_ms)

    def skip(self, reason: str) -> None:
        if not self._failed:
            with self._guard():
                self._viewer.skip(reason)

    def correct(self, change: SubmapChange, graph: SubmapGraph | None) -> None:
        if not self._failed:
            with self._guard():
                self._viewer.correct(change, graph)

    def end(self) -> None:
        with self._guard():
            self._viewer.end()

    def end_run(self, metrics: Mapping[str, Any], error: str) -> None:
        with self._guard():
            self._viewer.end_run(metrics, error)

    @contextmanager
    def _guard(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            if not self._failed:
                log.warning("viewer: disabled after an error; the run continues: %s", in_one_line(error))
            self._failed = True

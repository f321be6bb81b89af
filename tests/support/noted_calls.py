"""Viewer that writes its calls to a file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from framework.data import Detections, Frame, Pose
from framework.interfaces import SceneMap, Viewer

CALLS = "calls.jsonl"  # file in the run directory; one list per call, with the name of the method and the arguments


@dataclass
class NotedCalls(Viewer):
    """Viewer that writes its calls to a file in the run directory."""

    def begin_run(self, directory: Path, config: Mapping[str, Any]) -> None:
        self._file = directory / CALLS
        self._note("begin_run", config["seed"], (directory / "config.yaml").exists())

    def begin(self, scene: SceneMap, video: str, directory: Path) -> None:
        self._note("begin", video)

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        self._note("show", frame.index)

    def end(self) -> None:
        self._note("end")

    def end_run(self, metrics: Mapping[str, Any], error: str) -> None:
        self._note("end_run", metrics.get("instances.count"), metrics.get("partial"), error)

    def _note(self, *call: Any) -> None:
        with self._file.open("a") as file:
            file.write(json.dumps(call) + "\n")

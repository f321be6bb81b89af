"""Viewer that logs to Weights & Biases (https://wandb.ai, MIT)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from framework.config.validation import check_package
from framework.data import Detections, Frame, Pose
from framework.errors import ConfigError, in_one_line
from framework.interfaces import SceneMap, Viewer
from framework.runs.logged_values import frame_values, parameter_values, run_values


class Destination(Enum):
    """Destination of the logs."""

    OFFLINE = "offline"
    ONLINE = "online"


@dataclass
class WandbViewer(Viewer):
    """Logger of parameters, stage times, map size, metrics and the overview image to Weights & Biases."""

    mode: Destination = Destination.OFFLINE  # destination: OFFLINE (folder wandb in the run directory) or ONLINE (W&B)
    project: str = "instancemap"  # name of the project

    def __post_init__(self) -> None:
        check_package("viewer", "wandb", extra="wandb")

    def begin_run(self, directory: Path, config: Mapping[str, Any]) -> None:
        os.environ.setdefault("WANDB_ERROR_REPORTING", "false")  # W&B sends its errors by default
        import wandb

        self._directory, place = directory, directory.absolute()
        try:
            self._run = wandb.init(
                project=self.project,
                name=place.name,
                group=place.parent.name,
                dir=place,
                config=parameter_values(config),
                mode=self.mode.value,
                reinit="create_new",  # the global run of wandb belongs to the host application
                settings=wandb.Settings(silent=True, console="off", disable_code=True),
            )
        except wandb.Error as error:
            raise ConfigError(
                f"viewer.mode: expected access to W&B, got an error ({in_one_line(error)}); run wandb login, or set "
                "viewer.mode=OFFLINE"
            ) from error

    def begin(self, scene: SceneMap, video: str, directory: Path) -> None:
        self._scene = scene

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        self._run.log(frame_values(pose, stage_ms, self._scene), step=frame.index)

    def end_run(self, metrics: Mapping[str, Any], error: str) -> None:
        import wandb

        overview = self._directory / "overview.png"
        if metrics and overview.exists():
            self._run.log({"run/overview": wandb.Image(str(overview))})
        self._run.summary.update({**run_values(metrics), "run/status": error or "completed"})
        self._run.finish(exit_code=1 if error else 0)

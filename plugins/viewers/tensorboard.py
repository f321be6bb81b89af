"""Viewer that logs to TensorBoard (https://www.tensorflow.org/tensorboard, Apache-2.0)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from framework.config.validation import check_package
from framework.data import Detections, Frame, Pose
from framework.interfaces import SceneMap, Viewer
from framework.runs.logged_values import frame_values, parameter_values, run_values

FLUSH_S = 5  # maximum duration of data lost by a killed run, s


@dataclass
class TensorBoardViewer(Viewer):
    """Logger of parameters, stage times, map size, metrics and the overview image to TensorBoard."""

    folder: str = "tensorboard"  # folder of the event files, relative to the run directory

    def __post_init__(self) -> None:
        check_package("viewer", "tensorboard", extra="tensorboard")

    def begin_run(self, directory: Path, config: Mapping[str, Any]) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._directory, self._parameters = directory, parameter_values(config)
        # purge_step hides events of an earlier run in this folder
        self._writer = SummaryWriter(str(directory / self.folder), purge_step=0, flush_secs=FLUSH_S)

    def begin(self, scene: SceneMap, video: str, directory: Path) -> None:
        self._scene = scene

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        for name, value in frame_values(pose, stage_ms, self._scene).items():
            self._writer.add_scalar(name, value, frame.index)

    def end_run(self, metrics: Mapping[str, Any], error: str) -> None:
        self._writer.add_text("run/status", error or "completed")
        overview = self._directory / "overview.png"
        if metrics and overview.exists():
            self._writer.add_image("run/overview", np.array(Image.open(overview)), dataformats="HWC")
        self._writer.add_hparams(self._parameters, run_values(metrics), run_name=".")  # "." = the same folder
        self._writer.close()

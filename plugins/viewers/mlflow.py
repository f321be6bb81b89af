"""Viewer that logs to MLflow (https://mlflow.org, Apache-2.0)."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock
from platformdirs import user_cache_path

from framework.config.validation import check_package
from framework.data import Detections, Frame, Pose
from framework.errors import ConfigError, reason_of
from framework.interfaces import SceneMap, Viewer
from framework.runs.logged_values import frame_values, parameter_values, run_values

MAX_PARAMETERS = 100  # maximum number of parameters in a request to MLflow
MAX_PENDING = 1000  # maximum number of frames that wait for MLflow


@dataclass
class MLflowViewer(Viewer):
    """Logger of parameters, stage times, map size, metrics and the overview image to MLflow."""

    tracking_uri: str = ""  # database or server of MLflow; "" = MLFLOW_TRACKING_URI, or mlflow.db in the working folder
    experiment: str = "instancemap"  # name of the experiment in MLflow

    def __post_init__(self) -> None:
        check_package("viewer", "mlflow", extra="mlflow")

    def begin_run(self, directory: Path, config: Mapping[str, Any]) -> None:
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")  # MLflow sends usage statistics by default
        from mlflow import MlflowClient
        from mlflow.entities import Param

        self._directory = directory
        self._pending: deque[Any] = deque()  # operations of MLflow's thread
        # parallel runs of a sweep would create the tables of the database at the same time
        lock = user_cache_path("instancemap", appauthor=False, ensure_exists=True) / "mlflow.lock"
        with FileLock(lock), self._named_errors():
            self._client = MlflowClient(self.tracking_uri or None)
            self._run = self._client.create_run(self._experiment_id(), run_name=directory.absolute().name).info.run_id
            self._client.set_tag(self._run, "run_directory", str(directory.absolute()))
            parameters = [Param(key, str(value)) for key, value in parameter_values(config).items()]
            for k in range(0, len(parameters), MAX_PARAMETERS):
                self._client.log_batch(self._run, params=parameters[k : k + MAX_PARAMETERS])

    def begin(self, scene: SceneMap, video: str, directory: Path) -> None:
        self._scene = scene

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        entries = _entries(frame_values(pose, stage_ms, self._scene), frame.index)
        self._pending.append(self._client.log_batch(self._run, entries, synchronous=False))  # in a thread of MLflow
        if len(self._pending) > MAX_PENDING:
            self._pending.popleft().wait()

    def end_run(self, metrics: Mapping[str, Any], error: str) -> None:
        for pending in self._pending:
            pending.wait()
        self._client.log_batch(self._run, _entries(run_values(metrics), 0))
        overview = self._directory / "overview.png"
        if metrics and overview.exists():
            self._client.log_artifact(self._run, str(overview))
        if error:
            self._client.set_tag(self._run, "error", error)
        self._client.set_terminated(self._run, "FAILED" if error else "FINISHED")

    def _experiment_id(self) -> str:
        """Return the id of the experiment, which is created if necessary."""
        found = self._client.get_experiment_by_name(self.experiment)
        return str(found.experiment_id if found else self._client.create_experiment(self.experiment))

    @contextmanager
    def _named_errors(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # of MLflow, SQLAlchemy or an HTTP client
            raise ConfigError(
                f"viewer.tracking_uri: expected a database or server of MLflow, got {self.tracking_uri!r} "
                f"({reason_of(error)})"
            ) from error


def _entries(values: Mapping[str, float], step: int) -> list[Any]:
    from mlflow.entities import Metric

    now = int(1e3 * time.time())
    return [Metric(name, value, now, step) for name, value in values.items()]

"""Tests for viewer=mlflow. The logs are read with MLflow."""

from __future__ import annotations

from pathlib import Path

import pytest

from framework.errors import ConfigError
from plugins.viewers.mlflow import MLflowViewer
from tests.framework.commands.running.test_sweep import BY_JOBLIB, FAKES, begin, end
from tests.support.tracked_run import FRAMES, tracked_run

mlflow = pytest.importorskip("mlflow", reason="requires mlflow-skinny (extra mlflow)")

pytestmark = pytest.mark.integration


def test_mlflow_reads_complete_and_partial_runs(tmp_path: Path) -> None:
    uri = f"sqlite:///{tmp_path / 'mlflow.db'}"
    client = mlflow.MlflowClient(uri)
    for capacity, status, steps in ((100, "FINISHED", FRAMES), (1, "FAILED", 1)):
        run = tracked_run(
            tmp_path, "viewer=mlflow", f"fuser.capacity={capacity}", returncode=0 if status == "FINISHED" else 3
        )
        experiment = client.get_experiment_by_name("instancemap")
        stored = client.search_runs([experiment.experiment_id])[0]  # the newest run
        keys = [key for key in stored.data.metrics if key.startswith("frame/")]
        series = {
            key: [(each.step, each.value) for each in client.get_metric_history(stored.info.run_id, key)]
            for key in keys
        }
        run.check(series, stored.data.metrics, steps)
        assert (stored.info.status, stored.info.run_name) == (status, "run")
        assert stored.data.params["dataset.frames"] == str(FRAMES)
        assert stored.data.tags["run_directory"] == str(run.directory)
        assert stored.data.tags.get("error", "").startswith("" if status == "FINISHED" else "fuser.capacity: expected")
        assert [file.path for file in client.list_artifacts(stored.info.run_id)] == ["overview.png"]


def test_mlflow_invalid_database_raises_error(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"viewer\.tracking_uri: expected a database or server of MLflow, got 'nope:x'"
    ):
        MLflowViewer(tracking_uri="nope:x").begin_run(tmp_path, {})


@pytest.mark.acceptance
def test_mlflow_stores_parallel_runs_of_sweep(tmp_path: Path) -> None:
    """Each worker opens the database, which is created by the sweep."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    done = end(begin(tmp_path, *FAKES, *BY_JOBLIB, "viewer=mlflow", "seed=1,2,3", "hydra.sweep.dir=s", sweep="-m"))
    assert done.returncode == 0, done.stderr
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    runs = client.search_runs([client.get_experiment_by_name("instancemap").experiment_id])
    assert sorted((run.data.params["seed"], run.info.status) for run in runs) == [
        (f"{k}", "FINISHED") for k in (1, 2, 3)
    ]

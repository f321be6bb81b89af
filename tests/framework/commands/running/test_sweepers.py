"""Tests for sweepers that optimize the objective of runs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from hydra.core.utils import JobReturn, JobStatus
from hydra.errors import MissingConfigException
from hydra.utils import instantiate
from omegaconf import OmegaConf

from framework.config.composition import one_line
from framework.files.search_paths import CONF
from tests.framework.commands.running.test_sweep import BY_JOBLIB, FAKES, begin, end, serial

N_TRIALS = 30
SPACE = ["fuser.voxel_size=interval(0.005,0.05)", "refiner.x=interval(0,1)"]


def planted(voxel_size: float, x: float) -> float:
    """Return a smooth objective in [0, 1] with the maximum 1 at (0.02, 0.7)."""
    return float(np.exp(-(((voxel_size - 0.02) / 0.01) ** 2) - ((x - 0.7) / 0.2) ** 2))


def launch_planted(overrides: Sequence[Sequence[str]], initial_job_idx: int) -> list[JobReturn]:
    """Evaluate the planted objective for the overrides of each job, in place of a launcher of Hydra."""
    jobs = [dict(override.split("=") for override in job) for job in overrides]
    values = [planted(float(job["fuser.voxel_size"]), float(job["refiner.x"])) for job in jobs]
    return [JobReturn(status=JobStatus.COMPLETED, _return_value=value) for value in values]


def best_value(directory: Path, seed: int, sampler: str) -> float:
    """Return the best planted objective that the sweeper finds."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        own = compose(
            "config",
            [
                "hydra/sweeper=optuna",
                f"hydra/sweeper/sampler={sampler}",
                f"hydra.sweeper.sampler.seed={seed}",
                "hydra.sweeper.direction=maximize",
                f"hydra.sweeper.n_trials={N_TRIALS}",
                "hydra.sweeper.n_jobs=1",
            ],
            return_hydra_config=True,
        ).hydra
    sweeper = instantiate(own.sweeper).sweeper
    sweeper.launcher, sweeper.hydra_context = SimpleNamespace(launch=launch_planted), SimpleNamespace()
    sweeper.config = OmegaConf.create({"hydra": {"sweep": {"dir": str(directory)}}})
    sweeper.sweep(SPACE)
    return float(OmegaConf.load(directory / "optimization_results.yaml").best_value)


@pytest.mark.integration
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_optuna_beats_random_search_in_median(tmp_path: Path) -> None:
    optuna = pytest.importorskip("optuna", reason="requires hydra-optuna-sweeper (extra sweepers)")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    seeds = range(10)
    tpe, random = ([best_value(tmp_path, seed, sampler) for seed in seeds] for sampler in ("tpe", "random"))
    assert np.median(tpe) > np.median(random)


@pytest.mark.integration
def test_optuna_optimizes_metric_of_runs(tmp_path: Path) -> None:
    """The last sweep continues the stored study. Its runs are skipped or have new folders."""
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="requires hydra-optuna-sweeper (extra sweepers)")
    arguments = (
        "hydra/sweeper=optuna",
        "hydra.sweeper.n_trials=3",
        "hydra.sweeper.storage=sqlite:///study.db",
        "hydra.sweeper.study_name=lost",
        "objective=frames_lost",
        "tracker.lost_to=range(1,5)",
        "hydra.sweep.dir=s",
        "skip_completed=true",
    )
    for _ in range(2):
        done = serial(tmp_path, *FAKES, *arguments, sweep="-m")
        assert done.returncode == 0, done.stderr
        runs = [json.loads(path.read_text()) for path in (tmp_path / "s").glob("*/metrics.json")]
        found = OmegaConf.load(tmp_path / "s" / "optimization_results.yaml")
        assert found.best_value == min(run["frames_lost"] for run in runs) == found.best_params["tracker.lost_to"]


@pytest.mark.integration
def test_optuna_optimizes_several_metrics(tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="requires hydra-optuna-sweeper (extra sweepers)")
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    arguments = (
        *BY_JOBLIB,
        "hydra/sweeper=optuna",
        "hydra.sweeper.n_trials=2",
        "hydra.sweeper.direction=[minimize,maximize]",
        "objective=[frames_lost,frames]",
        "tracker.lost_to=choice(2)",
        "dataset.frames=choice(5)",
        "hydra.sweep.dir=s",
    )
    done = end(begin(tmp_path, *FAKES, *arguments, sweep="-m"))
    assert done.returncode == 0, done.stderr
    solutions = OmegaConf.load(tmp_path / "s" / "optimization_results.yaml").solutions
    assert {tuple(one["values"]) for one in solutions} == {(2.0, 5.0)}


@pytest.mark.integration
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "objective: expected a metric to optimize, got none; set objective=instances.ap50, for example"),
        (
            ["objective=frame"],
            "a run failed: objective: expected a metric of this run, got frame; did you mean frames?",
        ),
    ],
)
def test_optuna_without_known_metric_reports_error(tmp_path: Path, arguments: list[str], message: str) -> None:
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="requires hydra-optuna-sweeper (extra sweepers)")
    swept = ("hydra/sweeper=optuna", "hydra.sweeper.n_trials=1", "dataset.frames=range(2,4)")
    done = serial(tmp_path, *FAKES, *swept, *arguments, sweep="-m")
    assert (done.returncode, done.stderr.splitlines()[-1]) == (1, f"error: {message}")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("name", ["optuna", "ax"])
def test_missing_sweeper_error_names_extra(name: str) -> None:
    error = MissingConfigException("?", missing_cfg_file=f"hydra/sweeper/{name}", options=["basic"])
    assert one_line(error).endswith("pip install 'instancemap[sweepers]'")

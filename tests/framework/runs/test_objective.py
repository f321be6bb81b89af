"""Tests for the objective that a sweeper optimizes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from framework.errors import ConfigError
from framework.runs.objective import objective_keys, objective_of

METRICS = {"sequence": "desk", "frames": 6, "instances.ap50": 0.25, "instances.ap50.bed": None, "git_dirty": True}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    (tmp_path / "metrics.json").write_text(json.dumps(METRICS))
    return tmp_path


@pytest.mark.parametrize(
    ("objective", "value"),
    [(None, None), ("frames", 6.0), (["instances.ap50", "frames"], [0.25, 6.0]), (["frames"], [6.0])],
)
def test_objective_returns_chosen_metrics(run: Path, objective: Any, value: Any) -> None:
    """The result is a list if the keys are a list, also for a single key."""
    assert objective_of(run, OmegaConf.create({"objective": objective}).objective) == value


@pytest.mark.parametrize(
    ("objective", "message"),
    [
        ("instances.ap5", "objective: expected a metric of this run, got instances.ap5; did you mean instances.ap50?"),
        ("instances.ap50.bed", "objective: expected a number for instances.ap50.bed, got null; choose another metric"),
        ("sequence", 'objective: expected a number for sequence, got "desk"; choose another metric'),
        (["frames", "git_dirty"], "objective: expected a number for git_dirty, got true; choose another metric"),
        ("speed", "objective: expected a metric of this run, got speed; choose a key of metrics.json"),
    ],
)
def test_objective_without_number_raises_error(run: Path, objective: Any, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        objective_of(run, objective)
    assert str(error.value) == message


def test_objective_of_run_without_truth_error_names_cause(run: Path) -> None:
    (run / "metrics.json").write_text(json.dumps({"frames": 6, "instances.count": 2}))
    with pytest.raises(ConfigError, match=r"got instances\.ap50; choose a dataset with ground truth"):
        objective_of(run, "instances.ap50")


@pytest.mark.parametrize("objective", [3, [], ["frames", 3]])
def test_objective_keys_of_other_types_raise(objective: Any) -> None:
    with pytest.raises(ConfigError, match=r"objective: expected a key of metrics\.json or a list of keys, got"):
        objective_keys(objective)

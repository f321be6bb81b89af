"""Tests for stored runs as a data frame."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import pandas
import pytest
from omegaconf import OmegaConf

from framework.errors import DataError
from framework.runs.data_frame import load_runs, without_formulas
from framework.runs.provenance import config_hash


def write_run(directory: Path, config: dict[str, Any], **metrics: object) -> None:
    directory.mkdir(parents=True)
    (directory / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(config)))
    (directory / "metrics.json").write_text(json.dumps({**metrics, "config_hash": config_hash(config)}))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return the folder of two runs with different options and of a failed run."""
    chosen = {"choice.dataset": "scenenn", "choice.fuser": "bayes", "git_commit": "abc", "git_dirty": False}
    first = {"seed": 0, "threads": 2, "dataset": {"scene": "011"}, "fuser": {"voxel_size": 1, "sides": [1, 2]}}
    second = {"row": "b", "seed": 1, "dataset": {"scene": "016"}, "fuser": {"voxel_size": 0.02, "split": True}}
    code = {"code.fuser": "plugins.fusers.bayes 3f2a9c41d0b7"}  # missing in runs of older versions
    write_run(tmp_path / "a", first, **chosen, **code, seed=9, frames=8, fps=20.0, **{"instances.ap50": None})
    write_run(tmp_path / "in" / "b", second, **chosen, frames=4, fps=21.5, **{"instances.ap50": 1 / 3})
    (tmp_path / "failed").mkdir()
    (tmp_path / "failed" / "metrics.partial.json").write_text('{"partial": "the map is full"}')
    return tmp_path


def test_load_runs_returns_typed_columns(folder: Path) -> None:
    runs = load_runs(folder)
    assert list(runs["run"]) == ["a", "in/b"]
    types = {
        **{"run": "string", "row": "string", "seed": "Int64", "threads": "Int64", "frames": "Int64"},
        **{"dataset": "string", "dataset.scene": "string", "fuser": "string", "fuser.sides": "string"},
        **{"fuser.voxel_size": "float64", "fuser.split": "boolean", "git_dirty": "boolean", "git_commit": "string"},
        **{"fps": "float64", "instances.ap50": "float64", "code.fuser": "string", "config_hash": "string"},
    }
    assert {key: str(kind) for key, kind in runs.dtypes.items()} == types
    assert list(runs["dataset.scene"]) == ["011", "016"]
    assert list(runs["seed"]) == [0, 1], "expected the seed of the config"
    assert list(runs["fuser.sides"].fillna("")) == ["[1, 2]", ""]
    assert list(runs["row"].isna()) == [True, False]
    assert list(runs["code.fuser"].fillna("none")) == ["plugins.fusers.bayes 3f2a9c41d0b7", "none"]
    assert runs["instances.ap50"].isna()[0]
    assert runs["instances.ap50"][1] == 1 / 3


def test_load_runs_csv_keeps_values(folder: Path) -> None:
    runs = load_runs(str(folder))
    runs.to_csv(folder / "runs.csv", index=False)
    read = pandas.read_csv(folder / "runs.csv", dtype=dict(runs.dtypes))
    pandas.testing.assert_frame_equal(read, runs)


def test_load_runs_reports_incomplete_runs(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        load_runs(folder)
    assert [record.message for record in caplog.records] == [
        f"load_runs: omitted {folder / 'failed'}: partial: the map is full"
    ]


def test_load_runs_without_completed_run_raises(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected a completed run, got none"):
        load_runs(tmp_path)
    with pytest.raises(DataError, match="nowhere: expected a folder of runs, got no folder"):
        load_runs(tmp_path / "nowhere")


def test_without_formulas_changes_only_texts() -> None:
    texts = ["=1+1", "@SUM(A1)", "+x", "-x", "-1.5", "+2", "a=b", "\x1b[2J", None]
    frame = without_formulas(
        pandas.DataFrame({"=name": pandas.Series(texts, dtype="string"), "x": [-0.5] * len(texts)})
    )
    assert list(frame.columns) == ["'=name", "x"]
    found = frame["'=name"].tolist()
    assert found[:-1] == ["'=1+1", "'@SUM(A1)", "'+x", "'-x", "-1.5", "+2", "a=b", r"\x1b[2J"]
    assert found[-1] is pandas.NA
    assert frame["x"].tolist() == [-0.5] * len(texts)

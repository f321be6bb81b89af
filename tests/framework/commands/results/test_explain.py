"""Tests for `instancemap explain` on a small run."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from framework.commands.results import explain
from framework.config import composition
from framework.errors import DataError
from framework.explanation.contributions import STAGES, Stage
from framework.explanation.stored_explanation import StoredExplanation
from framework.runs.stored_runs import GROUND_TRUTH, read_record
from tests.support.reported_run import FAKES, store_parameter, unverified_copy, write_run

pytestmark = pytest.mark.integration


def test_explain_writes_explanation_and_prints_contributions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "run")
    monkeypatch.setattr(composition, "_added", [FAKES])
    monkeypatch.setattr(sys, "argv", ["instancemap explain", str(run), "--figure", str(tmp_path / "bars")])
    explain.main()
    printed = capsys.readouterr().out
    assert "no lost object and no false instance" in printed
    assert "loss (1 - instances.ap50)" in printed
    stored = StoredExplanation.read(run)
    assert stored is not None
    assert stored.is_current
    assert stored.contributions is not None
    assert set(stored.contributions.stages.values()) == {0.0}
    assert (tmp_path / "bars.png").exists()


def test_explain_figure_without_contributions_is_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(tmp_path), "--causes-only", "--figure", str(tmp_path / "bars")]
    monkeypatch.setattr(sys, "argv", ["instancemap explain", *words])
    with pytest.raises(SystemExit) as ended:
        explain.main()
    assert ended.value.code == 2
    assert "--figure: expected contributions of the stages, got --causes-only" in capsys.readouterr().err


def test_explain_stored_config_cannot_read_environment(tmp_path: Path) -> None:
    run = unverified_copy(write_run(tmp_path / "run"), tmp_path / "changed")
    store_parameter(run, "fuser.voxel_size", "${oc.env:SECRET}")
    with pytest.raises(DataError, match=r"fuser\.voxel_size: expected a resolved value in the run's config\.yaml"):
        explain.explain_run(read_record(run), with_contributions=False)
    store_parameter(run, "fuser.voxel_size", 0.03)
    metrics = json.loads((run / "metrics.json").read_text())
    (run / "metrics.json").write_text(json.dumps(metrics | {GROUND_TRUTH: "${oc.env:SECRET}"}))
    with pytest.raises(DataError, match=r"dataset\.ground_truth: expected a resolved value"):
        explain.explain_run(read_record(run), with_contributions=False)


def test_explain_config_has_truth_of_replaced_stages(tmp_path: Path) -> None:
    config = read_record(write_run(tmp_path / "run")).config
    assert explain.given_stages(config) == frozenset()
    truth = explain.with_truth(config, frozenset(STAGES))
    assert truth.detector.exact is False
    assert truth.fuser.association == "GROUND_TRUTH"
    assert truth.refiner["_target_"].endswith("GroundTruthRefiner")
    assert truth.dataset == config["dataset"]
    assert explain.given_stages(dict(truth)) == frozenset(Stage)

"""Tests for the comparison of run directories after config keys have been renamed."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from tests import same_results

OLD = "ahead: 2\nmap: null\nrefiner: {links: {connected: {gap: 0.1, min_share: 0.05}}}\ntracker: {finest: 0.5}\n"
NEW = (
    "prefetch: 0\nresume_from: null\ndetection_interval: 1\ntracker: {finest_scale: 0.5}\n"
    "refiner: {links: {connected: {max_gap: 0.1, min_piece_ratio: 0.05}}}\n"
)


def _run(directory: Path, config: str, tsdf: float = 0.5, ate: float = 0.01) -> Path:
    directory.mkdir(parents=True)
    (directory / "config.yaml").write_text(config)
    (directory / "metrics.json").write_text(json.dumps({"ate": ate, "fps": tsdf}))
    np.savez(directory / "map.npz", tsdf=np.full(3, tsdf, np.float32))
    return directory.parent


def _status(before: Path, after: Path, monkeypatch: pytest.MonkeyPatch) -> object:
    monkeypatch.setattr(sys, "argv", ["same_results", str(before), str(after)])
    with pytest.raises(SystemExit) as end:
        same_results.main()
    return end.value.code


def test_same_results_renamed_keys_are_equal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert not _status(_run(tmp_path / "a/run", OLD), _run(tmp_path / "b/run", NEW), monkeypatch)
    listed = [line for line in capsys.readouterr().out.splitlines() if "only in one config" in line]
    assert listed == ["run: not compared, only in one config: detection_interval"]


@pytest.mark.parametrize(
    ("config", "tsdf", "ate", "named"),
    [
        (NEW, 0.25, 0.01, "map.npz: tsdf"),
        (NEW, 0.5, 0.02, "ate"),
        (NEW.replace("0.05", "0.06"), 0.5, 0.01, "min_piece_ratio"),
    ],
)
def test_same_results_reports_difference(
    config: str,
    tsdf: float,
    ate: float,
    named: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert _status(_run(tmp_path / "a/run", OLD), _run(tmp_path / "b/run", config, tsdf, ate), monkeypatch)
    assert named in capsys.readouterr().out

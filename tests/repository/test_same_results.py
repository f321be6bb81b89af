"""Tests for the comparison of run directories."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from tests import same_results

OLD = "prefetch: 2\nresume_from: null\nrefiner: {links: {connected: {max_gap: 0.1, min_piece_ratio: 0.05}}}\n"
NEW = f"{OLD}detection_interval: 1\n".replace("prefetch: 2", "prefetch: 0")


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


def test_same_results_new_key_is_not_compared(
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

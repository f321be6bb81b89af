"""Tests for the command `synthesize`."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from framework.commands.recordings import synthesize
from framework.synthetic.benchmark import SCENES
from framework.synthetic.scenenn_scene import BenchmarkSettings

pytestmark = pytest.mark.integration


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["synthesize", *arguments])
    synthesize.main()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--scenes", "bedroom,011"], "--scenes: expected one or more of living_chairs, bedroom"),
        (["--scenes", ""], "scenes: expected one or more of"),
        (["--jobs", "0"], "--jobs: expected at least 1"),
        (["--frames", "0"], "frames: expected at least 1"),
        (["--seed", "-1"], "seed: expected at least 0"),
        (["--width", "30"], "width: expected a multiple of 4 px"),
    ],
)
def test_synthesize_invalid_arguments_are_one_line_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments, complaint: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        run(monkeypatch, str(tmp_path / "rooms"), *arguments)
    assert ended.value.code == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert complaint in lines[0]
    assert not (tmp_path / "rooms").exists()


def test_synthesize_writes_all_scenes_by_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = []
    monkeypatch.setattr(synthesize, "write_scenes", lambda *arguments: asked.append(arguments))
    run(monkeypatch, str(tmp_path), "--jobs", "3")
    run(monkeypatch, str(tmp_path), "--scenes", "couches,bedroom", "--seed", "2", "--frames", "30", "--width", "320")
    assert asked[0] == (tmp_path, SCENES, BenchmarkSettings(), 3)
    assert list(asked[1][1]) == ["couches", "bedroom"]
    assert asked[1][2] == BenchmarkSettings(seed=2, frames=30, width=320)
    assert f"dataset.root={tmp_path} dataset.scene=living_chairs" in capsys.readouterr().out

"""Tests for docs/tutorials/own_classes.md: its program and commands are executed."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from instancemap import load_runs
from tests.support.doc_pages import CHECKOUT, blocks
from tests.support.table_text import grids

pytestmark = pytest.mark.acceptance

TUTORIAL = "docs/tutorials/own_classes.md"


def line_of(words: list[str]) -> list[str]:
    return [sys.executable, *words[1:]] if words[0] == "python" else [sys.executable, "-m", "framework", *words[1:]]


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Run all commands of the tutorial. Return their folder and output."""
    folder = tmp_path_factory.mktemp("own_classes")
    shutil.copy(CHECKOUT / "examples" / "color_masks.py", folder)
    texts = []
    for line in "".join(blocks("bash", TUTORIAL)).splitlines():
        done = subprocess.run(
            line_of(shlex.split(line)),
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(CHECKOUT)},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == 0, done.stderr[-4000:]
        texts += [done.stdout, done.stderr]
    return folder, "\n".join(texts)


def test_own_classes_tutorial_shows_its_output(output: tuple[Path, str]) -> None:
    log, table = blocks("text", TUTORIAL)
    found = re.sub(r"(?m)^[\d:]+ \w+ +", "", output[1])  # without times and levels
    for line in log.splitlines():
        if line != "...":
            assert re.sub(r"at [\d.]+/s", "", line) in re.sub(r"at [\d.]+/s", "", found)
    [rows] = [grid for grid in grids(output[1]) if "| screen |" in grid[0] and "minus" not in grid[0]]
    number = re.compile(r"\d\.\d{3}")
    documented = grids(table)[0]
    assert [number.sub("", row) for row in rows] == [number.sub("", row) for row in documented]
    found_values, values = (
        [float(text) for row in grid for text in number.findall(row)] for grid in (rows, documented)
    )
    assert found_values == pytest.approx(values, abs=0.0015), "expected differences only of another type of processor"


def test_own_classes_tutorial_writes_report_figure_and_metrics(output: tuple[Path, str]) -> None:
    folder, text = output
    assert b"textbook" in (folder / "outputs/own/report.html").read_bytes()
    assert (folder / "outputs/refiners/figure.png").stat().st_size > 10_000
    runs = load_runs(folder / "outputs/refiners")
    assert set(runs["label_space"]) == {"own classes"}
    assert set(runs["evaluated_classes.label_space"]) == {"coco"}
    assert runs["instances.ap50.tv"].notna().all()
    assert "AP50" in text

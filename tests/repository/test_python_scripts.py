"""The scripts of docs/python.md run as they stand, one after the other."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[2]
PAGE = (CHECKOUT / "docs" / "python.md").read_text()
SCRIPTS = dict(re.findall(r"## ([^\n]+)\n\n```python\n(.*?)```", PAGE, re.DOTALL))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where they run; the first one leaves a map there."""
    directory = tmp_path_factory.mktemp("scripts")
    run(directory, "Map a recording")
    return directory


def run(directory: Path, name: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPTS[name]],
        cwd=directory,
        env={"PYTHONPATH": str(CHECKOUT), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_there_are_ten() -> None:
    assert len(SCRIPTS) == 10


def test_the_first_one_maps(place: Path) -> None:
    assert (place / "desk.npz").stat().st_size > 100_000


@pytest.mark.parametrize(
    ("name", "printed"),
    [
        ("Map what a camera gives", r"\[0\. 0\. 0\.\]"),
        ("Give the poses of another system", r"\(\d+, 3\)"),
        ("Ask for objects", r"\d+ \w+( \w+)? 0\.\d\d \[(.|\n)*\d\.\d\d by names: \d+ tv \w+ \["),
        ("Which is nearest", r"\w"),
        ("What is at this pixel", r"\w"),
        ("Look at the map from elsewhere", r"\[\d+"),
        ("Take one object out", r""),
        ("Ask while it maps", r"\d+ objects"),
        ("Map with a stage of your own", r"0 frames lost; [1-9]\d* objects"),
    ],
)
def test_each_of_the_others_runs(place: Path, name: str, printed: str) -> None:
    assert re.search(printed, run(place, name))
    left = {"Look at the map from elsewhere": "view.png", "Take one object out": "object.ply"}.get(name)
    assert left is None or (place / left).stat().st_size > 1000

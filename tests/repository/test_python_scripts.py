"""Tests that the scripts of docs/python.md run unchanged in one process."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[2]
PAGE = (CHECKOUT / "docs" / "python.md").read_text()
SCRIPTS = dict(re.findall(r"## ([^\n]+)\n\n```python\n(.*?)```", PAGE, re.DOTALL))


PRINTED = {
    "Map a sequence": r"[1-9]\d* objects",
    "Map camera images": r"\(\d{4,}, 3\)",
    "Ask for objects": r"\d+ \w+( \w+)? 0\.\d\d \[(.|\n)*m\n\[(.|\n)*\d\.\d\d tv \w+ \[",
    "Render a view": r"instance at the center: [1-9]",
    "Extract an object or the floor": r"\(\d{3,}, 3\)\n\d+ vertices on the floor",
    "Query during mapping": r"[1-9]\d* objects\n\w",
    "Use your own stage": r"0 frames lost; [1-9]\d* objects",
}
MARK = "=== "
RUN = f"""
import json
for name, script in json.load(open("scripts.json")).items():
    print("{MARK}" + name, flush=True)
    exec(compile(script, name, "exec"), {{"__name__": "__main__"}})
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder in which all scripts have been run. The output is in printed.txt."""
    directory = tmp_path_factory.mktemp("scripts")
    (directory / "scripts.json").write_text(json.dumps(SCRIPTS))
    done = subprocess.run(
        [sys.executable, "-c", RUN],
        cwd=directory,
        env={"PYTHONPATH": str(CHECKOUT), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr
    (directory / "printed.txt").write_text(done.stdout)
    return directory


def test_documented_scripts_all_have_expected_output() -> None:
    assert list(SCRIPTS) == list(PRINTED)


@pytest.mark.parametrize("name", PRINTED)
def test_documented_script_prints_expected_output(place: Path, name: str) -> None:
    parts = (place / "printed.txt").read_text().split(MARK)[1:]
    printed = dict(part.split("\n", 1) for part in parts)
    assert re.search(PRINTED[name], printed[name])


@pytest.mark.parametrize(("name", "size"), [("desk.npz", 100_000), ("view.png", 1000)])
def test_documented_script_writes_file(place: Path, name: str, size: int) -> None:
    assert (place / name).stat().st_size > size

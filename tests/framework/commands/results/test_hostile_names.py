"""Tests for names in run files that contain escape sequences, markup or formulas."""

from __future__ import annotations

import csv
import json
import logging
import re
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from framework import __main__ as main_module
from framework.config import composition
from framework.files.manifest import Manifest, RunStatus
from framework.runtime.plain_output import plain
from framework.runtime.signals import ENDING
from tests.support import reported_run
from tests.support.command_call import call_command
from tests.support.forked_commands import FAKE_CONF
from tests.support.scenes import corner_room

pytestmark = pytest.mark.integration

NAMES = [
    ("\x1b[2J\x1b]0;title\x07", "a\u202egpj.exe\u2066"),
    ("<img src=x onerror=alert(1)>", "[click](javascript:alert(1))"),
    ("=cmd|' /C calc'!A0", "\\input{x}$\\frac{$"),
    ("a|b\r\n# head\n\\end{table}", "**best** `code` __b__"),
    ("</script><script>alert(1)</script>", "{{7*7}} ${x} %s {0}"),
    ("\0nul", "\u2028line\x85"),
]
"""The class names of the two objects. The first name is also the name of the sequence."""


@pytest.fixture(params=NAMES, ids=range(len(NAMES)))
def run(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the directory of a run with hostile names."""
    with monkeypatch.context() as patched:
        patched.setattr(corner_room, "CLASSES", request.param)
        name = property(lambda _: request.param[0], lambda *_: None)
        patched.setattr(corner_room.CornerRoom, "name", name, raising=False)
        return reported_run.write_run(tmp_path / "runs" / "run")


@pytest.fixture
def command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Iterator[Callable[..., tuple[int, str, str]]]:
    """Return a function that runs a command line in this process and returns the status, stdout and stderr."""

    def start(*words: object) -> tuple[int, str, str]:
        with monkeypatch.context() as patched:
            patched.setattr(sys, "stdout", sys.stdout)  # main() replaces the streams
            patched.setattr(sys, "stderr", sys.stderr)
            return call_command(main_module, words, monkeypatch, capsys)

    monkeypatch.setattr(composition, "_added", [FAKE_CONF])
    factory, handlers = logging.getLogRecordFactory(), {number: signal.getsignal(number) for number in ENDING}
    yield start
    logging.setLogRecordFactory(factory)
    for number, handler in {**handlers, signal.SIGPIPE: signal.SIG_IGN}.items():
        signal.signal(number, handler)


def test_commands_escape_hostile_names(run: Path, tmp_path: Path, command: Callable[..., tuple[int, str, str]]) -> None:
    assert Manifest.read(run).status is RunStatus.COMPLETE
    out = tmp_path / "out"
    upright = ("--up", "0", "0", "1", "--floor", "0")
    for status, *words in (
        (0, "query", run, "red"),
        (1, "query", run, "plaid"),
        (0, "diff", run, run),
        (0, "report", run),
        (0, "export", run, "--to", "glb", "obj", "ply", "floorplan", "graph", "--out", out, *upright),
        (0, "tables", run.parent),
        (0, "figures", run.parent, "figure.kind=class_heatmap"),
    ):
        found, stdout, stderr = command(*words)
        assert (found, plain(stdout)) == (status, stdout)
        assert plain(stderr.replace("\r", "")) == stderr.replace("\r", "")
    for path in (run.parent / "table.md", run.parent / "table.tex", run / "report.html", *out.glob("*.*json")):
        text = path.read_text()
        assert plain(text) == text
    markdown = (run.parent / "table.md").read_text()
    latex = re.sub(r"^%.*\n", "", (run.parent / "table.tex").read_text(), flags=re.MULTILINE)  # without comments
    assert not re.search(r"<[a-z/]|\]\(|^# head|(?<!\\)\*\*best|(?<!\\)`code", markdown, re.MULTILINE)
    assert latex.count("\\end{table") == latex.count("\\end{tabular}")
    assert not re.search(r"\\input|\$\\frac|^# head", latex, re.MULTILINE)
    for row in csv.reader((run.parent / "table.csv").open(newline="")):
        assert not [cell for cell in row if cell.startswith(("=", "@"))]
    page = (run / "report.html").read_text()
    assert page.count("</script>") == page.count("<script")
    assert "<img src=x" not in page


def test_commands_lone_surrogate_error_names_file(tmp_path: Path, command: Callable[..., tuple[int, str, str]]) -> None:
    run = reported_run.write_run(tmp_path / "run")
    for name, words in (
        ("instances.json", (("report",), ("export",))),
        ("metrics.json", (("report",), ("tables",))),
    ):
        path = run / name
        before = path.read_text()
        content = json.loads(before)
        if name == "metrics.json":
            content["sequence"] = "\ud800"
        else:
            content[0]["class"] = "\ud800"
        path.write_text(json.dumps(content))
        for first, *rest in words:
            status, _, stderr = command(first, run, *rest)
            assert (status, len(stderr.splitlines())) == (1, 1)
            assert name in stderr
        path.write_text(before)

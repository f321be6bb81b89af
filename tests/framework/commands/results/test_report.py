"""Tests for the command `report`."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from framework.commands.results import report
from framework.config import composition
from framework.errors import DataError
from framework.pose_graph.graph_file import write_pose_graph
from framework.reporting import run_page
from framework.reporting.run_page import RunReport
from tests.support.command_call import call_command
from tests.support.reported_run import rename_class, unverified_copy, write_run
from tests.support.scenes.corner_room import CornerRoom
from tests.support.scenes.given_changes import GRAPH

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("fakes_registered")]


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture
def stored(mapped: Path, tmp_path: Path) -> Path:
    return unverified_copy(mapped, tmp_path / "runs" / "first")


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Return a function that runs the command in this process and returns the status, stdout and stderr."""

    def start(*arguments: object) -> tuple[int, str, str]:
        return call_command(report, arguments, monkeypatch, capsys)

    return start


def texts(page: str) -> str:
    """Return the visible text of an HTML page with normalized white space."""
    body = page[page.index("<body>") : page.index('<script type="application/json"')]
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", body))


def test_report_of_run_is_one_reproducible_page(stored: Path, command) -> None:
    status, out, err = command(stored)
    page = stored / "report.html"
    assert (status, out, err) == (0, f"{page.resolve().as_uri()}\n", "")
    before = page.read_bytes()
    assert command(stored, "--out", stored.parent / "again.html")[0] == 0
    assert (stored.parent / "again.html").read_bytes() == before
    assert {path.name for path in stored.parent.iterdir()} == {"first", "again.html"}
    message = texts(before.decode())
    metrics = json.loads((stored / "metrics.json").read_text())
    assert "corner_room" in message
    assert f"AP50 {metrics['instances.ap50']:.2f}" in message
    assert f"of {metrics['instances.count']}; probability ≥ 0.5" in message
    for heading in ("Map", "Objects", "Ground truth", "Trajectory", "Mapping progress", "Stage times", "Provenance"):
        assert heading in message
    assert before.count(b"data:image/webp") > 3, "expected images of objects, mapping progress and overview.png"
    assert not re.search(rb'(src|href)="(?!data:|#)', before)


def test_report_of_corrected_run_shows_back_end(stored: Path, command) -> None:
    write_pose_graph(stored / "pose_graph.json", GRAPH)
    shutil.copy(stored / "trajectory.txt", stored / "trajectory_tracked.txt")
    assert command(stored)[0] == 0
    message = texts((stored / "report.html").read_text())
    assert "Back end 2 submaps, 1 loop." in message
    assert "1 4 20.5 283 0.7" in message


def test_report_different_number_of_tracked_poses_is_error(stored: Path, command) -> None:
    lines = (stored / "trajectory.txt").read_text().splitlines(keepends=True)
    (stored / "trajectory_tracked.txt").write_text("".join(lines[:-1]))
    status, _, err = command(stored)
    assert (status, "trajectory_tracked.txt: expected 6 poses, as in trajectory.txt, got 5" in err) == (1, True)


def test_report_escapes_html_in_class_names(stored: Path, command) -> None:
    rename_class(stored, "<script>alert(1)</script>")
    assert command(stored)[0] == 0
    page = (stored / "report.html").read_text()
    assert "<script>alert" not in page
    assert page.count("<script>") == 1
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page


def test_report_without_sequence_shows_map_images(stored: Path, command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(composition, "_added", [])
    assert command(stored)[0] == 0
    page = (stored / "report.html").read_text()
    assert "The sequence could not be read" in texts(page)
    sources = {one["source"] for one in json.loads(re.findall(r'id="report-data">(.*?)</script>', page)[0])["objects"]}
    assert sources == {"map"}
    assert "Individual objects cannot be compared" in texts(page)


def test_report_with_large_path_omits_enlarged_path(stored: Path, command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(composition, "_added", [])  # the ground-truth path requires the sequence
    monkeypatch.setattr(run_page, "SMALL_PATH", 0.0)  # every path is large enough in the top view
    assert command(stored)[0] == 0
    page = (stored / "report.html").read_text()
    assert "Camera path, top view" in page
    assert "The path, enlarged." not in page
    assert '<div class="column">' not in page


def test_report_different_sequence_is_detected(stored: Path, command, tmp_path: Path) -> None:
    lines = (stored / "trajectory.txt").read_text().splitlines()
    moved = [f"{float(line.split()[0]) + 5:.9f} {line.partition(' ')[2]}" for line in lines]
    (stored / "trajectory.txt").write_text("\n".join(moved) + "\n")
    assert command(stored)[0] == 0
    assert "the first frame differs from the first frame of the run" in texts((stored / "report.html").read_text())


def test_report_invalid_unicode_name_error_names_file(stored: Path, command) -> None:
    rename_class(stored, "cup \ud800")
    status, _, err = command(stored)
    expected = r"instances.json: expected valid Unicode, got the lone surrogate '\ud800'"
    assert (status, err.startswith(f"error: {stored / expected}")) == (1, True)


def test_report_object_without_class_is_listed(stored: Path, command) -> None:
    """Some fusers write maps without classes."""
    entries = json.loads((stored / "instances.json").read_text())
    entries[0] |= {"class": None, "class_probabilities": {}}
    (stored / "instances.json").write_text(json.dumps(entries))
    assert command(stored)[0] == 0
    assert f"object {entries[0]['id']}" in texts((stored / "report.html").read_text())


def test_report_contains_command_that_applies_edits(stored: Path, command) -> None:
    run = stored.rename(stored.with_name("my room's run"))
    assert command(run)[0] == 0
    page = (run / "report.html").read_text()
    assert "cannot apply edits" not in page
    [data] = re.findall(r'id="report-data">(.*?)</script>', page)
    editing = json.loads(data)["edit"]
    options = ["--edits", "edits.json", "--out", f"{run}_edited"]
    assert shlex.split(editing["command"]) == ["instancemap", "edit", str(run), *options]
    assert editing["classes"] == ["chair", "couch"]


def test_report_of_map_that_cannot_be_edited_says_so(stored: Path, command) -> None:
    (stored / "map.npz").unlink()
    assert command(stored)[0] == 0
    assert "cannot apply edits to this run, because it has no map.npz" in texts((stored / "report.html").read_text())


def test_report_is_removed_by_new_run_in_folder(stored: Path, command) -> None:
    assert command(stored)[0] == 0
    write_run(stored, frames=3)
    assert not (stored / "report.html").exists()


def test_report_unreadable_truth_reason_is_shown(stored: Path, command, monkeypatch: pytest.MonkeyPatch) -> None:
    def unreadable(_: CornerRoom) -> None:
        raise DataError("instances.json is not valid JSON")

    monkeypatch.setattr(CornerRoom, "scene_truth", unreadable)
    assert command(stored)[0] == 0
    message = texts((stored / "report.html").read_text())
    assert "cannot be compared: instances.json is not valid JSON" in message
    assert "AP50" in message


def test_report_of_partial_run_is_marked_partial(stored: Path, command) -> None:
    metrics = json.loads((stored / "metrics.json").read_text())
    (stored / "metrics.json").unlink()
    (stored / "metrics.partial.json").write_text(json.dumps({"partial": "interrupted by Ctrl-C", **metrics}))
    for name in ("map.npz", "mesh.ply", "overview.png"):
        (stored / name).unlink()
    assert command(stored)[0] == 0
    message = texts((stored / "report.html").read_text())
    assert "This run is partial: interrupted by Ctrl-C." in message
    assert "cannot apply edits to this run, because it is partial" in message
    assert "The map is empty" in message


def test_report_of_empty_run_is_written(stored: Path, command) -> None:
    (stored / "trajectory.txt").write_text("")
    (stored / "mesh.ply").unlink()
    (stored / "instances.json").write_text("[]")
    (stored / "timings.csv").write_text("frame,stage,milliseconds\n")
    assert command(stored)[0] == 0
    message = texts((stored / "report.html").read_text())
    assert "The map is empty" in message
    assert "No objects were found" in message


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("instances.json", "{}", "instances.json: expected a JSON array of instances"),
        ("instances.json", '[{"id": 1}]', "entry 1"),
        ("instances.json", '[{"id": 1, "class": "cup", "confidence": NaN}]', "entry 1"),
        ("mesh.ply", "ply\n", "mesh.ply"),
        ("timings.csv", "frame,stage,milliseconds\n0,read,soon\n", "timings.csv, line 2"),
        ("trajectory.txt", "1 2 3\n", "trajectory.txt, line 1"),
        ("config.yaml", "seed: 9\n", "expected the config_hash of config.yaml, "),
    ],
)
def test_report_damaged_file_is_one_line_error(stored: Path, command, name: str, content: str, message: str) -> None:
    (stored / name).write_text(content)
    status, out, err = command(stored)
    assert (status, out, len(err.splitlines())) == (1, "", 1), err
    assert message in err
    assert not (stored / "report.html").exists()


@pytest.mark.parametrize(("key", "value"), [("center", [1e300, 0, 0]), ("extent", [float("nan"), 1, 1])])
def test_report_out_of_range_boxes_are_one_line_error(stored: Path, command, key: str, value: list[float]) -> None:
    entries = json.loads((stored / "instances.json").read_text())
    entries[1]["obb"][key] = value
    (stored / "instances.json").write_text(json.dumps(entries))
    status, _, err = command(stored)
    assert (status, len(err.splitlines())) == (1, 1)
    assert f"instances.json, entry 2: {key}: expected numbers of shape (3,) in [-1e+06, 1e+06], got" in err


def test_report_invalid_output_path_fails_before_reading(
    stored: Path, command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RunReport, "of", pytest.fail)
    assert "expected an existing parent folder" in command(stored, "--out", stored / "missing" / "page.html")[2]
    assert ": expected a regular file, got a folder" in command(stored, "--out", stored)[2]


def test_report_url_is_percent_encoded(stored: Path, command) -> None:
    moved = stored.rename(stored.parent / "my run #2 50%")
    _, out, _ = command(moved)
    assert out.endswith("my%20run%20%232%2050%25/report.html\n")


def test_report_invalid_or_repeated_run_is_rejected(stored: Path, command, tmp_path: Path) -> None:
    assert "expected a run directory with metrics.json or" in command(tmp_path)[2]
    assert "expected distinct runs" in command(stored, stored.parent / "." / "first")[2]


def test_report_of_several_runs_writes_comparison(mapped: Path, stored: Path, command) -> None:
    second = unverified_copy(mapped, stored.parent / "sec & ond")
    metrics = json.loads((second / "metrics.json").read_text())
    metrics |= {"instances.ap50": metrics["instances.ap50"] - 0.25, "trajectory.ate_rmse_m": 0.0005, "fps": 1000.0}
    (second / "metrics.json").write_text(json.dumps(metrics))
    status, out, err = command(stored, second)
    assert (status, err) == (0, "")
    assert [Path(line).name for line in out.splitlines()] == ["report.html", "report.html", "comparison.html"]
    page = (stored.parent / "comparison.html").read_text()
    assert 'href="first/report.html"' in page
    assert 'href="sec%20%26%20ond/report.html"' in page
    assert "<b>1000.0</b>" in page
    assert "<small>\u22120.250</small>" in page
    assert "None: all parameters are equal." in page
    assert page.count('<script type="text/plain" id="map-') == 2

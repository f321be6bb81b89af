"""Tests for the command `export`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import trimesh

import instancemap
from framework.commands.results import export
from framework.errors import ConfigError
from tests.support.scenes.exported_room import ExportedRoom

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ExportedRoom().write(tmp_path_factory.mktemp("runs") / "room")


def exported(monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    monkeypatch.setattr(sys, "argv", ["instancemap export", *map(str, words)])
    export.main()


def test_export_prints_written_files(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--out", tmp_path, "--resolution", 0.1, "--robot-height", 0.5)
    exported(monkeypatch, run, "--to", "glb", "floorplan", "graph", *options)
    message = [Path(line).relative_to(tmp_path).as_posix() for line in capsys.readouterr().out.splitlines()]
    objects = [f"objects/{name}.glb" for name in ("dining_table_1", "cube_2", "picture_3")]
    plans = ["floor_plan.png", "floor_plan.geojson", "map.pgm", "map.yaml"]
    assert message == ["scene.glb", *objects, *plans, "scene_graph.json"]
    assert sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()) == sorted(
        message
    )
    assert "resolution: 0.1" in (tmp_path / "map.yaml").read_text()


def test_export_writes_objects_to_run_folder_by_default(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exported(monkeypatch, run, "--to", "obj", "--object", "cube", "--object", 1, "--triangles", 100)
    found = sorted((run / "export").rglob("*.obj"))
    assert [path.name for path in found] == ["cube_2.obj", "dining_table_1.obj"]
    assert all(len(trimesh.load(path).faces) <= 100 for path in found)


def test_export_default_format_is_glb(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exported(monkeypatch, run, "--object", "cube", "--out", tmp_path)
    assert [path.name for path in tmp_path.rglob("*.*")] == ["cube_2.glb"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--to", "stl"), "invalid choice: 'stl'"),
        (("--to", "glb", "--triangles", "many"), "invalid int value: 'many'"),
        (("--to", "glb", "--up", "0", "1"), "expected 3 arguments"),
    ],
)
def test_export_invalid_arguments_exit_with_status_2(
    words: tuple[str, ...], message: str, run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        exported(monkeypatch, run, *words)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("--to", "glb", "--object", "sofa"),
            "object: expected an id or class of this run, got 'sofa'; classes: cube, dining table, picture",
        ),
        (("--to", "glb", "--triangles", "1"), "triangles: expected at least 4, got 1"),
        (("--to", "floorplan", "--resolution", "0"), "resolution"),
        (("--to", "floorplan", "--robot-height", "nan"), "robot_height"),
        (("--to", "glb", "--min-probability", "2"), "min_probability"),
        (("--to", "glb", "--up", "0", "nan", "1"), "up: expected a nonzero direction of 3 finite numbers"),
        (("--to", "glb", "--floor", "nan"), "expected a floor height in [-10000, 10000] m, got nan"),
        (("--to", "glb", "--out", "/dev/null"), "/dev/null"),
        (("--to", "floorplan", "--floor=-1e300"), "expected a floor height in [-10000, 10000] m"),
    ],
)
def test_export_invalid_request_is_one_line_error(
    words: tuple[str, ...], message: str, run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        exported(monkeypatch, run, *words)
    assert ended.value.code == 1
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert message in line


def test_export_python_function_matches_command(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = instancemap.export(run, "glb", out=tmp_path / "a", objects=["cube"], coloring="class")
    exported(monkeypatch, run, "--to", "glb", "--out", tmp_path / "b", "--object", "cube", "--colors", "class")
    assert written == [tmp_path / "a" / "objects" / "cube_2.glb"]
    assert written[0].read_bytes() == (tmp_path / "b" / "objects" / "cube_2.glb").read_bytes()
    for wrong, message in (
        ({"coloring": "rainbow"}, "coloring: expected one of appearance, instance, class, got 'rainbow'"),
        ({"colours": "class"}, "export: expected options among .*, got 'colours'"),
    ):
        with pytest.raises(ConfigError, match=message):
            instancemap.export(run, "glb", out=tmp_path, **wrong)
    with pytest.raises(ConfigError, match="a format: expected one of glb, ply"):
        instancemap.export(run, "stl")


@pytest.mark.parametrize("damage", ["mesh", "instances", "metrics", "trajectory"])
def test_export_damaged_run_is_one_line_error(
    damage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = ExportedRoom().write(tmp_path / "run")
    if damage == "mesh":
        (run / "mesh.ply").write_bytes((run / "mesh.ply").read_bytes()[:-7])
    elif damage == "instances":
        entries = json.loads((run / "instances.json").read_text())
        entries[0]["vertices"] += 1
        (run / "instances.json").write_text(json.dumps(entries))
    elif damage == "metrics":
        (run / "metrics.json").write_text('{"map.up.x": 0, "map.up.y": 0, "map.up.z": 0}')
    else:
        (run / "trajectory.txt").write_text("1 2 3\n")
    with pytest.raises(SystemExit):
        exported(monkeypatch, run, "--to", "glb")
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {run}")

"""Tests of runs with classes outside of COCO, from the detector to table, report and export."""

from __future__ import annotations

import html
import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

import instancemap
from framework.files.json_file import read_json
from framework.files.manifest import Manifest
from framework.runs.mesh_file import read_mesh
from instancemap import load_map, load_runs
from tests.support import option_files
from tests.support.forked_commands import completed

pytestmark = pytest.mark.integration
REPEATED = pytest.mark.acceptance  # the same rule with other values

NAMES = {1: "forklift", 2: "pallet"}  # by instance id
MAPPING = ("tracker=ground_truth", "fuser.voxel_size=0.02", "fuser.min_observations=1")


def write_truth(root: Path, names: dict[int, str]) -> None:
    (root / "instances.json").write_text(json.dumps({str(key): {"class": names[key]} for key in names}))


def write_room(root: Path, names: dict[int, str]) -> list[str]:
    """Write an RGB-D folder with two instances and a mask folder, both with these class names. Return the overrides."""
    root.mkdir()
    option_files.overrides("dataset", "rgbd_folder", root)
    write_truth(root, NAMES)
    masks = root / "masks"
    shutil.copytree(root / "instance", masks)
    for path in sorted(masks.glob("*.png")):
        ids = set(np.unique(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)).tolist()) - {0}
        entries = [{"id": key, "class": names[key], "score": 0.9} for key in sorted(ids)]
        path.with_suffix(".json").write_text(json.dumps(entries))
    (root / "names.txt").write_text("\n".join(dict.fromkeys(names.values())) + "\n")
    detector = ["detector=precomputed", f"detector.path={masks}", f"detector.label_space={root / 'names.txt'}"]
    return ["dataset=rgbd_folder", f"dataset.root={root}", *detector]


@dataclass(frozen=True)
class OwnRun:
    """A run that was made with the Python API."""

    directory: Path
    overrides: list[str]
    names: dict[int, str]  # by instance id


@pytest.fixture(scope="module", params=["own", "object", "punctuation"])
def python_run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> OwnRun:
    """Return a run with own classes, with class-agnostic masks, or with names that files and pages must escape."""
    folder = tmp_path_factory.mktemp("python")
    odd = {1: "fork/lift, gelb", 2: 'Größe <b>5.5"%'}
    names = {"own": NAMES, "object": dict.fromkeys(NAMES, "object"), "punctuation": odd}[request.param]
    overrides = write_room(folder / "room", names)
    if request.param == "punctuation":
        write_truth(folder / "room", names)
    return OwnRun(instancemap.run(folder / "runs" / "own", *overrides, *MAPPING), overrides, names)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the run directory of a map with the classes forklift and pallet."""
    folder = tmp_path_factory.mktemp("own")
    done = completed(folder, *write_room(folder / "room", NAMES), *MAPPING, "hydra.run.dir=outputs/own")
    assert done.returncode == 0, done.stderr[-4000:]
    return folder / "outputs/own"


def test_own_classes_are_in_map_and_metrics(run: Path) -> None:
    assert sorted(one["class"] for one in read_json(run / "instances.json")) == ["forklift", "pallet"]
    metrics = read_json(run / "metrics.json")
    assert metrics["instances.ap50"] == 1.0
    assert metrics["instances.ap50.forklift"] == metrics["instances.ap50.pallet"] == 1.0
    assert set(load_map(run / "map.npz").classes) == {"forklift", "pallet"}
    assert load_runs(run.parent)["instances.ap50.pallet"].tolist() == [1.0]


@pytest.mark.parametrize(
    ("command", "file"),
    [
        (("report", "outputs/own"), "report.html"),
        (("export", "outputs/own", "--to", "graph"), "export/scene_graph.json"),
        (("export", "outputs/own", "--to", "glb"), "export/scene.glb"),
    ],
)
def test_own_classes_are_in_outputs_of_command(run: Path, command: tuple[str, ...], file: str) -> None:
    done = completed(run.parent.parent, *command)
    assert done.returncode == 0, done.stderr[-4000:]
    content = (run / file).read_bytes()
    assert b"forklift" in content
    assert b"pallet" in content


def test_own_class_is_found_by_name(run: Path) -> None:
    done = completed(run.parent.parent, "query", "outputs/own", "pallet")
    assert done.returncode == 0, done.stderr[-4000:]
    assert "pallet" in done.stdout


def test_own_classes_have_column_in_table(run: Path) -> None:
    done = completed(run.parent.parent, "tables", "outputs", "table.columns=[instances.ap50.forklift]")
    assert done.returncode == 0, done.stderr[-4000:]
    assert "forklift" in done.stdout


def test_python_run_equals_command(run: Path, tmp_path: Path) -> None:
    room = run.parent.parent / "room"
    detector = [f"detector.path={room / 'masks'}", f"detector.label_space={room / 'names.txt'}"]
    words = ["dataset=rgbd_folder", f"dataset.root={room}", "detector=precomputed", *detector, *MAPPING]
    made = instancemap.run(tmp_path / "own", *words)
    files, expected = Manifest.read(made).files, Manifest.read(run).files
    assert files.keys() == expected.keys()
    for name in ("config.yaml", "instances.json", "mesh.ply", "map.npz"):
        assert files[name] == expected[name]
    assert Manifest.read(made).changed_files(made) == []


def test_python_run_has_classes_in_all_files(python_run: OwnRun) -> None:
    classes = tuple(dict.fromkeys(python_run.names.values()))
    scene = load_map(python_run.directory / "map.npz")
    assert scene.classes == read_mesh(python_run.directory / "mesh.ply").classes == classes
    found = {one["id"]: one["class"] for one in read_json(python_run.directory / "instances.json")}
    assert sorted(found.values()) == sorted(python_run.names.values())
    assert {key: scene.name(one) for key, one in scene.instances().items()} == found


def test_python_run_is_in_tables(python_run: OwnRun) -> None:
    name = python_run.names[1]
    runs = load_runs(python_run.directory.parent)
    assert runs["instances.ap50_agnostic"].tolist() == [1.0]
    if name != "object":
        assert runs[f"instances.ap50.{name}"].tolist() == [1.0]
        column = f"table.columns=['instances.ap50.{name}']"
        assert f"| {name} |" in instancemap.tables(python_run.directory.parent, column)
    assert "AP50 agnostic" in instancemap.tables(python_run.directory.parent)


def test_python_run_is_reported_and_exported(python_run: OwnRun) -> None:
    page = instancemap.report(python_run.directory).read_text()
    graph = instancemap.export(python_run.directory, "glb", "ply", "obj", "floorplan", "graph")
    nodes = read_json(next(path for path in graph if path.name == "scene_graph.json"))["nodes"]
    exported = sorted(node["class"] for node in nodes if node["kind"] == "object")
    assert exported == sorted(python_run.names.values())
    for name in python_run.names.values():
        assert html.escape(name).replace("&quot;", "&#34;") in page
        assert "<b>5.5" not in page


@pytest.mark.parametrize("key", NAMES)
def test_python_query_finds_class_by_name(python_run: OwnRun, key: int) -> None:
    name = python_run.names[key]
    found = instancemap.query(python_run.directory, name)
    assert found.by == "names"
    assert {one.name for one in found.objects} == {name}
    assert len(found.objects) == [*python_run.names.values()].count(name)


@pytest.mark.parametrize(
    "python_run",
    [pytest.param("own", marks=REPEATED), "object", pytest.param("punctuation", marks=REPEATED)],
    indirect=True,
)
def test_class_agnostic_map_gets_classes_by_edit(python_run: OwnRun, tmp_path: Path) -> None:
    ids = [one["id"] for one in read_json(python_run.directory / "instances.json")]
    edits = [{"rename": [ids[0], "forklift truck"]}]
    edited = instancemap.edit(python_run.directory, edits, tmp_path / "edited")
    [found] = instancemap.query(edited, "forklift trucks").objects
    assert (found.instance.id, found.name) == (ids[0], "forklift truck")
    others = [one for one in read_json(edited / "instances.json") if one["id"] != ids[0]]
    assert [one["class_probabilities"]["forklift truck"] for one in others] == [0.0]
    truth = f"dataset.ground_truth={edited}"
    again = instancemap.run(tmp_path / "again", *python_run.overrides, *MAPPING, truth)
    metrics = read_json(again / "metrics.json")
    assert metrics["instances.ap50.forklift truck"] == 0.0
    assert metrics["instances.ap50_agnostic"] == 1.0


def test_detect_result_with_known_names_keeps_them(tmp_path: Path) -> None:
    """A wall has no COCO class."""
    words = write_room(tmp_path / "room", {1: "chair", 2: "wall"})
    write_truth(tmp_path / "room", {1: "chair", 2: "wall"})
    done = completed(tmp_path, "detect", *words, "detector.class_names=OWN", "out=found.json")
    assert done.returncode == 0, done.stderr[-4000:]
    assert "mask AP50 1.00, mask AP 1.00 (mean of 2 classes" in done.stderr
    arguments = done.stderr.split("use the file with: ")[1].split()
    made = instancemap.run(tmp_path / "run", *words[:2], *arguments, *MAPPING)
    assert sorted(one["class"] for one in read_json(made / "instances.json")) == ["chair", "wall"]

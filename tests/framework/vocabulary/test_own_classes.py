"""Tests of runs with classes outside of COCO, from the detector to table, report and export."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from framework.files.json_file import read_json
from instancemap import load_map, load_runs
from tests.support import option_files
from tests.support.forked_commands import completed

pytestmark = pytest.mark.integration

NAMES = {1: "forklift", 2: "pallet"}  # by instance id
MAPPING = ("tracker=ground_truth", "fuser.voxel_size=0.02", "fuser.min_observations=1")


def write_room(root: Path, names: dict[int, str]) -> list[str]:
    """Write an RGB-D folder with two instances and a mask folder, both with these class names. Return the overrides."""
    root.mkdir()
    option_files.overrides("dataset", "rgbd_folder", root)
    (root / "instances.json").write_text(json.dumps({str(key): {"class": NAMES[key]} for key in NAMES}))
    masks = root / "masks"
    shutil.copytree(root / "instance", masks)
    for path in sorted(masks.glob("*.png")):
        ids = set(np.unique(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)).tolist()) - {0}
        entries = [{"id": key, "class": names[key], "score": 0.9} for key in sorted(ids)]
        path.with_suffix(".json").write_text(json.dumps(entries))
    (root / "names.txt").write_text("\n".join(dict.fromkeys(names.values())) + "\n")
    detector = ["detector=precomputed", f"detector.path={masks}", f"detector.label_space={root / 'names.txt'}"]
    return ["dataset=rgbd_folder", f"dataset.root={root}", *detector]


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


def test_class_agnostic_masks_are_objects(tmp_path: Path) -> None:
    words = write_room(tmp_path / "room", dict.fromkeys(NAMES, "object"))
    done = completed(tmp_path, *words, *MAPPING, "hydra.run.dir=outputs/objects")
    assert done.returncode == 0, done.stderr[-4000:]
    assert [one["class"] for one in read_json(tmp_path / "outputs/objects/instances.json")] == ["object", "object"]
    assert read_json(tmp_path / "outputs/objects/metrics.json")["instances.ap50_agnostic"] == 1.0

"""Tests for ScanNet predictions and mask folders."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from framework.errors import DataError
from framework.files.ply import PlyMesh
from framework.runs.external_maps.array_files import read_mask
from framework.runs.external_maps.class_labels import ClassIdNames
from framework.runs.external_maps.external_map import ExternalMap, read_surface
from framework.runs.external_maps.mask_predictions import read_mask_predictions

POINTS = 5
SURFACE = PlyMesh(np.zeros((POINTS, 3), np.float32), np.empty((0, 3), np.int32), {}, ())
MESH = Path("scene0000_00_vh_clean_2.ply")


def scannet_predictions(folder: Path, scene: str = "scene0000_00") -> Path:
    """Write the predictions of a scene, as evaluated by ScanNet's script."""
    (folder / "predicted_masks").mkdir(parents=True, exist_ok=True)
    masks = {"000": [1, 1, 0, 0, 0], "001": [0, 1, 1, 1, 0], "002": [0] * POINTS}
    for name, values in masks.items():
        (folder / "predicted_masks" / f"{scene}_{name}.txt").write_text("\n".join(map(str, values)) + "\n")
    lines = [("000", 5, 0.75), ("001", 6, 0.5), ("002", 7, 0.25)]
    text = "".join(f"predicted_masks/{scene}_{name}.txt {label} {score:.4f}\n" for name, label, score in lines)
    (folder / f"{scene}.txt").write_text(text)
    return folder


def mask_folder(folder: Path, entries: object, **masks: object) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "instances.json").write_text(json.dumps(entries))
    for name, values in masks.items():
        np.save(folder / f"{name}.npy", np.array(values))
    return folder


def read(labels: Path, names: ClassIdNames | None = None) -> ExternalMap:
    return read_mask_predictions(MESH, SURFACE, labels, names)


def shown(found: ExternalMap) -> dict[int, tuple[list[int], str | None, float | None]]:
    return {key: (one.vertices.tolist(), one.label, one.confidence) for key, one in found.instances.items()}


@pytest.mark.parametrize("as_file", [True, False])
def test_scannet_predictions_have_nyu40_classes(as_file: bool, tmp_path: Path) -> None:
    labels = scannet_predictions(tmp_path)
    found = read(labels / "scene0000_00.txt" if as_file else labels)
    assert shown(found) == {1: ([0, 1], "chair", 0.75), 2: ([1, 2, 3], "sofa", 0.5)}  # empty masks are left out


def test_scannet_predictions_of_scene_are_selected_by_mesh(tmp_path: Path) -> None:
    scannet_predictions(tmp_path, "scene0001_00")
    scannet_predictions(tmp_path)
    assert "scene0000_00.txt" in read(tmp_path).source
    (tmp_path / "scene0000_00.txt").rename(tmp_path / "scene0002_00.txt")
    with pytest.raises(DataError, match="or the ScanNet predictions scene0000_00_vh_clean_2"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("predicted_masks/scene0000_00_000.txt chair 0.5", "line 1: expected MASK_FILE CLASS_ID CONFIDENCE"),
        ("predicted_masks/scene0000_00_000.txt 5", "line 1: expected MASK_FILE CLASS_ID CONFIDENCE"),
        ("predicted_masks/scene0000_00_000.txt 5 7.5", "line 1: confidence: expected a number in .0, 1."),
        ("predicted_masks/scene0000_00_000.txt 5 nan", "line 1: confidence: expected a number in .0, 1."),
        ("predicted_masks/scene0000_00_000.txt 77 0.5", "line 1: expected a class id of nyu40"),
        ("../outside.txt 5 0.5", "expected a mask file below"),
        ("", "expected at least one instance, got none"),
    ],
)
def test_invalid_scannet_line_is_error(line: str, message: str, tmp_path: Path) -> None:
    (scannet_predictions(tmp_path) / "scene0000_00.txt").write_text(line + "\n")
    with pytest.raises(DataError, match=message):
        read(tmp_path)


def test_mask_folder_accepts_flags_and_indices(tmp_path: Path) -> None:
    entries = [
        {"mask": "flags.npy", "class": "chair", "confidence": 0.9},
        {"mask": "indices.npy", "class": 6, "confidence": 0.8},
        {"mask": "bytes.npy", "class": None},
    ]
    flags = [True, False, False, False, True]
    masks = {"flags": flags, "indices": [3, 1, 3], "bytes": np.array([[0], [1], [0], [0], [1]], np.uint8)}
    found = read(mask_folder(tmp_path / "masks", entries, **masks), ClassIdNames.of("nyu40"))
    assert shown(found) == {1: ([0, 4], "chair", 0.9), 2: ([1, 3], "sofa", 0.8), 3: ([1, 4], "unlabeled", None)}


def test_mask_folder_accepts_csv(tmp_path: Path) -> None:
    np.save(tmp_path / "0.npy", np.array([2]))
    np.save(tmp_path / "1.npy", np.array([3, 4]))
    (tmp_path / "instances.csv").write_text("mask,class,confidence\n0.npy,traffic light,0.5\n1.npy,5,\n")
    found = read(tmp_path, ClassIdNames.of("nyu40"))
    assert shown(found) == {1: ([2], "traffic light", 0.5), 2: ([3, 4], "chair", None)}


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"class": "chair"}, "entry 1: mask: expected the name of a mask file, got None"),
        ({"mask": "none.npy"}, "none.npy"),
        ({"mask": "0.npy", "class": ["chair"]}, "entry 1: class: expected a name, an id or null"),
        ({"mask": "0.npy", "class": 5}, "entry 1: class: expected names of the class ids, got none"),
        ("0.npy", "entry 1: expected a JSON object"),
    ],
)
def test_invalid_mask_entry_is_error(entry: object, message: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=message):
        read(mask_folder(tmp_path / "masks", [entry], **{"0": [1, 2]}))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.ones(POINTS + 1, np.bool_), "expected 5 values, one for each point of the map, got 6"),
        (np.array([0, POINTS]), "expected indices of points in .0, 5., got 0 to 5"),
        (np.array([-1, 2]), "expected indices of points in .0, 5., got -1 to 2"),
        (np.zeros(POINTS), "expected Booleans or integers"),
    ],
)
def test_mask_of_other_map_is_error(values: np.ndarray, message: str, tmp_path: Path) -> None:
    np.save(tmp_path / "0.npy", values)
    with pytest.raises(DataError, match=message):
        read_mask(tmp_path / "0.npy", POINTS)


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY\x01\x00", b"PK\x03\x04", b"text"])
def test_damaged_npy_is_error(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "0.npy").write_bytes(content)
    with pytest.raises(DataError, match=r"0\.npy: expected an NPY file"):
        read_mask(tmp_path / "0.npy", POINTS)


def test_pickled_npy_is_error(tmp_path: Path) -> None:
    np.save(tmp_path / "0.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(DataError, match=r"0\.npy: expected an NPY file"):
        read_mask(tmp_path / "0.npy", POINTS)


def test_points_in_npy_are_surface_without_triangles(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(7, 3))
    np.save(tmp_path / "points.npy", points)
    surface = read_surface(tmp_path / "points.npy")
    np.testing.assert_array_equal(surface.vertices, points.astype(np.float32))
    assert surface.triangles.shape == (0, 3)


@pytest.mark.parametrize("points", [np.zeros((4, 2)), np.zeros((4, 3), np.int32), np.full((4, 3), np.nan)])
def test_invalid_points_are_error(points: np.ndarray, tmp_path: Path) -> None:
    np.save(tmp_path / "points.npy", points)
    with pytest.raises(DataError, match=r"points\.npy: expected"):
        read_surface(tmp_path / "points.npy")

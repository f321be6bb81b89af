"""Tests for object embeddings."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from framework.api import load_scene
from framework.data import Detections, PointClusters
from framework.errors import DataError
from framework.interfaces import MapFuser, SceneMap
from framework.mapping.instances.instance_table import InstanceTable
from framework.mapping.instances.object_embedding import ARRAYS, ObjectEmbedding
from framework.mapping.storage.map_file import write_map
from tests.support import registered
from tests.support.scenes.analytic_scene import room, walk
from tests.support.true_masks import fuse_masks, masks_of

X, Y = np.float32([1, 0, 0]), np.float32([0, 1, 0])
WITH_TABLES = ("bayesian_tsdf", "last_write", "object_volumes", "open3d_vbg")


def test_object_embedding_mean_and_spread_match_definition() -> None:
    once = ObjectEmbedding.of(X, 0.7)
    np.testing.assert_allclose(once.mean, X, atol=1e-6)
    assert once.spread == pytest.approx(0, abs=1e-6)
    both = once + ObjectEmbedding.of(Y, 0.7)
    np.testing.assert_allclose(both.mean, [np.sqrt(0.5), np.sqrt(0.5), 0], atol=1e-6)
    assert both.spread == pytest.approx(1 - np.sqrt(0.5))
    assert both.count == 2
    heavier = ObjectEmbedding.of(X, 0.9) + ObjectEmbedding.of(Y, 0.3)
    np.testing.assert_allclose(heavier.mean, np.float32([3, 1, 0]) / np.sqrt(10), atol=1e-6)
    opposite = once + ObjectEmbedding.of(-X, 0.7)
    assert opposite.spread == pytest.approx(1)
    assert np.isfinite(opposite.mean).all()


def test_embeddings_of_merged_instances_are_combined() -> None:
    table = InstanceTable()
    for embedding in (X, Y, None):
        record = table.create(1, 0)
        known = None if embedding is None else ObjectEmbedding.of(embedding, 0.5)
        table.observe(record.id, np.zeros(1), 0.5, 0, known)
    table.merge(1, 2)
    merged = table.records[1].embedding
    assert merged is not None
    assert (merged.count, merged.weight) == (2, 1.0)
    np.testing.assert_allclose(merged.sum, [0.5, 0.5, 0])
    table.merge(1, 3)
    assert table.records[1].embedding == merged
    table.create(1, 0)
    table.merge(4, 1)
    assert table.records[4].embedding == merged


@pytest.mark.parametrize("kind", [Detections, PointClusters])
@pytest.mark.parametrize(
    ("embeddings", "space", "fault"),
    [
        (np.eye(2, 3, dtype=np.float32), "", "expected a name in embedding_space, got an empty string"),
        (None, "words@1", "expected embeddings for embedding_space 'words@1', got none"),
        (np.eye(3, dtype=np.float32), "words@1", r": expected shape \(2, any\), got \(3, 3\)"),
        (np.eye(2, 3), "words@1", "expected an array"),
        (np.full((2, 3), 0.4, np.float32), "words@1", r"expected a unit vector or zeros in each row, got .* 0\.69"),
        (np.full((2, 3), np.nan, np.float32), "words@1", "expected finite values"),
        (np.zeros((2, 0), np.float32), "words@1", "expected 1 to 65536 columns, got 0"),
        (np.eye(2, 3, dtype=np.float32), "w" * 301, "at most 300 characters"),
    ],
)
def test_embeddings_invalid_values_raise(kind: type, embeddings: np.ndarray | None, space: str, fault: str) -> None:
    scores, rows = np.ones(2, np.float32), np.ones((2, 1), np.float32)
    given = {"embeddings": embeddings, "embedding_space": space, "scores": scores, "class_probabilities": rows}
    if kind is Detections:
        given |= {"masks": np.zeros((2, 4, 4), np.bool_), "boxes": np.zeros((2, 4), np.float32)}
    else:
        given |= {"points_world": np.zeros((0, 3), np.float32), "pixels": np.zeros((0, 2), np.int32)}
        given |= {"cluster": np.zeros(0, np.int32)}
    with pytest.raises(DataError, match=fault):
        kind(classes=("chair",), **given)


def mapped(name: str, frames: int = 4, embeddings: np.ndarray | None = None, space: str = "words@1") -> MapFuser:
    """Map the analytic room. The last of its three objects has no embedding."""
    fuser: MapFuser = registered.built("fuser", name, "fuser.voxel_size=0.08")
    for k, T in enumerate(walk(4)[:frames]):
        frame = room().frame(T, k)
        fuse_masks(fuser, frame, masks_of(frame), [0.9, 0.8, 0.9], embeddings=embeddings, space=space)
    return fuser


EMBEDDINGS = np.float32([[1, 0], [0, 1], [0, 0]])


def embeddings_of(scene: SceneMap) -> list[list[float] | None]:
    found = [scene.instances()[k].embedding for k in sorted(scene.instances())]
    return [None if embedding is None else embedding.tolist() for embedding in found]


@pytest.mark.parametrize("name", WITH_TABLES)
def test_embeddings_map_file_round_trip_is_exact(name: str, tmp_path: Path) -> None:
    scene = mapped(name, embeddings=EMBEDDINGS).scene
    assert embeddings_of(scene) == [[1, 0], [0, 1], None]
    assert scene.embedding_space == "words@1"
    scene.save(tmp_path / "map.npz")
    loaded = load_scene(tmp_path / "map.npz")
    assert (embeddings_of(loaded), loaded.embedding_space) == (embeddings_of(scene), scene.embedding_space)
    loaded.save(tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "map.npz").read_bytes()


@pytest.mark.parametrize("name", WITH_TABLES)
def test_map_without_embeddings_stores_none(name: str, tmp_path: Path) -> None:
    scene = mapped(name).scene
    assert embeddings_of(scene) == [None] * 3
    scene.save(tmp_path / "map.npz")
    with np.load(tmp_path / "map.npz") as file:
        assert not set(ARRAYS) & set(file.files)
        assert b"embedding" not in file["header"].tobytes()
    mapped(name, embeddings=np.zeros((3, 2), np.float32)).scene.save(tmp_path / "zeros.npz")
    assert (tmp_path / "zeros.npz").read_bytes() == (tmp_path / "map.npz").read_bytes()


def test_resumed_map_accumulates_embeddings(tmp_path: Path) -> None:
    first = mapped("bayesian_tsdf", embeddings=EMBEDDINGS)
    first.scene.save(tmp_path / "map.npz")
    second: MapFuser = registered.built("fuser", "bayesian_tsdf", "fuser.voxel_size=0.08")
    second.resume(load_scene(tmp_path / "map.npz"))
    frame = room().frame(walk(4)[0], 0)
    fuse_masks(second, frame, masks_of(frame), [0.9, 0.8, 0.9], embeddings=EMBEDDINGS[[1, 1, 1]])
    turned = second.scene.instances()[1]
    np.testing.assert_allclose(turned.embedding, np.float32([4, 1]) / np.sqrt(17), atol=1e-6)
    assert turned.embedding_spread == pytest.approx(1 - np.sqrt(17) / 5)


def test_embeddings_of_other_space_or_length_raise() -> None:
    fuser = mapped("bayesian_tsdf", embeddings=EMBEDDINGS)
    frame = room().frame(walk(4)[0], 9)
    with pytest.raises(DataError, match=r"detector: expected embeddings from words@1 \(as in the map\)"):
        fuse_masks(fuser, frame, masks_of(frame), [0.9] * 3, embeddings=EMBEDDINGS, space="words@2")
    with pytest.raises(DataError, match="detector: expected embeddings of equal length, got 2 and 3 numbers;"):
        fuse_masks(fuser, frame, masks_of(frame), [0.9] * 3, embeddings=np.eye(3))


@pytest.mark.parametrize(
    ("array", "value", "fault"),
    [
        ("embedding_ids", np.int32([1, 1]), "embedding_ids: expected unique instances, got duplicates"),
        ("embedding_ids", np.int32([1, 77]), "embedding_ids: expected ids in the map, got 77"),
        ("embedding_ids", np.int32([1, 2, 3]), "embedding_sums: expected shape"),
        ("embedding_sums", np.float32([[1, 0], [0, 1]]), "embedding_sums: expected an array"),
        ("embedding_sums", np.float64([1, 0]), r"embedding_sums: expected \(M, D\) with D in \[1, .*\]"),
        (
            "embedding_sums",
            np.float64([[900, 0], [0, 1]]),
            "embedding_sums: expected vectors with norm / weight of at most 1, got ",
        ),
        ("embedding_weights", np.float64([0, 1]), r"embedding_weights: expected values in \(0, 1e\+12\], got .* to"),
        ("embedding_counts", np.int64([0, 1]), r"embedding_counts: expected values in \[1, .* to"),
        ("embedding_counts", None, "expected the arrays embedding_counts for the embedding space"),
    ],
)
def test_map_file_with_invalid_embeddings_raises(
    tmp_path: Path, array: str, value: np.ndarray | None, fault: str
) -> None:
    path = tmp_path / "map.npz"
    mapped("bayesian_tsdf", embeddings=EMBEDDINGS).scene.save(path)
    with np.load(path) as file:
        arrays = dict(file)
    header = json.loads(arrays.pop("header").tobytes())
    arrays = {name: found for name, found in arrays.items() if name != array}
    write_map(path, header, arrays if value is None else arrays | {array: value})
    with pytest.raises(DataError, match=fault) as refused:
        load_scene(path)
    assert "\n" not in str(refused.value)

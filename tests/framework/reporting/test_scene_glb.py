"""Tests for maps as GLB files."""

from __future__ import annotations

import io
import json
import struct

import numpy as np
import pytest
import trimesh

from framework.data import InstanceMesh
from framework.exporting.decimation import with_finer_objects
from framework.reporting.scene_glb import MAX_BYTES, MAX_TRIANGLES, light_enough, scene_glb


def two_squares() -> InstanceMesh:
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    vertices = np.concatenate([square, square + np.float32(2)])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    colors = np.full((8, 3), (188, 0, 255), np.uint8)
    ids = np.array([0, 0, 0, 0, 5, 5, 5, 5], np.int32)
    return InstanceMesh(vertices, triangles, colors, ids, ids - 1, ())


UP = np.array([0.0, 0.0, 1.0])


def tree_of(content: bytes) -> tuple[dict, bytes]:
    length = struct.unpack("<I", content[12:16])[0]
    return json.loads(content[20 : 20 + length]), content[20 + length + 8 :]


def test_scene_glb_has_one_node_with_class_per_object() -> None:
    mesh = two_squares()
    content = scene_glb(mesh, np.linspace(0, 1, 8, dtype=np.float32), {5: "<b>cup</b>"}, UP)
    scene = trimesh.load_scene(io.BytesIO(content), file_type="glb")
    assert set(scene.geometry) == {"room", "b_cup_b_5"}
    np.testing.assert_array_equal(scene.geometry["b_cup_b_5"].vertices, mesh.vertices[4:])
    tree, _ = tree_of(content)
    extras = {node["name"]: node.get("extras") for node in tree["nodes"] if "mesh" in node}
    assert extras == {"room": None, "b_cup_b_5": {"id": 5, "class": "<b>cup</b>"}}
    assert content == scene_glb(mesh, np.linspace(0, 1, 8, dtype=np.float32), {5: "<b>cup</b>"}, UP)


def test_scene_glb_has_linear_colors_and_first_seen_times() -> None:
    first_seen = np.linspace(0, 1, 8, dtype=np.float32)
    tree, binary = tree_of(scene_glb(two_squares(), first_seen, {5: "cup"}, UP))
    [attributes] = [m["primitives"][0]["attributes"] for m in tree["meshes"] if m["name"] == "cup_5"]

    def values(name: str, kind: type, width: int) -> np.ndarray:
        view = tree["bufferViews"][tree["accessors"][attributes[name]]["bufferView"]]
        return np.frombuffer(binary, kind, 4 * width, view["byteOffset"]).reshape(4, width)

    accessor = tree["accessors"][attributes["COLOR_0"]]
    assert (accessor["componentType"], accessor["type"], accessor["normalized"]) == (5123, "VEC4", True)
    colors = values("COLOR_0", np.uint16, 4) / 65535
    np.testing.assert_allclose(colors[0], [0.5029, 0, 1, 1], atol=1e-4)  # sRGB 188 is half of the linear intensity
    np.testing.assert_array_equal(values("_FIRST_SEEN", np.float32, 1)[:, 0], first_seen[4:])


def test_scene_glb_is_y_up() -> None:
    """In glTF, the up direction is y."""
    up = np.array([0.6, 0.0, -0.8])
    content = scene_glb(two_squares(), np.zeros(8, np.float32), {}, up)
    scene = trimesh.load_scene(io.BytesIO(content), file_type="glb")
    T, _ = scene.graph["room"]
    np.testing.assert_allclose(T[:3, :3] @ up, (0, 1, 0), atol=1e-6)


def test_scene_glb_unnamed_labels_belong_to_room() -> None:
    scene = trimesh.load_scene(io.BytesIO(scene_glb(two_squares(), np.zeros(8, np.float32), {}, UP)), file_type="glb")
    assert set(scene.geometry) == {"room"}
    assert len(scene.geometry["room"].faces) == 4


@pytest.mark.parametrize("shared_vertices", [True, False])
def test_scene_glb_size_of_large_map_is_limited(shared_vertices: bool) -> None:
    n = 500
    x, y = np.meshgrid(np.arange(n, dtype=np.float32), np.arange(n, dtype=np.float32), indexing="ij")
    vertices = 0.01 * np.stack([x, y, np.sin(x / 30) * np.cos(y / 20)], axis=-1).reshape(-1, 3)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate([np.stack([a, a + n, a + 1], 1), np.stack([a + 1, a + n, a + n + 1], 1)])
    if not shared_vertices:
        triangles = triangles[::2]
        vertices, triangles = vertices[triangles.ravel()], np.arange(triangles.size).reshape(-1, 3)
    zeros = np.zeros(len(vertices), np.int32)
    mesh = InstanceMesh(
        vertices, triangles.astype(np.int32), np.full((len(vertices), 3), 90, np.uint8), zeros, zeros - 1, ()
    )
    light = light_enough(with_finer_objects(mesh, MAX_TRIANGLES))
    content = scene_glb(light, np.zeros(len(light.vertices), np.float32), {}, UP)
    assert 1_000_000 < len(content) <= MAX_BYTES

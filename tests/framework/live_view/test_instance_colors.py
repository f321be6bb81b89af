"""Tests for instance colors. They must be constant over time, and different between neighbors."""

from __future__ import annotations

import numpy as np

from framework.data import Frame, InstanceMesh
from framework.geometry import back_project, transform
from framework.live_view.instance_colors import InstanceColors, seen_instances
from framework.rendering.palette import instance_colors
from tests.support.scenes.corner_room import CAMERA, CLASSES, CornerRoom, look, pose_at


def test_instance_colors_are_unchanged_by_new_instances() -> None:
    centroids = {key: np.random.default_rng(key).uniform(0, 2, 3) for key in (3, 5, 9, 12)}
    colors = InstanceColors()
    colors.add({key: centroids[key] for key in (5, 3)})
    first = {key: colors[key].tolist() for key in (3, 5)}
    colors.add({**centroids, 3: np.array([50.0, 0, 0])})  # instance 3 has moved
    assert {key: colors[key].tolist() for key in (3, 5)} == first
    assert len({tuple(colors[key].tolist()) for key in centroids}) == 4
    assert [colors[key].tolist() for key in (3, 5)] == instance_colors(np.array([centroids[3], centroids[5]])).tolist()


def test_instance_colors_paint_only_instance_vertices() -> None:
    mesh, colors = room_mesh(), InstanceColors()
    colors.add({1: np.zeros(3), 2: np.ones(3)})
    painted = colors.painted(mesh)
    np.testing.assert_array_equal(painted[mesh.instance_ids == 0], mesh.colors[mesh.instance_ids == 0])
    for key in (1, 2):
        of = mesh.instance_ids == key
        gray = mesh.colors[of].mean(axis=1, keepdims=True)
        np.testing.assert_allclose(painted[of], 0.4 * gray + 0.6 * colors[key], atol=1.01)


def room_mesh() -> InstanceMesh:
    """Return a mesh whose vertices are the back-projected depth of the first frame, with instance ids 0 to 2."""
    depth, _, color, ids = look(CAMERA, pose_at(0))
    v, u = np.nonzero(depth > 0)
    points = back_project(CAMERA, np.stack([u, v], 1).astype(np.int32), depth[v, u])
    vertices = np.asarray(transform(pose_at(0), points), np.float32)
    labels = ids[v, u].astype(np.int32)
    return InstanceMesh(vertices, np.zeros((0, 3), np.int32), color[v, u], labels, labels - 1, CLASSES)


def masks_of(frame: Frame) -> np.ndarray:
    ids = look(CAMERA, pose_at(frame.index))[3]
    return np.stack([ids == 2, ids == 1, ids == 0, np.zeros_like(ids, bool)])


def test_seen_instances_match_masks_to_visible_instances() -> None:
    frame = CornerRoom()[5]
    found = seen_instances(masks_of(frame), frame, pose_at(5), room_mesh())
    assert found.tolist() == [2, 1, 0, 0]


def test_seen_instances_ignore_occluded_vertices() -> None:
    frame = CornerRoom()[5]
    near = Frame(5, 0.0, frame.color, np.full(frame.depth.shape, 0.5, np.float32), CAMERA)
    assert seen_instances(masks_of(frame), near, pose_at(5), room_mesh()).tolist() == [0, 0, 0, 0]


def test_seen_instances_accept_empty_map_and_no_masks() -> None:
    frame, mesh = CornerRoom()[0], room_mesh()
    nothing = InstanceMesh(
        mesh.vertices[:0], mesh.triangles, mesh.colors[:0], mesh.instance_ids[:0], mesh.class_ids[:0], CLASSES
    )
    assert seen_instances(masks_of(frame), frame, pose_at(0), nothing).tolist() == [0, 0, 0, 0]
    assert seen_instances(masks_of(frame)[:0], frame, pose_at(0), mesh).tolist() == []

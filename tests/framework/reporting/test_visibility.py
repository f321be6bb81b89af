"""Tests for the visibility of a map from the poses of a trajectory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from framework.data import Camera, InstanceMesh
from framework.exporting.decimation import joined
from framework.reporting.visibility import RENDERED_POSES, sightings, spread_out

CAMERA = Camera(200, 150, 150.0, 150.0, 99.5, 74.5)


def wall(n: int = 41) -> InstanceMesh:
    """Return a wall of 4 m x 1 m, 2 m in front of the origin, with an object at each end."""
    x, y = np.meshgrid(np.linspace(-2, 2, n), np.linspace(-0.5, 0.5, n), indexing="ij")
    vertices = np.stack([x, y, np.full_like(x, 2)], axis=-1).reshape(-1, 3).astype(np.float32)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate([np.stack([a, a + n, a + 1], 1), np.stack([a + 1, a + n, a + n + 1], 1)])
    ids = np.select([vertices[:, 0] < -1.2, vertices[:, 0] > 1.2], [3, 4]).astype(np.int32)
    return InstanceMesh(vertices, triangles.astype(np.int32), np.zeros((n * n, 3), np.uint8), ids, ids - 1, ())


def at(x: float) -> np.ndarray:
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = x
    return T_world_camera


def test_sightings_first_seen_is_first_visible_pose() -> None:
    mesh = wall()
    found = sightings(mesh, mesh.instance_ids, np.array([at(-1.0), at(-0.2), at(0.2)]), CAMERA, {})
    half = 2 * 100 / 150  # m, visible half width
    x = mesh.vertices[:, 0]
    assert found.chosen == [0, 1, 2]
    assert (found.first_seen[x < -1.0 + half - 0.05] == 0).all()
    assert (found.first_seen[(x > -1.0 + half + 0.05) & (x < -0.2 + half - 0.05)] == 1).all()
    assert (found.first_seen[x > 0.2 + half + 0.05] == 3).all(), (
        "expected the number of poses, 3, for a vertex that is never visible"
    )
    assert found.growth[-1] == 1
    assert (np.diff(found.growth) > 0).all()


def test_sightings_best_pose_shows_complete_object() -> None:
    mesh = wall()
    near = at(-1.0)
    near[2, 3] = 1.0  # the object has more pixels, but only 0.59 of it is visible
    poses = np.array([at(-3.2), near, at(-1.4), at(0.0), at(1.7)])
    assert sightings(mesh, mesh.instance_ids, poses, CAMERA, {}).best == {3: 2, 4: 4}


def test_sightings_best_pose_avoids_blurred_image() -> None:
    mesh = wall()
    poses = np.array([at(-1.4), at(-1.5), at(1.7)])
    both = [sightings(mesh, mesh.instance_ids, poses, CAMERA, {k: 0.4}).best[3] for k in (0, 1)]
    assert both == [1, 0]


def test_sightings_exclude_occluded_objects() -> None:
    mesh = wall()
    nearer = replace(
        mesh,
        vertices=mesh.vertices - np.float32([0, 0, 1]),
        instance_ids=np.where(mesh.instance_ids > 0, 9, 0).astype(np.int32),
    )
    before = joined([mesh, nearer])
    found = sightings(before, before.instance_ids, np.array([at(0.0)]), CAMERA, {})
    assert (found.first_seen[: len(mesh.vertices)] == 1).all()
    assert 3 not in found.best


def test_spread_out_poses_cover_trajectory_evenly() -> None:
    assert spread_out(0) == []
    assert spread_out(1) == [0]
    assert spread_out(5) == [0, 1, 2, 3, 4]
    chosen = spread_out(1000)
    assert (len(chosen), chosen[0], chosen[-1]) == (RENDERED_POSES, 0, 999)
    assert set(np.diff(chosen)) <= {12, 13}

"""Tests for the camera path of the benchmark with 2,000 frames."""

import numpy as np

from framework.geometry import back_project, inverse, project, transform
from tests.benchmarks.room_row import CAMERA, FRAMES_PER_ROOM, LENGTH, OBJECTS, RoomRow, pose_at


def test_room_row_frames_repeat_after_one_room() -> None:
    walk = RoomRow(FRAMES_PER_ROOM + 100)
    now, later = walk[80], walk[80 + FRAMES_PER_ROOM]
    np.testing.assert_allclose(now.depth, later.depth, atol=1e-4)
    assert (now.color != later.color).mean() < 0.001
    seen, seen_later = (set(np.unique(f.truth.instance_ids).tolist()) - {0} for f in (now, later))
    assert len(seen) >= 3
    assert {i + len(OBJECTS) for i in seen} == seen_later, "expected the same objects in the next room"
    assert all(walk.class_names[i] == walk.class_names[i + len(OBJECTS)] for i in seen)
    step = pose_at(80 + FRAMES_PER_ROOM)[:3, 3] - pose_at(80)[:3, 3]
    np.testing.assert_allclose(step, (LENGTH, 0, 0), atol=1e-9)


def test_room_row_nearby_frames_show_same_surface() -> None:
    walk = RoomRow(100)
    one, other = walk[60], walk[64]
    v, u = (x.ravel() for x in np.mgrid[: CAMERA.height, : CAMERA.width])
    points = back_project(CAMERA, np.stack([u, v], axis=1).astype(np.int32), one.depth.ravel())
    points = transform(inverse(other.T_world_camera) @ one.T_world_camera, points)
    pixels = np.rint(project(CAMERA, points)).astype(int)
    inside = ((pixels >= 0) & (pixels < (CAMERA.width, CAMERA.height))).all(axis=1)
    u, v = pixels[inside].T
    assert (np.abs(points[inside, 2] - other.depth[v, u]) < 0.03).mean() > 0.97
    assert np.median(np.abs(one.color.reshape(-1, 3)[inside].astype(int) - other.color[v, u])) <= 2

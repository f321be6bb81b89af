"""Tests for the overview image of a map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from framework.data import Camera, InstanceMesh
from framework.geometry import inverse, project, transform
from framework.rendering import overview
from framework.rendering.ambient_occlusion import openness
from framework.rendering.camera_path import PATH_END, PATH_START
from framework.rendering.palette import instance_colors
from framework.rendering.surface import FrontSides, Surface
from framework.rendering.viewpoint import _visible, best_view, fitted, looking, surrounding_poses, upward
from tests.support.scenes.boxes_room import Z_UP, furnished, walk

RNG = np.random.default_rng(0)
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
Y_DOWN = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@pytest.mark.parametrize("R", [Z_UP, Y_UP, Y_DOWN], ids=["z-up", "y-up", "y-down"])
@pytest.mark.parametrize("flipped", [False, True])
def test_upward_is_found_for_any_world_axis(R: np.ndarray, flipped: bool) -> None:
    mesh, poses = furnished(R), walk(R)
    triangles = mesh.triangles[:, ::-1] if flipped else mesh.triangles
    surface = Surface.seen_from(mesh.vertices, triangles, poses)
    np.testing.assert_allclose(upward(poses, surface), R @ [0, 0, 1], atol=1e-3)
    np.testing.assert_array_equal(surface.face_normals, Surface(mesh.vertices, mesh.triangles).face_normals)


def test_upward_of_tilted_camera_is_corrected_by_floor() -> None:
    mesh, poses = furnished(), walk()
    surface = Surface(mesh.vertices, mesh.triangles)
    one_way = np.repeat(poses[:1], 5, axis=0)  # tilted by 22 degrees
    assert -one_way[0, :3, 1] @ [0, 0, 1] < 0.95
    np.testing.assert_allclose(upward(one_way, surface), [0, 0, 1], atol=1e-3)


def test_front_sides_depth_is_exact() -> None:
    mesh = furnished()
    camera, R = Camera(33, 25, 30.0, 30.0, 16.0, 12.0), looking(np.array([-1.0, 0, 0]), np.array([0.0, 0, 1]))
    eye = np.array([0.5, 0.0, 0.4])
    hits = FrontSides(Surface(mesh.vertices, mesh.triangles), eye).seen_by(camera, R)
    assert hits.depth[12, 16] == pytest.approx(0.5 - -0.6, abs=1e-5)  # the side of the red box
    assert hits.nearest(mesh.instance_ids)[12, 16] == 1
    # the wall behind the box; depth is along z, not along the ray
    assert hits.depth[12, 0] == pytest.approx(2.5, abs=1e-4)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, eye
    pixels = project(camera, transform(inverse(T), hits.points_world.astype(np.float64)))
    u, v = np.meshgrid(np.arange(33), np.arange(25))
    np.testing.assert_allclose(pixels, np.stack([u, v], axis=-1), atol=1e-3)


def test_front_sides_ignore_back_faces_of_walls_and_ceiling() -> None:
    mesh = furnished()
    camera, R = Camera(9, 9, 60.0, 60.0, 4.0, 4.0), looking(np.array([0.0, 0.1, -1.0]), np.array([0.0, 0, 1]))
    hits = FrontSides(Surface(mesh.vertices, mesh.triangles), np.array([0.0, -0.5, 5.0])).seen_by(camera, R)
    # the floor is visible through the ceiling at 2.5 m
    np.testing.assert_allclose(hits.points_world[..., 2], 0, atol=1e-4)


def test_openness_near_objects_is_below_open_floor() -> None:
    mesh = furnished()
    camera, R = Camera(128, 128, 80.0, 80.0, 63.5, 63.5), looking(np.array([-1.0, 0, -1.0]), np.array([0.0, 0, 1]))
    hits = FrontSides(Surface(mesh.vertices, mesh.triangles), np.array([2.5, 0.0, 3.0])).seen_by(camera, R)
    normals = np.tile(np.float32(R[2]), (128, 128, 1))  # up direction in the camera frame
    light = openness(camera, hits.depth, normals)
    x, y, z = np.moveaxis(hits.points_world, -1, 0)
    floor = hits.seen & (np.abs(z) < 1e-3)
    near_box = floor & (np.abs(x + 0.55) < 0.05) & (np.abs(y) < 0.3)
    free = floor & (np.abs(x) < 0.1) & (y < -0.3) & (y > -0.8)
    assert light[free].mean() > 0.98
    assert light[near_box].mean() < 0.85


def test_fitted_camera_view_encloses_points_tightly() -> None:
    points = RNG.uniform(-1, 1, (4000, 3)).astype(np.float32) * [2, 1, 0.5]
    R = looking(np.array([1.0, 2.0, -1.0]), np.array([0.0, 0, 1]))
    camera, T = fitted(R, points.astype(np.float32), 400, 300)
    pixels = project(camera, transform(inverse(T), points.astype(np.float64)))
    inside = (pixels >= -0.5).all(axis=1) & (pixels[:, 0] < 399.5) & (pixels[:, 1] < 299.5)
    assert inside.mean() > 0.98
    spread = np.ptp(pixels[inside], axis=0) / [400, 300]
    assert spread.max() > 0.9


def test_visible_points_match_painters_algorithm() -> None:
    camera, T = Camera(30, 20, 25.0, 25.0, 14.5, 9.5), np.eye(4)
    T[:3, :3], T[:3, 3] = looking(np.array([1.0, 0.5, -0.2]), np.array([0.0, 0, 1])), [-3, -1.5, 0.5]
    points, normals = RNG.uniform(-2, 2, (3000, 3)).astype(np.float32), RNG.normal(0, 1, (3000, 3)).astype(np.float32)
    local = transform(inverse(T), points.astype(np.float64))
    expected: dict[tuple[int, int], int] = {}
    for i in np.argsort(-local[:, 2]):  # the farthest first
        u, v = np.rint(project(camera, local[i]))
        front = (points[i] - T[:3, 3]) @ normals[i] < 0
        if front and local[i, 2] > 0 and 0 <= u < camera.width and 0 <= v < camera.height:
            expected[int(v), int(u)] = int(i)
    assert len(expected) > 300
    shown = _visible(points, normals, camera, T)
    assert shown.tolist() == [expected[pixel] for pixel in sorted(expected)]


def test_best_view_looks_down_and_shows_objects() -> None:
    mesh, poses = furnished(), walk()
    surface = Surface(mesh.vertices, mesh.triangles)
    camera, T = best_view(surface, mesh.instance_ids, poses, 200, 150)
    assert -0.9 < T[2, 2] < -0.5  # the camera looks down at an angle
    assert T[2, 3] > 2.5  # the camera is above the ceiling
    ids = FrontSides(surface, T[:3, 3]).seen_by(camera, T[:3, :3]).nearest(mesh.instance_ids)
    assert (ids == 1).sum() > 200
    assert (ids == 2).sum() > 200


def test_best_view_of_ceiling_alone_frames_it() -> None:
    """All candidate views look down, so none shows a front face."""
    x, y = np.meshgrid([-1.0, 1.0], [-1.0, 1.0])
    corners = np.stack([x.ravel(), y.ravel(), np.full(4, 2.5)], axis=1).astype(np.float32)
    surface = Surface(corners, np.array([[0, 2, 1], [1, 2, 3]], np.int32))  # visible from below
    camera, T = best_view(surface, np.zeros(4, np.int32), walk(), 200, 150)
    assert np.isfinite(T).all()
    in_camera = (corners - T[:3, 3]) @ T[:3, :3]
    assert (in_camera[:, 2] > 0).all()
    u, v = camera.fx * in_camera[:, 0] / in_camera[:, 2], camera.fy * in_camera[:, 1] / in_camera[:, 2]
    assert np.abs([u + camera.cx - 100, v + camera.cy - 75]).max() < 110


def test_overview_shows_colors_left_and_instances_right(tmp_path: Path) -> None:
    mesh, instances = furnished(), {1: ("chair", 0.9), 2: ("couch", 0.6)}
    overview.write_overview(tmp_path / "overview.png", mesh, instances, walk(), "two boxes")
    assert [path.name for path in tmp_path.iterdir()] == ["overview.png"]
    image = np.asarray(Image.open(tmp_path / "overview.png")).astype(int)
    assert image.shape[1] == 2 * overview.PANEL_WIDTH
    panels = image[overview.TITLE_HEIGHT :][: overview.PANEL_HEIGHT]
    left, right = panels[:, : overview.PANEL_WIDTH], panels[:, overview.PANEL_WIDTH :]
    red = (left[..., 0] > 3 * left[..., 1]) & (left[..., 0] > 3 * left[..., 2])
    blue = (left[..., 2] > 3 * left[..., 1]) & (left[..., 2] > 3 * left[..., 0])
    assert red.sum() > 5000
    assert blue.sum() > 5000
    colors = instance_colors(np.array([[-1, 0, 0.4], [1, 0.3, 0.4]])).astype(float)
    for where, color in ((red, colors[0]), (blue, colors[1])):
        shown = np.median(right[where], axis=0)
        hue = shown / np.linalg.norm(shown) @ (color / np.linalg.norm(color))
        assert hue > 0.98
    assert np.ptp(np.median(right[~red & ~blue], axis=0)) < 12, "expected a gray background"


def test_overview_unlisted_ids_are_background() -> None:
    image = overview.overview(furnished(), {1: ("chair", 0.9)}, walk(), "one of them").astype(int)
    right = image[overview.TITLE_HEIGHT :][: overview.PANEL_HEIGHT, overview.PANEL_WIDTH :]
    colorful = np.ptp(right, axis=2) > 60
    assert 5000 < colorful.sum() < 0.2 * colorful.size


def test_overview_of_empty_map_has_notice() -> None:
    nothing = InstanceMesh(
        *(np.zeros((0, 3), dtype) for dtype in (np.float32, np.int32, np.uint8)),
        np.zeros(0, np.int32),
        np.zeros(0, np.int32),
        (),
    )
    image = overview.overview(nothing, {}, np.zeros((0, 4, 4)), "nothing")
    assert (image != overview.PAPER).any()


def test_instance_colors_of_neighbors_are_distinct() -> None:
    centroids = RNG.uniform(0, 6, (40, 3))
    colors = instance_colors(centroids).astype(float)
    np.testing.assert_array_equal(colors, instance_colors(centroids))
    distance = np.linalg.norm(centroids[:, None] - centroids[None], axis=2) + 99 * np.eye(40)
    nearest = distance.argmin(axis=1)
    assert np.linalg.norm(colors - colors[nearest], axis=1).min() > 60


def test_comparison_differs_only_in_changed_instance(tmp_path: Path) -> None:
    mesh, poses = furnished(), walk()
    keys = [k for k in np.unique(mesh.instance_ids).tolist() if k > 0]
    without_first = np.where(mesh.instance_ids == keys[0], 0, mesh.instance_ids).astype(np.int32)
    before = overview.InstanceState("instances", mesh.instance_ids, dict.fromkeys(keys, ""))
    after = overview.InstanceState("instances", without_first, dict.fromkeys(keys[1:], ""))
    overview.write_comparison(tmp_path / "both.png", mesh, [before, after], poses)
    with Image.open(tmp_path / "both.png") as image:
        left, right = np.split(np.asarray(image), 2, axis=1)
    changed = (left != right).any(axis=2)
    assert 0 < changed.mean() < 0.2
    v, u = np.nonzero(changed)
    box = changed[v.min() : v.max() + 1, u.min() : u.max() + 1]
    assert box.mean() > 0.4, "expected a single changed region"


@pytest.mark.parametrize("R", [Z_UP, Y_UP, Y_DOWN], ids=["z-up", "y-up", "y-down"])
@pytest.mark.parametrize("flipped", [False, True])
def test_surrounding_poses_see_the_front_of_a_room(R: np.ndarray, flipped: bool) -> None:
    mesh = furnished(R)
    poses = surrounding_poses(mesh.vertices, R @ [0.0, 0, 1])
    triangles = mesh.triangles[:, ::-1] if flipped else mesh.triangles
    surface = Surface.seen_from(mesh.vertices, triangles, poses)
    np.testing.assert_array_equal(surface.face_normals, Surface(mesh.vertices, mesh.triangles).face_normals)
    np.testing.assert_allclose(upward(poses, surface), R @ [0, 0, 1], atol=1e-3)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    assert ((poses[:, :3, 3] > low) & (poses[:, :3, 3] < high)).all()


def test_overview_without_poses_shows_map_without_path() -> None:
    mesh = furnished()
    names = {1: ("chair", 0.9)}
    image = overview.overview(mesh, names, np.zeros((0, 4, 4)), "title")
    assert image.shape == overview.overview(mesh, names, walk(), "title").shape
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 1000  # not a text panel
    path = (np.array(PATH_START), np.array(PATH_END))
    assert not any((image == color).all(axis=-1).any() for color in path)

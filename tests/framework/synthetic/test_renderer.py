"""The renderer's geometry, to float precision."""

import numpy as np

from framework.data import Camera
from framework.synthetic.camera_path import look
from framework.synthetic.lights import globe
from framework.synthetic.piece import Furniture
from framework.synthetic.ray_caster import NO_TRIANGLE, image_rays, pixel_rays
from framework.synthetic.renderer import EDGE_SAMPLES, EDGE_STEP, WHITE, Renderer, to_srgb
from framework.synthetic.solids import panel, rounded_box
from framework.synthetic.surfaces import assemble
from framework.synthetic.textures import Material, Texture

CAMERA = Camera(64, 48, 50.0, 55.0, 30.7, 22.9)
GREY = Material(Texture.PAINT, (0.7, 0.7, 0.7), (0.7, 0.7, 0.7))


def scene(*solids):
    objects = []
    for instance, solid in enumerate(solids):
        piece = Furniture("thing", "chair" if instance else None)
        piece.add(solid, GREY)
        objects.append((instance, piece))
    return assemble(objects)


def test_depth_of_a_slanted_plane_is_exact():
    wall = panel(60.0, 60.0, 5.0).moved(z=-30).turned("x", 0.5).turned("z", 0.4)
    renderer = Renderer(scene(wall), [globe(np.array([0.0, 2.0, 0.0]), 0.1, (1, 1, 1))])
    T = look(np.array([0.3, 2.0, 0.2]), -1.9, -0.2, 0.1)
    picture = renderer.render(CAMERA, T)
    u, v = np.meshgrid(np.arange(64.0), np.arange(48.0))
    ray = np.stack([(u - 30.7) / 50, (v - 22.9) / 55, np.ones_like(u)], axis=-1) @ T[:3, :3].T
    n = wall.normals[0]
    expected = n @ (wall.vertices[0] - T[:3, 3]) / (ray @ n)
    assert (picture.depth > 0).all()
    np.testing.assert_allclose(picture.depth, expected, rtol=2e-6)
    shifted = np.abs(np.diff(expected, axis=1)).min() / 2  # what half a pixel would amount to
    assert shifted > 50 * np.abs(picture.depth - expected).max()
    cosine = np.abs(ray @ n) / np.linalg.norm(ray, axis=-1)
    np.testing.assert_allclose(picture.incidence, cosine, atol=1e-5)


def test_ids_and_nothing():
    box = rounded_box(1.0, 1.0, 1.0, 0.01)
    floor = panel(3.0, 3.0).turned("x", np.pi / 2).moved(y=1.5, z=-0.5)
    renderer = Renderer(scene(floor, box), [globe(np.array([2.0, 2.0, 3.0]), 0.1, (1, 1, 1))])
    camera = Camera(9, 9, 9.0, 9.0, 4.0, 4.0)
    picture = renderer.render(camera, look(np.array([-3.0, 0, 0]), 0.0, 0.0, 0.0))
    assert picture.instance_ids[4, 4] == 1
    assert picture.depth[4, 4] == np.float32(2.5)
    assert picture.depth[0, 4] == 0  # above the box there is nothing
    assert picture.instance_ids[0, 4] == 0
    assert picture.color[0, 4].tolist() == [0, 0, 0]
    assert picture.instance_ids[6, 0] == 0
    assert picture.depth[6, 0] > 0  # the floor


def test_a_lamp_casts_a_shadow():
    plate = rounded_box(1.0, 1.0, 0.02, 0.004).moved(z=1.0)
    floor = panel(6.0, 6.0).turned("x", np.pi / 2).moved(y=3.0)
    renderer = Renderer(scene(floor, plate), [globe(np.array([0.0, 0.0, 2.0]), 0.05, (1, 1, 1))])
    above = look(np.array([0.0, 0.0, 0.9]), 0.0, -np.pi / 2, 0.0)  # between plate and floor, looking down
    camera = Camera(101, 101, 30.0, 30.0, 50.0, 50.0)
    light = renderer.render(camera, above).color.astype(float).mean(axis=-1)
    # The plate's shadow reaches 1 m from the middle: 33 px at 0.9 m.
    assert light[40:61, 40:61].mean() < 0.25 * light[50, 95:].mean()


def test_tone_curve_rises_from_black_to_white():
    light = np.linspace(0, 3, 500, dtype=np.float32)[:, None].repeat(3, axis=1)
    grey = to_srgb(light)[:, 0].astype(int)
    assert grey[0] == 0
    assert grey[-1] == 255
    assert (np.diff(grey) >= 0).all()


# The kernels against the same arithmetic on whole images


def furnished():
    """Things before each other, some of them with steps of depth inside one part, and nothing beyond."""
    floor = panel(3.0, 3.0).turned("x", np.pi / 2).moved(y=1.5, z=-0.5)
    return Renderer(
        scene(floor, rounded_box(0.5, 0.6, 0.7, 0.05), rounded_box(0.3, 0.2, 1.5, 0.02).moved(x=0.6, y=0.3)),
        [globe(np.array([-2.0, 1.0, 3.0]), 0.1, (1, 1, 1))],
    )


def test_rays_are_those_of_the_arithmetic_on_whole_images_to_the_bit():
    T = look(np.array([-3.0, 0.2, 0.3]), 0.1, -0.2, 0.3)
    x, y = (np.arange(64)[None, :] - CAMERA.cx) / CAMERA.fx, (np.arange(48)[:, None] - CAMERA.cy) / CAMERA.fy
    expected = np.empty((48, 64, 6), np.float32)
    expected[..., :3] = T[:3, 3]
    for c in range(3):
        expected[..., 3 + c] = T[c, 0] * x + (T[c, 1] * y + T[c, 2])
    np.testing.assert_array_equal(image_rays(CAMERA, T), expected)
    v, u = np.nonzero(np.random.default_rng(0).random((48, 64)) < 0.1)
    np.testing.assert_array_equal(pixel_rays(CAMERA, T, u[:, None], v[:, None])[:, 0], expected[v, u])


def test_a_picture_is_that_of_the_arithmetic_on_whole_images_to_the_bit():
    renderer = furnished()
    T = look(np.array([-3.0, 0.2, 0.3]), 0.1, -0.2, 0.3)
    rays = image_rays(CAMERA, T)
    hits = renderer.caster.cast(rays)
    met = hits.triangle != NO_TRIANGLE
    depth = np.where(met, hits.distance, np.float32(0))
    d, n = rays[..., 3:], hits.normal
    along, square = (a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2] for a, b in ((d, n), (d, d)))
    part = np.where(met, renderer.surfaces.parts[hits.triangle], -1)
    edge = np.zeros(depth.shape, np.bool_)
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        step = (part[a] != part[b]) | (np.abs(depth[a] - depth[b]) > EDGE_STEP * depth[a])
        edge[a] |= step
        edge[b] |= step
    light, _ = renderer._shade(rays, hits, CAMERA)
    v, u = np.nonzero(edge)
    assert 50 < len(u) < 0.5 * edge.size
    offsets = np.array(EDGE_SAMPLES)
    finer = pixel_rays(CAMERA, T, u[:, None] + offsets[:, 0], v[:, None] + offsets[:, 1])
    samples, _ = renderer._shade(finer, renderer.caster.cast(finer), CAMERA)
    light[v, u] = np.minimum(samples, WHITE).mean(axis=1)

    picture = renderer.render(CAMERA, T)
    np.testing.assert_array_equal(picture.depth, depth)
    np.testing.assert_array_equal(picture.incidence, np.abs(along) / np.sqrt(square))
    np.testing.assert_array_equal(picture.instance_ids, np.where(met, renderer.surfaces.instance_ids[hits.triangle], 0))
    np.testing.assert_array_equal(picture.color, to_srgb(light))
    for a, b in zip(renderer.depth_and_ids(CAMERA, T), (picture.depth, picture.instance_ids), strict=True):
        np.testing.assert_array_equal(a, b)

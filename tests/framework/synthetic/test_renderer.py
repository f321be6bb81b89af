"""Tests for the renderer."""

from dataclasses import replace

import numpy as np
import pytest

from framework.data import Camera
from framework.rendering.rasterizer_kernels import NO_TRIANGLE
from framework.synthetic.furniture.piece import Furniture
from framework.synthetic.furniture.solids import panel, rounded_box
from framework.synthetic.lights import globe
from framework.synthetic.paints import Material, Texture
from framework.synthetic.ray_caster import image_rays, pixel_rays
from framework.synthetic.renderer import EDGE_SAMPLES, Renderer, cast_ids, to_srgb
from framework.synthetic.shading_kernels import EDGE_STEP, WHITE
from framework.synthetic.surfaces import assemble
from framework.synthetic.texture_kernels import surface_color
from framework.synthetic.walk import look

pytestmark = pytest.mark.integration

CAMERA = Camera(64, 48, 50.0, 55.0, 30.7, 22.9)
GRAY = Material(Texture.PAINT, (0.7, 0.7, 0.7), (0.7, 0.7, 0.7))


def scene(*solids):
    objects = []
    for instance, solid in enumerate(solids):
        piece = Furniture("thing", "chair" if instance else None)
        piece.add(solid, GRAY)
        objects.append((instance, piece))
    return assemble(objects)


def test_renderer_depth_of_slanted_plane_is_exact():
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
    shifted = np.abs(np.diff(expected, axis=1)).min() / 2  # m, smallest depth change within half a pixel
    assert shifted > 50 * np.abs(picture.depth - expected).max()
    cosine = np.abs(ray @ n) / np.linalg.norm(ray, axis=-1)
    np.testing.assert_allclose(picture.incidence, cosine, atol=1e-5)


def test_renderer_background_has_zero_depth_and_id():
    box = rounded_box(1.0, 1.0, 1.0, 0.01)
    floor = panel(3.0, 3.0).turned("x", np.pi / 2).moved(y=1.5, z=-0.5)
    renderer = Renderer(scene(floor, box), [globe(np.array([2.0, 2.0, 3.0]), 0.1, (1, 1, 1))])
    camera = Camera(9, 9, 9.0, 9.0, 4.0, 4.0)
    picture = renderer.render(camera, look(np.array([-3.0, 0, 0]), 0.0, 0.0, 0.0))
    assert picture.instance_ids[4, 4] == 1
    assert picture.depth[4, 4] == np.float32(2.5)
    assert picture.depth[0, 4] == 0  # nothing is above the box
    assert picture.instance_ids[0, 4] == 0
    assert picture.color[0, 4].tolist() == [0, 0, 0]
    assert picture.instance_ids[6, 0] == 0
    assert picture.depth[6, 0] > 0  # the floor


def test_renderer_lamp_casts_shadow():
    plate = rounded_box(1.0, 1.0, 0.02, 0.004).moved(z=1.0)
    floor = panel(6.0, 6.0).turned("x", np.pi / 2).moved(y=3.0)
    renderer = Renderer(scene(floor, plate), [globe(np.array([0.0, 0.0, 2.0]), 0.05, (1, 1, 1))])
    # the camera is between plate and floor and looks down
    above = look(np.array([0.0, 0.0, 0.9]), 0.0, -np.pi / 2, 0.0)
    camera = Camera(101, 101, 30.0, 30.0, 50.0, 50.0)
    light = renderer.render(camera, above).color.astype(float).mean(axis=-1)
    # the shadow of the plate has a radius of 1 m, which is 33 px at 0.9 m
    assert light[40:61, 40:61].mean() < 0.25 * light[50, 95:].mean()


def test_tone_curve_rises_from_black_to_white():
    light = np.linspace(0, 3, 500, dtype=np.float32)[:, None].repeat(3, axis=1)
    gray = to_srgb(light)[:, 0].astype(int)
    assert gray[0] == 0
    assert gray[-1] == 255
    assert (np.diff(gray) >= 0).all()


# Kernels compared with slow references


def furnished():
    """Return a renderer of overlapping objects without a background. Some objects contain depth steps."""
    floor = panel(3.0, 3.0).turned("x", np.pi / 2).moved(y=1.5, z=-0.5)
    return Renderer(
        scene(floor, rounded_box(0.5, 0.6, 0.7, 0.05), rounded_box(0.3, 0.2, 1.5, 0.02).moved(x=0.6, y=0.3)),
        [globe(np.array([-2.0, 1.0, 3.0]), 0.1, (1, 1, 1))],
    )


def test_image_rays_equal_vectorized_reference():
    T = look(np.array([-3.0, 0.2, 0.3]), 0.1, -0.2, 0.3)
    x, y = (np.arange(64)[None, :] - CAMERA.cx) / CAMERA.fx, (np.arange(48)[:, None] - CAMERA.cy) / CAMERA.fy
    expected = np.empty((48, 64, 6), np.float32)
    expected[..., :3] = T[:3, 3]
    for c in range(3):
        expected[..., 3 + c] = T[c, 0] * x + (T[c, 1] * y + T[c, 2])
    np.testing.assert_array_equal(image_rays(CAMERA, T), expected)
    v, u = np.nonzero(np.random.default_rng(0).random((48, 64)) < 0.1)
    np.testing.assert_array_equal(pixel_rays(CAMERA, T, u[:, None], v[:, None])[:, 0], expected[v, u])


def light_along(renderer, rays):
    """Return the light (N, 3) and the cosine of incidence (N,) of each ray (N, 6)."""
    s, irradiance, hits = renderer.surfaces, renderer._lit.irradiance, renderer.caster.cast(rays)
    light, cosines = np.zeros((len(rays), 3)), np.zeros(len(rays))
    for n, f in enumerate(hits.triangle):
        if f == NO_TRIANGLE:
            continue
        corners, (b, c) = s.triangles[f], hits.uv[n].astype(float)
        weights = np.array([1 - b - c, b, c])
        p, q, r = s.vertices[corners].astype(float)
        normal = np.cross(q - p, r - p)
        ray = rays[n, 3:].astype(float)
        cosines[n] = abs(normal @ ray) / np.linalg.norm(normal) / np.linalg.norm(ray)
        material = s.material_table[s.materials[f]]
        footprint = hits.distance[n] / CAMERA.fx / np.sqrt(max(cosines[n], 0.05))
        color = surface_color(material, *(weights @ s.texture[corners]), footprint)
        light[n] = np.array(color) * (weights @ irradiance[corners] + material[11])
    return light, cosines


def test_renderer_image_matches_per_ray_shading():
    renderer = furnished()
    T = look(np.array([-3.0, 0.2, 0.3]), 0.1, -0.2, 0.3)
    picture = renderer.render(CAMERA, T)
    rays = image_rays(CAMERA, T)
    hits = renderer.caster.cast(rays)
    met = hits.triangle != NO_TRIANGLE
    depth = np.where(met, hits.distance, np.float32(0))
    np.testing.assert_allclose(picture.depth, depth, atol=2e-6)
    np.testing.assert_array_equal(picture.instance_ids, np.where(met, renderer.surfaces.instance_ids[hits.triangle], 0))
    part = np.where(met, renderer.surfaces.parts[hits.triangle], -1)
    edge = np.zeros(depth.shape, np.bool_)
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        step = (part[a] != part[b]) | (np.abs(depth[a] - depth[b]) > EDGE_STEP * depth[a])
        edge[a] |= step
        edge[b] |= step
    v, u = np.nonzero(edge)
    assert 50 < len(u) < 0.5 * edge.size
    light, cosines = light_along(renderer, rays.reshape(-1, 6))
    light = light.reshape(*CAMERA.shape, 3)
    np.testing.assert_allclose(picture.incidence.ravel(), cosines, atol=1e-5)
    smooth = np.zeros((len(u), 3))
    for du, dv in EDGE_SAMPLES:
        finer = pixel_rays(CAMERA, T, u[:, None] + du, v[:, None] + dv)[:, 0]
        sample, _ = light_along(renderer, finer)
        seen = renderer.caster.cast(finer)
        same = (seen.triangle != NO_TRIANGLE) & (renderer.surfaces.parts[seen.triangle] == part[v, u])
        same &= np.abs(seen.distance - depth[v, u]) <= EDGE_STEP * depth[v, u]
        assert 0.2 < same.mean() < 0.9
        smooth += np.minimum(np.where(same[:, None], light[v, u], sample), WHITE) / len(EDGE_SAMPLES)
    light[v, u] = smooth
    difference = np.abs(picture.color.astype(int) - to_srgb(light.astype(np.float32)))
    assert difference.max() <= 1  # one gray level, due to rounding
    assert (difference > 0).mean() < 0.02
    for a, b in zip(renderer.depth_and_ids(CAMERA, T), (picture.depth, picture.instance_ids), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(cast_ids(renderer.surfaces, renderer.caster, CAMERA, T), picture.instance_ids)


def test_renderer_material_table_changes_only_colors():
    renderer = furnished()
    T = look(np.array([-3.0, 0.2, 0.3]), 0.1, -0.2, 0.3)
    table = renderer.surfaces.material_table.copy()
    table[:, 1:7] *= (0.2, 1, 1, 0.2, 1, 1)  # less red
    picture, other = renderer.render(CAMERA, T), renderer.render(CAMERA, T, table)
    np.testing.assert_array_equal(other.depth, picture.depth)
    np.testing.assert_array_equal(other.color[..., 1:], picture.color[..., 1:])
    seen = picture.depth > 0
    assert (other.color[seen][:, 0] < picture.color[seen][:, 0]).all()


def test_renderer_unread_depends_on_darkness_and_incidence():
    wall = panel(60.0, 60.0, 5.0).moved(z=-30).turned("x", 0.5).turned("z", 0.4)
    T = look(np.array([0.3, 2.0, 0.2]), -1.9, -0.2, 0.1)
    lamp = [globe(np.array([0.0, 2.0, 0.0]), 0.1, (1, 1, 1))]
    for dark, shiny in ((0.0, 0.0), (0.3, 0.0), (0.2, 0.8)):
        piece = Furniture("wall", None)
        piece.add(wall, replace(GRAY, dark=dark, shiny=shiny))
        picture = Renderer(assemble([(0, piece)]), lamp).render(CAMERA, T)
        turned = np.minimum(1, (1 - picture.incidence) / (1 - np.cos(np.deg2rad(60))))
        assert np.ptp(turned) > 0.3
        np.testing.assert_allclose(picture.unread, dark + (1 - dark) * shiny * turned, atol=1e-5)

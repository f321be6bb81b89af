"""Tests for the solids of furniture."""

import numpy as np
import pytest

from framework.synthetic.furniture.solids import Section, cushion, cylinder, loft, panel, rounded_box, tube
from tests.support.scenes.labeled_furniture import LABELED


def volume(solid):
    a, b, c = (solid.vertices[solid.triangles[:, i]] for i in range(3))
    return float(np.einsum("fc,fc->", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize(
    ("solid", "expected"),
    [
        (rounded_box(0.4, 0.3, 0.2, 0.001), 0.4 * 0.3 * 0.2),
        (rounded_box(0.2, 0.2, 0.2, 0.1, 8), 4 / 3 * np.pi * 0.1**3),
        (cylinder(0.1, 0.5, segments=64), np.pi * 0.01 * 0.5),
        (loft([Section(0, 0.2, 0.1, n=60), Section(1, 0.2, 0.1, n=60)], 64), 0.4 * 0.2),
        (cylinder(0.2, 0.6, 1e-4, segments=64), np.pi * 0.04 * 0.6 / 3),
    ],
)
def test_solid_volume_matches_analytic_volume(solid, expected):
    assert volume(solid) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize(
    "solid",
    [
        rounded_box(0.5, 0.3, 0.1, 0.02, 3),
        cushion(0.5, 0.4, 0.15),
        cylinder(0.05, 0.7),
        tube([(0, 0, 0), (0, 0, 1)], 0.02),
    ],
)
def test_solid_normals_point_outward(solid):
    a, b, c = (solid.vertices[solid.triangles[:, i]] for i in range(3))
    faces = np.cross(b - a, c - a)
    area = np.linalg.norm(faces, axis=1)
    real = area > 1e-10
    agreement = np.einsum("fc,fc->f", faces, solid.normals[solid.triangles].mean(axis=1))[real] / area[real]
    assert agreement.min() > 0.3
    np.testing.assert_allclose(np.linalg.norm(solid.normals, axis=1), 1, atol=1e-9)
    assert volume(solid) > 0 or len(solid.triangles) < 60


def test_panel_triangles_face_forward():
    wall = panel(2.0, 1.0)
    a, b, c = (wall.vertices[wall.triangles[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a)[:, 1] > 0).all()


@pytest.mark.parametrize("class_name", sorted(LABELED))
def test_furniture_is_on_floor_and_has_expected_size(class_name):
    largest = {
        "bed": (1.9, 2.3, 1.3), "chair": (0.6, 0.7, 1.1), "couch": (2.7, 1.05, 1.0), "dining table": (1.7, 1.2, 0.8),
        "book": (0.4, 0.4, 0.1), "refrigerator": (0.8, 0.8, 1.9), "tv": (1.3, 0.3, 0.8), "toilet": (0.5, 0.8, 0.9),
        "backpack": (0.45, 0.4, 0.6),
    }[class_name]  # fmt: skip
    for seed in range(4):
        piece = LABELED[class_name](np.random.default_rng(seed))
        low, high = piece.bounds()
        assert piece.class_name == class_name
        assert low[2] == pytest.approx(0, abs=0.003)
        assert (high - low < largest).all()
        assert (high - low > 0.15 * np.array(largest)).all()

"""Tests for mesh regions. Together they must equal the mesh, and only changed regions are returned."""

from __future__ import annotations

import numpy as np
import pytest

from framework.live_view.mesh_regions import MeshPart, MeshRegions, Region


def sheet(width: int, height: int, spacing: float = 0.1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the vertices, m, the triangles and the colors of a grid in the plane z = 0, centered on the origin."""
    x, y = np.meshgrid(np.arange(width) - width // 2, np.arange(height) - height // 2, indexing="ij")
    vertices = (np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3) * spacing).astype(np.float32)
    corner = (np.arange(width - 1)[:, None] * height + np.arange(height - 1)).ravel()
    triangles = np.stack([corner, corner + 1, corner + height], axis=1).astype(np.int32)
    return vertices, triangles, np.random.default_rng(0).integers(0, 255, vertices.shape, np.uint8)


def corners(vertices: np.ndarray, triangles: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Return the positions and colors (F, 18) of the corners of all triangles, sorted."""
    rows = np.concatenate([vertices, colors.astype(np.float32)], axis=1)[triangles].reshape(len(triangles), -1)
    return rows[np.lexsort(rows.T)]


def changed(regions: MeshRegions, *mesh: np.ndarray) -> dict[Region, MeshPart]:
    return dict(regions.changed(*mesh))


@pytest.mark.parametrize("side", [0.35, 1.0, 50.0])
def test_mesh_regions_together_equal_mesh(side: float) -> None:
    mesh = sheet(40, 25)
    parts = changed(MeshRegions(side), *mesh)
    found = [corners(part.vertices, part.triangles, part.colors) for part in parts.values()]
    together = np.concatenate(found)
    np.testing.assert_array_equal(together[np.lexsort(together.T)], corners(*mesh))
    for region, part in parts.items():
        first = part.vertices[part.triangles[:, 0]] / side
        assert (np.floor(first + 1e-6) <= region).any()
        assert ((first >= np.array(region) - 1e-5) & (first <= np.array(region) + 1 + 1e-5)).all()
        assert np.unique(part.triangles).tolist() == list(range(len(part.vertices))), (
            "expected triangles that use every vertex"
        )


def test_mesh_regions_support_bounding_box_of_over_65536_cubes() -> None:
    vertices, triangles, colors = sheet(40, 40, spacing=10.0)
    parts = changed(MeshRegions(1.0), vertices, triangles, colors)
    assert len(parts) == len(triangles)
    assert sum(len(part.triangles) for part in parts.values()) == len(triangles)


def test_mesh_regions_return_only_changed_parts() -> None:
    regions = MeshRegions(1.0)
    vertices, triangles, colors = sheet(40, 40)
    assert len(changed(regions, vertices, triangles, colors)) == 16
    assert not changed(regions, vertices.copy(), triangles.copy(), colors.copy())
    colors[0] += 1  # the corner at x = y = -2 m
    assert list(changed(regions, vertices, triangles, colors)) == [(-2, -2, 0)]


def test_mesh_regions_return_removed_parts_once() -> None:
    regions = MeshRegions(1.0)
    vertices, triangles, colors = sheet(40, 40)
    changed(regions, vertices, triangles, colors)
    left = triangles[vertices[triangles[:, 0], 0] < 1]
    parts = changed(regions, vertices, left, colors)
    assert [region for region, part in parts.items() if not len(part.triangles)] == [(1, y, 0) for y in range(-2, 2)]
    assert not changed(regions, vertices, left, colors)
    assert not [part for part in changed(regions, vertices, left[:0], colors).values() if len(part.triangles)]

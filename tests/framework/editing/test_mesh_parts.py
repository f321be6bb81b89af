"""Tests for the division of a mesh into parts."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import InstanceMesh
from framework.editing.edits import SplitBy
from framework.editing.mesh_parts import parts_of
from framework.errors import DataError

SPACING = 0.02  # m, voxel size and distance of neighboring vertices; the minimum part has 25 vertices


def sheet(side: int, x: float, slope: float = 0.0) -> InstanceMesh:
    """Return a square sheet of side x side vertices from x, m, that rises along y."""
    i, j = np.divmod(np.arange(side * side), side)
    vertices = np.stack([x + i * SPACING, j * SPACING, slope * j * SPACING], axis=1).astype(np.float32)
    corners = np.arange(side * side).reshape(side, side)
    a, b, c = corners[:-1, :-1].ravel(), corners[1:, :-1].ravel(), corners[:-1, 1:].ravel()
    count = side * side
    labels = np.ones(count, np.int32)
    triangles = np.stack([a, b, c], axis=1).astype(np.int32)
    return InstanceMesh(vertices, triangles, np.zeros((count, 3), np.uint8), labels, labels, ("chair",))


def joined(*meshes: InstanceMesh) -> InstanceMesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    triangles = [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=False)]
    rest = {name: np.concatenate([getattr(mesh, name) for mesh in meshes]) for name in ("vertices", "colors")}
    labels = np.ones(starts[-1], np.int32)
    return InstanceMesh(
        rest["vertices"], np.concatenate(triangles).astype(np.int32), rest["colors"], labels, labels, ()
    )


def test_parts_of_separate_sheets_are_ordered_by_size() -> None:
    """The last sheet is smaller than the minimum area. One corner of each sheet has no triangle."""
    parts = parts_of(joined(sheet(6, 0), sheet(8, 1), sheet(4, 2)), SplitBy.PARTS, SPACING)
    sizes = [6 * 6, 8 * 8, 4 * 4]
    expected = np.repeat([1, 0, -1], sizes)
    expected[np.cumsum(sizes) - 1] = -1
    assert parts.tolist() == expected.tolist()


def test_parts_of_connected_sheet_raises_data_error() -> None:
    with pytest.raises(
        DataError, match=r"expected at least two parts with 25 or more vertices \(0.01 m\^2\), got parts"
    ):
        parts_of(sheet(8, 0), SplitBy.PARTS, SPACING)


def test_parts_by_plane_separate_dominant_plane() -> None:
    mesh = joined(sheet(8, 0, slope=2.0), sheet(20, 0))
    mesh.vertices[:64, 2] += 0.1
    parts = parts_of(mesh, SplitBy.PLANE, SPACING)
    assert parts.tolist() == [1] * 64 + [0] * 400
    assert parts_of(mesh, SplitBy.PLANE, SPACING).tolist() == parts.tolist()

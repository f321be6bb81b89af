"""Triangle meshes in PLY files.

All three encodings are read, and little-endian binary is written. Open3D is not used because it crashes on some
malformed files. plyfile has a GPL license.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt

from framework.data import Array, Float32, Int32, Int64
from framework.errors import DataError
from framework.files.atomic_write import atomic_write, read_bytes
from framework.files.ply_elements import TYPES, Element, read_elements

LARGEST_FILE = 2**32  # bytes; the mesh of a room has about 2^26
AXES = ("x", "y", "z")
INDICES = ("vertex_indices", "vertex_index")  # names of the list property of faces
TYPE_NAMES = {code: name for name, code in reversed(TYPES.items())}  # traditional names: float instead of float32


@dataclass(frozen=True)
class PlyMesh:
    """A mesh with vertex properties."""

    vertices: Float32  # (V, 3) m
    triangles: Int32  # (F, 3) vertex indices
    properties: Mapping[str, Array]  # by name: other scalar properties (V,) of the vertices, in the type of the file
    comments: tuple[str, ...]  # comments of the header, in file order
    triangle_properties: Mapping[str, Array] = field(default_factory=dict)  # (F,) scalar properties of the faces


def found_property(mesh: PlyMesh, values: Array | None) -> str:
    """Describe the type of a vertex property, or list the existing properties if `values` is None.

    The text is used in messages after "got".
    """
    if values is not None:
        return str(values.dtype)
    return f"only the properties {', '.join((*AXES, *sorted(mesh.properties)))}"


def read_ply(path: Path, origin: Sequence[float] = (0.0, 0.0, 0.0)) -> PlyMesh:
    """Read a mesh.

    Polygons are converted to triangles. Other elements and list properties of vertices are ignored.

    Args:
        path: The file.
        origin: Position (3,), m, that is subtracted from the vertices in float64.

    Raises:
        DataError: The file is damaged, a vertex is not finite, or a vertex index is invalid.
    """
    header, elements = read_elements(path, read_bytes(path, LARGEST_FILE))
    if "vertex" not in elements:
        raise DataError(f"{path}, line {header.lines}: expected an element 'vertex' in the header, got none")
    vertices = _vertices(path, elements["vertex"], origin)
    triangles, of_triangles = np.empty((0, 3), np.int32), {}
    if "face" in elements:
        triangles, lengths = _triangles(path, elements["face"], len(vertices))
        scalars = elements["face"].scalars
        of_triangles = {name: np.repeat(values, lengths - 2) for name, values in scalars.items()}
    properties = {name: values for name, values in elements["vertex"].scalars.items() if name not in AXES}
    return PlyMesh(vertices, triangles, properties, header.comments, of_triangles)


def write_ply(
    path: Path, vertices: Float32, triangles: Int32, properties: Mapping[str, Array], comments: Sequence[str] = ()
) -> None:
    """Write a mesh atomically.

    Args:
        path: The output file.
        vertices: The vertices (V, 3), m.
        triangles: The vertex indices (F, 3) of the triangles.
        properties: The vertex properties (V,) by name.
        comments: The comments of the header.

    Raises:
        DataError: The mesh is invalid, or the file cannot be written.
    """
    _check_mesh(path, vertices, triangles)
    row = _vertex_dtype(path, len(vertices), properties)
    broken = next((comment for comment in comments if "\n" in comment or "\r" in comment), None)
    if broken is not None:
        raise DataError(f"{path}: expected comments without line breaks, got {broken!r:.60}")
    rows = np.empty(len(vertices), row)
    for axis, name in enumerate(AXES):
        rows[name] = vertices[:, axis]
    for name, values in properties.items():
        rows[name] = values
    faces = np.empty(len(triangles), [("count", "u1"), ("vertex_indices", "<i4", (3,))])
    faces["count"] = 3
    faces["vertex_indices"] = triangles
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {len(vertices)}",
        *(f"property {TYPE_NAMES[row[name].char]} {name}" for name in row.names or ()),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode("ascii", "replace"))
        file.write(rows.data)  # not `tofile`, which does not report that the disk is full
        file.write(faces.data)


def _vertices(path: Path, rows: Element, origin: Sequence[float]) -> Float32:
    missing = [axis for axis in AXES if axis not in rows.scalars]
    if missing:
        raise DataError(f"{path}: element 'vertex': expected a scalar property {missing[0]!r}, got none")
    with np.errstate(over="ignore"):  # values too large for float32 become infinite and are rejected
        columns = [rows.scalars[axis].astype(np.float64) - start for axis, start in zip(AXES, origin, strict=True)]
        vertices = np.stack([column.astype(np.float32) for column in columns], axis=1)
    if not np.isfinite(vertices).all():
        k = int(np.argmin(np.isfinite(vertices).all(axis=1)))
        found = " ".join(f"{rows.scalars[axis][k]:g}" for axis in AXES)
        raise DataError(f"{path}, {rows.place(k)}: vertex {k}: expected finite coordinates, got {found}")
    return vertices


def _triangles(path: Path, rows: Element, vertices: int) -> tuple[Int32, Int64]:
    """Return the triangles (F, 3) and the number of corners (P,) of each face."""
    name = next((name for name in INDICES if name in rows.lists), None)
    if name is None:
        raise DataError(f"{path}: element 'face': expected a list property {' or '.join(INDICES)}, got none")
    indices, lengths = rows.lists[name]
    if indices.dtype.kind == "f":
        raise DataError(f"{path}: {name}: expected an integer type, got {indices.dtype}")
    if (lengths < 3).any():
        k = int(np.argmax(lengths < 3))
        raise DataError(f"{path}, {rows.place(k)}: face {k}: expected at least 3 vertices, got {lengths[k]}")
    corners = cast(npt.NDArray[np.signedinteger], indices)
    if corners.size and (corners.min() < 0 or corners.max() >= vertices):
        wrong = int(np.argmax((corners < 0) | (corners >= vertices)))
        k = int(np.searchsorted(np.cumsum(lengths), wrong, side="right"))
        expected = f"expected vertex indices in [0, {vertices})"
        raise DataError(f"{path}, {rows.place(k)}: face {k}: {expected}, got {corners[wrong]}")
    return _fans(corners.astype(np.int32, copy=False), lengths), lengths


def _fans(corners: Int32, lengths: Int64) -> Int32:
    """Split P polygons into triangles (F, 3).

    Args:
        corners: The vertex indices of all polygons, concatenated.
        lengths: The number of corners (P,) of each polygon.
    """
    if (lengths == 3).all():
        return corners.reshape(-1, 3)
    triangles = lengths - 2  # number of triangles of each polygon
    corner_0 = np.repeat(_starts(lengths), triangles)
    corner_1 = corner_0 + 1 + np.arange(len(corner_0)) - np.repeat(_starts(triangles), triangles)
    return corners[np.stack([corner_0, corner_1, corner_1 + 1], axis=1)]


def _starts(lengths: Int64) -> Int64:
    return np.asarray(np.cumsum(lengths) - lengths)


def _check_mesh(path: Path, vertices: Float32, triangles: Int32) -> None:
    for name, array, dtype in (("vertices", vertices, np.float32), ("triangles", triangles, np.int32)):
        if array.dtype != dtype or array.ndim != 2 or array.shape[1] != 3:
            expected = f"expected shape (N, 3) and type {np.dtype(dtype)}"
            raise DataError(f"{path}: {name}: {expected}, got {array.shape} and {array.dtype}")
    if not np.isfinite(vertices).all():
        raise DataError(f"{path}: vertices: expected finite coordinates, got NaN or infinity")
    if triangles.size and (triangles.min() < 0 or triangles.max() >= len(vertices)):
        raise DataError(
            f"{path}: triangles: expected vertex indices in [0, {len(vertices)}), got {triangles.min()} to "
            f"{triangles.max()}"
        )


def _vertex_dtype(path: Path, vertices: int, properties: Mapping[str, Array]) -> np.dtype[np.void]:
    fields = [(axis, "<f4") for axis in AXES]
    for name, values in properties.items():
        if name.split() != [name] or not name.isascii() or name in AXES:
            expected = "expected a property name of one ASCII word other than x, y and z"
            raise DataError(f"{path}: {expected}, got {name!r}")
        if values.shape != (vertices,) or values.dtype.char not in TYPE_NAMES:
            raise DataError(
                f"{path}: {name}: expected shape ({vertices},) and a PLY type, got {values.shape} and {values.dtype}"
            )
        fields.append((name, values.dtype.newbyteorder("<").str))
    return np.dtype(fields)

"""The map's surface as a binary PLY file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from framework.atomic_files import written_whole
from framework.data import InstanceMesh

_VERTEX = np.dtype(
    [
        *((axis, "<f4") for axis in ("x", "y", "z")),
        *((channel, "u1") for channel in ("red", "green", "blue")),
        ("instance", "<i4"),
        ("class", "<i4"),
    ]
)
_FACE = np.dtype([("count", "u1"), ("vertex_indices", "<i4", (3,))])


def write_mesh(path: Path, mesh: InstanceMesh) -> None:
    """Writes `mesh` as a binary little-endian PLY: vertex x y z [m], red green blue, instance (0 = none), class.

    `class` is an index into the comment line `classes`, -1 = none.
    """
    vertices = np.empty(len(mesh.vertices), _VERTEX)
    for column, axis in enumerate(("x", "y", "z")):
        vertices[axis] = mesh.vertices[:, column]
    for column, channel in enumerate(("red", "green", "blue")):
        vertices[channel] = mesh.colors[:, column]
    vertices["instance"] = mesh.instance_ids
    vertices["class"] = mesh.class_ids
    faces = np.empty(len(mesh.triangles), _FACE)
    faces["count"] = 3
    faces["vertex_indices"] = mesh.triangles
    header = "\n".join(
        [
            "ply",
            "format binary_little_endian 1.0",
            "comment InstanceMap; metres; instance 0 = none; class -1 = none, else an index into:",
            f"comment classes {','.join(mesh.classes)}",
            f"element vertex {len(vertices)}",
            *(f"property float {axis}" for axis in ("x", "y", "z")),
            *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
            "property int instance",
            "property int class",
            f"element face {len(faces)}",
            "property list uchar int vertex_indices",
            "end_header\n",
        ]
    )
    with written_whole(path) as temporary, temporary.open("wb") as file:
        file.write(header.encode("ascii", "replace"))
        vertices.tofile(file)
        faces.tofile(file)

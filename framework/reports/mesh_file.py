"""The map's surface as a binary PLY file, written and read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from framework.atomic_files import written_whole
from framework.data import InstanceMesh
from framework.errors import DataError
from framework.ply import read_ply

_VERTEX = np.dtype(
    [
        *((axis, "<f4") for axis in ("x", "y", "z")),
        *((channel, "u1") for channel in ("red", "green", "blue")),
        ("instance", "<i4"),
        ("class", "<i4"),
    ]
)
_FACE = np.dtype([("count", "u1"), ("vertex_indices", "<i4", (3,))])
_CLASSES = "classes "  # begins the comment that names the classes


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
            f"comment {_CLASSES}{','.join(mesh.classes)}",
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


def read_mesh(path: Path) -> InstanceMesh:
    """The mesh that `write_mesh` wrote, to the bit. Raises DataError, naming the file, for anything else."""
    ply = read_ply(path)
    columns = {}
    for name in _VERTEX.names or ():
        if name in "xyz":
            continue
        if name not in ply.properties or ply.properties[name].dtype != _VERTEX[name]:
            raise DataError(f"{path} is no mesh of a run: expected {_VERTEX[name]} {name} of each vertex")
        columns[name] = ply.properties[name]
    listed = [comment.removeprefix(_CLASSES) for comment in ply.comments if comment.startswith(_CLASSES)]
    if len(listed) != 1:
        raise DataError(f"{path} is no mesh of a run: expected one line 'comment {_CLASSES}...', found {len(listed)}")
    return InstanceMesh(
        vertices=ply.vertices,
        triangles=ply.triangles,
        colors=np.stack([columns[channel] for channel in ("red", "green", "blue")], axis=1),
        instance_ids=columns["instance"],
        class_ids=columns["class"],
        classes=tuple(listed[0].split(",")) if listed[0] else (),
    )

"""Reading and writing of mesh.ply, the surface of a map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote, unquote

import numpy as np

from framework.data import Array, InstanceMesh
from framework.errors import DataError
from framework.files.manifest import verified
from framework.files.ply import read_ply, write_ply
from framework.runtime.plain_output import plain

CHANNELS = ("red", "green", "blue")
TYPES = {**dict.fromkeys(CHANNELS, np.uint8), "instance": np.int32, "class": np.int32}
"""Types of the vertex properties other than the position."""

SAFE = "".join(chr(code) for code in range(32, 127) if chr(code) not in ",%")  # not escaped in class names
CLASSES = "classes "  # prefix of the comment with the class names


def write_mesh(path: Path, mesh: InstanceMesh, comments: Sequence[str] = ()) -> None:
    """Write a mesh to a binary PLY file.

    Each vertex has a position in m, a color, an instance id and a class. The class is an index into the class names in
    the header, where commas and characters outside of ASCII are escaped as in URLs. Vertices without an instance have
    the id 0, and vertices without a class have the index -1. `comments` are added to the header.
    """
    properties: dict[str, Array] = {
        **{channel: mesh.colors[:, k] for k, channel in enumerate(CHANNELS)},
        "instance": mesh.instance_ids,
        "class": mesh.class_ids,
    }
    comments = (
        *comments,
        "InstanceMap; meters; instance 0 = none; class -1 = none, else an index into:",
        f"{CLASSES}{','.join(quote(plain(name), SAFE) for name in mesh.classes)}",
    )
    write_ply(path, mesh.vertices, mesh.triangles, properties, comments)


def read_mesh(path: Path) -> InstanceMesh:
    """Read a mesh that was written by `write_mesh`.

    Raises:
        DataError: The file is missing or damaged, or is not the mesh of a run.
    """
    with verified(path):
        ply = read_ply(path)
    for name, kind in TYPES.items():
        if name not in ply.properties or ply.properties[name].dtype != kind:
            got = ply.properties[name].dtype if name in ply.properties else "none"
            raise DataError(
                f"{path}: expected {np.dtype(kind)} for the vertex property {name!r}, got {got}; "
                "use the mesh.ply of a run"
            )
    class_lists = listed_classes(ply.comments)
    if len(class_lists) != 1:
        raise DataError(
            f"{path}: expected one line 'comment {CLASSES}...', got {len(class_lists)} lines; use the mesh.ply of a run"
        )
    return InstanceMesh(
        vertices=ply.vertices,
        triangles=ply.triangles,
        colors=np.stack([ply.properties[channel] for channel in CHANNELS], axis=1).astype(np.uint8),
        instance_ids=ply.properties["instance"].astype(np.int32),
        class_ids=ply.properties["class"].astype(np.int32),
        classes=class_lists[0],
    )


def listed_classes(comments: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the class names in each comment of `write_mesh` with classes. Control characters are escaped."""
    lists = [comment[len(CLASSES) :] for comment in comments if f"{comment} ".startswith(CLASSES)]
    return [tuple(plain(unquote(name)) for name in names.split(",")) if names else () for names in lists]

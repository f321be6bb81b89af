"""Reading and writing of mesh.ply, the surface of a map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import quote, unquote

import numpy as np

from framework.data import Array, InstanceMesh, Structure
from framework.errors import DataError
from framework.files.manifest import verified
from framework.files.ply import read_ply, write_ply
from framework.runtime.plain_output import plain

CHANNELS = ("red", "green", "blue")
TYPES = {**dict.fromkeys(CHANNELS, np.uint8), "instance": np.int32, "class": np.int32}
"""Types of the vertex properties other than the position."""

STRUCTURE = "structure"  # optional vertex property, uint8
SAFE = "".join(chr(code) for code in range(32, 127) if chr(code) not in ",%")  # not escaped in class names
CLASSES = "classes "  # prefix of the comments with the class names
LONGEST_LIST = 1000  # maximum number of characters of the names in a comment; Open3D aborts for lines of 1,024 bytes


def write_mesh(path: Path, mesh: InstanceMesh, comments: Sequence[str] = ()) -> None:
    """Write a mesh to a binary PLY file.

    Each vertex has a position in m, a color, an instance id and a class, and its `Structure` if it is determined. The
    class is an index into the class names in the header, where commas and characters outside of ASCII are escaped as in
    URLs. Long lists of names are split into several comments. Vertices without an instance have the id 0, and vertices
    without a class have the index -1.
    `comments` are added to the header.
    """
    properties: dict[str, Array] = {
        **{channel: mesh.colors[:, k] for k, channel in enumerate(CHANNELS)},
        "instance": mesh.instance_ids,
        "class": mesh.class_ids,
    }
    if mesh.structure is not None:
        properties[STRUCTURE] = mesh.structure
        kinds = ", ".join(f"{kind.value} = {kind.name.lower()}" for kind in Structure)
        comments = (*comments, f"InstanceMap; structure: {kinds}")
    comments = (
        *comments,
        "InstanceMap; meters; instance 0 = none; class -1 = none, else an index into:",
        *(CLASSES + names for names in _lists([quote(plain(name), SAFE) for name in mesh.classes])),
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
    structure = ply.properties.get(STRUCTURE)
    if structure is not None and (structure.dtype != np.uint8 or structure.max(initial=0) > max(Structure)):
        raise DataError(
            f"{path}: expected uint8 values of at most {max(Structure)} for the vertex property {STRUCTURE!r}, got "
            f"{structure.dtype} values of up to {structure.max()}; use the mesh.ply of a run"
        )
    classes = listed_classes(ply.comments)
    if classes is None:
        raise DataError(f"{path}: expected a line 'comment {CLASSES}...', got none; use the mesh.ply of a run")
    return InstanceMesh(
        vertices=ply.vertices,
        triangles=ply.triangles,
        colors=np.stack([ply.properties[channel] for channel in CHANNELS], axis=1).astype(np.uint8),
        instance_ids=ply.properties["instance"].astype(np.int32),
        class_ids=ply.properties["class"].astype(np.int32),
        classes=classes,
        structure=None if structure is None else structure.astype(np.uint8),
    )


def listed_classes(comments: Sequence[str]) -> tuple[str, ...] | None:
    """Return the class names in the comments of `write_mesh`, None = no comment. Control characters are escaped."""
    lists = [comment[len(CLASSES) :] for comment in comments if f"{comment} ".startswith(CLASSES)]
    names = ",".join(lists)
    return (tuple(plain(unquote(name)) for name in names.split(",")) if names else ()) if lists else None


def _lists(names: Sequence[str]) -> Iterator[str]:
    """Yield names, separated by commas, in lists of at most LONGEST_LIST characters or one name."""
    start = length = 0
    for end, name in enumerate(names):
        if end > start and length + len(name) > LONGEST_LIST:
            yield ",".join(names[start:end])
            start, length = end, 0
        length += len(name) + 1
    yield ",".join(names[start:])

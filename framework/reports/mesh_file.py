"""The map's surface as a binary PLY file."""

from __future__ import annotations

from pathlib import Path

from framework.data import Array, InstanceMesh
from framework.ply import write_ply


def write_mesh(path: Path, mesh: InstanceMesh) -> None:
    """Writes `mesh` as a binary little-endian PLY: vertex x y z [m], red green blue, instance (0 = none), class.

    `class` is an index into the comment line `classes`, -1 = none.
    """
    properties: dict[str, Array] = {
        **{channel: mesh.colors[:, k] for k, channel in enumerate(("red", "green", "blue"))},
        "instance": mesh.instance_ids,
        "class": mesh.class_ids,
    }
    comments = (
        "InstanceMap; metres; instance 0 = none; class -1 = none, else an index into:",
        f"classes {','.join(mesh.classes)}",
    )
    write_ply(path, mesh.vertices, mesh.triangles, properties, comments)

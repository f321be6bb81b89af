"""Parts of a room as PLY and OBJ files, z up, in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from framework.data import InstanceMesh
from framework.exporting.object_meshes import Coloring, Part, part_colors
from framework.exporting.submeshes import joined
from framework.files.atomic_write import written_whole
from framework.geometry import transform
from framework.runs.mesh_file import write_mesh

DIGITS = 5  # of an OBJ file's numbers behind the point: 0.01 mm


def write_parts_ply(path: Path, parts: Sequence[Part], coloring: Coloring = Coloring.APPEARANCE) -> None:
    """Writes parts as one PLY file, each where it stands, with the properties of a run's `mesh.ply`."""
    meshes = [
        replace(_placed(part), colors=colors) for part, colors in zip(parts, part_colors(parts, coloring), strict=True)
    ]
    write_mesh(path, joined(meshes))


def write_parts_obj(path: Path, parts: Sequence[Part], coloring: Coloring = Coloring.APPEARANCE) -> None:
    """Writes parts as one OBJ file, each where it stands, under its name; `v` lines have a colour (x y z r g b), sRGB.

    Parts without triangles are left out.
    """
    scene = trimesh.Scene()
    for part, colors in zip(parts, part_colors(parts, coloring), strict=True):
        if len(part.mesh.triangles):
            placed = _placed(part)
            mesh = trimesh.Trimesh(placed.vertices, placed.triangles, vertex_colors=colors, process=False)
            scene.add_geometry(mesh, part.name, part.name)
    text = trimesh.exchange.obj.export_obj(scene, include_normals=False, digits=DIGITS, header=None)
    header = "# InstanceMap; metres, z up; colours behind the vertices: x y z r g b\n"
    with written_whole(path) as temporary:
        temporary.write_text(header + text + "\n")


def _placed(part: Part) -> InstanceMesh:
    """A part's mesh where it stands in the room."""
    vertices = transform(part.T_room_part, part.mesh.vertices.astype(np.float64))
    return replace(part.mesh, vertices=vertices.astype(np.float32))

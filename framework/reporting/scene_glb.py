"""A light map as a GLB file: one node for each object, one for what is around them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import trimesh

from framework.data import Array, Bool, Float32, Int32
from framework.reporting.decimation import LightMesh, clustered

MOST_BYTES = 9_500_000  # of the file; browsers of phones still turn it
BYTES_OF_VERTEX, BYTES_OF_TRIANGLE = 24, 12  # place, colour, first sight; three indices
MOST_TRIANGLES = 300_000  # together with half as many vertices they come to 7 MB
NOT_GEOMETRY = 200_000  # bytes for names and nodes

REMAINDER = "remainder"  # the node of what is no object
COLOR, FIRST_SEEN = "_COLOR", "_FIRST_SEEN"


def scene_glb(mesh: LightMesh, first_seen: Float32, names: Mapping[int, str]) -> bytes:
    """The map as binary glTF 2.0, unlit: COLOR_0 in linear light as the format has it, and `_FIRST_SEEN`.

    The axes are the map's, in metres; triangles are seen from the side to which they are wound. A node is called
    `object <id>` or `remainder`, with the id and the class in its extras. The file is at most MOST_BYTES long where
    the mesh is one of `light_enough`.

    Args:
        first_seen: (V,) in [0, 1], which share of the video had passed when each vertex was seen first.
        names: class by id, of each object that gets a node; other labels count as none.
    """
    labels = np.where(np.isin(mesh.instance_ids, list(names)), mesh.instance_ids, 0).astype(np.int32)
    of_triangle = triangle_labels(mesh.triangles, labels)
    linear = _linear(mesh.colors)
    scene = trimesh.Scene()
    for key in (0, *sorted(names)):
        part = _part(mesh, of_triangle == key, linear, first_seen)
        if part is None:
            continue
        name = f"object {key}" if key else REMAINDER
        part.metadata = {"id": key, "class": names[key]} if key else {"id": 0}
        scene.add_geometry(part, node_name=name, geom_name=name)
    content = scene.export(  # type: ignore[no-untyped-call]
        file_type="glb", include_normals=False, tree_postprocessor=_as_standard_colors
    )
    assert isinstance(content, bytes)
    return content


def light_enough(mesh: LightMesh, most_bytes: int = MOST_BYTES) -> LightMesh:
    """The mesh itself, or, where a file of it would have more bytes, a coarser one."""
    return clustered(mesh, most_bytes - NOT_GEOMETRY, BYTES_OF_VERTEX, BYTES_OF_TRIANGLE)


def triangle_labels(triangles: Int32, labels: Int32) -> Int32:
    """(F,) the label that two corners have, else that of the first; triangles (F, 3), labels (V,)."""
    corners = labels[triangles]
    return np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0])


def _part(mesh: LightMesh, chosen: Bool, linear: Array, first_seen: Float32) -> trimesh.Trimesh | None:
    """The chosen triangles (F,), None where there are none."""
    if not chosen.any():
        return None
    used, triangles = np.unique(mesh.triangles[chosen], return_inverse=True)
    return trimesh.Trimesh(
        vertices=mesh.vertices[used],
        faces=triangles.reshape(-1, 3),
        vertex_attributes={COLOR: linear[used], FIRST_SEEN: first_seen[used].astype(np.float32)},
        process=False,
    )


def _linear(colors: Array) -> Array:
    """sRGB (V, 3) of 8 bits as linear RGBA (V, 4) of 16: 8 would leave few steps in the dark."""
    share = np.arange(256) / 255
    curve = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    table = np.rint(65535 * curve).astype(np.uint16)
    return np.concatenate([table[colors], np.full((len(colors), 1), 65535, np.uint16)], axis=1)


def _as_standard_colors(tree: dict[str, Any]) -> None:
    """Gives the colours the standard's name, which trimesh keeps for 8 bits, and says that no light falls on them."""
    for mesh in tree.get("meshes", ()):
        for primitive in mesh["primitives"]:
            attributes = primitive["attributes"]
            attributes["COLOR_0"] = attributes.pop(COLOR)
            tree["accessors"][attributes["COLOR_0"]]["normalized"] = True
            primitive["material"] = 0
    tree["materials"] = [
        {
            "name": "unlit",
            "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
            "extensions": {"KHR_materials_unlit": {}},
        }
    ]
    tree["extensionsUsed"] = ["KHR_materials_unlit"]

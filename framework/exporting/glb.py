"""Binary glTF 2.0 files with one node per object and one node for the rest of the room.

The y axis points up, and colors are linear. Image colors are unlit (KHR_materials_unlit), because they already contain
the lighting. Instance and class colors are lit. The room is one-sided, so that its interior is visible from outside.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import trimesh

from framework.data import Float32, Float64, Int32, UInt8, UInt16
from framework.exporting.object_meshes import Coloring, Part, linear, part_colors
from framework.rendering.surface import Surface
from framework.vocabulary.label_spaces import label_space_of

T_GLTF_ROOM = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
COLOR = "_LINEAR"  # color attribute, because the 8-bit colors of trimesh are too coarse for dark linear colors
UNLIT = "KHR_materials_unlit"
UNSIGNED_SHORT = 5123


@dataclass(frozen=True)
class Node:
    """A named mesh of a glTF scene. A node without triangles contains only metadata."""

    name: str  # unique
    vertices: Float32  # (V, 3) m, in the node's frame
    triangles: Int32  # (F, 3) vertex indices
    colors: UInt8  # (V, 3) sRGB
    T_gltf_node: Float64  # (4, 4)
    one_sided: bool  # visible only from the front
    extras: Mapping[str, Any]  # metadata
    attributes: Mapping[str, Float32] = field(default_factory=dict)  # vertex attributes (V,); names start with _


def glb(shown: Sequence[Part], coloring: Coloring = Coloring.APPEARANCE, comments: Sequence[str] = ()) -> bytes:
    """Return the content of a GLB file with the given parts. The result is deterministic.

    Comments are stored as metadata of the scene.
    """
    return glb_of(
        [_node(part, colors) for part, colors in zip(shown, part_colors(shown, coloring), strict=True)],
        lit=coloring is not Coloring.APPEARANCE,
        comments=comments,
    )


def glb_of(nodes: Sequence[Node], lit: bool, comments: Sequence[str] = ()) -> bytes:
    """Return the content of a GLB file with the given nodes. The result is deterministic."""
    scene: Any = trimesh.Scene(base_frame="world", metadata={"comments": list(comments)} if comments else None)
    for node in nodes:
        extras = dict(node.extras)
        if not len(node.triangles):
            scene.graph.update(node.name, matrix=node.T_gltf_node, metadata=extras)
            continue
        attributes: dict[str, Any] = {COLOR: _shorts(node.colors), **node.attributes}
        normals = _unit(Surface(node.vertices, node.triangles).vertex_normals) if lit else None
        mesh = trimesh.Trimesh(
            node.vertices, node.triangles, vertex_normals=normals, vertex_attributes=attributes, process=False
        )
        scene.add_geometry(mesh, node.name, node.name, transform=node.T_gltf_node, metadata=extras)

    def finish(tree: dict[str, Any]) -> None:
        _with_materials(tree, lit, {node.name for node in nodes if node.one_sided})

    export: Callable[..., bytes] = trimesh.exchange.gltf.export_glb
    return bytes(export(scene, include_normals=lit, tree_postprocessor=finish))


def _node(part: Part, colors: UInt8) -> Node:
    """Convert a part to a node whose own frame has y up."""
    vertices = (part.mesh.vertices @ T_GLTF_ROOM[:3, :3].T).astype(np.float32)
    T_gltf_part = T_GLTF_ROOM @ part.T_room_part @ T_GLTF_ROOM.T
    return Node(part.name, vertices, part.mesh.triangles, colors, T_gltf_part, part.object is None, extras(part))


def extras(part: Part) -> dict[str, Any]:
    """Return the metadata of an object. The rest of the room has no metadata."""
    one = part.object
    if one is None:
        return {}
    return {
        "id": one.id,
        "class": one.class_name,
        "label_space": label_space_of(part.mesh.classes),
        "probability": one.probability,
        "confidence": one.confidence,
        "exists": one.existence,
    }


def _unit(normals: Float32) -> Float32:
    """Replace zero normals (V, 3) by (0, 1, 0), because glTF forbids zero normals."""
    return np.where(np.abs(normals).max(axis=1, keepdims=True) > 0.1, normals, np.array([0, 1, 0], np.float32))


def _shorts(colors: UInt8) -> UInt16:
    """Convert sRGB colors (V, 3) to linear 16-bit RGBA colors (V, 4)."""
    full = np.full((len(colors), 4), np.iinfo(np.uint16).max, np.uint16)
    full[:, :3] = np.rint(linear(colors) * np.float32(np.iinfo(np.uint16).max))
    return full


def _with_materials(tree: dict[str, Any], lit: bool, one_sided: set[str]) -> None:
    """Add vertex colors and materials to the meshes of a glTF tree."""
    plain: dict[str, Any] = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9}}
    if not lit:
        plain["extensions"] = {UNLIT: {}}
    used: dict[str, dict[str, Any]] = {}
    for mesh in tree.get("meshes", []):
        kind = "room" if mesh["name"] in one_sided else "object"
        used.setdefault(kind, {"name": kind, **plain, "doubleSided": kind == "object"})
        for primitive in mesh["primitives"]:
            primitive["material"] = list(used).index(kind)
            attributes = primitive["attributes"]
            attributes["COLOR_0"] = attributes.pop(COLOR)
            accessor = tree["accessors"][attributes["COLOR_0"]]
            assert accessor["componentType"] == UNSIGNED_SHORT
            accessor["normalized"] = True
    if used:
        tree["materials"] = list(used.values())
        if not lit:
            tree["extensionsUsed"] = [UNLIT]

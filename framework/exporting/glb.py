"""Binary glTF 2.0: a node for each object, with what is known of it in `extras`, and one for the rest of the room.

glTF has y up. Colours are linear and unlit (KHR_materials_unlit), as a photograph has its light in it; those that tell
objects or classes are lit. The rest of the room shows its front only, so that one looks into it from outside.
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

T_GLTF_ROOM = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
COLOR = "_LINEAR"  # as trimesh gets the colours, whose own have 8 bits: too few for dark ones that are linear
UNLIT = "KHR_materials_unlit"
UNSIGNED_SHORT = 5123


@dataclass(frozen=True)
class Node:
    """A named surface of V vertices and F triangles; without triangles it is a node without a mesh."""

    name: str  # each another one
    vertices: Float32  # (V, 3) m, in the node's frame
    triangles: Int32  # (F, 3)
    colors: UInt8  # (V, 3) sRGB
    T_gltf_node: Float64  # (4, 4)
    one_sided: bool  # seen from its front only
    extras: Mapping[str, Any]
    attributes: Mapping[str, Float32] = field(default_factory=dict)  # (V,) by name, which begins with _


def glb(shown: Sequence[Part], coloring: Coloring = Coloring.APPEARANCE) -> bytes:
    """Parts of a room as a GLB file, each where it stands in the room. The same parts give the same bytes."""
    return glb_of(
        [_node(part, colors) for part, colors in zip(shown, part_colors(shown, coloring), strict=True)],
        lit=coloring is not Coloring.APPEARANCE,
    )


def glb_of(nodes: Sequence[Node], lit: bool) -> bytes:
    """Nodes as a GLB file; the same nodes give the same bytes. Light falls on them where they are `lit`."""
    scene: Any = trimesh.Scene(base_frame="world")
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
    """A part with y up in its own frame, too, as who loads an object by itself expects it."""
    vertices = (part.mesh.vertices @ T_GLTF_ROOM[:3, :3].T).astype(np.float32)
    T_gltf_part = T_GLTF_ROOM @ part.T_room_part @ T_GLTF_ROOM.T
    return Node(part.name, vertices, part.mesh.triangles, colors, T_gltf_part, part.object is None, extras(part))


def extras(part: Part) -> dict[str, Any]:
    """What a node says of an object; nothing of the rest of the room."""
    one = part.object
    if one is None:
        return {}
    return {"id": one.id, "class": one.class_name, "probability": one.probability, "confidence": one.confidence}


def _unit(normals: Float32) -> Float32:
    """(V, 3) with something for vertices whose triangles have no area: glTF knows no normals of length 0."""
    return np.where(np.abs(normals).max(axis=1, keepdims=True) > 0.1, normals, np.array([0, 1, 0], np.float32))


def _shorts(colors: UInt8) -> UInt16:
    """(V, 4) linear RGBA in 16 bits."""
    full = np.full((len(colors), 4), np.iinfo(np.uint16).max, np.uint16)
    full[:, :3] = np.rint(linear(colors) * np.float32(np.iinfo(np.uint16).max))
    return full


def _with_materials(tree: dict[str, Any], lit: bool, one_sided: set[str]) -> None:
    """Has the vertices' colours be colours, and gives the meshes their materials."""
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

"""Meshes cut out of a map's mesh, and put together again."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from framework.data import Bool, InstanceMesh


def submesh(mesh: InstanceMesh, kept: Bool, triangles: Bool | None = None) -> InstanceMesh:
    """The vertices (V,) that are kept, and of the triangles (F,), None = all, those between them."""
    number = np.cumsum(kept, dtype=np.int32) - 1
    chosen = kept[mesh.triangles].all(axis=1) if triangles is None else triangles
    return InstanceMesh(
        mesh.vertices[kept],
        number[mesh.triangles[chosen]].astype(np.int32),
        mesh.colors[kept],
        mesh.instance_ids[kept],
        mesh.class_ids[kept],
        mesh.classes,
    )


def corners_of(mesh: InstanceMesh, triangles: Bool) -> Bool:
    """(V,) the vertices of the triangles (F,)."""
    used = np.zeros(len(mesh.vertices), np.bool_)
    used[mesh.triangles[triangles]] = True
    return used


def joined(meshes: Sequence[InstanceMesh]) -> InstanceMesh:
    """Meshes of one map, at least one, as one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return InstanceMesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.triangles + start for mesh, start in zip(meshes, starts, strict=True)]).astype(np.int32),
        np.concatenate([mesh.colors for mesh in meshes]),
        np.concatenate([mesh.instance_ids for mesh in meshes]),
        np.concatenate([mesh.class_ids for mesh in meshes]),
        meshes[0].classes,
    )

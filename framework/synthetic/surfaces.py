"""Triangle arrays of a furnished room."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from framework.data import Bool, Float32, Float64, Int32
from framework.synthetic.furniture.piece import Furniture
from framework.synthetic.paints import DARK, Material, material_table


@dataclass(frozen=True)
class Surfaces:
    """Exact geometry of a room, with materials and instance ids."""

    vertices: Float32  # (V, 3) m, world frame
    normals: Float32  # (V, 3) unit vectors, smoothed over each part
    texture: Float32  # (V, 3) m, texture coordinates
    triangles: Int32  # (F, 3) vertex indices
    instance_ids: Int32  # (F,), 0 = floor, wall or ceiling
    materials: Int32  # (F,) rows of material_table
    parts: Int32  # (F,) index of each triangle's part; edges between parts are antialiased
    material_table: Float32  # (M, 14), see paints.material_table
    class_names: Mapping[int, str | None]  # instance id -> COCO class; None = clutter

    @property
    def unreadable(self) -> Bool:
        """Mask (F,) of the triangles without depth readings, such as glossy screens and window panes."""
        return np.asarray(self.material_table[self.materials, DARK] >= 1)


def assemble(objects: Iterable[tuple[int, Furniture]]) -> Surfaces:
    """Combine objects in their final poses, given as pairs of instance id and object."""
    vertices: list[Float64] = []
    normals: list[Float64] = []
    texture: list[Float64] = []
    triangles: list[Int32] = []
    ids: list[npt.NDArray[np.int64]] = []
    materials: list[npt.NDArray[np.int64]] = []
    parts: list[npt.NDArray[np.int64]] = []
    rows: dict[Material, int] = {}
    class_names: dict[int, str | None] = {}
    count = 0
    for instance, piece in objects:
        if instance:
            class_names[instance] = piece.class_name
        for solid, material in piece.parts:
            faces = len(solid.triangles)
            vertices.append(solid.vertices)
            normals.append(solid.normals)
            texture.append(solid.texture)
            triangles.append(solid.triangles + count)
            ids.append(np.full(faces, instance))
            materials.append(np.full(faces, rows.setdefault(material, len(rows))))
            parts.append(np.full(faces, len(parts)))
            count += len(solid.vertices)
    return Surfaces(
        vertices=np.concatenate(vertices).astype(np.float32),
        normals=np.concatenate(normals).astype(np.float32),
        texture=np.concatenate(texture).astype(np.float32),
        triangles=np.concatenate(triangles).astype(np.int32),
        instance_ids=np.concatenate(ids).astype(np.int32),
        materials=np.concatenate(materials).astype(np.int32),
        parts=np.concatenate(parts).astype(np.int32),
        material_table=material_table(list(rows)),
        class_names=class_names,
    )

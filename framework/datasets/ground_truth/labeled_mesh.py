"""Ground-truth meshes with an instance id for each vertex."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from framework.data import (
    AnnotatedObjects,
    Camera,
    DeferredTruth,
    Float32,
    Float64,
    FrameTruth,
    Int32,
    SceneTruth,
    Structure,
    UInt8,
)
from framework.errors import NoPoseError
from framework.files.hashing import add_array, path_hash
from framework.rendering import rasterizer
from framework.rendering.rasterizer import Rasterizer


@dataclass(frozen=True)
class LabeledMesh:
    """A ground-truth mesh with an instance id for each vertex."""

    vertices: Float32  # (V, 3) m, world frame
    triangles: Int32  # (F, 3) vertex indices
    instance_ids: Int32  # (V,), 0 = no instance
    class_names: Mapping[int, str | None]  # by instance id; None = unknown class, not evaluated
    classes: tuple[str, ...] | None = None  # all annotated classes; None = unknown
    annotated: AnnotatedObjects | None = None  # None = class_names are the names of the annotation

    def scene_truth(self) -> SceneTruth:
        """Return the vertices as ground-truth points."""
        return SceneTruth(
            self.vertices,
            self.instance_ids,
            dict(self.class_names),
            self.classes,
            annotated=self.annotated,
            structure=None if self.annotated is None else _annotated_structure(self.annotated),
        )

    def seen_by(self, camera: Camera, T_world_camera: Float64) -> FrameTruth:
        """Return the ground truth of a view, rendered on demand.

        Each pixel has the instance id of the nearest vertex of its triangle.

        Args:
            camera: The camera of the view.
            T_world_camera: The pose (4, 4) of the view.
        """
        return DeferredTruth(
            render=lambda: self._rasterizer.draw(camera, T_world_camera).nearest(self.triangles, self.instance_ids),
            shape=camera.shape,
            class_names=self.class_names,
            origin=f"{self._fingerprint} {camera!r} {T_world_camera.tobytes().hex()}",
        )

    @cached_property
    def _rasterizer(self) -> Rasterizer:
        return Rasterizer(self.vertices, self.triangles)

    @cached_property
    def _fingerprint(self) -> str:
        """SHA-256 hash of the mesh and the rendering code."""
        digest = hashlib.sha256()
        for array in (self.vertices, self.triangles, self.instance_ids):
            add_array(digest, array)
        for source in (__file__, rasterizer.__file__):
            digest.update(path_hash(Path(source)).encode())
        return digest.hexdigest()


def _annotated_structure(annotated: AnnotatedObjects) -> UInt8 | None:
    """Return the `Structure` (V,) of annotated floors, walls and ceilings, or None if there are none."""
    structure = np.zeros(len(annotated.instance_ids), np.uint8)
    for kind in (Structure.FLOOR, Structure.WALL, Structure.CEILING):
        ids = [key for key, name in annotated.own_names.items() if name is not None and name.upper() == kind.name]
        structure[np.isin(annotated.instance_ids, ids)] = kind
    return structure if structure.any() else None


def unseen(camera: Camera, why: str) -> FrameTruth:
    """Return a placeholder for the ground truth of a frame without a pose.

    Accessing the instance ids raises NoPoseError with the message `why`.
    """

    def render() -> Int32:
        raise NoPoseError(why)

    return DeferredTruth(render, camera.shape, class_names={}, origin=why)

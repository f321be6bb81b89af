"""A mesh whose vertices are labelled with the true instances, as data sets of scanned rooms publish them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from framework.data import Camera, DeferredTruth, Float32, Float64, FrameTruth, Int32, SceneTruth
from framework.files.hashing import add_array, path_hash
from framework.rendering import rasterizer
from framework.rendering.rasterizer import Rasterizer


@dataclass(frozen=True)
class LabeledMesh:
    """The true surface of a scene and the instances on it."""

    vertices: Float32  # (V, 3) m, world
    triangles: Int32  # (F, 3)
    instance_ids: Int32  # (V,), 0 = no instance
    class_names: Mapping[int, str | None]  # as in FrameTruth
    classes: tuple[str, ...] | None = None  # as in SceneTruth

    def scene_truth(self) -> SceneTruth:
        """The vertices as points: all of them, whatever frames of the video are chosen."""
        return SceneTruth(self.vertices, self.instance_ids, dict(self.class_names), self.classes)

    def seen_by(self, camera: Camera, T_world_camera: Float64) -> FrameTruth:
        """The instances that `camera` would see, rendered when they are asked for.

        They are those of the mesh's vertices nearest to what the pixels meet.
        """
        return DeferredTruth(
            render=lambda: self._drawn(camera, T_world_camera),
            shape=camera.shape,
            class_names=self.class_names,
            origin=f"{self._fingerprint} {camera!r} {T_world_camera.tobytes().hex()}",
        )

    def _drawn(self, camera: Camera, T_world_camera: Float64) -> Int32:
        return self._rasterizer.draw(camera, T_world_camera).nearest(self.triangles, self.instance_ids)

    @cached_property
    def _rasterizer(self) -> Rasterizer:
        return Rasterizer(self.vertices, self.triangles)

    @cached_property
    def _fingerprint(self) -> str:
        """SHA-256 (hex) of what is rendered, and of the code that does."""
        digest = hashlib.sha256()
        for array in (self.vertices, self.triangles, self.instance_ids):
            add_array(digest, array)
        for source in (__file__, rasterizer.__file__):
            digest.update(path_hash(Path(source)).encode())
        return digest.hexdigest()

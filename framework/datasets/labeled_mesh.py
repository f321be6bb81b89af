"""A mesh whose vertices are labelled with the true instances, as data sets of scanned rooms publish them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from framework.data import Camera, Float32, Float64, FrameTruth, Int32, SceneTruth
from framework.synthetic.ray_caster import NO_TRIANGLE, RayCaster, image_rays


@dataclass(frozen=True)
class LabeledMesh:
    """The true surface of a scene and the instances on it."""

    vertices: Float32  # (V, 3) m, world
    triangles: Int32  # (F, 3)
    instance_ids: Int32  # (V,), 0 = no instance
    class_names: Mapping[int, str | None]  # as in FrameTruth

    def scene_truth(self) -> SceneTruth:
        """The vertices as points: all of them, whatever frames of the video are chosen."""
        return SceneTruth(self.vertices, self.instance_ids, dict(self.class_names))

    def seen_by(self, camera: Camera, T_world_camera: Float64) -> FrameTruth:
        """The instances that `camera` would see, by ray-casting: those of the mesh's vertices nearest to the hits."""
        hits = self._caster.cast(image_rays(camera, T_world_camera))
        met = hits.triangle != NO_TRIANGLE
        u, v = hits.uv[met].T
        corner = np.stack([1 - u - v, u, v], axis=1).argmax(axis=1)
        ids = np.zeros(camera.shape, np.int32)
        ids[met] = self.instance_ids[self.triangles[hits.triangle[met], corner]]
        return FrameTruth(ids, self.class_names)

    @cached_property
    def _caster(self) -> RayCaster:
        return RayCaster(self.vertices, self.triangles)

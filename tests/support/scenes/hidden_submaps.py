"""Hidden submaps that are exact scenes."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from framework.data import Camera, Frame, SurfaceView
from framework.geometry import inverse
from framework.interfaces import SubmapSurfaces
from framework.tracking.pyramid import normals_of

FrameAt = Callable[[np.ndarray, Camera], Frame]  # renders a frame from a pose (4, 4) in the scene


@dataclass
class HiddenSubmaps(SubmapSurfaces):
    """Hidden submaps that show one scene each."""

    scenes: dict[int, tuple[FrameAt, np.ndarray]]  # each scene and T_world_scene (4, 4), by submap

    def hidden_surfaces(self) -> HiddenSubmaps:
        return self

    def render(
        self, camera: Camera, T_world_camera: np.ndarray, submaps: Collection[int], depth: np.ndarray | None = None
    ) -> SurfaceView:
        """Return the nearest surface of the submaps."""
        nearest = np.zeros(camera.shape, np.float32)
        normals, color = np.zeros((*camera.shape, 3), np.float32), np.zeros((*camera.shape, 3), np.uint8)
        for number in sorted(self.scenes.keys() & set(submaps)):
            frame_at, T_world_scene = self.scenes[number]
            frame = frame_at(inverse(T_world_scene) @ T_world_camera, camera)
            mapped = (frame.depth > 0) & ((nearest == 0) | (frame.depth < nearest))
            nearest[mapped], color[mapped] = frame.depth[mapped], frame.color[mapped]
            normals[mapped] = (normals_of(frame) @ T_world_camera[:3, :3].T)[mapped]
        return SurfaceView(camera, T_world_camera, nearest, normals, color)

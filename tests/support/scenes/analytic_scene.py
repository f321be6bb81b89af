"""Scene of planes and spheres, rendered exactly."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from framework.data import Camera, Frame, FrameTruth, PointClusters

CAMERA = Camera(160, 120, 131.0, 131.0, 79.5, 59.5)


NOTHING = PointClusters(  # a frame without detections
    np.zeros((0, 3), np.float32),
    np.zeros((0, 2), np.int32),
    np.zeros(0, np.int32),
    np.zeros((0, 1), np.float32),
    np.zeros(0, np.float32),
    ("chair",),
)


@dataclass
class Scene:
    """Planes n . x = d (m), with n toward the camera, and spheres. Surfaces are numbered from 1."""

    planes: list[tuple[np.ndarray, float]] = field(default_factory=list)
    spheres: list[tuple[np.ndarray, float]] = field(default_factory=list)
    contrast: float = 0.5  # contrast of the texture, in [0, 1]

    def render(self, camera: Camera, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return depth (H, W), m, color (H, W, 3), and the surface number (H, W), 0 = nothing."""
        v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
        directions = rays @ T_world_camera[:3, :3].T
        origin = T_world_camera[:3, 3]
        depth = np.full(camera.shape, np.inf)
        surface = np.zeros(camera.shape, np.int32)
        for k, (n, d) in enumerate(self.planes, start=1):
            with np.errstate(divide="ignore", invalid="ignore"):
                z = (d - origin @ n) / (directions @ n)
            hit = (z > 0) & (z < depth)
            depth[hit], surface[hit] = z[hit], k
        for k, (center, radius) in enumerate(self.spheres, start=1 + len(self.planes)):
            a = (directions**2).sum(-1)
            b = directions @ (origin - center)
            c = ((origin - center) ** 2).sum() - radius**2
            root = b**2 - a * c
            with np.errstate(invalid="ignore"):
                z = (-b - np.sqrt(root)) / a
            hit = (root > 0) & (z > 0) & (z < depth)
            depth[hit], surface[hit] = z[hit], k
        points = origin + directions * np.where(np.isfinite(depth), depth, 0)[..., None]
        color = self._texture(points)
        return np.where(np.isfinite(depth), depth, 0).astype(np.float32), color, surface

    def _texture(self, points: np.ndarray) -> np.ndarray:
        """Return a solid texture of a few wavelengths, so that a point has the same color in all views."""
        x, y, z = (points[..., i] for i in range(3))
        waves = [
            np.sin(7 * x + 3 * y) + np.sin(11 * z - 5 * x + 1) + np.sin(17 * y + 4 * z),
            np.sin(9 * y - 2 * z) + np.sin(13 * x + 2) + np.sin(6 * z + 8 * y),
            np.sin(8 * z + 5 * x) + np.sin(10 * y - 7 * x) + np.sin(15 * z + 3),
        ]
        return np.clip(127.5 + self.contrast * 42 * np.stack(waves, axis=-1), 0, 255).astype(np.uint8)

    def frame(
        self, T_world_camera: np.ndarray, index: int = 0, camera: Camera = CAMERA, class_name: str = "chair"
    ) -> Frame:
        """Return the scene as a frame. Spheres are instances, and planes are background."""
        depth, color, surface = self.render(camera, T_world_camera)
        instance_ids = np.where(surface > len(self.planes), surface - len(self.planes), 0).astype(np.int32)
        names = dict.fromkeys(range(1, len(self.spheres) + 1), class_name)
        return Frame(index, index / 30, color, depth, camera, T_world_camera, FrameTruth(instance_ids, names))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distances (P,), m, of points (P, 3), m, to the nearest surface."""
        distances = [np.abs(points @ n - d) for n, d in self.planes]
        distances += [np.abs(np.linalg.norm(points - center, axis=1) - radius) for center, radius in self.spheres]
        return np.min(distances, axis=0)


def room() -> Scene:
    """Return a room corner with three spheres. All camera motions are determined by the geometry."""
    return Scene(
        planes=[
            (np.array([0.0, 0.0, -1.0]), -2.5),
            (np.array([0.0, -1.0, 0.0]), -1.0),
            (np.array([1.0, 0.0, 0.0]), -1.6),
            (np.array([-0.8, 0.0, -0.6]), -2.1),
        ],
        spheres=[
            (np.array([-0.5, 0.6, 2.0]), 0.4),
            (np.array([0.5, 0.7, 1.8]), 0.3),
            (np.array([0.1, 0.2, 2.3]), 0.35),
        ],
    )


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, rotvec: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """Return T_world_camera from a position (m) and a rotation vector (rad)."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    T[:3, 3] = (x, y, z)
    return T


def walk(frames: int) -> list[np.ndarray]:
    """Return the poses of a smooth hand-held motion with steps of about 10 mm and 0.5 degrees."""
    t = np.linspace(0, 1, frames) * frames / 60
    return [
        pose(
            0.25 * np.sin(2 * s),
            0.1 * np.sin(3 * s),
            0.15 * (1 - np.cos(2 * s)),
            (0.08 * np.sin(2.5 * s), 0.2 * np.sin(1.5 * s), 0),
        )
        for s in t
    ]

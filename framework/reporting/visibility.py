"""Visibility of a decimated map along a trajectory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from framework.data import Bool, Camera, Float32, Float64, InstanceMesh, Int32
from framework.geometry import inverse
from framework.rendering.rasterizer import Rasterizer

RENDERED_POSES = 80  # maximum number of poses at which the map is rendered
LOOK_WIDTH = 200  # px, width of the rendered images
TOLERANCE, TOLERANCE_PER_DEPTH = (
    0.05,
    0.03,
)  # m, and m per m of depth; a vertex that is farther behind the rendered surface is hidden
NOT_CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)  # nominal Kinect, used if the camera is unknown


@dataclass(frozen=True)
class Sightings:
    """Visibility of a mesh with V vertices from n poses."""

    chosen: list[int]  # indices of the n poses in the trajectory
    first_seen: Int32  # (V,) index into `chosen` of the first pose with a view of each vertex; n = never visible
    best: Mapping[int, int]  # index of the pose with the best view, by label; labels without a view are missing

    @property
    def growth(self) -> Float64:
        """Fraction (n,) of the visible vertices that were seen up to each pose, in [0, 1]."""
        counts = np.bincount(self.first_seen, minlength=len(self.chosen) + 1)[: len(self.chosen)]
        return np.asarray(np.cumsum(counts) / max(1, int(counts.sum())))


def spread_out(count: int, most: int = RENDERED_POSES) -> list[int]:
    """Return at most `most` evenly spaced indices of `count` poses, including the first and the last."""
    return np.unique(np.rint(np.linspace(0, count - 1, min(count, most))).astype(int)).tolist() if count else []


def sightings(
    mesh: InstanceMesh, labels: Int32, poses: Float64, camera: Camera, clarity: Mapping[int, float]
) -> Sightings:
    """Return the visibility of a mesh from at most RENDERED_POSES evenly spaced poses.

    Args:
        mesh: Mesh of the map.
        labels: Object labels (V,) of the vertices, 0 = none.
        poses: Camera poses (P, 4, 4) of the trajectory.
        camera: Camera of the sequence.
        clarity: Sharpness of the image in [0, 1], by index of the pose; 1 if missing.
    """
    chosen = spread_out(len(poses))
    small = camera.scaled(LOOK_WIDTH / camera.width)
    rasterizer = Rasterizer(mesh.vertices, mesh.triangles)
    first_seen = np.full(len(mesh.vertices), len(chosen), np.int32)
    ids = np.union1d(labels, [0])
    indices = np.searchsorted(ids, labels).astype(np.int32)  # ids may be arbitrarily large
    sizes = np.bincount(indices, minlength=len(ids))
    best_scores = np.zeros(len(sizes))
    best = np.full(len(sizes), -1)
    for step, k in enumerate(chosen):
        buffer = rasterizer.draw(small, poses[k])
        inside, visible = _seen(mesh.vertices, poses[k], small, buffer.depth)
        first_seen[visible & (first_seen == len(chosen))] = step
        pixels = np.bincount(buffer.nearest(mesh.triangles, indices).ravel(), minlength=len(sizes))
        whole = np.bincount(indices[inside], minlength=len(sizes)) / np.maximum(sizes, 1)
        # prefer complete objects over large ones
        scores = clarity.get(k, 1.0) * np.sqrt(pixels) * whole**2
        better = scores > best_scores
        best[better], best_scores[better] = k, scores[better]
    seen = {int(key): int(k) for key, k in zip(ids, best, strict=True) if key != 0 and k >= 0}
    return Sightings(chosen, first_seen, seen)


def _seen(vertices: Float32, T_world_camera: Float64, camera: Camera, depth: Float32) -> tuple[Bool, Bool]:
    """Return the mask (V,) of the vertices inside the image, and the mask (V,) of the visible vertices.

    Args:
        vertices: Vertices (V, 3) in the world frame, m.
        T_world_camera: Camera pose (4, 4).
        camera: Camera of the depth image.
        depth: Depth image (H, W) along z, m; 0 = no surface.
    """
    T_camera_world = inverse(T_world_camera).astype(np.float32)
    x, y, z = T_camera_world[:3, :3] @ vertices.T + T_camera_world[:3, 3:]
    ahead = np.maximum(z, 1e-6)
    u, v = np.rint(camera.fx * x / ahead + camera.cx), np.rint(camera.fy * y / ahead + camera.cy)
    inside = (z > 1e-3) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    visible = np.zeros(len(vertices), np.bool_)
    # because of rounding, a vertex at the border of the surface may be projected to a pixel without a surface
    bordered = np.where(depth > 0, depth, cv2.dilate(depth, np.ones((3, 3), np.uint8)))
    seen = bordered[v[inside].astype(int), u[inside].astype(int)]
    visible[inside] = z[inside] < seen + TOLERANCE + TOLERANCE_PER_DEPTH * seen
    return inside, visible

"""What the cameras of a trajectory saw of a light map: when each place first, and which of them each object best."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from framework.data import Bool, Camera, Float32, Float64, InstanceMesh, Int32
from framework.geometry import inverse
from framework.rendering.rasterizer import Rasterizer

LOOKS = 80  # poses of a trajectory that are looked from: two or three a second of a short video
LOOK_WIDTH = 200  # px, of the pictures that sightings are judged by
BEHIND = 0.05  # m + 3% of the depth: what lies farther behind what a pixel shows is hidden
BEHIND_SHARE = 0.03
NOT_CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)  # of a Kinect, where the recording's is not known


@dataclass(frozen=True)
class Sightings:
    """What of a mesh with V vertices was seen from n poses of the trajectory."""

    chosen: list[int]  # the poses
    first_seen: Int32  # (V,) which of `chosen`; n = from none of them
    best: Mapping[int, int]  # label -> the pose that sees it best; labels that none sees are not in it

    @property
    def growth(self) -> Float64:
        """(n,) the share of the seen vertices that were seen until each pose, with it."""
        counts = np.bincount(self.first_seen, minlength=len(self.chosen) + 1)[: len(self.chosen)]
        return np.asarray(np.cumsum(counts) / max(1, counts.sum()))


def spread_out(count: int, most: int = LOOKS) -> list[int]:
    """At most so many of `count` poses, the first and the last among them, as evenly as can be."""
    return np.unique(np.rint(np.linspace(0, count - 1, min(count, most))).astype(int)).tolist() if count else []


def sightings(
    mesh: InstanceMesh, labels: Int32, poses: Float64, camera: Camera, clarity: Mapping[int, float]
) -> Sightings:
    """What the poses (P, 4, 4) saw of a mesh, by looking from some of them again.

    Args:
        labels: (V,) of the vertices, 0 = none.
        camera: that of the video.
        clarity: how sharp the picture from a pose is, in [0, 1]; 1 where it is not in it.
    """
    chosen = spread_out(len(poses))
    small = camera.scaled(LOOK_WIDTH / camera.width)
    rasterizer = Rasterizer(mesh.vertices, mesh.triangles)
    first_seen = np.full(len(mesh.vertices), len(chosen), np.int32)
    ids = np.union1d(labels, [0])
    places = np.searchsorted(ids, labels).astype(np.int32)  # ids may be any numbers
    sizes = np.bincount(places, minlength=len(ids))
    best_scores = np.zeros(len(sizes))
    best = np.full(len(sizes), -1)
    for step, k in enumerate(chosen):
        buffer = rasterizer.draw(small, poses[k])
        inside, visible = _seen(mesh.vertices, poses[k], small, buffer.depth)
        first_seen[visible & (first_seen == len(chosen))] = step
        pixels = np.bincount(buffer.nearest(mesh.triangles, places).ravel(), minlength=len(sizes))
        whole = np.bincount(places[inside], minlength=len(sizes)) / np.maximum(sizes, 1)
        # a picture whose border cuts an object off tells less of it, and twice as large is not twice as good
        scores = clarity.get(k, 1.0) * np.sqrt(pixels) * whole**2
        better = scores > best_scores
        best[better], best_scores[better] = k, scores[better]
    seen = {int(key): int(k) for key, k in zip(ids, best, strict=True) if key != 0 and k >= 0}
    return Sightings(chosen, first_seen, seen)


def _seen(vertices: Float32, T_world_camera: Float64, camera: Camera, depth: Float32) -> tuple[Bool, Bool]:
    """(V,) which vertices lie in a picture, and which of them are seen, given its depth (H, W) m."""
    T_camera_world = inverse(T_world_camera).astype(np.float32)
    x, y, z = T_camera_world[:3, :3] @ vertices.T + T_camera_world[:3, 3:]
    ahead = np.maximum(z, 1e-6)
    u, v = np.rint(camera.fx * x / ahead + camera.cx), np.rint(camera.fy * y / ahead + camera.cy)
    inside = (z > 1e-3) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    visible = np.zeros(len(vertices), np.bool_)
    # a vertex on the surface's border may be rounded to beside it
    bordered = np.where(depth > 0, depth, cv2.dilate(depth, np.ones((3, 3), np.uint8)))
    seen = bordered[v[inside].astype(int), u[inside].astype(int)]
    visible[inside] = z[inside] < seen + BEHIND + BEHIND_SHARE * seen
    return inside, visible

"""Ray casting with Open3D (Embree)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from numba import get_num_threads

from framework.data import Array, Bool, Camera, Float32, Float64, Int32

if TYPE_CHECKING:
    import open3d as o3d

Numbers = npt.NDArray[np.floating] | npt.NDArray[np.integer]


@dataclass(frozen=True)
class RayHits:
    """First intersections of rays with surfaces.

    The leading dimensions are those of the rays.
    """

    distance: Float32  # in units of the length of the ray's direction vector, inf = no intersection
    triangle: Int32  # NO_TRIANGLE = no intersection
    uv: Float32  # (..., 2) barycentric weights of the second and third vertex of the triangle


class RayCaster:
    """A thread-safe ray caster for a triangle mesh, with deterministic results."""

    def __init__(self, vertices: Float32, triangles: Int32) -> None:
        import open3d as o3d

        # Embree's tree is built in one thread, so that the choice between equally distant triangles is deterministic
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(
            _tensor(np.ascontiguousarray(vertices, np.float32)), _tensor(np.ascontiguousarray(triangles, np.uint32))
        )

    def cast(self, rays: Float32) -> RayHits:
        """Return the first intersections of rays (..., 6), each with origin (m) and direction."""
        answer = self._scene.cast_rays(_tensor(np.ascontiguousarray(rays)), get_num_threads())
        triangle = answer["primitive_ids"].numpy().view(np.int32)  # Embree's invalid id 2^32 - 1 becomes -1
        return RayHits(answer["t_hit"].numpy(), triangle, answer["primitive_uvs"].numpy())

    def occluded(self, origins: Float32, ends: Float32) -> Bool:
        """Return True for each pair of points (..., 3), m, with a surface between them.

        Surfaces at the points themselves are ignored.
        """
        rays = np.concatenate([origins, ends - origins], axis=-1).astype(np.float32)
        return np.asarray(self._scene.test_occlusions(_tensor(rays), 1e-3, 0.999, get_num_threads()).numpy())


def _tensor(array: Array) -> o3d.core.Tensor:
    import open3d as o3d

    return o3d.core.Tensor.from_numpy(array)


def pixel_rays(camera: Camera, T_world_camera: Float64, u: Numbers, v: Numbers) -> Float32:
    """Return the rays (A, B, 6) in the world frame through image points.

    Directions have length 1 along the optical axis, so that the distance of an intersection is its depth.

    Args:
        camera: The camera.
        T_world_camera: The pose (4, 4).
        u: The horizontal coordinates, px, which can be broadcast to (A, B).
        v: The vertical coordinates, px, which can be broadcast to (A, B).
    """
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    rays = np.empty((*np.broadcast_shapes(x.shape, y.shape), 6), np.float32)
    # without BLAS, because its rounding may depend on the number of threads
    for axis, (to_right, down, ahead, at) in enumerate(T_world_camera[:3]):
        rays[..., axis] = at
        rays[..., 3 + axis] = to_right * x + (down * y + ahead)
    return rays


def image_rays(camera: Camera, T_world_camera: Float64) -> Float32:
    """Return the rays (H, W, 6) in the world frame through all pixel centers."""
    return pixel_rays(camera, T_world_camera, np.arange(camera.width)[None, :], np.arange(camera.height)[:, None])

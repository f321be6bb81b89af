"""Pictures of a triangle surface by Embree ray-casting: no window system, no OpenGL."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d

from framework.data import Bool, Camera, Float32, Float64, Int32

OCCLUSION_RANGE_M = 0.35  # what is nearer than this to a point takes light from it
OCCLUSION_START_M = np.float32(2e-3)  # in front of the surface, so that it does not shade itself
OCCLUSION_RAYS = 8  # per pixel; neighbours in tiles of 4x4 pixels look elsewhere, and the tile is averaged
OCCLUSION_TILE = 4  # px
OCCLUSION_DEPTH = 0.75  # how dark a point gets that is closed in on all sides


VOTES = 20000  # triangles that are asked which of their sides was seen
VOTERS = 50  # cameras that are asked


@dataclass(frozen=True)
class Hits:
    """What each pixel sees of a surface."""

    depth: Float32  # (H, W) m along z, 0 = nothing
    points_world: Float32  # (H, W, 3) m
    vertices: Int32  # (H, W, 3) the corners of the triangle that was hit; 0 where nothing was
    weights: Float32  # (H, W, 3) barycentric

    @property
    def seen(self) -> Bool:
        """(H, W)."""
        return np.asarray(self.depth > 0)

    def every(self, n: int) -> Hits:
        """The picture of each n-th pixel."""
        return Hits(self.depth[::n, ::n], self.points_world[::n, ::n], self.vertices[::n, ::n], self.weights[::n, ::n])

    def interpolated(self, values: Float32) -> Float32:
        """(H, W, C) of values (V, C) at the vertices."""
        return np.asarray(np.einsum("hwk,hwkc->hwc", self.weights, values[self.vertices]), np.float32)

    def nearest(self, labels: Int32) -> Int32:
        """(H, W) the label (V,) of the nearest corner, 0 where nothing is seen."""
        corner = np.take_along_axis(self.vertices, self.weights.argmax(axis=2)[..., None], axis=2)[..., 0]
        return np.where(self.seen, labels[corner], 0).astype(np.int32)


class Surface:
    """Triangles whose winding says which side is the front: the side that was seen."""

    def __init__(self, vertices: Float32, triangles: Int32) -> None:
        self.vertices = vertices  # (V, 3) m
        self.triangles = triangles  # (F, 3)
        corners = vertices[triangles]
        # (F, 3), length = twice the area, so that sums of them weigh by area
        self.face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    @classmethod
    def seen_from(cls, vertices: Float32, triangles: Int32, poses: Float64) -> Surface:
        """The surface wound so that most of what lies before the cameras at `poses` (F, 4, 4) shows them its front.

        Mesh extractors do not agree on the winding.
        """
        surface = cls(vertices, triangles)
        some = slice(None, None, max(1, len(triangles) // VOTES))
        centers = vertices[triangles[some]].mean(axis=1)
        votes = 0.0
        for T_world_camera in poses[:: max(1, len(poses) // VOTERS)]:
            rays = centers - T_world_camera[:3, 3]
            distance = np.linalg.norm(rays, axis=1)
            ahead = rays @ T_world_camera[:3, 2] > 0.8 * distance
            towards = -(surface.face_normals[some] * rays).sum(axis=1)[ahead] / np.maximum(distance[ahead], 1e-6) ** 3
            votes += float(towards.sum())
        return surface if votes >= 0 else cls(vertices, np.ascontiguousarray(triangles[:, ::-1]))

    def vertex_normals(self) -> Float32:
        """(V, 3) unit length, averaged over the triangles around each vertex by area."""
        sums = np.stack(
            [
                np.bincount(self.triangles.ravel(), np.repeat(self.face_normals[:, axis], 3), len(self.vertices))
                for axis in range(3)
            ],
            axis=1,
        )
        return np.asarray(sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12), np.float32)


class FrontSides:
    """The triangles of a surface that face an eye: not the walls and ceilings between it and the room."""

    def __init__(self, surface: Surface, eye_world: Float64) -> None:
        self.eye_world = eye_world.astype(np.float32)  # (3,) m
        rays = surface.vertices[surface.triangles[:, 0]] - self.eye_world
        self._triangles = surface.triangles[(surface.face_normals * rays).sum(axis=1) < 0]
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(surface.vertices, np.float32)),
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(self._triangles, np.uint32)),
        )

    def seen_by(self, camera: Camera, R_world_camera: Float64) -> Hits:
        """What a camera at the eye sees along each pixel's ray."""
        height, width = camera.shape
        u, v = np.meshgrid(
            np.float32((np.arange(width) - camera.cx) / camera.fx),
            np.float32((np.arange(height) - camera.cy) / camera.fy),
        )
        directions = np.stack([u, v, np.ones_like(u)], axis=-1) @ R_world_camera.T.astype(np.float32)
        rays = np.concatenate([np.broadcast_to(self.eye_world, directions.shape), directions], axis=-1)
        found = self._scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
        depth = found["t_hit"].numpy()  # the rays have z = 1 in the camera, so t is the depth
        seen = np.isfinite(depth)
        depth = np.where(seen, depth, np.float32(0))
        triangle = np.where(seen, found["primitive_ids"].numpy(), 0).astype(np.int64)
        uv = found["primitive_uvs"].numpy()
        return Hits(
            depth=depth,
            points_world=np.asarray(self.eye_world + depth[..., None] * directions, np.float32),
            vertices=self._triangles[triangle] if len(self._triangles) else np.zeros((height, width, 3), np.int32),
            weights=np.concatenate([1 - uv.sum(axis=-1, keepdims=True), uv], axis=-1),
        )

    def openness(self, hits: Hits, normals: Float32) -> Float32:
        """(H, W) in (0, 1]: how much of the light from around reaches what is seen (ambient occlusion)."""
        height, width = hits.depth.shape
        seen = hits.seen
        points, n = hits.points_world[seen], normals[seen]
        helper = np.where(np.abs(n[:, :1]) < 0.7, [[1, 0, 0]], [[0, 1, 0]]).astype(np.float32)
        tangent = np.cross(n, helper)
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
        bitangent = np.cross(n, tangent)
        v, u = np.nonzero(seen)
        tile = ((v % OCCLUSION_TILE) * OCCLUSION_TILE + u % OCCLUSION_TILE) * 7 % OCCLUSION_TILE**2
        turn = np.float32(2 * np.pi * tile / OCCLUSION_TILE**2 / OCCLUSION_RAYS)
        blocked = np.zeros(len(points), np.float32)
        for k in range(OCCLUSION_RAYS):  # directions, each for all pixels: dense around the normal, as light counts
            angle = turn + np.float32(2 * np.pi * k / OCCLUSION_RAYS)
            sine = np.float32(np.sqrt((k + 0.5) / OCCLUSION_RAYS))
            around = np.cos(angle)[:, None] * tangent + np.sin(angle)[:, None] * bitangent
            directions = sine * around + np.sqrt(1 - sine**2) * n
            rays = np.concatenate([points + OCCLUSION_START_M * n, directions], axis=1)
            blocked += self._scene.test_occlusions(o3d.core.Tensor.from_numpy(rays), 0.0, OCCLUSION_RANGE_M).numpy()
        image = np.zeros((height, width), np.float32)
        image[seen] = blocked / OCCLUSION_RAYS
        # the mean over a tile, of the pixels that see something
        mean = cv2.blur(image, (OCCLUSION_TILE, OCCLUSION_TILE))
        share = cv2.blur(seen.astype(np.float32), (OCCLUSION_TILE, OCCLUSION_TILE))
        return np.asarray(1 - OCCLUSION_DEPTH * mean / np.maximum(share, 1e-6), np.float32)

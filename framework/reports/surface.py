"""Pictures of a triangle surface by Embree ray-casting: no window system, no OpenGL."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d

from framework.data import Bool, Camera, Float32, Float64, Int32

LAYERS = 8  # back faces that a ray may pass before it counts as having hit nothing
STEP_BEHIND_M = 1e-4  # how far behind a back face its ray starts anew
OCCLUSION_RANGE_M = 0.35  # what is nearer than this to a point takes light from it
OCCLUSION_RAYS = 8  # per pixel; neighbours in tiles of 4x4 pixels look elsewhere, and the tile is averaged
OCCLUSION_TILE = 4  # px
OCCLUSION_DEPTH = 0.75  # how dark a point gets that is closed in on all sides


@dataclass(frozen=True)
class Hits:
    """What each pixel sees of a surface: its front sides only."""

    depth: Float32  # (H, W) m along z, 0 = nothing
    points_world: Float32  # (H, W, 3) m
    vertices: Int32  # (H, W, 3) the corners of the triangle that was hit; 0 where nothing was
    weights: Float32  # (H, W, 3) barycentric

    @property
    def seen(self) -> Bool:
        """(H, W)."""
        return np.asarray(self.depth > 0)

    def interpolated(self, values: Float32) -> Float32:
        """(H, W, C) of values (V, C) at the vertices."""
        return np.asarray(np.einsum("hwk,hwkc->hwc", self.weights, values[self.vertices]), np.float32)

    def nearest(self, labels: Int32) -> Int32:
        """(H, W) the label (V,) of the nearest corner, 0 where nothing is seen."""
        corner = np.take_along_axis(self.vertices, self.weights.argmax(axis=2)[..., None], axis=2)[..., 0]
        return np.where(self.seen, labels[corner], 0).astype(np.int32)


class Surface:
    """Triangles that can be looked at. Their winding says which side is the front, the side that was seen."""

    def __init__(self, vertices: Float32, triangles: Int32) -> None:
        self.vertices = vertices  # (V, 3) m
        self.triangles = triangles  # (F, 3)
        corners = vertices[triangles]
        # (F, 3), length = twice the area, so that sums of them weigh by area
        self.face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(vertices, np.float32)),
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(triangles, np.uint32)),
        )

    def facing(self, poses: Float64) -> Surface:
        """This surface, wound so that the cameras at `poses` (F, 4, 4) see its front; extractors differ in it."""
        fan = np.stack(np.meshgrid([-0.4, 0.0, 0.4], [-0.3, 0.0, 0.3], [1.0]), axis=-1).reshape(-1, 3)
        chosen = poses[:: max(1, len(poses) // 50)]
        directions = np.einsum("fij,nj->fni", chosen[:, :3, :3], fan).reshape(-1, 3)
        origins = np.repeat(chosen[:, :3, 3], len(fan), axis=0)
        found = self._cast(origins, directions)
        hit = np.isfinite(found["t_hit"])
        away = (found["primitive_normals"] * directions).sum(axis=1)[hit] > 0
        return Surface(self.vertices, self.triangles[:, ::-1]) if away.mean() > 0.5 else self

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

    def seen_by(self, camera: Camera, T_world_camera: Float64) -> Hits:
        """The nearest front side along each pixel's ray; rays pass through back sides, so walls and ceilings between
        the camera and the room do not hide it."""
        height, width = camera.shape
        u, v = np.meshgrid(
            np.float32((np.arange(width) - camera.cx) / camera.fx),
            np.float32((np.arange(height) - camera.cy) / camera.fy),
        )
        rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)  # z = 1: t is the depth
        directions = rays @ T_world_camera[:3, :3].T.astype(np.float32)
        origin = T_world_camera[:3, 3].astype(np.float32)

        depth = np.zeros(len(directions), np.float32)
        triangle = np.zeros(len(directions), np.int64)
        uv = np.zeros((len(directions), 2), np.float32)
        going = np.arange(len(directions))
        start = np.zeros(len(directions), np.float32)
        for _ in range(LAYERS):
            found = self._cast(origin + start[going, None] * directions[going], directions[going])
            hit = np.isfinite(found["t_hit"])
            front = hit & ((found["primitive_normals"] * directions[going]).sum(axis=1) < 0)
            at = start[going] + np.where(hit, found["t_hit"], 0)
            depth[going[front]] = at[front]
            triangle[going[front]] = found["primitive_ids"][front]
            uv[going[front]] = found["primitive_uvs"][front]
            behind = hit & ~front
            start[going[behind]] = at[behind] + STEP_BEHIND_M
            going = going[behind]
            if not len(going):
                break

        weights = np.stack([1 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1)
        return Hits(
            depth=depth.reshape(height, width),
            points_world=(origin + depth[:, None] * directions).reshape(height, width, 3),
            vertices=np.where(depth[:, None] > 0, self.triangles[triangle], 0).reshape(height, width, 3),
            weights=weights.reshape(height, width, 3),
        )

    def openness(self, hits: Hits, normals: Float32, eye_world: Float64) -> Float32:
        """(H, W) in (0, 1]: how much of the light around reaches what the eye (3,) m sees (ambient occlusion)."""
        height, width = hits.depth.shape
        seen = hits.seen
        points, n = hits.points_world[seen], normals[seen]
        view = points - eye_world.astype(np.float32)
        helper = np.where(np.abs(n[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]).astype(np.float32)
        tangent = np.cross(n, helper)
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
        bitangent = np.cross(n, tangent)
        v, u = np.nonzero(seen)
        tile = ((v % OCCLUSION_TILE) * OCCLUSION_TILE + u % OCCLUSION_TILE) * 7 % OCCLUSION_TILE**2
        turn = 2 * np.pi * tile / OCCLUSION_TILE**2 / OCCLUSION_RAYS
        blocked = np.zeros(len(points), np.float32)
        for k in range(OCCLUSION_RAYS):  # directions, each for all pixels: spread evenly, dense around the normal
            angle = turn + 2 * np.pi * k / OCCLUSION_RAYS
            sine = np.sqrt((k + 0.5) / OCCLUSION_RAYS)
            around = np.cos(angle)[:, None] * tangent + np.sin(angle)[:, None] * bitangent
            directions = sine * around + np.sqrt(1 - sine**2) * n
            found = self._cast(points + 2e-3 * n, directions)
            shown = (found["primitive_normals"] * view).sum(axis=1) < 0  # what is looked through casts no shade
            blocked += shown & (found["t_hit"] < OCCLUSION_RANGE_M)
        image = np.zeros((height, width), np.float32)
        image[seen] = blocked / OCCLUSION_RAYS
        # the mean over a tile, of the pixels that see something
        mean = cv2.blur(image, (OCCLUSION_TILE, OCCLUSION_TILE))
        share = cv2.blur(seen.astype(np.float32), (OCCLUSION_TILE, OCCLUSION_TILE))
        return np.asarray(1 - OCCLUSION_DEPTH * mean / np.maximum(share, 1e-6), np.float32)

    def _cast(self, origins: Float64 | Float32, directions: Float64 | Float32) -> dict[str, np.ndarray]:
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        return {
            name: tensor.numpy() for name, tensor in self._scene.cast_rays(o3d.core.Tensor.from_numpy(rays)).items()
        }

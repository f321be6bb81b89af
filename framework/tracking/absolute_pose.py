"""Camera pose from 2D-3D matches, estimated by pycolmap.

The method is P3P in LO-RANSAC with refinement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Bool, Camera, Float32, Float64
from framework.geometry import inverse, nearest_rotation, transform

COLMAP_PIXEL_CENTER = 0.5  # coordinate of the center of the first pixel in COLMAP, px; 0 in this project
REFERENCE_SIDE = 640  # longer image side for max_error, px; for larger images, max_error increases proportionally
CONFIDENCE = 0.9999  # probability that RANSAC draws a sample without outliers
MAX_DEPTH_ERROR = 0.05  # maximum depth error of an inlier, fraction of its depth


@dataclass(frozen=True)
class AbsolutePose:
    """A camera pose and its inliers."""

    T_world_camera: Float64  # (4, 4)
    inliers: Bool  # (M,) True for the inliers among the matches


@dataclass
class AbsolutePoseEstimator:
    """Deterministic estimator of the camera pose from 2D-3D matches."""

    max_error: float = 4.0  # maximum reprojection error of an inlier, px, > 0, for images of at most 640 px
    min_inliers: int = 15  # minimum number of inliers, >= 4; wrong poses have 4 to 8
    min_inlier_ratio: float = 0.25  # minimum fraction of inliers among the matches, in (0, 1]
    seed: int = 0  # random seed, >= 0

    def __post_init__(self) -> None:
        import pycolmap

        check_bounds(
            self, max_error=(1e-3, 1e3), min_inliers=(4, 100_000), min_inlier_ratio=(1e-3, 1.0), seed=(0, 2**31 - 1)
        )
        self._estimation = pycolmap.AbsolutePoseEstimationOptions()
        self._estimation.ransac.min_inlier_ratio = self.min_inlier_ratio  # limits the number of trials
        self._estimation.ransac.confidence = CONFIDENCE
        self._estimation.ransac.random_seed = self.seed
        self._refinement = pycolmap.AbsolutePoseRefinementOptions()

    def estimate(
        self, camera: Camera, pixels: Float32, points_world: Float32, depth: Float32 | None = None
    ) -> AbsolutePose | None:
        """Return the camera pose, or None if there are too few inliers.

        An inlier reprojects within `max_error` and agrees with its depth reading.

        Args:
            camera: The camera.
            pixels: The pixels (M, 2), u and v, with pixel centers at integers.
            points_world: The matching points (M, 3), m.
            depth: The depth reading (M,) at each pixel, m, 0 = none.
        """
        import pycolmap

        finite = np.isfinite(pixels).all(axis=1) & np.isfinite(points_world).all(axis=1)
        needed = max(self.min_inliers, self.min_inlier_ratio * len(pixels))
        if np.count_nonzero(finite) < needed:
            return None
        max_error = self.max_error * max(1.0, max(camera.shape) / REFERENCE_SIDE)
        self._estimation.ransac.max_error = max_error
        found = pycolmap.estimate_and_refine_absolute_pose(
            pixels[finite].astype(np.float64) + COLMAP_PIXEL_CENTER,
            points_world[finite].astype(np.float64),
            pycolmap.Camera(
                model="PINHOLE",
                width=camera.width,
                height=camera.height,
                params=[camera.fx, camera.fy, camera.cx + COLMAP_PIXEL_CENTER, camera.cy + COLMAP_PIXEL_CENTER],
            ),
            self._estimation,
            self._refinement,
        )
        if found is None:
            return None
        T_camera_world = np.eye(4)
        T_camera_world[:3] = found["cam_from_world"].matrix()
        if not np.isfinite(T_camera_world).all():
            return None
        T_camera_world[:3, :3] = nearest_rotation(T_camera_world[:3, :3])
        readings = np.zeros(len(pixels), np.float32) if depth is None else depth
        inliers = finite & self._inliers(camera, pixels, points_world, readings, T_camera_world, max_error)
        if np.count_nonzero(inliers) < needed:
            return None
        return AbsolutePose(inverse(T_camera_world), inliers)

    def _inliers(
        self,
        camera: Camera,
        pixels: Float32,
        points_world: Float32,
        depth: Float32,
        T_camera_world: Float64,
        max_error: float,
    ) -> Bool:
        """Return a Boolean array (M,), True for matches with a small reprojection error that agree with their depth."""
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            x, y, z = transform(T_camera_world, points_world.astype(np.float64)).T
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            near = np.hypot(u - pixels[:, 0], v - pixels[:, 1]) <= max_error
            confirmed = (depth == 0) | (np.abs(z - depth) <= MAX_DEPTH_ERROR * depth)
        return np.asarray(near & (z > 0) & confirmed, np.bool_)

"""Selection of a viewpoint for a map.

The view is oblique, from above, and shows many objects.
"""

from __future__ import annotations

import numpy as np

from framework.data import Camera, Float32, Float64, Int32
from framework.rendering.surface import Surface
from framework.rendering.viewpoint_kernels import draw_fronts, sum_level_normals

FIELD_OF_VIEW_RAD = np.deg2rad(32)  # vertical field of view; narrow, for a weak perspective
ELEVATIONS_RAD = np.deg2rad([38.0, 52.0])  # candidate angles of the camera above the horizontal
AZIMUTHS = 16  # number of candidate directions around the up direction
EYE_HEIGHT = 0.8  # height of virtual cameras in the map, relative to the height of the map
VIRTUAL_ELEVATIONS_RAD = np.deg2rad([10.0, 45.0])  # angles of virtual cameras below the horizontal
MARGIN = 1.04  # size of the view relative to its content
TRIAL_WIDTH, TRIAL_HEIGHT = 96, 72  # px, size of candidate images
TRIAL_POINTS = 60000  # approximate maximum number of vertices in candidate images
LEVEL_CONE_RAD = np.deg2rad(30)  # largest angle between floor normals and the mean up direction of the cameras


def surrounding_poses(vertices: Float32, up: Float64 | None = None) -> Float64:
    """Return virtual camera poses (N, 4, 4) for a map without a trajectory.

    The cameras are above the center of the map, and look slightly and steeply down in all directions.

    Args:
        vertices: The vertices (V, 3), m.
        up: The up direction (3,), a unit vector; None = the z axis.
    """
    up = np.array([0.0, 0.0, 1.0]) if up is None else up
    points = _without_strays(vertices).astype(np.float64)
    heights = points @ up
    center = (points.min(axis=0) + points.max(axis=0)) / 2
    eye = center + (heights.min() + EYE_HEIGHT * np.ptp(heights) - center @ up) * up
    side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    side /= np.linalg.norm(side)
    poses = []
    for elevation in VIRTUAL_ELEVATIONS_RAD:
        for azimuth in 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS:
            level = np.cos(azimuth) * side + np.sin(azimuth) * np.cross(up, side)
            pose = np.eye(4)
            pose[:3, :3] = looking(np.cos(elevation) * level - np.sin(elevation) * up, up)
            pose[:3, 3] = eye
            poses.append(pose)
    return np.array(poses)


def upward(poses: Float64, surface: Surface) -> Float64:
    """Return the up direction (3,), a unit vector in the world frame.

    The mean up direction of the cameras is refined with the normals of floors and table tops.

    Args:
        poses: The camera poses (F, 4, 4) of the mapped frames.
        surface: The surface of the map.
    """
    up = -poses[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    cone = LEVEL_CONE_RAD
    for _ in range(5):  # mean shift with a narrowing cone
        mean, fraction = sum_level_normals(surface.face_normals, up, np.cos(cone))
        if fraction < 0.02 or np.linalg.norm(mean) == 0:
            return np.asarray(up)
        up = mean / np.linalg.norm(mean)
        cone = max(cone / 1.5, np.deg2rad(6))
    return np.asarray(up)


def best_view(surface: Surface, instance_ids: Int32, poses: Float64, width: int, height: int) -> tuple[Camera, Float64]:
    """Return the camera and the camera pose (4, 4) with the best view of a surface.

    Candidate views look down from several directions. The best view shows many objects, preferably from a direction
    similar to those of the mapping cameras.

    Args:
        surface: The surface.
        instance_ids: The instance (V,) of each vertex, 0 = none.
        poses: The camera poses (F, 4, 4) of the mapped frames.
        width: The width of the image, px.
        height: The height of the image, px.
    """
    up = upward(poses, surface)
    forward = poses[:, :3, 2].mean(axis=0)
    forward -= (forward @ up) * up
    if np.linalg.norm(forward) < 0.1:  # the cameras looked in all directions
        forward = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    forward /= np.linalg.norm(forward)
    side = np.cross(forward, up)

    chosen = slice(None, None, max(1, len(surface.vertices) // TRIAL_POINTS))
    points, normals = surface.vertices[chosen], surface.vertex_normals[chosen]
    bulk = _without_strays(points)
    best_score, shown = -np.inf, points
    R = np.eye(3)
    for elevation in ELEVATIONS_RAD:
        for azimuth in 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS:
            level = np.cos(azimuth) * forward + np.sin(azimuth) * side
            R_trial = looking(np.cos(elevation) * level - np.sin(elevation) * up, up)
            visible = _visible(points, normals, *_framed(R_trial, bulk, TRIAL_WIDTH, TRIAL_HEIGHT))
            score = _score(instance_ids[chosen][visible])
            score *= 1 + 0.15 * np.cos(azimuth)  # prefer the direction of the cameras
            if score > best_score:
                best_score, R, shown = score, R_trial, points[visible] if len(visible) else points
    # frame only the visible points, without the ceiling and the near walls
    return fitted(R, shown, width, height)


def looking(forward: Float64, up: Float64) -> Float64:
    """Return the rotation R_world_camera (3, 3) of a camera with the given viewing direction.

    Args:
        forward: The viewing direction (3,) in the world frame.
        up: The up direction (3,) of the image in the world frame, not parallel to `forward`.
    """
    z = forward / np.linalg.norm(forward)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def fitted(R_world_camera: Float64, points_world: Float32, width: int, height: int) -> tuple[Camera, Float64]:
    """Return a camera and a camera pose (4, 4) from which all points except outliers are visible.

    Args:
        R_world_camera: The rotation (3, 3) of the camera.
        points_world: The points (P, 3), m.
        width: The width of the image, px.
        height: The height of the image, px.
    """
    return _framed(R_world_camera, _without_strays(points_world), width, height)


def _without_strays(points: Float32) -> Float32:
    """Return the points without outliers, i.e. between two percentiles along each axis."""
    low, high = np.percentile(points, [0.3, 99.7], axis=0)
    kept = points[((points >= low) & (points <= high)).all(axis=1)]
    return kept if len(kept) else points


def _framed(R_world_camera: Float64, points_world: Float32, width: int, height: int) -> tuple[Camera, Float64]:
    """Return a camera and a camera pose (4, 4) from which all points are visible."""
    focal = height / 2 / np.tan(FIELD_OF_VIEW_RAD / 2)
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    x, y, z = R_world_camera.T @ points_world.T
    # |x - x0| <= tan_x (z - z0) for all points; the extreme lines of both sides intersect at the camera
    tan_x, tan_y = width / 2 / focal / MARGIN, height / 2 / focal / MARGIN
    right, left = (x - tan_x * z).max(), (x + tan_x * z).min()
    below, above = (y - tan_y * z).max(), (y + tan_y * z).min()
    nearest = min(-(right - left) / (2 * tan_x), -(below - above) / (2 * tan_y), z.min() - 0.1)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = R_world_camera
    T_world_camera[:3, 3] = R_world_camera @ [(right + left) / 2, (below + above) / 2, nearest]
    return camera, T_world_camera


def _visible(points: Float32, normals: Float32, camera: Camera, T_world_camera: Float64) -> Int32:
    """Return the indices of the visible points: the nearest front-facing point at each pixel."""
    nearest = np.full(camera.shape, -1, np.int32)
    points, normals = (
        np.ascontiguousarray(points),
        np.ascontiguousarray(normals),
    )  # the compiled signature of the kernel requires contiguous arrays
    draw_fronts(points, normals, T_world_camera, (camera.fx, camera.fy, camera.cx, camera.cy), nearest)
    return np.asarray(nearest[nearest >= 0])


def _score(instance_ids: Int32) -> float:
    """Return the score of a view from the instances (N,) of its visible points."""
    # square roots favor many small objects over one large object
    return float(np.sqrt(np.bincount(instance_ids, minlength=1)[1:]).sum() + np.sqrt(len(instance_ids)))

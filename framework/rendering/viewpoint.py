"""Selection of a viewpoint for a map: an oblique view into the room from above, with many visible objects."""

from __future__ import annotations

import numpy as np

from framework.data import Camera, Float32, Float64, Int32
from framework.rendering.surface import Surface
from framework.rendering.viewpoint_kernels import draw_fronts, sum_level_normals

FIELD_OF_VIEW_RAD = np.deg2rad(32)  # vertical field of view; narrow, for a weak perspective
ELEVATIONS_RAD = np.deg2rad([38.0, 52.0])  # candidate angles of the camera above the horizontal
AZIMUTHS = 16  # number of candidate directions around the up direction
MARGIN = 1.04  # size of the view relative to its content
TRIAL_WIDTH, TRIAL_HEIGHT = 96, 72  # px, size of candidate images
TRIAL_POINTS = 60000  # approximate maximum number of vertices in candidate images
LEVEL_CONE_RAD = np.deg2rad(30)  # largest angle between floor normals and the mean up direction of the cameras


def upward(poses: Float64, surface: Surface) -> Float64:
    """Return the up direction (3,), a unit vector in the world frame.

    It is the mean of the cameras' -y axes, refined with the normals of floors and table tops.

    Args:
        poses: (F, 4, 4) T_world_camera.
        surface: Surface of the map.
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
    """Return a camera and the pose T_world_camera (4, 4) with the best view of a surface.

    Candidate views look down from AZIMUTHS directions at the angles ELEVATIONS_RAD. The best view has the highest
    `_score`, which favors many visible objects; directions similar to those of the mapping cameras are preferred.

    Args:
        surface: Surface to show.
        instance_ids: (V,) instance ids of the surface's vertices, 0 = none.
        poses: (F, 4, 4) T_world_camera of the mapped frames.
        width: Width of the image in px.
        height: Height of the image in px.
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
                best_score, R, shown = score, R_trial, points[visible]
    # frame only the visible points, without the ceiling and the near walls
    return fitted(R, shown, width, height)


def looking(forward: Float64, up: Float64) -> Float64:
    """Return the rotation R_world_camera (3, 3) of a camera from its viewing direction and its up direction.

    Args:
        forward: (3,) viewing direction, world frame.
        up: (3,) up direction of the image, world frame; not parallel to `forward`.
    """
    z = forward / np.linalg.norm(forward)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def fitted(R_world_camera: Float64, points_world: Float32, width: int, height: int) -> tuple[Camera, Float64]:
    """Return a camera, and the pose T_world_camera (4, 4) nearest to the points that shows all points but outliers.

    Args:
        R_world_camera: (3, 3) rotation of the camera.
        points_world: (P, 3) m.
        width: Width of the image in px.
        height: Height of the image in px.
    """
    return _framed(R_world_camera, _without_strays(points_world), width, height)


def _without_strays(points: Float32) -> Float32:
    """Return the points (P, 3) whose coordinates are between the 0.3rd and the 99.7th percentile of each axis.

    If no point is left, return all points.
    """
    low, high = np.percentile(points, [0.3, 99.7], axis=0)
    kept = points[((points >= low) & (points <= high)).all(axis=1)]
    return kept if len(kept) else points


def _framed(R_world_camera: Float64, points_world: Float32, width: int, height: int) -> tuple[Camera, Float64]:
    """Return a camera and pose like `fitted`, but with all points in view, including outliers."""
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
    """Return the indices of the visible points: the nearest front-facing point of each pixel.

    Args:
        points: (P, 3) m, world frame.
        normals: (P, 3) unit vectors, world frame.
        camera: Camera of the image.
        T_world_camera: (4, 4) pose of the camera.
    """
    nearest = np.full(camera.shape, -1, np.int32)
    points, normals = (
        np.ascontiguousarray(points),
        np.ascontiguousarray(normals),
    )  # the compiled signature of the kernel requires contiguous arrays
    draw_fronts(points, normals, T_world_camera, (camera.fx, camera.fy, camera.cx, camera.cy), nearest)
    return np.asarray(nearest[nearest >= 0])


def _score(instance_ids: Int32) -> float:
    """Return the score of a view from the instance ids (N,) of its visible points, 0 = none.

    The score is the sum of the square roots of each instance's number of points and of N. The square roots favor many
    small objects over one large object.
    """
    return float(np.sqrt(np.bincount(instance_ids, minlength=1)[1:]).sum() + np.sqrt(len(instance_ids)))

"""Image pyramids of depth and intensity, with normals."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np

from framework.data import Camera, Float32, Frame, SurfaceView, UInt8
from framework.sensors.noise_models import SensorKind
from framework.tracking.pyramid_kernels import compute_normals, find_distinct, halve, halve_mapped

SAMPLED = 4  # stride of the depth readings for the quantization estimate, px
FEWEST_VALUES = 16  # minimum number of distinct depths for the quantization estimate
SCATTERED = 0.15  # minimum fraction of missing neighbors of readings in scattered depth; a Kinect has at most 0.02
COARSE = 2.5  # maximum step between depth values of fine depth, in standard deviations of the sensor
NORMALS = "normals"  # key in Frame.depth_cache

_normals_lock = threading.Lock()  # one lock for all frames, because frames are pickled and kernels use all cores


def intrinsics(camera: Camera) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Return fx, fy, cx and cy, px, in single precision."""
    return np.float32(camera.fx), np.float32(camera.fy), np.float32(camera.cx), np.float32(camera.cy)


@dataclass(frozen=True)
class PyramidLevel:
    """One resolution of an RGB-D image."""

    camera: Camera
    depth: Float32  # (H, W) m, 0 = no reading
    intensity: Float32  # (H, W) in [0, 1]
    normals: Float32  # (3, H, W) surface normals toward the camera, in the camera frame; 0 at edges
    sensor: SensorKind = SensorKind.KINECT_V1  # kind of the depth sensor


def build_pyramid(
    camera: Camera, depth: Float32, color: UInt8, finest: float, levels: int,
    sensor: SensorKind = SensorKind.KINECT_V1,
) -> list[PyramidLevel]:  # fmt: skip
    """Return the image pyramid, finest level first.

    Intensities are averaged over all pixels, and depths only over pixels of one surface.

    Args:
        camera: The camera.
        depth: The depth image (H, W), m, 0 = no reading.
        color: The color image (H, W, 3), RGB.
        finest: The scale of the finest level: 1 or a power of 1/2.
        levels: The number of levels.
        sensor: The depth sensor.
    """
    intensity = _intensity(color)
    pyramid: list[PyramidLevel] = []
    least = camera.width * finest
    while True:
        if camera.width <= least:
            pyramid.append(PyramidLevel(camera, depth, intensity, _normals(depth, camera), sensor))
            if len(pyramid) == levels:
                return pyramid
        camera = _halved(camera)
        half_depth, half_intensity = np.empty(camera.shape, np.float32), np.empty(camera.shape, np.float32)
        halve(depth, intensity, half_depth, half_intensity)
        depth, intensity = half_depth, half_intensity


def normals_of(frame: Frame) -> Float32:
    """Return the surface normals of a frame, from the depth of the four neighbors of each pixel.

    The normals are computed once per frame and shared by all stages. This function is thread-safe.

    Args:
        frame: The frame.

    Returns:
        The normals (H, W, 3) in the camera frame, a read-only view that is not contiguous: unit vectors toward the
        camera, and 0 where unknown. A normal is unknown at the image border, without depth at the pixel or at one of
        its neighbors, and at jumps of more than 5% of the depth.
    """
    with _normals_lock:
        if NORMALS not in frame.depth_cache:
            normals = np.moveaxis(_normals(frame.depth, frame.camera), 0, -1)
            normals.flags.writeable = False
            frame.depth_cache[NORMALS] = normals
        return cast(Float32, frame.depth_cache[NORMALS])


def is_coarse(depth: Float32, otherwise: bool, sensor: SensorKind = SensorKind.KINECT_V1) -> bool:
    """Return True if a depth image is quantized too coarsely to compute normals from neighboring pixels.

    The step is the gap between neighboring distinct depth values. It is compared with the noise of the sensor.

    Args:
        depth: The depth image (H, W), m, 0 = no reading.
        otherwise: The result if there are too few distinct values.
        sensor: The depth sensor.
    """
    values = _distinct(depth[::SAMPLED, ::SAMPLED])
    if len(values) < FEWEST_VALUES:
        return otherwise
    steps = np.diff(values) / sensor.sigma(values[:-1])  # 1.5 to 1.9 for a Kinect
    nearer = steps[: len(steps) // 2]
    return bool(np.partition(nearer, len(nearer) // 4)[len(nearer) // 4] > COARSE)  # a gap may span several steps


def is_scattered(depth: Float32) -> bool:
    """Return True if many readings of a depth image (H, W) have a neighbor without depth."""
    known = depth[::SAMPLED] > 0
    pairs = np.count_nonzero(known[:, :-1]) + np.count_nonzero(known[:, 1:])
    return bool(np.count_nonzero(known[:, :-1] ^ known[:, 1:]) > SCATTERED * pairs)


def _distinct(depth: Float32) -> Float32:
    """Return the distinct positive values of a depth image in ascending order."""
    # for few distinct values, a hash table is faster than np.unique
    bits = np.ascontiguousarray(depth).view(np.int32)
    table = np.zeros(1 << (2 * bits.size).bit_length(), np.int32)
    found = np.empty(bits.size, np.int32)
    return np.sort(found[: find_distinct(bits.ravel(), table, found)].view(np.float32))


def _normals(depth: Float32, camera: Camera) -> Float32:
    """Return the normals (3, H, W) of depth (H, W), m; see `PyramidLevel`."""
    normals = np.empty((3, *camera.shape), np.float32)
    compute_normals(depth, intrinsics(camera), normals)
    return normals


def _halved(camera: Camera) -> Camera:
    return Camera(
        camera.width // 2,
        camera.height // 2,
        camera.fx / 2,
        camera.fy / 2,
        (camera.cx + 0.5) / 2 - 0.5,
        (camera.cy + 0.5) / 2 - 0.5,
    )


def _intensity(color: UInt8) -> Float32:
    return np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).astype(np.float32) * np.float32(1 / 255))


def model_intensities(view: SurfaceView, levels: int) -> list[Float32]:
    """Return the intensity of a view at several resolutions, finest first, -1 = not mapped."""
    intensity = _intensity(view.color)
    intensity[view.depth == 0] = -1
    pyramid = [intensity]
    for _ in range(levels - 1):
        height, width = pyramid[-1].shape
        half = np.empty((height // 2, width // 2), np.float32)
        halve_mapped(pyramid[-1], half)
        pyramid.append(half)
    return pyramid

"""Error model of RGB-D cameras.

- Axial depth noise follows the noise model of the sensor (`framework.sensors.noise_models`).
- The disparity of a Kinect v1 is quantized to 1/8 px. The step of the depth z in m is therefore 2.9e-3 z^2 m
  (Khoshelham and Oude Elberink, "Accuracy and Resolution of Kinect Depth Data for Indoor Mapping Applications", Sensors
  12(2), 2012). The disparity of a RealSense D400 is quantized to 1/32 px. The depth of other sensors has steps of 1 mm.
- Lateral noise moves readings across edges by about a pixel (Nguyen et al.). It is applied as in Handa et al., "A
  Benchmark for RGB-D Visual Odometry, 3D Reconstruction and SLAM", ICRA 2014.
- Readings are missing where the projector or second camera is occluded, at many pixels along depth edges, and at
  grazing angles.
- Dark and shiny surfaces lose readings in patches, because the correlation window is wider than a pixel.
- Each device has a fixed error: a constant offset and a low-frequency pattern. Both grow with the square of the depth,
  as errors of the disparity do, and warp walls at more than 3 m (Teichman, Miller and Thrun, "Unsupervised Intrinsic
  Calibration of Depth Sensors via SLAM", RSS 2013; Basso, Menegatti and Pretto, "Robust Intrinsic and Extrinsic
  Calibration of RGB-D Cameras", IEEE Transactions on Robotics 34(5), 2018). Its size is our choice: about 1 cm at 4 m.
- Color has noise and motion blur.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import NamedTuple

import cv2
import numpy as np

from framework.data import Camera, Float32, Float64, UInt8, UInt16
from framework.geometry import inverse
from framework.sensors.noise_models import SensorKind
from framework.synthetic.rgbd_camera_kernels import (
    QUANTILE_BITS,
    SPARE_BITS,
    add_noise,
    blur,
    drop_patches,
    read_depth,
)

LATERAL_SIGMA = 0.8  # px at 640 px width, standard deviation: the constant term of Nguyen et al.
PATCH = 14.0  # px at 640 px width, spacing of the random field that determines the patches without readings
COLOR_SIGMA = 1.5  # standard deviation of color noise, in gray levels from 0 to 255
DISPARITY_ERROR = 0.025  # px, standard deviation of the offset and of the pattern of a device that measures disparity
RANGE_ERROR = 4e-4  # 1/m, standard deviation of both for other devices, relative to the square of the depth
PATTERN_NODES = (4, 5)  # rows and columns of the random grid that the pattern interpolates


class Triangulation(NamedTuple):
    """Geometry of a sensor that measures disparity."""

    baseline: float  # m, distance to the projector or the second camera; 0 = no triangulation
    steps_depth: float  # product of depth (m) and disparity (quantization steps); 0 = constant steps of depth


TRIANGULATION = {  # focal lengths: 580 px (Kinect v1, at 640 px width) and 424 px (D435, at 848 px width)
    SensorKind.KINECT_V1: Triangulation(0.075, 8 * 580 * 0.075),
    SensorKind.REALSENSE_D435: Triangulation(0.05, 32 * 424 * 0.05),
}


@dataclass(frozen=True)
class DepthSensor:
    """Simulated depth sensor."""

    noise: float  # 0 = exact, 1 = as measured; scales standard deviations and probabilities
    max_range: float  # m, maximum depth of a reading
    kind: SensorKind = SensorKind.KINECT_V1
    distortion: Float32 | None = None  # (H, W) 1/m, fixed error relative to the square of the depth; None = no error

    def measure(
        self,
        depth: Float32,
        incidence: Float32,
        camera: Camera,
        rng: np.random.Generator,
        unread: Float32 | None = None,
    ) -> Float32:
        """Simulate the depth readings (H, W), m along z, 0 = no reading.

        Args:
            depth: The exact depth (H, W), m along z, 0 = no surface.
            incidence: The cosine of the angle of incidence (H, W).
            camera: The camera of the depth image.
            rng: The random number generator.
            unread: The fraction of readings (H, W) that are lost on dark and shiny materials; None = 0.
        """
        if self.distortion is not None:
            depth = depth + self.distortion * depth * depth
        if self.noise == 0 or self.kind is SensorKind.EXACT:
            return np.where(depth <= self.max_range, depth, np.float32(0))
        noise, width, normal = self.noise, camera.width, normal_quantiles()
        theta = np.arccos(np.minimum(incidence, np.float32(1)))
        random = random_bits((*depth.shape, 4), rng)
        baseline, steps_depth = TRIANGULATION.get(self.kind, Triangulation(0.0, 0.0))
        reading = np.zeros(depth.shape, np.float32)
        read_depth(
            depth, theta, random, normal, np.float32(noise), np.float32(noise * LATERAL_SIGMA * width / 640),
            np.float32(camera.fx * baseline), np.float32(steps_depth), self.kind.noise, np.float32(self.max_range),
            reading,
        )  # fmt: skip
        if unread is not None:
            cell = PATCH * width / 640
            nodes = (int(depth.shape[0] / cell) + 2, int(depth.shape[1] / cell) + 2)
            field = normal[random_bits(nodes, rng) >> SPARE_BITS]
            drop_patches(unread, field, np.float32(cell), normal, np.float32(min(noise, 1.0)), reading)
        return reading


def device_distortion(kind: SensorKind, camera: Camera, rng: np.random.Generator) -> Float32:
    """Return the fixed error (H, W) of a random device, 1/m, relative to the square of the depth."""
    baseline = TRIANGULATION[kind].baseline if kind in TRIANGULATION else 0.0
    sigma = DISPARITY_ERROR * camera.width / 640 / (camera.fx * baseline) if baseline else RANGE_ERROR
    offset, nodes = rng.normal(), rng.normal(size=PATTERN_NODES)
    pattern = cv2.resize(nodes, (camera.width, camera.height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(sigma * (offset + pattern), np.float32)


def noisy_color(color: UInt8, noise: float, rng: np.random.Generator) -> UInt8:
    """Add image noise to a color image (H, W, 3).

    A noise of 1 is typical of indoor light.
    """
    if noise == 0:
        return color
    noisy = np.empty_like(color)
    bits = random_bits((color.size,), rng)
    add_noise(color.reshape(-1), bits, normal_quantiles(), np.float32(noise * COLOR_SIGMA), noisy.reshape(-1))
    return noisy


def blurred(
    color: UInt8, depth: Float32, camera: Camera, T_world_camera: Float64, T_world_open: Float64, T_world_close: Float64
) -> UInt8:
    """Add motion blur to a color image.

    Args:
        color: The color image (H, W, 3), RGB.
        depth: The exact depth (H, W), m, 0 = no blur.
        camera: The camera.
        T_world_camera: The pose (4, 4) of the color image.
        T_world_open: The pose (4, 4) at the start of the exposure.
        T_world_close: The pose (4, 4) at the end of the exposure.
    """
    picture = np.empty_like(color)
    K = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
    T_open_camera, T_close_camera = (
        (inverse(end) @ T_world_camera).astype(np.float32) for end in (T_world_open, T_world_close)
    )
    blur(color, depth, K, T_open_camera, T_close_camera, picture)
    return picture


def random_bits(shape: tuple[int, ...], rng: np.random.Generator) -> UInt16:
    """Return an array of 16-bit random numbers.

    This is several times faster than sampling a distribution.
    """
    count = math.prod(shape)
    words = rng.integers(0, 2**64, -(-count // 4), np.uint64)
    return words.view(np.uint16)[:count].reshape(shape)


@lru_cache
def normal_quantiles() -> Float32:
    """Return evenly spaced quantiles (2^QUANTILE_BITS,) of the standard normal distribution."""
    count = 1 << QUANTILE_BITS
    quantiles = np.array([NormalDist().inv_cdf((k + 0.5) / count) for k in range(count)])
    return np.asarray(quantiles / quantiles.std(), np.float32)

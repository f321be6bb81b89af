"""The depth errors of a structured-light camera of the Kinect v1's kind.

- Axial noise grows with the square of depth and towards grazing angles: Nguyen, Izadi and Lovell, "Modeling Kinect
  Sensor Noise for Improved 3D Reconstruction and Tracking", 3DIMPVT 2012, equation for sigma_z(z, theta).
- Disparity is quantised to 1/8 px, so depth comes in steps of 2.9e-3 z^2: Khoshelham and Oude Elberink, "Accuracy and
  Resolution of Kinect Depth Data for Indoor Mapping Applications", Sensors 12(2), 2012.
- A reading belongs to a place up to about a pixel aside (lateral noise, Nguyen et al.; applied as Handa et al.,
  "A Benchmark for RGB-D Visual Odometry, 3D Reconstruction and SLAM", ICRA 2014, do).
- There is no reading where the projector, a baseline aside of the camera, cannot shine; at many pixels along depth
  edges; and on surfaces seen at a grazing angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Bool, Camera, Float32, UInt8

BASELINE = 0.075  # m, between projector and camera
DISPARITY_STEPS = 8.0  # per px
FOCAL_KINECT = 580.0  # px, of the depth camera at 640 px width; quantisation does not depend on our image size
MIN_RANGE = 0.4  # m
LATERAL_SIGMA = 0.8  # px at 640 px width: the constant term of Nguyen et al.
EDGE_JUMP = 0.05  # relative step of depth that the sensor's correlation window cannot follow
EDGE_DROP = 0.5  # probability of no reading beside such a step
GRAZING_START, GRAZING_END = np.deg2rad(80.0), np.deg2rad(88.0)  # from all readings to none
COLOR_SIGMA = 1.5  # grey levels of 255


def axial_sigma(z: Float32, theta: Float32) -> Float32:
    """The standard deviation (m) of depth z (m) at incidence angle theta (rad), Nguyen et al. 2012, eq. 2."""
    theta = np.minimum(theta, np.float32(np.deg2rad(80)))  # the model was fitted up to here and then diverges
    return np.asarray(
        0.0012 + 0.0019 * (z - 0.4) ** 2 + 0.0001 / np.sqrt(np.maximum(z, 0.1)) * theta**2 / (np.pi / 2 - theta) ** 2,
        np.float32,
    )


def depth_step(z: Float32) -> Float32:
    """The distance (m) between neighbouring depth values at depth z (m)."""
    return np.asarray(z * z / np.float32(DISPARITY_STEPS * FOCAL_KINECT * BASELINE), np.float32)


@dataclass(frozen=True)
class DepthSensor:
    """Turns exact depth into readings."""

    noise: float  # 0 = exact, 1 = as measured; scales the standard deviations and the probabilities
    max_range: float  # m, nothing is read beyond

    def measure(self, depth: Float32, incidence: Float32, camera: Camera, rng: np.random.Generator) -> Float32:
        """The readings (H, W) m for exact `depth` (H, W) m seen under the cosines `incidence`, 0 = no reading."""
        exact = np.where(depth <= self.max_range, depth, np.float32(0))
        if self.noise == 0:
            return exact
        valid = (exact > MIN_RANGE) & ~_in_projector_shadow(depth, camera)
        theta = np.arccos(np.minimum(incidence, np.float32(1)))
        chance = rng.random(depth.shape, np.float32)
        grazing = (theta - np.float32(GRAZING_START)) / np.float32(GRAZING_END - GRAZING_START)
        lost = np.where(_beside_edge(depth), np.float32(EDGE_DROP), np.float32(0))
        valid &= chance >= min(self.noise, 1.0) * np.maximum(lost, grazing)
        shifted = self._shifted(depth, camera, rng)
        reading = _quantised(shifted + self._axial(shifted, theta, rng))
        valid &= (reading > MIN_RANGE) & (reading <= self.max_range)
        return np.where(valid, reading, np.float32(0))

    def _axial(self, z: Float32, theta: Float32, rng: np.random.Generator) -> Float32:
        """Gaussian noise which, together with the quantisation that follows, has the measured deviation."""
        variance = (self.noise * axial_sigma(z, theta)) ** 2 - depth_step(z) ** 2 / 12
        return np.asarray(np.sqrt(np.maximum(variance, 0)) * rng.standard_normal(z.shape, np.float32), np.float32)

    def _shifted(self, depth: Float32, camera: Camera, rng: np.random.Generator) -> Float32:
        """Each pixel's depth, or a neighbour's, as the lateral noise falls."""
        sigma = np.float32(self.noise * LATERAL_SIGMA * camera.width / 640)
        offset = np.rint(sigma * rng.standard_normal((2, *depth.shape), np.float32)).astype(np.int32)
        v = np.clip(np.arange(camera.height, dtype=np.int32)[:, None] + offset[0], 0, camera.height - 1)
        u = np.clip(np.arange(camera.width, dtype=np.int32)[None, :] + offset[1], 0, camera.width - 1)
        neighbour = depth[v, u]
        # Only across an edge: within a smooth surface the axial noise already holds all measured deviation.
        other = np.abs(neighbour - depth) > np.float32(EDGE_JUMP) * depth
        return np.where(other & (neighbour > 0), neighbour, depth)


def noisy_color(color: UInt8, noise: float, rng: np.random.Generator) -> UInt8:
    """`color` with the grain of a camera indoors."""
    if noise == 0:
        return color
    grain = np.float32(noise * COLOR_SIGMA) * rng.standard_normal(color.shape, np.float32)
    return np.asarray(np.clip(np.rint(color + grain), 0, 255), np.uint8)


def _quantised(depth: Float32) -> Float32:
    """Depth rounded to the nearest disparity step."""
    scale = np.float32(DISPARITY_STEPS * FOCAL_KINECT * BASELINE)
    steps = np.rint(scale / np.maximum(depth, np.float32(0.1)))
    return np.asarray(scale / np.maximum(steps, 1), np.float32)


def _in_projector_shadow(depth: Float32, camera: Camera) -> Bool:
    """Where something nearer stands between the projector, to the right of the camera, and the surface.

    Along a row the projector sees pixel u at u - f b / z. A pixel whose place there is not left of all those to its
    right is hidden by them.
    """
    disparity = np.where(depth > 0, np.float32(camera.fx * BASELINE) / np.maximum(depth, np.float32(0.1)), 0)
    place = np.arange(camera.width, dtype=np.float32)[None, :] - disparity
    smallest_to_the_right = np.minimum.accumulate(place[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(place > smallest_to_the_right + np.float32(1.0))


def _beside_edge(depth: Float32) -> Bool:
    """The pixels on either side of a step of depth."""
    edge = np.zeros(depth.shape, np.bool_)
    for a, b in (
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
        ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
    ):
        step = np.abs(depth[a] - depth[b]) > np.float32(EDGE_JUMP) * np.minimum(depth[a], depth[b])
        edge[a] |= step
        edge[b] |= step
    return edge

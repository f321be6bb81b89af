"""The depth errors of a structured-light camera of the Kinect v1's kind.

- Axial noise grows with the square of depth and towards grazing angles: see `framework.sensors.noise_models`.
- Disparity is quantised to 1/8 px, so depth comes in steps of 2.9e-3 z^2: Khoshelham and Oude Elberink, "Accuracy and
  Resolution of Kinect Depth Data for Indoor Mapping Applications", Sensors 12(2), 2012.
- A reading belongs to a place up to about a pixel aside (lateral noise, Nguyen et al.; applied as Handa et al.,
  "A Benchmark for RGB-D Visual Odometry, 3D Reconstruction and SLAM", ICRA 2014, do).
- There is no reading where the projector, a baseline aside of the camera, cannot shine; at many pixels along depth
  edges; and on surfaces seen at a grazing angle.
- Dark and shiny surfaces lose readings in patches: the correlation window that finds no pattern is wider than a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist

import numpy as np
from numba import njit

from framework.data import Bool, Camera, Float32, UInt8, UInt16
from framework.sensors.noise_models import axial_sigma_at_angle

BASELINE = 0.075  # m, between projector and camera
DISPARITY_STEPS = 8.0  # per px
FOCAL_KINECT = 580.0  # px, of the depth camera at 640 px width; quantisation does not depend on our image size
MIN_RANGE = 0.4  # m
LATERAL_SIGMA = 0.8  # px at 640 px width: the constant term of Nguyen et al.
EDGE_JUMP = 0.05  # relative step of depth that the sensor's correlation window cannot follow
EDGE_DROP = 0.5  # probability of no reading beside such a step
GRAZING_START, GRAZING_END = np.deg2rad(80.0), np.deg2rad(88.0)  # from all readings to none
PATCH = 14.0  # px at 640 px width, between the random numbers that patches without readings come from
COLOR_SIGMA = 1.5  # grey levels of 255
QUANTILE_BITS = 12  # a normal error is one of so many equally likely ones: up to 3.7 standard deviations
SPARE_BITS = 16 - QUANTILE_BITS

_SCALE = np.float32(DISPARITY_STEPS * FOCAL_KINECT * BASELINE)  # m, depth times steps of disparity


@njit(cache=True, nogil=True)
def depth_step(z: np.float32) -> np.float32:
    """The distance (m) between neighbouring depth values at depth z (m)."""
    return np.float32(z * z / _SCALE)


@dataclass(frozen=True)
class DepthSensor:
    """Turns exact depth into readings."""

    noise: float  # 0 = exact, 1 = as measured; scales the standard deviations and the probabilities
    max_range: float  # m, nothing is read beyond

    def measure(
        self,
        depth: Float32,
        incidence: Float32,
        camera: Camera,
        rng: np.random.Generator,
        unread: Float32 | None = None,
    ) -> Float32:
        """The readings (H, W) m for exact `depth` (H, W) m seen under the cosines `incidence`, 0 = no reading.

        `unread` (H, W) is the share of readings that materials lose, in patches; None = no material loses any.
        """
        if self.noise == 0:
            return np.where(depth <= self.max_range, depth, np.float32(0))
        theta = np.arccos(np.minimum(incidence, np.float32(1)))
        reading = np.zeros(depth.shape, np.float32)
        _read(
            depth,
            theta,
            random_bits((*depth.shape, 4), rng),
            normal_quantiles(),
            np.float32(self.noise),
            np.float32(self.noise * LATERAL_SIGMA * camera.width / 640),
            np.float32(camera.fx * BASELINE),
            np.float32(self.max_range),
            reading,
        )
        if unread is not None:
            cell = PATCH * camera.width / 640
            nodes = (int(depth.shape[0] / cell) + 2, int(depth.shape[1] / cell) + 2)
            field = normal_quantiles()[random_bits(nodes, rng) >> SPARE_BITS]
            _lose(unread, field, np.float32(cell), normal_quantiles(), np.float32(min(self.noise, 1.0)), reading)
        return reading


def noisy_color(color: UInt8, noise: float, rng: np.random.Generator) -> UInt8:
    """`color` with the grain of a camera indoors."""
    if noise == 0:
        return color
    noisy = np.empty_like(color)
    bits = random_bits((color.size,), rng)
    _add(color.reshape(-1), bits, normal_quantiles(), np.float32(noise * COLOR_SIGMA), noisy.reshape(-1))
    return noisy


def random_bits(shape: tuple[int, ...], rng: np.random.Generator) -> UInt16:
    """16 random bits in each place: several times cheaper than as many random numbers of a distribution."""
    count = math.prod(shape)
    words = rng.integers(0, 2**64, -(-count // 4), np.uint64)
    return words.view(np.uint16)[:count].reshape(shape)


@lru_cache
def normal_quantiles() -> Float32:
    """(2^QUANTILE_BITS,) equally likely numbers of mean 0 and variance 1 that are distributed normally."""
    count = 1 << QUANTILE_BITS
    quantiles = np.array([NormalDist().inv_cdf((k + 0.5) / count) for k in range(count)])
    return np.asarray(quantiles / quantiles.std(), np.float32)


# The kernels compute in float32, in this order: their tests compare them to the last bit with whole images.


@njit(cache=True, nogil=True)
def _read(
    depth: Float32,
    theta: Float32,
    random: UInt16,
    normal: Float32,
    noise: np.float32,
    lateral_sigma: np.float32,
    disparity_scale: np.float32,
    max_range: np.float32,
    reading: Float32,
) -> None:
    """Writes the readings (H, W) m, where there is one.

    depth (H, W) m; theta (H, W) rad, of incidence; random (H, W, 4) bits: for losing a reading, for the lateral error
    along y and x and for the axial one; normal (N,): normal_quantiles; lateral_sigma: px; disparity_scale: px m.
    """
    height, width = depth.shape
    beside_edge = _beside_edge(depth)
    most_lost = min(noise, np.float32(1))
    for v in range(height):
        # Along a row the projector, to the right of the camera, sees pixel u at u - f b / z. What does not lie left of
        # all that is to its right is hidden by it: something nearer stands between the projector and the surface.
        leftmost = np.float32(np.inf)
        for u in range(width - 1, -1, -1):
            z = depth[v, u]
            place = np.float32(u)
            if z > 0:
                place -= disparity_scale / max(z, np.float32(0.1))
            leftmost = min(leftmost, place)
            if place > leftmost + np.float32(1) or not np.float32(MIN_RANGE) < z <= max_range:
                continue
            lost = np.float32(EDGE_DROP) if beside_edge[v, u] else np.float32(0)
            grazing = (theta[v, u] - np.float32(GRAZING_START)) / np.float32(GRAZING_END - GRAZING_START)
            chance = np.float32(random[v, u, 0]) / np.float32(65536)
            if chance < most_lost * max(lost, grazing):
                continue
            aside_v = lateral_sigma * normal[random[v, u, 1] >> SPARE_BITS]
            aside_u = lateral_sigma * normal[random[v, u, 2] >> SPARE_BITS]
            seen = _shifted(depth, v, u, aside_v, aside_u)
            # Gaussian noise which, together with the quantisation that follows, has the measured deviation
            sigma, step = noise * axial_sigma_at_angle(seen, theta[v, u]), depth_step(seen)
            variance = sigma * sigma - step * step / np.float32(12)
            seen += np.sqrt(max(variance, np.float32(0))) * normal[random[v, u, 3] >> SPARE_BITS]
            steps = np.rint(_SCALE / max(seen, np.float32(0.1)))
            quantised = _SCALE / max(steps, np.float32(1))
            if np.float32(MIN_RANGE) < quantised <= max_range:
                reading[v, u] = quantised


@njit(cache=True, nogil=True)
def _lose(
    unread: Float32, field: Float32, cell: np.float32, normal: Float32, most_lost: np.float32, reading: Float32
) -> None:
    """Takes readings (H, W) away, in patches, so that a share of `most_lost` times `unread` (H, W) is lost.

    A pixel loses its reading where a smooth random field is below the quantile of that share. The field lies between
    the normal numbers `field` (R, C), `cell` px apart; divided by the length of the weights it is normal in each pixel.
    """
    one, count = np.float32(1), np.float32(len(normal))
    for v in range(reading.shape[0]):
        y = np.float32(v) / cell
        j = int(y)
        b = y - np.float32(j)
        for u in range(reading.shape[1]):
            entry = int(most_lost * unread[v, u] * count)
            if entry == 0 or reading[v, u] == 0:
                continue
            x = np.float32(u) / cell
            i = int(x)
            a = x - np.float32(i)
            upper = (one - a) * field[j, i] + a * field[j, i + 1]
            lower = (one - a) * field[j + 1, i] + a * field[j + 1, i + 1]
            length = np.sqrt(((one - a) * (one - a) + a * a) * ((one - b) * (one - b) + b * b))
            if entry >= len(normal) or ((one - b) * upper + b * lower) / length < normal[entry]:
                reading[v, u] = 0


@njit(cache=True, nogil=True)
def _shifted(depth: Float32, v: int, u: int, dv: np.float32, du: np.float32) -> np.float32:
    """A pixel's depth, or that of the neighbour (dv, du) px aside, rounded, where an edge is in between.

    Only there: within a smooth surface the axial noise already holds all measured deviation.
    """
    y = min(max(v + int(np.rint(dv)), 0), depth.shape[0] - 1)
    x = min(max(u + int(np.rint(du)), 0), depth.shape[1] - 1)
    own, neighbour = depth[v, u], depth[y, x]
    across = abs(neighbour - own) > np.float32(EDGE_JUMP) * own
    return np.float32(neighbour if across and neighbour > 0 else own)


@njit(cache=True, nogil=True)
def _beside_edge(depth: Float32) -> Bool:
    """The pixels (H, W) on either side of a step of depth."""
    height, width = depth.shape
    edge = np.zeros((height, width), np.bool_)
    for v in range(height):
        for u in range(width):
            own = depth[v, u]
            for y, x in ((v, u + 1), (v + 1, u)):
                if y < height and x < width:
                    other = depth[y, x]
                    if abs(own - other) > np.float32(EDGE_JUMP) * min(own, other):
                        edge[v, u] = edge[y, x] = True
    return edge


@njit(cache=True, nogil=True)
def _add(color: UInt8, random: UInt16, normal: Float32, sigma: np.float32, noisy: UInt8) -> None:
    """Writes `color` (N,) with noise of this deviation added, rounded; random (N,) bits, normal: normal_quantiles."""
    for n in range(len(color)):
        value = np.rint(np.float32(color[n]) + sigma * normal[random[n] >> SPARE_BITS])
        noisy[n] = np.uint8(min(max(value, np.float32(0)), np.float32(255)))

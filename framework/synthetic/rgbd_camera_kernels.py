"""Kernels of rgbd_camera.py, in single precision."""

from __future__ import annotations

import numpy as np

from framework.compilation.kernel_cache import njit
from framework.data import Bool, Float32, UInt8, UInt16
from framework.sensors.noise_models import FLOOR, DepthNoise
from framework.sensors.noise_models_kernels import axial_sigma_at_angle

MIN_RANGE = 0.4  # m, minimum depth of a reading
EDGE_JUMP = 0.05  # minimum relative step of depth at an edge, where the sensor's correlation window fails
EDGE_DROP = 0.5  # probability of no reading next to such a step
# rad, angles of incidence at which the first readings and all readings are lost
GRAZING_START, GRAZING_END = np.deg2rad(80.0), np.deg2rad(88.0)
QUANTILE_BITS = 12  # random bits per normal error: 2^QUANTILE_BITS equally likely values, up to 3.7 standard deviations
SPARE_BITS = 16 - QUANTILE_BITS  # unused bits of a 16-bit random number
MAX_SAMPLES = 9  # maximum number of samples along the path of a pixel; more samples make no visible difference
SHARP = np.float32(0.5)  # px, minimum path length for blur


@njit(cache=True, nogil=True)
def depth_step(z: np.float32, steps_depth: np.float32) -> np.float32:
    """Return the quantization step, m, at depth z, m.

    `steps_depth` is the product of depth (m) and disparity (quantization steps). If it is 0, the step is constant.
    """
    return np.float32(z * z / steps_depth) if steps_depth > 0 else np.float32(FLOOR)


@njit(cache=True, nogil=True)
def quantized(z: np.float32, steps_depth: np.float32) -> np.float32:
    """Round depth z, m, to a quantization step.

    `steps_depth` is described in `depth_step`.
    """
    if steps_depth > 0:
        steps = np.rint(steps_depth / max(z, np.float32(0.1)))
        return np.float32(steps_depth / max(steps, np.float32(1)))
    return np.float32(np.rint(z / np.float32(FLOOR)) * np.float32(FLOOR))


@njit(cache=True, nogil=True)
def read_depth(
    depth: Float32,
    theta: Float32,
    random: UInt16,
    normal: Float32,
    noise: np.float32,
    lateral_sigma: np.float32,
    disparity_scale: np.float32,
    steps_depth: np.float32,
    model: DepthNoise,
    max_range: np.float32,
    reading: Float32,
) -> None:
    """Simulate depth readings.

    Pixels without a reading remain unchanged in the output.

    Args:
        depth: The exact depth (H, W), m along z, 0 = no surface.
        theta: The angle of incidence (H, W), rad.
        random: The random bits (H, W, 4) for the loss of readings, the lateral error along y and x, and the axial
            error.
        normal: The quantiles (N,) from `normal_quantiles`.
        noise: The scale of the noise model, 1 = as measured.
        lateral_sigma: The standard deviation of the lateral error, px.
        disparity_scale: The product of disparity (px) and depth (m).
        steps_depth: The product of depth (m) and disparity (quantization steps), see `depth_step`.
        model: The model of the axial noise.
        max_range: The maximum depth of a reading, m.
        reading: The output depth (H, W), m.
    """
    height, width = depth.shape
    near_edge = _near_edge(depth)
    largest_loss = min(noise, np.float32(1))
    for v in range(height):
        # The projector, or the other camera, is to the right of the camera. Pixel u is at u - f b / z in the projector.
        # In the projector, a pixel is to the left of all pixels that are to its right in the camera, unless it is in
        # the shadow of a nearer surface.
        leftmost = np.float32(np.inf)
        for u in range(width - 1, -1, -1):
            z = depth[v, u]
            projector_u = np.float32(u)
            if z > 0:
                projector_u -= disparity_scale / max(z, np.float32(0.1))
            leftmost = min(leftmost, projector_u)
            if projector_u > leftmost + np.float32(1) or not np.float32(MIN_RANGE) < z <= max_range:
                continue
            edge_loss = np.float32(EDGE_DROP) if near_edge[v, u] else np.float32(0)
            grazing_loss = (theta[v, u] - np.float32(GRAZING_START)) / np.float32(GRAZING_END - GRAZING_START)
            chance = np.float32(random[v, u, 0]) / np.float32(65536)
            if chance < largest_loss * max(edge_loss, grazing_loss):
                continue
            lateral_v = lateral_sigma * normal[random[v, u, 1] >> SPARE_BITS]
            lateral_u = lateral_sigma * normal[random[v, u, 2] >> SPARE_BITS]
            noisy = _shifted(depth, v, u, lateral_v, lateral_u)
            # the variances of this Gaussian noise and of the following quantization add up to the measured variance
            sigma, step = noise * axial_sigma_at_angle(noisy, theta[v, u], model), depth_step(noisy, steps_depth)
            variance = sigma * sigma - step * step / np.float32(12)
            noisy += np.sqrt(max(variance, np.float32(0))) * normal[random[v, u, 3] >> SPARE_BITS]
            value = quantized(noisy, steps_depth)
            if np.float32(MIN_RANGE) < value <= max_range:
                reading[v, u] = value


@njit(cache=True, nogil=True)
def drop_patches(
    unread: Float32, field: Float32, cell: np.float32, normal: Float32, largest_loss: np.float32, reading: Float32
) -> None:
    """Remove depth readings in random patches.

    Args:
        unread: The fraction of lost readings (H, W).
        field: Normally distributed random numbers (R, C) on a coarse grid.
        cell: The distance between the grid points, px.
        normal: The quantiles (N,) from `normal_quantiles`.
        largest_loss: A factor for the fraction of lost readings.
        reading: The depth readings (H, W), m, input and output.
    """
    # A reading is lost if an interpolated random field is below the quantile of the fraction of lost readings. The
    # interpolated value is divided by the norm of the weights, so that it is normally distributed at each pixel.
    one, count = np.float32(1), np.float32(len(normal))
    for v in range(reading.shape[0]):
        y = np.float32(v) / cell
        j = int(y)
        b = y - np.float32(j)
        for u in range(reading.shape[1]):
            entry = int(largest_loss * unread[v, u] * count)
            if entry == 0 or reading[v, u] == 0:
                continue
            x = np.float32(u) / cell
            i = int(x)
            a = x - np.float32(i)
            upper = (one - a) * field[j, i] + a * field[j, i + 1]
            lower = (one - a) * field[j + 1, i] + a * field[j + 1, i + 1]
            norm = np.sqrt(((one - a) * (one - a) + a * a) * ((one - b) * (one - b) + b * b))
            if entry >= len(normal) or ((one - b) * upper + b * lower) / norm < normal[entry]:
                reading[v, u] = 0


@njit(cache=True, nogil=True)
def _shifted(depth: Float32, v: int, u: int, dv: np.float32, du: np.float32) -> np.float32:
    """Return the depth at a pixel, m, or at an offset from the pixel if a depth edge is in between."""
    # smooth surfaces have no lateral error, because the axial noise model already includes the effect
    y = min(max(v + int(np.rint(dv)), 0), depth.shape[0] - 1)
    x = min(max(u + int(np.rint(du)), 0), depth.shape[1] - 1)
    own, neighbor = depth[v, u], depth[y, x]
    across = abs(neighbor - own) > np.float32(EDGE_JUMP) * own
    return np.float32(neighbor if across and neighbor > 0 else own)


@njit(cache=True, nogil=True)
def _near_edge(depth: Float32) -> Bool:
    """Return the mask (H, W) of the pixels at depth edges."""
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
def add_noise(color: UInt8, random: UInt16, normal: Float32, sigma: np.float32, noisy: UInt8) -> None:
    """Add normally distributed noise to color values.

    Args:
        color: The values (N,) of all channels.
        random: The random numbers (N,) from `random_bits`.
        normal: The quantiles from `normal_quantiles`.
        sigma: The standard deviation, in gray levels from 0 to 255.
        noisy: The output values (N,).
    """
    for n in range(len(color)):
        value = np.rint(np.float32(color[n]) + sigma * normal[random[n] >> SPARE_BITS])
        noisy[n] = np.uint8(min(max(value, np.float32(0)), np.float32(255)))


@njit(cache=True, nogil=True)
def blur(
    color: UInt8, depth: Float32, K: Float32, T_open_camera: Float32, T_close_camera: Float32, picture: UInt8
) -> None:
    """Add motion blur to a color image.

    Each pixel becomes the mean of samples along its path during the exposure.

    Args:
        color: The color image (H, W, 3), RGB.
        depth: The depth (H, W), m along z, 0 = no blur.
        K: The intrinsics (fx, fy, cx, cy), px.
        T_open_camera: The transform (4, 4) from the camera to the camera at the start of the exposure.
        T_close_camera: The transform (4, 4) from the camera to the camera at the end of the exposure.
        picture: The output image (H, W, 3), RGB.
    """
    height, width = depth.shape
    for v in range(height):
        for u in range(width):
            u0, v0 = _reprojected(T_open_camera, K, u, v, depth[v, u])
            u1, v1 = _reprojected(T_close_camera, K, u, v, depth[v, u])
            length = np.sqrt((u1 - u0) * (u1 - u0) + (v1 - v0) * (v1 - v0))
            if not length >= SHARP:
                for c in range(3):
                    picture[v, u, c] = color[v, u, c]
                continue
            samples = min(int(np.ceil(length)) + 1, MAX_SAMPLES)
            red, green, blue = np.float32(0), np.float32(0), np.float32(0)
            for k in range(samples):
                along = (np.float32(k) + np.float32(0.5)) / np.float32(samples)
                x = min(max(u0 + along * (u1 - u0), np.float32(0)), np.float32(width - 1))
                y = min(max(v0 + along * (v1 - v0), np.float32(0)), np.float32(height - 1))
                i, j = min(int(x), width - 2), min(int(y), height - 2)
                a, b = x - np.float32(i), y - np.float32(j)
                w00, w10 = (1 - a) * (1 - b), a * (1 - b)
                w01, w11 = (1 - a) * b, a * b
                red += w00 * color[j, i, 0] + w10 * color[j, i + 1, 0]
                red += w01 * color[j + 1, i, 0] + w11 * color[j + 1, i + 1, 0]
                green += w00 * color[j, i, 1] + w10 * color[j, i + 1, 1]
                green += w01 * color[j + 1, i, 1] + w11 * color[j + 1, i + 1, 1]
                blue += w00 * color[j, i, 2] + w10 * color[j, i + 1, 2]
                blue += w01 * color[j + 1, i, 2] + w11 * color[j + 1, i + 1, 2]
            weight = np.float32(1) / np.float32(samples)
            picture[v, u, 0] = np.uint8(red * weight + np.float32(0.5))
            picture[v, u, 1] = np.uint8(green * weight + np.float32(0.5))
            picture[v, u, 2] = np.uint8(blue * weight + np.float32(0.5))


@njit(cache=True, nogil=True, inline="always")
def _reprojected(T, K, u, v, z):
    """Return the image coordinates, px, of a pixel with depth z, m, in another camera.

    The coordinates are unchanged if z is 0 or the point is behind the other camera.
    """
    px, py = (np.float32(u) - K[2]) / K[0] * z, (np.float32(v) - K[3]) / K[1] * z
    z_other = T[2, 0] * px + T[2, 1] * py + T[2, 2] * z + T[2, 3]
    if z <= 0 or z_other <= 0:
        return np.float32(u), np.float32(v)
    x_other = T[0, 0] * px + T[0, 1] * py + T[0, 2] * z + T[0, 3]
    y_other = T[1, 0] * px + T[1, 1] * py + T[1, 2] * z + T[1, 3]
    return K[0] * x_other / z_other + K[2], K[1] * y_other / z_other + K[3]

"""Depth and intensity at halved resolutions."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit, prange

from framework.data import Camera, Float32, SurfaceView, UInt8
from framework.sensors.noise_models import GROWTH, LEAST, NEAR

DEPTH_GAP = 0.05  # of the depth: readings farther apart than this do not belong to one surface and are not averaged
SAMPLED = 4  # px: every so manieth reading tells in what steps depth comes
FEWEST_VALUES = 16  # of depth, from which its steps are told
COARSE = 2.5  # standard deviations of a structured-light camera's depth, between neighboring values
MAPPED = np.float32(2.0)  # of the four pixels below one, so that it has the intensity of those


@dataclass(frozen=True)
class PyramidLevel:
    """One resolution of an RGB-D image."""

    camera: Camera
    depth: Float32  # (H, W) m, 0 = no reading
    intensity: Float32  # (H, W) in [0, 1]
    normals: Float32  # (3, H, W) of the surface, towards the camera, in its frame; 0 where neighbors are apart


def build_pyramid(camera: Camera, depth: Float32, color: UInt8, finest: float, levels: int) -> list[PyramidLevel]:
    """The image at `finest` times its size and at levels - 1 halvings of that, finest first.

    `finest` is 1 or a power of 1/2. Intensities average all pixels, depths those of one surface.
    """
    intensity = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).astype(np.float32) * np.float32(1 / 255)
    pyramid: list[PyramidLevel] = []
    least = camera.width * finest
    while True:
        if camera.width <= least:
            normals = np.empty((3, *camera.shape), np.float32)
            _normals(depth, *(np.float32(k) for k in (camera.fx, camera.fy, camera.cx, camera.cy)), normals)
            pyramid.append(PyramidLevel(camera, depth, intensity, normals))
            if len(pyramid) == levels:
                return pyramid
        camera = _halved(camera)
        half_depth, half_intensity = np.empty(camera.shape, np.float32), np.empty(camera.shape, np.float32)
        _halve(depth, intensity, half_depth, half_intensity)
        depth, intensity = half_depth, half_intensity


def is_coarse(depth: Float32, otherwise: bool) -> bool:
    """Whether depth (H, W) m comes in steps too coarse for normals from a pixel and its neighbors.

    Such is depth that was stored in 8 bits. Steps are gaps between the values that occur, of the nearer half, beside
    the noise of a structured-light camera: a Kinect's are 1.5 to 1.9 standard deviations at any distance, millimetres
    0.8 or less; those of 39 mm are 20 at 1 m and 3 at 3 m. `otherwise` is the answer where too few values occur.
    """
    values = _distinct(depth[::SAMPLED, ::SAMPLED])
    if len(values) < FEWEST_VALUES:
        return otherwise
    steps = np.diff(values) / (LEAST + GROWTH * (values[:-1] - NEAR) ** 2)
    return bool(np.percentile(steps[: len(steps) // 2], 25) > COARSE)  # a gap may be two steps, no step is missed


def _distinct(depth: Float32) -> Float32:
    """The different readings in depth (H, W) m, ascending: few, as a rule, and they are found faster than sorted."""
    bits = np.ascontiguousarray(depth).view(np.int32)
    table = np.zeros(1 << (2 * bits.size).bit_length(), np.int32)
    found = np.empty(bits.size, np.int32)
    return np.sort(found[: _find_distinct(bits.ravel(), table, found)].view(np.float32))


@njit(cache=True, nogil=True)
def _find_distinct(bits, table, found):
    """Fills `found` with the different ones of the bits that are above 0, and returns how many; table (2^k,) is a hash
    table of zeros, of more than twice as many.
    """
    count = 0
    last = np.uint64(table.shape[0] - 1)
    for value in bits:
        if value <= 0:
            continue
        slot = (np.uint64(value) * np.uint64(0x9E3779B97F4A7C15) >> np.uint64(32)) & last
        while table[slot] != 0 and table[slot] != value:
            slot = (slot + np.uint64(1)) & last
        if table[slot] == 0:
            table[slot] = value
            found[count] = value
            count += 1
    return count


def _halved(camera: Camera) -> Camera:
    return Camera(
        camera.width // 2,
        camera.height // 2,
        camera.fx / 2,
        camera.fy / 2,
        (camera.cx + 0.5) / 2 - 0.5,
        (camera.cy + 0.5) / 2 - 0.5,
    )


@njit(cache=True, nogil=True, parallel=True)
def _halve(depth, intensity, half_depth, half_intensity):
    for v in prange(half_depth.shape[0]):
        for u in range(half_depth.shape[1]):
            total = np.float32(0.0)
            nearest = np.float32(np.inf)
            for b in range(2):
                for a in range(2):
                    total += intensity[2 * v + b, 2 * u + a]
                    d = depth[2 * v + b, 2 * u + a]
                    if np.float32(0.0) < d < nearest:
                        nearest = d
            half_intensity[v, u] = total * np.float32(0.25)
            # the mean of the readings on the nearest surface
            farthest = nearest * np.float32(1.0 + DEPTH_GAP)
            total = np.float32(0.0)
            count = np.float32(0.0)
            for b in range(2):
                for a in range(2):
                    d = depth[2 * v + b, 2 * u + a]
                    if np.float32(0.0) < d < farthest:
                        total += d
                        count += np.float32(1.0)
            half_depth[v, u] = total / count if count > np.float32(0.0) else np.float32(0.0)


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def _normals(depth, fx, fy, cx, cy, normals):
    """Normals (3, H, W) from each pixel's four neighbors; 0 at the border, and where one of them is on another surface.

    A row in a pass that holds no branches, so that the compiler vectorises it.
    """
    height, width = depth.shape
    zero, one = np.float32(0.0), np.float32(1.0)
    inv_fx, inv_fy = one / fx, one / fy
    for v in prange(height):
        normals[0, v, 0] = normals[1, v, 0] = normals[2, v, 0] = zero
        normals[0, v, width - 1] = normals[1, v, width - 1] = normals[2, v, width - 1] = zero
        above, below = max(v - 1, 0), min(v + 1, height - 1)
        y = (np.float32(v) - cy) * inv_fy
        for u in range(1, width - 1):
            z = depth[v, u]
            left, right, up, down = depth[v, u - 1], depth[v, u + 1], depth[above, u], depth[below, u]
            x = (np.float32(np.int32(u)) - cx) * inv_fx
            across, along = right - left, down - up
            # the tangents (x + inv_fx) * right - (x - inv_fx) * left, ... along u and along v
            ax, ay = x * across + inv_fx * (right + left), y * across
            bx, by = x * along, y * along + inv_fy * (down + up)
            nx, ny, nz = by * across - along * ay, along * ax - bx * across, bx * ay - by * ax
            apart = max(max(abs(left - z), abs(right - z)), max(abs(up - z), abs(down - z)))
            smooth = (min(min(left, right), min(up, down)) > zero) & (apart <= np.float32(DEPTH_GAP) * z)
            norm = np.sqrt(nx * nx + ny * ny + nz * nz)
            scale = one / norm if smooth & (norm > zero) else zero
            normals[0, v, u], normals[1, v, u], normals[2, v, u] = nx * scale, ny * scale, nz * scale
    normals[:, 0] = zero
    normals[:, height - 1] = zero


def model_intensities(view: SurfaceView, levels: int) -> list[Float32]:
    """The view's intensity in [0, 1] at its own resolution and halvings of it, -1 where nothing is mapped."""
    intensity = cv2.cvtColor(view.color, cv2.COLOR_RGB2GRAY).astype(np.float32) * np.float32(1 / 255)
    intensity[view.depth == 0] = -1
    pyramid = [intensity]
    for _ in range(levels - 1):
        height, width = pyramid[-1].shape
        half = np.empty((height // 2, width // 2), np.float32)
        _halve_mapped(pyramid[-1], half)
        pyramid.append(half)
    return pyramid


@njit(cache=True, nogil=True, parallel=True)
def _halve_mapped(intensity, half):
    """The mean of those of four that are mapped: a young map is full of holes of one pixel."""
    zero, one = np.float32(0.0), np.float32(1.0)
    for v in prange(half.shape[0]):
        for u in range(half.shape[1]):
            total, count = zero, zero
            for b in range(2):
                for a in range(2):
                    i = intensity[2 * v + b, 2 * u + a]
                    if i >= zero:
                        total += i
                        count += one
            half[v, u] = total / count if count >= MAPPED else -one

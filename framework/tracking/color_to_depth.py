"""Registration of color images to depth images taken at other times.

The color image is taken dt = t_color + delay - t_depth after the depth image, where t_color and t_depth are the
timestamps. Its pose is extrapolated from the last two poses at constant velocity:

    T_world_color = interpolate(T_world_last, T_world_camera, 1 + dt / (t_depth - t_last))

Each depth reading is projected into the color image at this pose. Depth is not resampled.

Before tracking, the motion is predicted from the mean velocity of the last PREDICTING_STEPS steps. The velocity of a
single step would amplify pose errors, so that poses could oscillate.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from typing import NamedTuple

import numpy as np

from framework.data import DelayEstimate, Float64, Frame, Int32, Pose, UInt8
from framework.geometry import interpolate, inverse, rotation_angle
from framework.interfaces import SubmapChange
from framework.tracking.color_delay import MAX_STEP, DelayEstimator, is_usable
from framework.tracking.color_to_depth_kernels import register_colors
from framework.tracking.pyramid import intrinsics

MIN_SHIFT = 1.0  # px, minimum image motion between color and depth for a registration
PREDICTING_STEPS = 2  # number of steps in the velocity of a prediction
NEAR = 1.0  # m, assumed depth to compute the image motion
MIN_DISPLACING_DELAY = 0.003  # s, minimum delay with a visible effect on the colors of earlier frames
STRIDE = 8  # px, step between the depth readings used for their median

log = logging.getLogger(__name__)


class RegisteredFrame(NamedTuple):
    """A frame with color registered to depth."""

    frame: Frame  # color is registered to the depth pixels
    T_world_color: Float64  # (4, 4) pose of the color camera at the time of the color image
    # (H, W) flat index of the color pixel of each reading, -1 = none; None = color and depth have the same pixels
    color_pixels: Int32 | None = None


class ColorToDepth:
    """Registration of color to depth with a given or an estimated delay.

    Frames are not changed if the velocity is unknown or if the image motion is small.
    """

    def __init__(self, delay: float | None) -> None:
        """Set the delay of color at equal timestamps, s, or None to estimate it from tracked frames."""
        self._estimator = DelayEstimator() if delay is None else None
        self._usable = False  # True once the estimate was accurate enough
        self._given = 0.0 if delay is None else delay
        self._poses: deque[tuple[float, Float64]] = deque(maxlen=PREDICTING_STEPS + 1)  # time, s, and T_world_camera
        self.displaced_before = False  # True = estimate first used in the last frame; earlier colors are displaced

    @property
    def estimate(self) -> DelayEstimate | None:
        """Estimated delay, or None if the delay is given."""
        return None if self._estimator is None else self._estimator.estimate

    @property
    def delay(self) -> float:
        """Delay in use, s, 0 until it is known."""
        return self._given if self._estimator is None or not self._usable else self._estimator.estimate.seconds

    def predicted(self, frame: Frame) -> Frame:
        """Return the frame with color registered by the predicted motion, for tracking."""
        if not self._is_next(frame):
            return frame
        T_depth_color = self._motion_to_color(frame, PREDICTING_STEPS)
        if T_depth_color is None or _shift(frame, T_depth_color) < MIN_SHIFT:
            return frame
        return frame.with_color(register(frame, inverse(T_depth_color))[0])

    def tracked(self, frame: Frame, pose: Pose) -> RegisteredFrame:
        """Return the frame with color registered by the tracked motion, and store its pose for later frames."""
        self.displaced_before = False
        if pose.lost or not self._is_next(frame):
            self._poses.clear()
        if pose.lost:
            if self._estimator is not None:
                self._estimator.interrupt()
            return RegisteredFrame(frame, pose.T_world_camera)
        self._poses.append((frame.depth_time, pose.T_world_camera))
        if self._estimator is not None:
            self._estimator.add(frame, pose.T_world_camera)
            self._use(frame, self._estimator.estimate)
        T_depth_color = self._motion_to_color(frame, 1)
        if T_depth_color is None:
            return RegisteredFrame(frame, pose.T_world_camera)
        T_world_color = pose.T_world_camera @ T_depth_color
        if _shift(frame, T_depth_color) < MIN_SHIFT:
            return RegisteredFrame(frame, T_world_color)
        color, pixels = register(frame, inverse(T_depth_color))
        return RegisteredFrame(frame.with_color(color), T_world_color, pixels)

    def correct(self, change: SubmapChange, submap: int) -> None:
        """Move the poses of the last frames with the submap of the last frame, which keeps the motion between them."""
        for k, (time, T_world_camera) in enumerate(self._poses):
            self._poses[k] = time, change.moved(submap, T_world_camera)
        if self._estimator is not None:
            self._estimator.correct(change, submap)

    def _use(self, frame: Frame, estimate: DelayEstimate) -> None:
        """Start to use the estimate when it is accurate enough, and log it."""
        if self._usable or not is_usable(estimate):
            return
        self._usable = True
        self.displaced_before = abs(estimate.seconds) >= MIN_DISPLACING_DELAY
        message = "frame %d: color is %.1f ms after depth at equal timestamps (standard deviation %.1f ms)"
        log.info(message, frame.index, 1e3 * estimate.seconds, 1e3 * estimate.deviation)

    def _is_next(self, frame: Frame) -> bool:
        """Return True if the frame follows the last tracked frame within MAX_STEP."""
        return bool(self._poses) and 0 < frame.depth_time - self._poses[-1][0] <= MAX_STEP

    def _motion_to_color(self, frame: Frame, steps: int) -> Float64 | None:
        """Return the motion T_depth_color (4, 4) at the mean velocity of the last steps, or None if it is unknown."""
        if len(self._poses) < 2:
            return None
        (start, T_world_start), (end, T_world_end) = self._poses[-min(steps + 1, len(self._poses))], self._poses[-1]
        dt = frame.color_time + self.delay - frame.depth_time
        if dt == 0.0:
            return np.eye(4)
        T_start_end = inverse(T_world_start) @ T_world_end
        return inverse(T_start_end) @ interpolate(np.eye(4), T_start_end, 1 + dt / (end - start))


def _shift(frame: Frame, T_a_b: Float64) -> float:
    """Return the approximate image motion of points at the depth NEAR for a small camera motion, px."""
    return frame.camera.fx * (rotation_angle(T_a_b[:3, :3]) + math.hypot(*T_a_b[:3, 3]) / NEAR)


def register(frame: Frame, T_color_depth: Float64) -> tuple[UInt8, Int32]:
    """Return the nearest color (H, W, 3) of each depth pixel, and its flat index (H, W).

    The index is -1 outside the color image and without a depth reading. These pixels get the color of the nearest color
    pixel. Pixels without a reading are projected at the median depth. `T_color_depth` (4, 4) transforms points
    from the depth camera to the color camera.
    """
    color, pixels = np.empty_like(frame.color), np.empty(frame.camera.shape, np.int32)
    readings = frame.depth[::STRIDE, ::STRIDE]
    readings = readings[readings > 0]
    median = np.float32(np.median(readings) if len(readings) else NEAR)
    T = np.ascontiguousarray(T_color_depth[:3], np.float32)
    register_colors(frame.depth, median, intrinsics(frame.camera), T, frame.color, color, pixels)
    return color, pixels

"""Registration of color images to depth images taken at other times, from the camera's motion.

Color is taken dt = t_color + delay - t_depth after depth, with the timestamps t_color and t_depth of the images and a
constant delay. With the last two poses, at the times t_last and t_depth, and constant velocity:

    T_world_color = interpolate(T_world_last, T_world_camera, 1 + dt / (t_depth - t_last))

Each depth reading is projected into the color image at this pose. Depth is not resampled.
"""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from framework.data import DelayEstimate, Float64, Frame, Int32, Pose, UInt8
from framework.geometry import interpolate, inverse, rotation_angle
from framework.tracking.color_delay import MAX_STEP, DelayEstimator, is_usable
from framework.tracking.color_delay_kernels import locate_colors
from framework.tracking.pyramid import intrinsics

MIN_SHIFT = 1.0  # px, minimum image motion between color and depth for a registration
MAX_CHANGE = 1.0  # px, maximum image motion between the predicted and the tracked pose to keep a registration
NEAR = 1.0  # m, assumed depth of the points for these image motions
MIN_DISPLACING_DELAY = 0.003  # s, minimum delay with a visible effect on the colors of earlier frames
STRIDE = 8  # px, step between the depth readings used for their median

log = logging.getLogger(__name__)


class RegisteredFrame(NamedTuple):
    """A frame with color registered to depth."""

    frame: Frame  # with the color of each depth pixel
    T_world_color: Float64  # (4, 4) pose of the color camera
    color_pixels: Int32 | None = None  # (H, W) flat index of each reading's color pixel, -1 = none; None = same pixel


class _Registration(NamedTuple):
    source: Frame  # the frame before registration
    T_depth_color: Float64  # (4, 4)
    result: RegisteredFrame


class ColorToDepth:
    """Registration of color to depth, with a given or an estimated delay.

    Without a velocity (at the start, and after lost frames) and for motion below MIN_SHIFT, frames are not changed.
    """

    def __init__(self, delay: float | None) -> None:
        """Set the delay of color, s. None = estimated."""
        self._estimator = DelayEstimator() if delay is None else None
        self._usable = False  # True once the estimate was accurate enough
        self._given = 0.0 if delay is None else delay
        self._last: tuple[float, Float64] | None = None  # time, s, and pose of the last frame
        self._step: tuple[float, Float64] | None = None  # duration, s, and motion T_last_next of the last step
        self._latest: _Registration | None = None
        self.displaced_before = False  # True = estimate first used in the last frame; earlier colors are displaced

    @property
    def estimate(self) -> DelayEstimate | None:
        """The estimated delay, None if the delay is given."""
        return None if self._estimator is None else self._estimator.estimate

    @property
    def delay(self) -> float:
        """The delay in use, s; 0 until it is known."""
        return self._given if self._estimator is None or not self._usable else self._estimator.estimate.seconds

    def predicted(self, frame: Frame) -> Frame:
        """Return the frame with color registered by the last velocity, for tracking."""
        if self._last is None or self._step is None or not 0 < frame.depth_time - self._last[0] <= MAX_STEP:
            return frame
        return self._registered(frame, np.eye(4), *self._step).frame

    def tracked(self, frame: Frame, pose: Pose) -> RegisteredFrame:
        """Return the frame with color registered by the motion to its pose, and store the pose for later frames."""
        self.displaced_before = False
        if pose.lost:
            self._last = self._step = None
            if self._estimator is not None:
                self._estimator.interrupt()
            return RegisteredFrame(frame, pose.T_world_camera)
        last, self._last = self._last, (frame.depth_time, pose.T_world_camera)
        self._step = None
        if last is not None and 0 < frame.depth_time - last[0] <= MAX_STEP:
            self._step = frame.depth_time - last[0], inverse(last[1]) @ pose.T_world_camera
        if self._estimator is not None:
            self._estimator.add(frame, pose.T_world_camera)
            self._use(frame, self._estimator.estimate)
        if self._step is None:
            return RegisteredFrame(frame, pose.T_world_camera)
        return self._registered(frame, pose.T_world_camera, *self._step)

    def _use(self, frame: Frame, estimate: DelayEstimate) -> None:
        """Use the estimate from its first accurate value on, and log this value."""
        if self._usable or not is_usable(estimate):
            return
        self._usable = True
        self.displaced_before = abs(estimate.seconds) >= MIN_DISPLACING_DELAY
        message = "frame %d: color is %.1f ms after depth with equal timestamps (standard deviation %.1f ms)"
        log.info(message, frame.index, 1e3 * estimate.seconds, 1e3 * estimate.deviation)

    def _registered(
        self, frame: Frame, T_world_camera: Float64, seconds: float, T_last_next: Float64
    ) -> RegisteredFrame:
        """Return the frame registered by the motion T_last_next of a step with a duration of `seconds`."""
        dt = frame.color_time + self.delay - frame.depth_time
        if dt == 0.0:
            return RegisteredFrame(frame, T_world_camera)
        T_depth_color = inverse(T_last_next) @ interpolate(np.eye(4), T_last_next, 1 + dt / seconds)
        T_world_color = T_world_camera @ T_depth_color
        if _shift(frame, T_depth_color) < MIN_SHIFT:
            return RegisteredFrame(frame, T_world_color)
        if self._latest is not None and self._latest.source is frame:
            change = inverse(self._latest.T_depth_color) @ T_depth_color
            if _shift(frame, change) < MAX_CHANGE:
                return self._latest.result._replace(T_world_color=T_world_color)
        readings = frame.depth[::STRIDE, ::STRIDE]
        readings = readings[readings > 0]
        if not len(readings):
            return RegisteredFrame(frame, T_world_color)
        color, pixels = register(frame, np.median(readings), inverse(T_depth_color))
        registered = RegisteredFrame(replace(frame, color=color), T_world_color, pixels)
        self._latest = _Registration(frame, T_depth_color, registered)
        return registered


def _shift(frame: Frame, T_a_b: Float64) -> float:
    """Return the image motion, px, of points at the depth NEAR for a small motion of the camera."""
    return frame.camera.fx * (rotation_angle(T_a_b[:3, :3]) + math.hypot(*T_a_b[:3, 3]) / NEAR)


def register(frame: Frame, otherwise: np.float32, T_color_depth: Float64) -> tuple[UInt8, Int32]:
    """Return the color (H, W, 3) at each depth pixel, interpolated bilinearly, and its flat index (H, W).

    The index is -1 outside of the color image and without a reading. A pixel outside of the color image gets the color
    of the nearest pixel. A pixel without a reading gets the color at a depth of `otherwise` m.
    """
    shape = frame.camera.shape
    columns, rows, pixels = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.int32)
    T = np.ascontiguousarray(T_color_depth[:3], np.float32)
    locate_colors(frame.depth, otherwise, intrinsics(frame.camera), T, columns, rows, pixels)
    color = cv2.remap(frame.color, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(color, np.uint8), pixels

"""Path of a hand-held camera in a room.

The path is an ellipse above free floor. The camera faces the furniture on the opposite side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from framework.data import Float64, Int32
from framework.errors import DataError
from framework.synthetic.layout import CELL, Layout

FRAME_RATE = 30.0  # Hz
MAX_SPEED = 0.45  # m/s
MAX_TURN = np.deg2rad(28.0)  # rad/s, maximum angular speed
DISTANCE = 0.5  # m, minimum distance to furniture and walls
RADII = np.arange(0.30, 1.06, 0.15)  # m, radii of candidate ellipses
EYE_HEIGHT = (1.38, 1.58)  # m, range of the mean camera height
PITCH = np.deg2rad(14.0)  # rad, mean angle of the camera below the horizontal
PHASES = 48  # number of positions on the ellipse for the visibility score


@dataclass(frozen=True)
class CameraPath:
    """A smooth closed camera path."""

    center: Float64  # (2,) m, x y in the world frame
    radii: Float64  # (2,) m, along x and y
    height: float  # m, mean height
    start: float  # rad, phase of the first frame
    turn: int  # 1 = counterclockwise as seen from above, -1 = clockwise
    sway: Float64  # (4,) rad, phases of the hand motion
    phase_speed: float = 1.0  # rad/s

    def pose(self, frame: float) -> Float64:
        """Return the pose T_world_camera (4, 4) at a frame.

        Fractional values are between two frames.
        """
        return self.pose_at(self.start + self.turn * self.phase_speed * frame / FRAME_RATE)

    def pose_at(self, phase: float) -> Float64:
        position, yaw, pitch, roll = self._state(np.array([phase]))
        return look(position[0], float(yaw[0]), float(pitch[0]), float(roll[0]))

    def _state(self, phase: Float64) -> tuple[Float64, Float64, Float64, Float64]:
        """Return the positions (N, 3), m, and the yaw, pitch and roll angles (N,), rad, at phases (N,), rad."""
        a, b, c, d = self.sway  # the hand motion has integer harmonics, so that the path is closed
        position = np.empty((len(phase), 3))
        position[:, 0] = self.center[0] + self.radii[0] * np.cos(phase)
        position[:, 1] = self.center[1] + self.radii[1] * np.sin(phase)
        position[:, 2] = self.height + 0.055 * np.sin(2 * phase + a) + 0.018 * np.sin(7 * phase + b)
        across = self.center - position[:, :2]
        yaw = np.arctan2(across[:, 1], across[:, 0]) + np.deg2rad(2.5) * np.sin(2 * phase + c)
        yaw += np.deg2rad(0.4) * np.sin(9 * phase + a)
        pitch = -PITCH + np.deg2rad(4.5) * np.sin(3 * phase + d) + np.deg2rad(0.5) * np.sin(8 * phase + c)
        roll = np.deg2rad(1.6) * np.sin(4 * phase + b)
        return position, yaw, pitch, roll


class LabelView(Protocol):
    """A function that renders a small image (H, W) of instance ids."""

    def __call__(self, T_world_camera: Float64) -> Int32: ...


def plan_path(
    layout: Layout, frames: int, labels: LabelView, wanted: set[int], rng: np.random.Generator, stride: float = 1.0
) -> CameraPath:
    """Return the camera path with the best visibility of the wanted instances.

    Args:
        layout: The layout of the room.
        frames: The number of frames of the path.
        labels: A function that renders the instance ids at a pose.
        wanted: The ids of the instances that should be visible.
        rng: The random number generator.
        stride: The camera speed, relative to the recommended speed. The recommended speed is the highest within
            MAX_SPEED and MAX_TURN.

    Raises:
        DataError: The free floor is too small.
    """
    center, radii = _widest_ellipse(layout)
    turn = 1 if rng.uniform() < 0.5 else -1
    path = CameraPath(center, radii, float(rng.uniform(*EYE_HEIGHT)), 0.0, turn, rng.uniform(0, 2 * np.pi, 4))
    speed = stride * _allowed_phase_speed(path)
    start = _best_start(path, turn * speed * (frames - 1) / FRAME_RATE, labels, wanted)
    return CameraPath(center, radii, path.height, start, turn, path.sway, speed)


def _widest_ellipse(layout: Layout) -> tuple[Float64, Float64]:
    """Return the center (2,) and the radii (2,), m, of the largest ellipse above free floor."""
    angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    free, width, depth = layout.free, layout.width, layout.depth
    rows, columns = free.shape
    y, x = np.meshgrid(np.arange(1, rows - 1, 2), np.arange(1, columns - 1, 2), indexing="ij")
    best: tuple[float, float, Float64, Float64] | None = None
    for rx in RADII:
        for ry in RADII:
            u = np.rint(x[..., None] + rx / CELL * np.cos(angle)).astype(np.int64)
            v = np.rint(y[..., None] + ry / CELL * np.sin(angle)).astype(np.int64)
            inside = (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
            room = np.where(inside, free[np.clip(v, 0, rows - 1), np.clip(u, 0, columns - 1)], 0).min(axis=-1)
            at = np.unravel_index(int(room.argmax()), room.shape)
            if room[at] < DISTANCE + CELL:
                continue
            score = (float(min(rx, ry) + 0.3 * max(rx, ry)), float(room[at]))
            if best is None or score > best[:2]:
                center = np.array([(x[at] + 0.5) * CELL - width / 2, (y[at] + 0.5) * CELL - depth / 2])
                best = (*score, center, np.array([rx, ry]))
    if best is None:
        raise DataError("synthetic scene: expected free floor for a camera path, got none; set another seed or scene")
    return best[2], best[3]


def _allowed_phase_speed(path: CameraPath) -> float:
    """Return the highest phase speed, rad/s, within MAX_SPEED and MAX_TURN."""
    phase = np.linspace(0, 2 * np.pi, 721)
    step = phase[1]
    position, yaw, pitch, roll = path._state(phase)
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1) / step
    yaw = np.unwrap(yaw)
    turn = np.sqrt(sum(np.diff(angle) ** 2 for angle in (yaw, pitch, roll))) / step
    return float(1.0 / max((speed / MAX_SPEED).max(), (turn / MAX_TURN).max()))


def _best_start(path: CameraPath, sweep: float, labels: LabelView, wanted: set[int]) -> float:
    """Return the start phase, rad, from which most wanted instances are visible along the path.

    `sweep` is the change of the phase along the path, rad, negative if clockwise as seen from above.
    """
    phases = 2 * np.pi * np.arange(PHASES) / PHASES
    ids = sorted(wanted)
    pixels = np.array(
        [[np.count_nonzero(view == i) for i in ids] for view in (labels(path.pose_at(p)) for p in phases)]
    )
    steps = min(PHASES, max(1, round(abs(sweep) / (2 * np.pi) * PHASES) + 1))
    direction = 1 if sweep >= 0 else -1
    windows = (np.arange(PHASES)[:, None] + direction * np.arange(steps)) % PHASES
    seen = pixels[windows].max(axis=1)  # (PHASES, ids), best view of each instance
    score = (seen >= 40).sum(axis=1) + 1e-3 * np.minimum(seen, 400).mean(axis=1)
    return float(phases[int(score.argmax())])


def look(position: Float64, yaw: float, pitch: float, roll: float) -> Float64:
    """Return the pose T_world_camera (4, 4) of a camera with given position and angles.

    Args:
        position: The position (3,), m.
        yaw: The yaw about z, rad. A camera with a yaw of 0 faces +x, and one with a yaw of pi / 2 faces +y.
        pitch: The pitch, rad. A camera with a positive pitch faces up.
        roll: The roll about the optical axis, rad. A positive roll is clockwise as seen from behind the camera.
    """
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2] = c * right + s * down, c * down - s * right, forward
    T[:3, 3] = position
    return T

"""Tour of a hand-held camera through a building.

The tour passes through all rooms of both rows and closes a loop at the first room. It then passes through the first row
again, and returns to its start through the corridor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from framework.data import Float64
from framework.synthetic.buildings.building import CORRIDOR_WIDTH, WALKWAY, WALL, Building, RoomPlace
from framework.synthetic.walk import FRAME_RATE, PITCH, look

SPEED = 0.9  # m/s, maximum speed
TURN = np.deg2rad(50.0)  # rad/s, maximum angular speed about the vertical
STEP = 0.01  # m, distance between two samples of the path
ROUNDING = 0.25  # m, standard deviation of the Gaussian filter of the positions
BEHIND, AHEAD = 0.5, 1.0  # m, the camera faces from the position behind to the position ahead on the path
GAZE = 0.6  # m, standard deviation of the Gaussian filter of the directions
LOOK, LOOK_LENGTH = np.deg2rad(60.0), 0.9  # rad and m, how far and how long the camera turns towards a passed room
EYE_HEIGHT = 1.45  # m, mean height of the camera
ROW = CORRIDOR_WIDTH / 2 + WALL + WALKWAY / 2  # m, distance of the path through a row from the middle of the corridor


@dataclass(frozen=True)
class BuildingTour:
    """A closed camera path, which is repeated after its last frame."""

    frames: int  # number of frames of the path
    states: Float64  # (frames, 3) x, y in m and yaw in rad
    sway: Float64  # (4,) rad, phases of the hand motion

    def pose(self, frame: float) -> Float64:
        """Return the pose T_world_camera (4, 4) at a frame. Fractional values are between two frames."""
        k = np.arange(self.frames + 1)
        turned = self.states[0, 2] - self.states[-1, 2]
        turned = self.states[-1, 2] + (turned + np.pi) % (2 * np.pi) - np.pi
        closed = np.concatenate([self.states, [[*self.states[0, :2], turned]]])
        x, y, yaw = (float(np.interp(frame % self.frames, k, column)) for column in closed.T)
        phase = 2 * np.pi * frame / self.frames  # the hand motion has integer harmonics, so that the path is closed
        a, b, c, d = self.sway
        slow, fast = (max(1, round(self.frames / (FRAME_RATE * period))) for period in (5.0, 1.3))
        z = EYE_HEIGHT + 0.05 * np.sin(slow * phase + a) + 0.012 * np.sin(fast * phase + b)
        yaw += np.deg2rad(1.0) * np.sin(fast * phase + c)
        pitch = -PITCH + np.deg2rad(5.0) * np.sin(slow * phase + d) + np.deg2rad(0.6) * np.sin(fast * phase + a)
        roll = np.deg2rad(1.5) * np.sin(slow * phase + b)
        return look(np.array([x, y, z]), yaw, pitch, roll)


def plan_tour(building: Building, rng: np.random.Generator) -> BuildingTour:
    """Return the tour of a building."""
    north, south = ([room for room in building.rooms if room.side == side] for side in (1, -1))
    first_row = _through(north, 1)
    points = [*first_row, *_through(south[::-1], -1), *first_row]
    return _timed(*_sampled(np.array([*points, points[0]])), rng.uniform(0, 2 * np.pi, 4))


def _through(rooms: Sequence[RoomPlace], direction: int) -> list[tuple[float, float, float]]:
    """Return the path from the corridor through the rooms of a row and back to the corridor.

    Args:
        rooms: The rooms, in the order of the path.
        direction: 1 = to the east, -1 = to the west.

    Returns:
        Points of the path, x and y in m, and the angle by which the camera turns towards the room there, rad.
    """
    side, first, last = rooms[0].side, rooms[0].x, rooms[-1].x
    y, turn = side * ROW, side * direction * LOOK
    before_exit = last - direction * LOOK_LENGTH
    passed = [*((room.x, y, turn) for room in rooms[1:-1]), (before_exit, y, turn)]
    return [(first, 0.0, 0.0), (first, y, 0.0), *passed, (last, y, 0.0), (last, 0.0, 0.0)]


def _sampled(points: Float64) -> tuple[Float64, Float64]:
    """Return positions (N, 2), m, at intervals of about STEP on the rounded path, and the yaw (N,), rad, at each.

    Args:
        points: Points (P, 3) of a closed path, see `_through`. The last one is the first one.
    """
    legs = np.hypot(*np.diff(points[:, :2], axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(legs)])
    s = np.arange(0.0, along[-1], STEP)
    corners = np.stack([np.interp(s, along, points[:, k]) for k in (0, 1)], axis=1)
    positions = gaussian_filter1d(corners, ROUNDING / STEP, axis=0, mode="wrap")
    ahead, behind = (np.roll(positions, shift, axis=0) for shift in (-round(AHEAD / STEP), round(BEHIND / STEP)))
    yaw = np.unwrap(np.arctan2(*(ahead - behind).T[::-1]))
    winding = np.linspace(0, 2 * np.pi * round((yaw[-1] - yaw[0]) / (2 * np.pi)), len(s))
    yaw = winding + gaussian_filter1d(yaw - winding, GAZE / STEP, mode="wrap")
    for middle, turn in zip(along, points[:, 2], strict=True):
        yaw += turn * np.exp(-(((s - middle) / LOOK_LENGTH) ** 2))
    return positions, yaw


def _timed(positions: Float64, yaw: Float64, sway: Float64) -> BuildingTour:
    """Return the tour along positions (N, 2), m, with a yaw (N,), rad, within SPEED and TURN."""
    step = np.hypot(*np.diff(positions, axis=0, append=positions[:1]).T)
    turned = np.abs((np.diff(yaw, append=yaw[:1]) + np.pi) % (2 * np.pi) - np.pi)
    slow = maximum_filter1d(np.maximum(step / SPEED, turned / TURN), round(ROUNDING / STEP), mode="wrap")
    duration = gaussian_filter1d(slow, ROUNDING / STEP, mode="wrap")  # s, of each step
    time = np.concatenate([[0.0], np.cumsum(duration)[:-1]])
    frames = int(duration.sum() * FRAME_RATE)
    at = np.arange(frames) * duration.sum() / frames
    states = np.stack([np.interp(at, time, column) for column in (*positions.T, yaw)], axis=1)
    return BuildingTour(frames, states, sway)

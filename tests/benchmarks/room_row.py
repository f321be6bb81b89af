"""Camera path through a row of identical, furnished rooms.

The amount of new surface is the same in every frame. The world has x along the row, y to the left and z up. The path
repeats in every room. Two segments of the path that are a whole number of rooms apart show identical images of
different places. A higher cost of the second segment is therefore caused by the size of the map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from framework.data import Camera, Float32, Float64, Frame, FrameTruth, Int32, UInt8
from framework.interfaces import RGBDSequence

FRAMES_PER_ROOM = 260  # 1.5 cm per frame
LENGTH, HALF_WIDTH, HEIGHT = 3.9, 2.0, 2.6  # m, size of a room
WALL = 0.06  # m, half the thickness of the wall between two rooms
DOOR = (0.6, 2.1)  # m, half of the width, and the height
CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
CAMERA_HEIGHT = 1.4  # m, above the floor
PAN = np.deg2rad(35.0)  # rad, maximum angle of the camera to the left and to the right
PITCH = np.deg2rad(12.0)  # rad, mean angle of the camera below the horizontal

# Boxes of a room: lower and upper corner (m, x from the start of the room) and class. None is a part of the building.
FURNITURE = (
    ((-WALL, -HALF_WIDTH, 0.0), (WALL, -DOOR[0], HEIGHT), None),
    ((-WALL, DOOR[0], 0.0), (WALL, HALF_WIDTH, HEIGHT), None),
    ((-WALL, -DOOR[0], DOOR[1]), (WALL, DOOR[0], HEIGHT), None),
    ((0.5, 0.9, 0.68), (1.7, 1.7, 0.74), "dining table"),
    ((0.55, 0.95, 0.0), (0.62, 1.02, 0.68), None),
    ((1.58, 1.58, 0.0), (1.65, 1.65, 0.68), None),
    ((0.8, 1.1, 0.74), (1.1, 1.35, 0.98), "microwave"),
    ((1.3, 1.2, 0.74), (1.38, 1.45, 1.0), "book"),
    ((2.3, 1.1, 0.0), (3.5, 2.0, 0.45), "couch"),
    ((2.3, 1.8, 0.45), (3.5, 2.0, 0.9), "couch"),
    ((0.4, -2.0, 0.0), (1.1, -1.35, 1.75), "refrigerator"),
    ((1.5, -1.3, 0.0), (1.95, -0.85, 0.46), "chair"),
    ((1.5, -1.3, 0.46), (1.56, -0.85, 0.95), "chair"),
    ((2.3, -2.0, 0.0), (3.6, -1.55, 0.5), None),
    ((2.5, -1.8, 0.6), (3.4, -1.74, 1.15), "tv"),
    ((2.9, -1.77, 0.5), (3.0, -1.72, 0.6), None),
)
BOXES = np.array([(*low, *high) for low, high, _ in FURNITURE], np.float32)
OBJECTS = ("dining table", "microwave", "book", "couch", "refrigerator", "chair", "tv")  # one instance of each per room
OBJECT_OF_BOX = np.array([OBJECTS.index(name) + 1 if name else 0 for *_, name in FURNITURE], np.int32)


@dataclass
class RoomRow(RGBDSequence):
    """Sequence of noise-free frames along the path, with exact poses and instances."""

    frames: int = 2000

    def __post_init__(self) -> None:
        self.camera, self.name = CAMERA, "row of rooms"
        rooms = self.frames // FRAMES_PER_ROOM + 4  # from the room behind the camera to the last visible one
        self.class_names = {r * len(OBJECTS) + k: name for r in range(rooms) for k, name in enumerate(OBJECTS, start=1)}

    def __len__(self) -> int:
        return self.frames

    def __getitem__(self, k: int) -> Frame:
        T_world_camera = pose_at(k)
        depth = np.empty(CAMERA.shape, np.float32)
        color = np.empty((*CAMERA.shape, 3), np.uint8)
        ids = np.empty(CAMERA.shape, np.int32)
        _render(T_world_camera, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, BOXES, OBJECT_OF_BOX, depth, color, ids)
        return Frame(k, k / 30, color, depth, CAMERA, T_world_camera, FrameTruth(ids, self.class_names))


def pose_at(k: int) -> Float64:
    """Return T_world_camera (4, 4) of frame k. The path leads through the doors, and the camera pans left and right."""
    phase = 2 * np.pi * k / FRAMES_PER_ROOM
    yaw, pitch = PAN * np.sin(phase), -PITCH + np.deg2rad(2.0) * np.sin(3 * phase)
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2] = right, np.cross(forward, right), forward
    T[:3, 3] = (
        LENGTH * (k / FRAMES_PER_ROOM + 0.5),
        0.15 * np.sin(2 * phase),
        CAMERA_HEIGHT + 0.03 * np.sin(5 * phase),
    )
    return T


@njit(cache=True, nogil=True, parallel=True)
def _render(
    T: Float64,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    boxes: Float32,
    object_of_box: Int32,
    depth: Float32,
    color: UInt8,
    ids: Int32,
) -> None:
    """Render the depth, the color and the instance id of every pixel."""
    ox, oy, oz = np.float32(T[0, 3]), np.float32(T[1, 3]), np.float32(T[2, 3])
    for v in prange(depth.shape[0]):
        for u in range(depth.shape[1]):
            a, b = (u - cx) / fx, (v - cy) / fy
            dx = np.float32(T[0, 0] * a + T[0, 1] * b + T[0, 2])
            dy = np.float32(T[1, 0] * a + T[1, 1] * b + T[1, 2])
            dz = np.float32(T[2, 0] * a + T[2, 1] * b + T[2, 2])
            # the shell of all rooms: side walls, floor and ceiling
            t_side = ((HALF_WIDTH if dy > 0 else -HALF_WIDTH) - oy) / dy if dy != 0 else np.inf
            t_level = ((HEIGHT if dz > 0 else 0.0) - oz) / dz if dz != 0 else np.inf
            t = min(t_side, t_level)
            box = -1 if t_side < t_level else (-2 if dz > 0 else -3)
            # room by room along the ray, until the hit is in front of the next room
            room = int(np.floor((ox + WALL) / LENGTH))
            hit_room = room
            while True:
                begin = np.float32(room * LENGTH)
                for k in range(boxes.shape[0]):
                    near = _entry(boxes[k], begin, ox, oy, oz, dx, dy, dz)
                    if near < t:
                        t, box, hit_room = near, k, room
                if dx == 0:
                    break
                leaves = ((room + 1 if dx > 0 else room) * LENGTH - WALL - ox) / dx
                if leaves > t:
                    break
                room += 1 if dx > 0 else -1
            depth[v, u] = t
            ids[v, u] = 0
            if box >= 0 and object_of_box[box] > 0:
                ids[v, u] = (hit_room + 1) * 7 + object_of_box[box]
            _paint(ox + t * dx, oy + t * dy, oz + t * dz, box, color[v, u])


@njit(cache=True, nogil=True)
def _entry(box, begin, ox, oy, oz, dx, dy, dz):
    """Return the ray parameter where a ray enters a box of the room at x = `begin`, or inf without an intersection."""
    near, far = np.float32(1e-3), np.float32(np.inf)
    for axis in range(3):
        o = ox - begin if axis == 0 else (oy if axis == 1 else oz)
        d = dx if axis == 0 else (dy if axis == 1 else dz)
        if d == 0:
            if o < box[axis] or o > box[axis + 3]:
                return np.float32(np.inf)
            continue
        one, other = (box[axis] - o) / d, (box[axis + 3] - o) / d
        near, far = max(near, min(one, other)), min(far, max(one, other))
    return near if near < far else np.float32(np.inf)


@njit(cache=True, nogil=True)
def _paint(x, y, z, box, out):
    """Write the color of a point of the solid texture, which is the same in each room and differs between boxes."""
    x -= LENGTH * np.floor(x / LENGTH)  # a room contains a whole number of waves along x
    turn = np.float32(2 * np.pi / LENGTH)
    one = np.sin(6 * turn * x + 5 * y + 3 * z + box)
    two = np.sin(-9 * turn * x + 13 * y + 11 * z + 2 * box)
    three = np.sin(17 * turn * x - 23 * y + 19 * z)
    for c in range(3):
        tone = 120 + 60 * np.sin(2.4 * box + 2.1 * c)
        out[c] = np.uint8(min(255.0, max(0.0, tone + 22 * one + 18 * two + 14 * three)))

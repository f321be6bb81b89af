"""Furniture made of boxes, on a floor in front of a wall. Mask errors are configurable."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from framework.data import Camera, Detections, Frame, FrameTruth
from framework.rendering.rasterizer_kernels import NO_TRIANGLE
from framework.synthetic.ray_caster import RayCaster, image_rays

CAMERA = Camera(320, 240, 270.0, 270.0, 159.5, 119.5)
CLASSES = ("chair", "dining table", "couch")
ROOM = ((-4.0, -4.0, -0.1, 4.0, 4.0, 0.0), (-4.0, 2.0, 0.0, 4.0, 2.1, 3.0))  # floor and wall, as boxes
Box = tuple[float, float, float, float, float, float]  # x0 y0 z0 x1 y1 z1 m; z is up


@dataclass
class BoxScene:
    """Objects, each a list of boxes. Objects are numbered from 1, and `room` is not an object."""

    objects: list[list[Box]]
    room: tuple[Box, ...] = ROOM
    caster: RayCaster = field(init=False)

    @property
    def count(self) -> int:
        """Return the number of objects, including the room."""
        return 1 + len(self.objects)

    def __post_init__(self) -> None:
        boxes = [(0, box) for box in self.room]
        boxes += [(k, box) for k, parts in enumerate(self.objects, start=1) for box in parts]
        self.owner = np.repeat([k for k, _ in boxes], 12)
        corners = np.concatenate([_corners(box) for _, box in boxes])
        triangles = np.concatenate([BOX_TRIANGLES + 8 * i for i in range(len(boxes))])
        self.caster = RayCaster(corners.astype(np.float32), triangles.astype(np.int32))

    def frame(self, T_world_camera: np.ndarray, index: int) -> Frame:
        hits = self.caster.cast(image_rays(CAMERA, T_world_camera))
        met = hits.triangle != NO_TRIANGLE
        ids = np.where(met, self.owner[hits.triangle], 0).astype(np.int32)
        color = (80 + 40 * ids[..., None] % 160 + np.zeros(3)).astype(np.uint8)
        depth = np.where(met, hits.distance, 0).astype(np.float32)
        truth = FrameTruth(ids, dict.fromkeys(range(1, len(self.objects) + 1), CLASSES[0]))
        return Frame(index, index / 30, color, depth, CAMERA, T_world_camera, truth)

    def owners(self, points: np.ndarray, tolerance: float) -> np.ndarray:
        """Return the object (P,) within `tolerance` m of each point, 0 = room, -1 = none or several."""
        near = np.stack([_distance(points, parts) <= tolerance for parts in [list(self.room), *self.objects]], axis=1)
        return np.where(near.sum(axis=1) == 1, near.argmax(axis=1), -1)


def look_from(x: float, y: float, z: float, at: tuple[float, float, float]) -> np.ndarray:
    """Return T_world_camera of an upright camera at (x, y, z) that looks at the point `at`."""
    forward = np.array(at) - (x, y, z)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = (x, y, z)
    return T


def bled(mask: np.ndarray, px: int) -> np.ndarray:
    """Return the mask, dilated by `px` pixels."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * px + 1, 2 * px + 1))
    return cv2.dilate(mask.astype(np.uint8), kernel) > 0


def detected(masks: list[np.ndarray], class_ids: list[int]) -> Detections:
    """Return detections with score 0.8. The probability of the class is 0.6, and that of each other class is 0.2."""
    n = len(masks)
    probabilities = np.full((n, len(CLASSES)), 0.2, np.float32)
    probabilities[np.arange(n), class_ids] = 0.6
    return Detections(
        masks=np.array(masks, np.bool_).reshape(n, *CAMERA.shape),
        boxes=np.zeros((n, 4), np.float32),
        scores=np.full(n, 0.8, np.float32),
        class_probabilities=probabilities,
        classes=CLASSES,
    )


def table(x: float, y: float, width: float = 1.4, depth: float = 0.8, height: float = 0.74) -> list[Box]:
    """Return the boxes of a table at (x, y), m. The top is 4 cm thick, and the legs are 6 cm thick."""
    half = width / 2, depth / 2
    legs = [
        (x + i * (half[0] - 0.06) - 0.03, y + j * (half[1] - 0.06) - 0.03, 0.0,
         x + i * (half[0] - 0.06) + 0.03, y + j * (half[1] - 0.06) + 0.03, height - 0.04)
        for i in (-1, 1) for j in (-1, 1)
    ]  # fmt: skip
    return [(x - half[0], y - half[1], height - 0.04, x + half[0], y + half[1], height), *legs]


def chair(x: float, y: float) -> list[Box]:
    """Return the boxes of a chair at (x, y), m. The seat is at 45 cm, and the back is toward +y."""
    legs = [(x + i * 0.19 - 0.02, y + j * 0.19 - 0.02, 0.0, x + i * 0.19 + 0.02, y + j * 0.19 + 0.02, 0.42)
            for i in (-1, 1) for j in (-1, 1)]  # fmt: skip
    return [(x - 0.225, y - 0.225, 0.42, x + 0.225, y + 0.225, 0.47),
            (x - 0.225, y + 0.185, 0.47, x + 0.225, y + 0.225, 0.95), *legs]  # fmt: skip


BOX_TRIANGLES = np.array(
    [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
     [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]]
)  # fmt: skip


def _corners(box: Box) -> np.ndarray:
    """Return the corners (8, 3), m. x varies fastest."""
    x, y, z = (box[0], box[3]), (box[1], box[4]), (box[2], box[5])
    return np.array([(x[i], y[j], z[k]) for k in (0, 1) for j in (0, 1) for i in (0, 1)])


def _distance(points: np.ndarray, boxes: list[Box]) -> np.ndarray:
    """Return the distance, m, of points (P, 3) from the nearest box, 0 = inside a box."""
    distances = [
        np.linalg.norm(np.maximum(np.maximum(np.array(box[:3]) - points, points - np.array(box[3:])), 0), axis=1)
        for box in boxes
    ]
    return np.min(distances, axis=0)

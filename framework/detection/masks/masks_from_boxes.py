"""Masks from boxes and depth: the connected foreground of each box.

For each box:

1. The depth readings form a histogram over log depth, because sensor noise and the depth step per pixel of a slanted
   surface grow with depth. The weight of a reading decreases from 1 at the center of the box to 0 at its border.
2. A mode is a run of bins between two valleys. Valleys are bins below `VALLEY` of the run's peak. The foreground is the
   nearest mode with at least `significance` of the weight. Thin objects in front have less weight, and the wall behind
   is farther.
3. Two neighboring foreground pixels (4-connectivity) are connected if their depth step is small enough. The limit is
   the step of a surface with the slant `max_slant`, z tan(max_slant) / f per pixel, plus the sensor's noise. The
   connected component with the largest weight is the object.
4. Holes of the object are closed if they have no readings or are small.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from framework.data import Bool, Camera, Float32
from framework.detection.masks.masks_from_boxes_kernels import fill_masks
from framework.sensors.noise_models import SensorKind

LARGEST_CLOSED_HOLE = 0.01  # fraction of the box; larger holes with readings show the background


def masks_in_boxes(
    borders: Float32, depth: Float32, camera: Camera, significance: float, max_slant: float, min_readings: float,
    sensor: SensorKind = SensorKind.KINECT_V1,
) -> tuple[Bool, Bool]:  # fmt: skip
    """Return the masks (N, H, W) of the objects in boxes, and an array (N,), True for boxes with enough depth readings.

    The masks of other boxes are empty.

    Args:
        borders: (N, 4) x1 y1 x2 y2 px, pixel centers at integers.
        depth: (H, W) m, 0 = no reading.
        camera: The camera of the depth image.
        significance: Minimum fraction of the weighted readings in the foreground.
        max_slant: Maximum angle between the image plane and a surface, degrees.
        min_readings: Minimum fraction of a box's pixels that have a depth reading.
        sensor: The kind of the depth sensor.
    """
    height, width = depth.shape
    masks = np.zeros((len(borders), height, width), np.bool_)
    step = math.tan(math.radians(max_slant)) / min(camera.fx, camera.fy)
    borders = np.ascontiguousarray(borders, np.float64)
    windows = np.clip(np.ceil(borders), 0, [width, height, width, height]).astype(np.int64)
    found = fill_masks(borders, windows, depth, significance, step, sensor.noise, min_readings, masks)
    for i in np.flatnonzero(found):
        u1, v1, u2, v2 = windows[i]
        _close_holes(masks[i, v1:v2, u1:u2], depth[v1:v2, u1:u2] > 0)
    return masks, found


def _close_holes(mask: Bool, has_reading: Bool) -> None:
    """Close the holes of `mask` (h, w) in place, except holes at its border and large holes with depth readings.

    `has_reading`: (h, w), True where a pixel has a depth reading.
    """
    count, component = cv2.connectedComponents((~mask).view(np.uint8), connectivity=4)
    sizes = np.bincount(component.ravel(), minlength=count)
    readings = np.bincount(component[has_reading], minlength=count)
    closed = (readings == 0) | (sizes <= LARGEST_CLOSED_HOLE * mask.size)
    closed[np.concatenate([component[0], component[-1], component[:, 0], component[:, -1]])] = False
    closed[0] = True  # the mask itself
    mask[:] = closed[component]

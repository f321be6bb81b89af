"""Segmentation of the foreground in bounding boxes from depth.

For each box:

1. Compute a histogram of log depth. The weight of a reading decreases from 1 at the center of the box to 0 at its
   border. Log depth is used because noise and depth steps grow with depth.
2. Select the nearest mode of the histogram with at least `significance` of the total weight as foreground. Thin objects
   in front have less weight, and the background is farther. Neighboring modes are separated by valleys, i.e. bins
   below the fraction VALLEY of the peak.
3. Connect neighboring foreground pixels with similar depths. The limit of the depth step is z tan(max_slant) / f, the
   step of a slanted surface, plus the sensor noise. The component with the largest weight is the object.
4. Close holes that have no readings or are small.
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
    """Segment the objects in boxes by depth.

    Args:
        borders: The boxes (N, 4) x1 y1 x2 y2, px, with pixel centers at integers.
        depth: The depth (H, W), m, 0 = no reading.
        camera: The camera of the depth image.
        significance: The minimum fraction of the weighted readings in the foreground.
        max_slant: The maximum angle between the image plane and a surface, degrees.
        min_readings: The minimum fraction of pixels with a depth reading in a box.
        sensor: The kind of the depth sensor.

    Returns:
        The masks (N, H, W), and an array (N,) that is True for boxes with enough depth readings. Other masks are empty.
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
    """Close holes in a mask (h, w), in place.

    Holes at the border of the box and large holes with depth readings stay open.
    """
    count, component = cv2.connectedComponents((~mask).view(np.uint8), connectivity=4)
    sizes = np.bincount(component.ravel(), minlength=count)
    readings = np.bincount(component[has_reading], minlength=count)
    closed = (readings == 0) | (sizes <= LARGEST_CLOSED_HOLE * mask.size)
    closed[np.concatenate([component[0], component[-1], component[:, 0], component[:, -1]])] = False
    closed[0] = True  # the mask itself
    mask[:] = closed[component]

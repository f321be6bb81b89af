"""From boxes to masks by depth: what stands in front in a box, and holds together, is taken for the object.

A box detector says where an object is, not which pixels are its own. The rule, for each box:

1. The readings inside are weighted by how near they lie to the box's centre, 1 there and 0 at its border, and counted
   in a histogram over log depth, because sensor noise and the slant of surfaces per pixel grow with depth.
2. A mode is a run of bins between two valleys, bins that hold less than `VALLEY` of the run's highest. The nearest mode
   with at least `significance` of the weight is the foreground: a thin thing in front of the object does not have it,
   and the wall behind is not the nearest.
3. The foreground's pixels are connected to their four neighbours where a surface less slanted than `max_slant` explains
   the difference in depth: z tan(max_slant) / f from one pixel to the next, and the sensor's noise, which grows with
   z^2. The component with the most weight is the object: the one at the centre.
4. What it encloses is closed where there is no reading, or where the hole is small.

A box in which too few pixels have a reading has no mask: its object is not in front of anything that is known.
"""

from __future__ import annotations

import math

import numpy as np

from framework.data import Bool, Camera, Float32
from framework.detection.masks.masks_from_boxes_kernels import fill_masks


def masks_in_boxes(
    borders: Float32, depth: Float32, camera: Camera, significance: float, max_slant: float, min_readings: float
) -> tuple[Bool, Bool]:
    """The masks (N, H, W) of the objects in boxes, and (N,) whether there was enough depth for one.

    borders (N, 4) x1 y1 x2 y2 px with pixel centres at integers; depth (H, W) m, 0 = no reading. `significance`: share
    of the centre-weighted readings that the foreground has at least. `max_slant`: degrees between the image plane and
    a surface, at most. `min_readings`: share of the box's pixels in the image that must have a reading. A mask without
    enough depth is empty.
    """
    masks = np.zeros((len(borders), *depth.shape), np.bool_)
    step = math.tan(math.radians(max_slant)) / min(camera.fx, camera.fy)
    found = fill_masks(np.ascontiguousarray(borders, np.float64), depth, significance, step, min_readings, masks)
    return masks, found

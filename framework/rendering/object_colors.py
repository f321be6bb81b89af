"""Consistent colors for the objects in several maps of one scene."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.optimize import linear_sum_assignment

from framework.data import Int32, SceneTruth, UInt8
from framework.rendering.palette import DARK, instance_colors

SAME_OBJECT_IOU = 0.25  # minimum IoU of matching instances
UNKNOWN = (206, 184, 152)  # RGB of ground-truth instances of unknown class (not evaluated)


class ObjectColors:
    """Numbers and colors of the objects in one scene.

    The objects are the ground-truth instances and the unmatched instances of the maps, numbered from 1.
    """

    def __init__(self, truth: SceneTruth) -> None:
        ids = np.setdiff1d(truth.instance_ids, [0]).tolist()
        self.true_objects = {key: k for k, key in enumerate(ids, start=1)}  # object number by ground-truth id
        self.name_of = {k: name for key, k in self.true_objects.items() if (name := truth.class_names.get(key))}
        self.color_of: dict[int, UInt8] = dict.fromkeys(self.true_objects.values(), np.array(UNKNOWN, np.uint8))
        named = [key for key in ids if self.true_objects[key] in self.name_of]
        centroids = [truth.points_world[truth.instance_ids == key].mean(axis=0) for key in named]
        colors = instance_colors(np.array(centroids, np.float64).reshape(-1, 3))
        self.color_of |= {self.true_objects[key]: color for key, color in zip(named, colors, strict=True)}

    def objects(self, ids: Int32, true_ids: Int32) -> dict[int, int]:
        """Return the object number of each instance of a map, by instance id.

        Unmatched instances become new objects with dark colors.

        Args:
            ids: The instance (V,) of each point of the map, 0 = none.
            true_ids: The ground-truth instance (V,) of each point, 0 = none.
        """
        same = {key: self.true_objects[true] for key, true in same_objects(ids, true_ids).items()}
        others = np.setdiff1d(ids, [0, *same]).tolist()
        own = {key: k for k, key in enumerate(others, start=1 + len(self.color_of))}
        self.color_of |= dict(zip(own.values(), instance_colors(np.zeros((len(own), 3)), DARK), strict=True))
        return same | own


def same_objects(ids: Int32, true_ids: Int32) -> dict[int, int]:
    """Match instances to ground-truth instances, and return the ground-truth id by instance id.

    The matching is one-to-one and maximizes the sum of the IoUs. Pairs with a low IoU are omitted.

    Args:
        ids: The instance (V,) of each point, 0 = none.
        true_ids: The ground-truth instance (V,) of each point, 0 = none.
    """
    found, rows = np.unique(ids, return_inverse=True)
    true, columns = np.unique(true_ids, return_inverse=True)
    common = np.bincount(rows * len(true) + columns, minlength=len(found) * len(true)).reshape(len(found), len(true))
    iou = common / np.maximum(common.sum(axis=1)[:, None] + common.sum(axis=0)[None] - common, 1)
    iou[found == 0] = 0
    iou[:, true == 0] = 0
    pairs = zip(*linear_sum_assignment(-iou), strict=True)
    return {int(found[k]): int(true[t]) for k, t in pairs if iou[k, t] >= SAME_OBJECT_IOU}


def relabeled(ids: Int32, object_of: Mapping[int, int]) -> Int32:
    """Return the object number (V,) of each point from its instance (V,), 0 = none."""
    values, inverse = np.unique(ids, return_inverse=True)
    return np.array([object_of.get(key, 0) for key in values.tolist()], np.int32)[inverse]

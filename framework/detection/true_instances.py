"""Ground-truth instances of a frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from framework.data import Bool, Frame, Int32
from framework.errors import DataError


@dataclass(frozen=True)
class TrueInstances:
    """The N visible ground-truth instances of known class.

    They are sorted by decreasing number of pixels, then by id.
    """

    ids: Int32  # (N,)
    class_ids: Int32  # (N,) index into the detector's classes
    masks: Bool  # (N, H, W)

    def __len__(self) -> int:
        return len(self.ids)


def true_instances(frame: Frame, classes: Sequence[str], min_pixels: int = 1) -> TrueInstances:
    """Return the visible ground-truth instances of a frame.

    Args:
        frame: The frame.
        classes: The class names of the detector.
        min_pixels: The minimum number of pixels of an instance.

    Raises:
        DataError: The sequence has no instance ground truth, or a class is missing from `classes`.
    """
    if frame.truth is None:
        raise DataError(
            f"frame {frame.index}: expected instance ground truth for this detector, got none; set "
            "dataset.frame_ground_truth=true (scenenn, scannet) or dataset.ground_truth=PATH, or choose "
            "another dataset or detector"
        )
    index = {name: k for k, name in enumerate(classes)}
    names = {i: name for i, name in frame.truth.class_names.items() if i != 0 and name is not None}
    unknown = sorted({name for name in names.values() if name not in index})
    if unknown:
        raise DataError(
            f"frame {frame.index}: expected ground-truth classes among the {len(classes)} classes of the detector, got "
            f"{', '.join(map(repr, unknown))}; list all names in a file and set detector.label_space to this file"
        )

    found, areas = np.unique(frame.truth.instance_ids, return_counts=True)
    chosen = np.array([i in names for i in found.tolist()], np.bool_) & (areas >= min_pixels)
    found = found[chosen][np.argsort(-areas[chosen], kind="stable")]
    return TrueInstances(
        ids=found.astype(np.int32),
        class_ids=np.array([index[names[i]] for i in found.tolist()], np.int32),
        masks=frame.truth.instance_ids == found[:, None, None],
    )

"""Ground-truth masks of an analytic scene, and fusion of these masks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from framework.data import Detections, Frame, Pose
from framework.interfaces import MapFuser
from framework.refinement.lifting import lift

CLASSES = ("chair", "bed")
PROBABILITIES = (0.7, 0.3)  # class probabilities of every detection


def masks_of(frame: Frame) -> list[np.ndarray]:
    """Return a mask (H, W) for each ground-truth instance of the frame."""
    assert frame.truth is not None
    return [frame.truth.instance_ids == i for i in frame.truth.class_names]


def fuse_masks(
    fuser: MapFuser,
    frame: Frame,
    masks: Sequence[np.ndarray],
    scores: Sequence[float],
    probabilities: Sequence[tuple[float, float]] | None = None,
    embeddings: np.ndarray | None = None,
    space: str = "words@1",
) -> None:
    """Fuse the frame at its ground-truth pose with these masks and class distributions.

    `embeddings` (n, D) are optional.
    """
    assert frame.T_world_camera is not None
    pose = Pose(frame.T_world_camera)
    detections = detections_of(frame, masks, scores, probabilities, embeddings, space)
    fuser.fuse(frame, pose, lift(detections, frame, pose))


def detections_of(
    frame: Frame,
    masks: Sequence[np.ndarray],
    scores: Sequence[float],
    probabilities: Sequence[tuple[float, float]] | None = None,
    embeddings: np.ndarray | None = None,
    space: str = "words@1",
) -> Detections:
    """Return these masks as detections."""
    n = len(masks)
    return Detections(
        masks=np.array(masks, np.bool_).reshape(n, *frame.depth.shape),
        boxes=np.zeros((n, 4), np.float32),
        scores=np.array(scores, np.float32),
        class_probabilities=np.float32(probabilities or [PROBABILITIES] * n).reshape(n, 2),
        classes=CLASSES,
        embeddings=None if embeddings is None else embeddings.astype(np.float32),
        embedding_space="" if embeddings is None else space,
    )

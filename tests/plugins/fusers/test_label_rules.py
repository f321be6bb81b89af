"""Tests for the label rules of the fusers, with three detections of one object."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import Detections, Pose
from framework.interfaces import MapFuser
from framework.refinement.lifting import lift
from framework.registry import assemble
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from plugins.fusers.label_vote import LabelVote, Vote
from plugins.fusers.open3d_vbg import Open3DVoxelBlockGrid
from tests.support.scenes.analytic_scene import CAMERA, room, walk

SEEN = [(0.5, [0.6, 0.3, 0.1]), (0.9, [0.2, 0.1, 0.7]), (0.4, [0.6, 0.4, 0.0])]
"""Score and distribution over three classes in each frame."""


def product() -> np.ndarray:
    p = np.prod([0.9 * np.array(p) + 0.1 / 3 for _, p in SEEN], axis=0)
    return np.asarray(p / p.sum())


@pytest.mark.parametrize(
    ("fuser_class", "parameters", "expected"),
    [
        (BayesianTsdf, {}, product()),
        (LabelVote, {"vote": Vote.COUNT}, [2 / 3, 0, 1 / 3]),
        (LabelVote, {"vote": Vote.LAST}, [1, 0, 0]),
        (LabelVote, {"vote": Vote.MAX_SCORE}, [0.5 / 1.4, 0, 0.9 / 1.4]),  # the best score of each class
        (Open3DVoxelBlockGrid, {}, product()),
    ],
)
def test_fuser_class_probabilities_match_label_rule(
    fuser_class: type[MapFuser], parameters: dict[str, object], expected: np.ndarray
) -> None:
    fuser = assemble(fuser_class, voxel_size=0.02, max_depth=4.0, **parameters)
    for k, (T, (score, probabilities)) in enumerate(zip(walk(3), SEEN, strict=True)):
        frame = room().frame(T, k)
        assert frame.truth is not None
        mask = frame.truth.instance_ids == min(frame.truth.class_names)
        detections = Detections(
            mask[None],
            np.zeros((1, 4), np.float32),
            np.float32([score]),
            np.float32([probabilities]),
            ("chair", "bed", "couch"),
        )
        fuser.fuse(frame, Pose(T), lift(detections, frame, Pose(T)))
    [instance] = fuser.scene.instances().values()
    assert np.allclose(instance.class_probabilities, expected, atol=1e-5)
    assert (instance.first_frame, instance.last_frame) == (0, 2)
    # voxels and table agree, although each voxel is visible in only some of the frames
    view = fuser.scene.render(CAMERA, walk(3)[1])
    classes = view.class_ids[view.instance_ids == instance.id]
    assert np.bincount(classes).argmax() == np.argmax(expected)
    if fuser_class is not BayesianTsdf:
        assert 1 not in classes, "expected only the best class of a detection"

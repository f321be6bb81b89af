"""Tests for all real stages together, in a small synthetic room."""

import numpy as np
import pytest

from framework.evaluation.instances import PredictedInstances, evaluate
from framework.mapping.instance_map import InstanceMap
from framework.pipeline import Pipeline
from framework.registry import assemble
from framework.synthetic.sequence import Synthetic
from plugins.detectors.ground_truth import GroundTruthDetector
from plugins.detectors.simulated import SimulatedDetector
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from plugins.refiners.gmm_em import GmmEm
from plugins.trackers.voxel_hashing_icp import VoxelHashingIcp

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def sequence() -> Synthetic:
    return Synthetic(seed=3, width=320, height=240, frames=240, stop=24)


def mapped(sequence: Synthetic, detector: SimulatedDetector | GroundTruthDetector, prefetch: int) -> InstanceMap:
    fuser = assemble(BayesianTsdf, voxel_size=0.02)
    tracker = VoxelHashingIcp(finest_scale=1.0)
    result = Pipeline(detector, tracker, GmmEm(), fuser, prefetch=prefetch).run(sequence)
    assert result.frames_lost == 0
    assert result.frames_skipped == 0
    return fuser.scene


def test_prefetch_does_not_change_map(sequence: Synthetic) -> None:
    """The worker thread and the mapping kernels compete for the cores. The maps must be byte-identical."""
    maps = []
    for prefetch in (0, 2):
        scene = mapped(sequence, SimulatedDetector(seed=1), prefetch)
        b, r = scene.volume.voxels.block_count, scene.labels.row_count
        grid = scene.volume.voxels.grid
        arrays = [a[:b] for a in (grid.block_coords, grid.tsdf, grid.weight, grid.color, grid.label_row)]
        maps.append([a.tobytes() for a in arrays + [a[:r] for a in scene.labels.evidence]])
    assert maps[0] == maps[1]


def test_ground_truth_masks_give_accurate_instances(sequence: Synthetic) -> None:
    """With true masks, all errors are due to tracking and mapping."""
    scene = mapped(sequence, GroundTruthDetector(), prefetch=2)
    truth = sequence.scene_truth()
    assert truth is not None
    predicted = PredictedInstances.of_map(scene.mesh(), scene.instances(), scene.classes)
    metrics = evaluate(predicted, truth).metrics()
    assert metrics["instances.ap50"] > 0.9
    assert metrics["instances.mean_iou"] > 0.8
    exact = sequence.room.surfaces
    assert len(np.unique(exact.instance_ids)) > 8, "expected a furnished room"

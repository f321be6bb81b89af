"""Tests for the votes on vertex labels, compared with a voxel-by-voxel reference."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from framework.data import Detections, Pose
from framework.mapping.instance_map import InstanceMap
from framework.mapping.labels.vertex_labels_kernels import REACH, label_vertices
from framework.mapping.voxels.meshing import UnlabeledMesh
from framework.mapping.voxels.voxel_grid_kernels import UNSEEN, find_block
from framework.refinement.lifting import lift
from framework.registry import assemble
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from tests.support.scenes.analytic_scene import CAMERA, room, walk


@pytest.fixture(scope="module")
def fuser() -> BayesianTsdf:
    """Map three spheres. The upper part of each sphere is a separate instance, so there are label borders."""
    fuser = assemble(BayesianTsdf, voxel_size=0.03, max_depth=4.0, min_observations=1)
    for k, T in enumerate(walk(4)):
        frame = room().frame(T, k)
        assert frame.truth is not None
        whole = [frame.truth.instance_ids == i for i in frame.truth.class_names]
        upper = [mask & (np.arange(CAMERA.height) < 0.4 * CAMERA.height)[:, None] for mask in whole]
        masks = np.array([m for pair in zip(whole, upper, strict=True) for m in pair])
        n = len(masks)
        probabilities = np.tile(np.float32([0.7, 0.3]), (n, 1))
        probabilities[1::2] = [0.2, 0.8]
        scores = np.full(n, 0.9, np.float32)
        detections = Detections(masks, np.zeros((n, 4), np.float32), scores, probabilities, ("chair", "bed"))
        fuser.fuse(frame, Pose(T), lift(detections, frame, Pose(T)))
    return fuser


def labels_of(scene: InstanceMap, counts: np.ndarray, surface: UnlabeledMesh) -> tuple[np.ndarray, np.ndarray]:
    colors = np.empty((len(surface.voxels), 3), np.uint8)
    instances, classes = np.empty((2, len(surface.voxels)), np.int32)
    label_vertices(scene.volume.voxels.grid, scene.labels.evidence, counts, surface, colors, instances, classes)
    return instances, classes


def slow_vote(fuser: BayesianTsdf, counts: np.ndarray, vertex: np.ndarray) -> tuple[int, int]:
    scene = fuser.scene
    grid, evidence = scene.volume.voxels.grid, scene.labels.evidence
    place = vertex.astype(np.float64) / scene.volume.voxel_size
    base = np.floor(place).astype(int)
    votes: dict[int, float] = {}
    corners = []
    for corner in itertools.product((0, 1), repeat=3):
        voxel = base + corner
        share = float(np.prod(np.where(corner, place - base, 1 - (place - base))))
        block, _, _ = find_block(grid, *(int(x) >> 3 for x in voxel), np.int64(-2), np.int32(-1))
        i, j, k = (int(x) & 7 for x in voxel)
        n = (k * 8 + j) * 8 + i
        if block < 0 or grid.tsdf[block, n] == UNSEEN:
            continue
        if abs(float(grid.tsdf[block, n]) * grid.tsdf_unit) > REACH * scene.volume.voxel_size:
            continue
        best, most, label, row = 0, 0.0, -1, int(grid.label_row[block])
        labeled = int(evidence.labeled[row, n]) if row >= 0 else -1
        if labeled >= 0:
            label = int(evidence.class_ids[labeled, 0]) - 1
            for instance, value in zip(evidence.instance_ids[labeled], evidence.instance_value[labeled], strict=True):
                if instance > 0 and counts[instance] and value > most:
                    best, most = int(instance), float(value)
        votes[best] = votes.get(best, 0.0) + share
        corners.append((share, best, label))
    for instance, share in votes.items():
        if instance > 0 and share > 0.5 * sum(votes.values()):
            return instance, max((s, label) for s, best, label in corners if best == instance)[1]
    return 0, -1


@pytest.mark.parametrize("dropped", [(), (2, 3)])
def test_vertex_labels_match_voxelwise_reference(fuser: BayesianTsdf, dropped: tuple[int, ...]) -> None:
    scene = fuser.scene
    counts = np.ones(scene.table.last_id + 1, np.bool_)
    counts[list(dropped)] = False
    surface = scene.volume.surface()
    instances, classes = labels_of(scene, counts, surface)
    assert len(np.unique(instances)) >= 4 - len(dropped), "expected several different labels"
    rng = np.random.default_rng(0)
    near_labels = np.flatnonzero(instances > 0)
    chosen = np.concatenate([rng.choice(near_labels, 400), rng.choice(len(instances), 400)])
    expected = [slow_vote(fuser, counts, surface.vertices[v]) for v in chosen]
    # with exactly half of the votes, the result depends on rounding
    agree = np.mean([(instances[v], classes[v]) == e for v, e in zip(chosen.tolist(), expected, strict=True)])
    assert agree >= 0.995
    assert not set(dropped) & set(instances.tolist())


def test_vertex_labels_of_unmapped_space_are_none(fuser: BayesianTsdf) -> None:
    scene = fuser.scene
    counts = np.ones(scene.table.last_id + 1, np.bool_)
    far = UnlabeledMesh(np.full((1, 3), 1e3, np.float32), np.zeros((0, 3), np.int32), np.zeros(1, np.int32))
    instances, classes = labels_of(scene, counts, far)
    assert instances.tolist() == [0]
    assert classes.tolist() == [-1]

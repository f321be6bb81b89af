"""Time per frame for instances, with ten masks at 640x480 and a 1 cm map that contains the objects.

Run with `python -m pytest tests/benchmarks/test_instances.py`. Refinement is measured in test_refiners.py.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from framework.data import Frame, PointClusters, Pose
from framework.mapping.labels.pixel_lists import list_points_by_pixel
from framework.vocabulary.label_spaces import COCO
from plugins.fusers.bayesian_tsdf import RULE, BayesianTsdf
from tests.benchmarks.test_refiners import MASKS, ten_masks


@pytest.fixture(scope="module")
def mapped() -> tuple[BayesianTsdf, Frame, Pose, PointClusters]:
    """Return the fuser after five frames, the last frame, its pose, and its unrefined clusters with 80 classes."""
    clusters, frame = ten_masks()
    probabilities = np.random.default_rng(0).dirichlet(np.full(len(COCO), 0.1), MASKS).astype(np.float32)
    clusters = dataclasses.replace(clusters, class_probabilities=probabilities, classes=COCO)
    pose, fuser = Pose(np.eye(4)), BayesianTsdf()
    for _ in range(5):
        fuser.fuse(frame, pose, clusters)
    assert len(fuser.scene.table.records) == MASKS
    return fuser, frame, pose, clusters


def test_associate_ten_masks_speed(benchmark, mapped) -> None:
    fuser, frame, pose, clusters = mapped

    def associate() -> None:
        points = list_points_by_pixel(clusters, frame.depth.shape)
        overlaps = fuser.association.look_up(fuser.scene, frame, pose, points)
        matches = fuser.association.associate(
            fuser.scene.table, overlaps, clusters, frame.index, pose.T_world_camera[:3, 3]
        )
        fuser.association.merge(fuser.scene, matches)

    benchmark(associate)
    assert len(fuser.scene.table.records) == MASKS


def test_write_labels_of_ten_masks_speed(benchmark, mapped) -> None:
    fuser, frame, pose, clusters = mapped
    points = list_points_by_pixel(clusters, frame.depth.shape)
    overlaps = fuser.association.look_up(fuser.scene, frame, pose, points)
    matches = fuser.association.associate(
        fuser.scene.table, overlaps, clusters, frame.index, pose.T_world_camera[:3, 3]
    )
    seen = fuser.voxels.integrate(fuser.scene, frame, pose)

    def write_labels() -> None:
        evidence = fuser.evidence(clusters)
        fuser.voxels.update(fuser.scene, seen, points, matches, evidence, RULE)
        fuser.association.observe(fuser.scene.table, matches, evidence.classes)

    benchmark(write_labels)


def test_fuse_ten_masks_speed(benchmark, mapped) -> None:
    fuser, frame, pose, clusters = mapped
    benchmark(fuser.fuse, frame, pose, clusters)

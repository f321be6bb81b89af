"""Tests for data association by the ground truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from framework.data import Detections, Int32, Pose
from framework.mapping.instances.association import InstanceSource
from framework.refinement.lifting import lift
from framework.registry import assemble
from framework.testing.corner_room import frame_at, pose_at, spheres_in
from plugins.fusers.bayesian_tsdf import BayesianTsdf

NO_OVERLAP_MATCHES = 1.0  # minimum overlap that no cluster exceeds


def matched(fuser: BayesianTsdf, k: int, detections: Detections) -> Int32:
    """Fuse frame k with detections and return the matched instances."""
    frame, pose = frame_at(k), Pose(pose_at(k))
    fuser.fuse(frame, pose, lift(detections, frame, pose))
    assert fuser.association.matches is not None
    return fuser.association.matches.instance_ids


def fuser_by_truth() -> BayesianTsdf:
    source = InstanceSource.GROUND_TRUTH
    return assemble(BayesianTsdf, voxel_size=0.03, min_overlap=NO_OVERLAP_MATCHES, association=source)


def test_true_association_matches_object_without_overlap() -> None:
    fuser = fuser_by_truth()
    assert matched(fuser, 0, spheres_in(frame_at(0))).tolist() == [1, 2]
    found = spheres_in(frame_at(1))
    swapped = replace(found, masks=found.masks[::-1].copy(), boxes=found.boxes[::-1].copy())
    assert matched(fuser, 1, swapped).tolist() == [2, 1]


def test_true_association_matches_false_detections_by_rule() -> None:
    fuser = fuser_by_truth()
    found = spheres_in(frame_at(0))
    truth = frame_at(0).truth
    assert truth is not None
    wall = replace(found, masks=np.stack([found.masks[0], truth.instance_ids == 0]))
    assert matched(fuser, 0, wall).tolist() == [2, 1]  # instances of false detections are created first
    assert matched(fuser, 1, spheres_in(frame_at(1))).tolist() == [2, 3]


def test_true_association_creates_removed_instance_again() -> None:
    fuser = fuser_by_truth()
    matched(fuser, 0, spheres_in(frame_at(0)))
    fuser.scene.remove([1])
    assert matched(fuser, 1, spheres_in(frame_at(1))).tolist() == [3, 2]

"""Tests for the learned association in a fuser, and the contract tests of the fuser with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from framework.data import Detections, Int32, Pose
from framework.errors import DataError
from framework.interfaces import MapFuser
from framework.mapping.instances.association import InstanceSource
from framework.refinement.lifting import lift
from framework.registry import assemble
from framework.testing.contracts import FuserContract
from framework.testing.corner_room import frame_at, pose_at, spheres_in
from plugins.fusers.bayesian_tsdf import BayesianTsdf


def new_fuser() -> BayesianTsdf:
    return assemble(BayesianTsdf, voxel_size=0.03, association=InstanceSource.LEARNED)


class TestLearnedFuser(FuserContract):
    def plugin(self) -> MapFuser:
        return new_fuser()


def matched(fuser: BayesianTsdf, k: int, detections: Detections) -> Int32:
    """Fuse frame k with detections and return the matched instances."""
    frame, pose = frame_at(k), Pose(pose_at(k))
    fuser.fuse(frame, pose, lift(detections, frame, pose))
    assert fuser.association.matches is not None
    return fuser.association.matches.instance_ids


def without_first(found: Detections) -> Detections:
    names = ("masks", "boxes", "scores", "class_probabilities")
    return replace(found, **{name: getattr(found, name)[1:] for name in names})


def test_learned_association_matches_objects_over_frames() -> None:
    fuser = new_fuser()
    for k in range(4):
        assert matched(fuser, k, spheres_in(frame_at(k))).tolist() == [1, 2]
    assert len(fuser.scene.table.records) == 2


def test_learned_association_creates_instance_of_new_object() -> None:
    fuser = new_fuser()
    found = spheres_in(frame_at(0))
    assert matched(fuser, 0, without_first(found)).tolist() == [1]
    assert matched(fuser, 1, spheres_in(frame_at(1))).tolist() == [2, 1]


def test_learned_association_missing_weights_raises() -> None:
    with pytest.raises(DataError, match="association_weights"):
        assemble(BayesianTsdf, association=InstanceSource.LEARNED, association_weights=Path("none.safetensors"))

"""Tests for the union of two maps, compared with one map of all frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from framework.data import Float64
from framework.errors import DataError
from framework.mapping.instance_map import InstanceMap
from framework.mapping.instances.association import Association
from framework.mapping.instances.instance_table import PAGE
from tests.support import registered
from tests.support.scenes.analytic_scene import CAMERA, pose, room, walk
from tests.support.true_masks import fuse_masks, masks_of

VOXEL = 0.08  # m
POSES = walk(8)
HERE = np.eye(4)
ELSEWHERE = pose(1.3, -0.42, 0.77, rotvec=(0.3, 2.1, -0.2))  # T_other_world


def map_of(poses: Sequence[Float64], *overrides: str, T_other_world: Float64 = HERE, masks: bool = True) -> InstanceMap:
    """Return the map of the room from these poses in the world frame `other`."""
    fuser = registered.built("fuser", "bayesian_tsdf", f"fuser.voxel_size={VOXEL}", *overrides)
    for k, T in enumerate(poses):
        frame = room().frame(T, k)
        found = masks_of(frame) if masks else []
        fuse_masks(fuser, replace(frame, T_world_camera=T_other_world @ T), found, [0.9] * len(found))
    assert isinstance(fuser.scene, InstanceMap)
    return fuser.scene


@pytest.mark.parametrize("storage", ["COMPACT", "EXACT"])
@pytest.mark.parametrize("T_other_world", [HERE, ELSEWHERE], ids=["same world", "other world"])
def test_absorbed_half_equals_joint_map(storage: str, T_other_world: Float64) -> None:
    joint = map_of(POSES, f"fuser.storage={storage}")
    found = map_of(POSES[:5], f"fuser.storage={storage}")
    other = map_of(POSES[3:], f"fuser.storage={storage}", T_other_world=T_other_world)
    ids = found.absorb(other, np.linalg.inv(T_other_world), Association())
    assert ids == {1: 1, 2: 2, 3: 3}
    assert set(found.instances()) == set(joint.instances())
    for k, one in found.instances().items():
        assert (one.observations, one.last_frame) == (10, PAGE + 4), "expected the frames of both halves"
        assert one.class_probabilities.argmax() == joint.instances()[k].class_probabilities.argmax()
        assert one.obb.center == pytest.approx(joint.instances()[k].obb.center, abs=VOXEL)
        assert found.table.records[k].viewing.center == pytest.approx(joint.table.records[k].viewing.center, abs=VOXEL)
    of_joint, of_parts = joint.render(CAMERA, POSES[4]), found.render(CAMERA, POSES[4])
    both = (of_joint.depth > 0) & (of_parts.depth > 0)
    is_resampled = T_other_world is ELSEWHERE
    assert both.mean() > 0.95 * (of_joint.depth > 0).mean()
    assert np.median(np.abs(of_joint.depth - of_parts.depth)[both]) < (0.1 if is_resampled else 0.02) * VOXEL
    assert (of_joint.instance_ids == of_parts.instance_ids)[both].mean() > 0.96
    assert found.gravity().up == pytest.approx(joint.gravity().up, abs=0.05)


def test_absorbed_instances_get_new_ids_without_overlap() -> None:
    T = pose(30.0)
    found, other = map_of(POSES[:3]), map_of(POSES[:4], T_other_world=T)
    other.remove([2])
    other.relabel()
    assert found.absorb(other, HERE, Association()) == {1: 4, 3: 6}
    assert {k: one.observations for k, one in found.instances().items()} == {1: 3, 2: 3, 3: 3, 4: 4, 6: 4}
    assert set(np.unique(found.render(CAMERA, T @ POSES[0]).instance_ids)) <= {0, 4, 6}
    found.remove([4])  # depends on the instance sets of the rows
    assert set(found.labels.best_ids().tolist()) == {1, 2, 3, 6}


def test_absorbed_tentative_instances_keep_their_age(tmp_path: Path) -> None:
    found, other = map_of(POSES[:1]), map_of(POSES[:2])
    for scene in (found, other):
        scene.instance_ids()  # updates the tentative instances
    found.absorb(other, HERE, Association(min_overlap=1.0))
    assert found.instance_ids() == frozenset()
    age = {k: found.table.frames_detected - frame for k, frame in found.table.tentative.items()}
    assert age == {1: 0, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0}
    found.save(tmp_path / "map.npz")
    assert set(InstanceMap.load(tmp_path / "map.npz").table.records) == {1, 2, 3, 4, 5, 6}


@pytest.mark.parametrize("first", [True, False])
def test_absorbed_map_without_labels_is_surface(first: bool) -> None:
    labeled, plain = map_of(POSES[:4]), map_of(POSES[4:], masks=False)
    plain.classes = ()
    found, other = (labeled, plain) if first else (plain, labeled)
    found.absorb(other, HERE, Association())
    assert found.classes == ("chair", "bed")
    assert set(found.instances()) == {1, 2, 3}


@pytest.mark.parametrize(
    ("override", "got"),
    [
        ("fuser.voxel_size=0.1", "fuser.voxel_size: expected 0.08"),
        ("fuser.storage=EXACT", "fuser.storage: expected COMPACT"),
        ("fuser.max_depth=4", "fuser.max_depth: expected 5"),
    ],
)
def test_absorbed_map_with_other_parameters_raises(override: str, got: str) -> None:
    with pytest.raises(DataError, match=got):
        map_of(POSES[:1]).absorb(map_of(POSES[:1], override), HERE, Association())


def test_absorbed_map_with_other_label_rule_raises() -> None:
    fuser = registered.built("fuser", "label_count", f"fuser.voxel_size={VOXEL}")
    with pytest.raises(DataError, match="fuser: expected combine=SUM, logarithmic=True"):
        map_of(POSES[:1]).absorb(fuser.scene, HERE, Association())


def test_absorbed_map_with_other_classes_raises() -> None:
    found, other = map_of(POSES[:1]), map_of(POSES[:1])
    other.classes = ("chair", "sofa")
    with pytest.raises(DataError, match="detector: expected the label space of the map"):
        found.absorb(other, HERE, Association())
    assert set(found.table.records) == {1, 2, 3}


def test_absorbed_map_with_other_embeddings_raises() -> None:
    found, other = map_of(POSES[:1]), map_of(POSES[:1])
    found.table.embedding_space, other.table.embedding_space = "clip@1", "siglip@1"
    with pytest.raises(DataError, match="detector: expected embeddings from clip@1"):
        found.absorb(other, HERE, Association())
    assert set(found.table.records) == {1, 2, 3}

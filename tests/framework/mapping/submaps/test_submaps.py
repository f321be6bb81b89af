"""Tests for hidden, shown and moved submaps of a map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from framework.data import Float64
from framework.interfaces import MapFuser, SubmapChange
from framework.mapping.instance_map import InstanceMap
from tests.support import registered
from tests.support.scenes.analytic_scene import CAMERA, pose, room, walk
from tests.support.true_masks import fuse_masks, masks_of

VOXEL = 0.08  # m
POSES = walk(8)
FUSERS = ("bayesian_tsdf", "label_count", "last_write", "max_confidence")
LEFT, RIGHT = (pose(rotvec=(0, angle, 0)) for angle in (-0.6, 0.6))  # views that share few blocks


def new_fuser(name: str = "bayesian_tsdf", *overrides: str) -> MapFuser:
    return registered.built("fuser", name, f"fuser.voxel_size={VOXEL}", *overrides)


def fuse(fuser: MapFuser, poses: Sequence[Float64], first: int = 0) -> None:
    for k, T in enumerate(poses, start=first):
        frame = room().frame(T, k)
        fuse_masks(fuser, frame, masks_of(frame), [0.9] * 3)


def scene_of(fuser: MapFuser) -> InstanceMap:
    assert isinstance(fuser.scene, InstanceMap)
    return fuser.scene


def sorted_mesh(scene: InstanceMap) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and their labels and colors, in an order that depends on the coordinates alone."""
    mesh = scene.mesh()
    order = np.lexsort(mesh.vertices.T)
    return mesh.vertices[order], np.column_stack([mesh.instance_ids, mesh.class_ids, mesh.colors])[order]


@pytest.mark.parametrize("name", FUSERS)
@pytest.mark.parametrize("storage", ["COMPACT", "EXACT"])
def test_submap_hidden_and_shown_is_unchanged(name: str, storage: str) -> None:
    fuser = new_fuser(name, f"fuser.storage={storage}")
    fuse(fuser, POSES)
    scene = scene_of(fuser)
    before = sorted_mesh(scene)
    fuser.correct(SubmapChange(hidden=frozenset({0}), submap=1))
    assert scene.volume.voxels.block_count == 0
    assert not scene.render_visible(CAMERA, POSES[0]).depth.any()
    np.testing.assert_array_equal(sorted_mesh(scene)[0], before[0])
    assert scene.render(CAMERA, POSES[0]).instance_ids.any()
    assert fuser.correct(SubmapChange(shown=frozenset({0}), submap=2)) == {}
    assert not scene.submaps.hidden
    for found, expected in zip(sorted_mesh(scene), before, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_submap_of_block_is_submap_of_last_observation() -> None:
    fuser = new_fuser()
    fuse(fuser, [LEFT])
    fuser.correct(SubmapChange(submap=1))
    fuse(fuser, [RIGHT], 1)
    scene = scene_of(fuser)
    count = scene.volume.voxels.block_count
    fuser.correct(SubmapChange(hidden=frozenset({0}), submap=1))
    rest = scene.volume.voxels.block_count
    assert 0 < rest < count
    assert len(scene.submaps.hidden[0].block_coords) == count - rest
    fuser.correct(SubmapChange(hidden=frozenset({1}), submap=2))
    assert scene.volume.voxels.block_count == 0


def test_submap_is_entered_again() -> None:
    fuser = new_fuser()
    for number, view in ((0, LEFT), (1, RIGHT), (0, RIGHT)):
        fuser.correct(SubmapChange(submap=number))
        fuse(fuser, [view], 2 * scene_of(fuser).volume.integrator.frames)
    fuser.correct(SubmapChange(hidden=frozenset({0}), submap=2))
    assert scene_of(fuser).volume.voxels.block_count == 0


def test_hidden_submap_is_rendered_for_loops() -> None:
    fuser = new_fuser()
    fuse(fuser, POSES)
    scene = scene_of(fuser)
    before = scene.render_visible(CAMERA, POSES[3])
    fuser.correct(SubmapChange(hidden=frozenset({0}), submap=1))
    after = scene.hidden_surfaces().render(CAMERA, POSES[3], {0, 7})
    np.testing.assert_array_equal(after.depth, before.depth)
    assert not scene.hidden_surfaces().render(CAMERA, POSES[3], {7}).depth.any()


def test_shown_submap_equals_joint_integration() -> None:
    joint, parts = new_fuser(), new_fuser()
    fuse(joint, POSES)
    fuse(parts, POSES[:4])
    parts.correct(SubmapChange(hidden=frozenset({0}), submap=1))
    fuse(parts, POSES[4:], 4)
    merged = parts.correct(SubmapChange(shown=frozenset({0}), submap=2))
    assert merged == {4: 1, 5: 2, 6: 3}, "expected the older instance of each object"
    expected, found = scene_of(joint), scene_of(parts)
    assert set(found.instances()) == set(expected.instances())
    assert {k: one.observations for k, one in found.instances().items()} == {
        k: one.observations for k, one in expected.instances().items()
    }
    of_joint, of_parts = expected.render(CAMERA, POSES[2]), found.render(CAMERA, POSES[2])
    both = (of_joint.depth > 0) & (of_parts.depth > 0)
    assert both.mean() > 0.98 * (of_joint.depth > 0).mean()
    assert np.median(np.abs(of_joint.depth - of_parts.depth)[both]) < 0.02 * VOXEL
    assert (of_joint.instance_ids == of_parts.instance_ids)[both].mean() > 0.98


def test_evidence_of_joint_integration_is_sum() -> None:
    joint, parts = new_fuser("bayesian_tsdf", "fuser.absence_likelihood=1"), new_fuser()
    fuse(joint, POSES[:1])
    fuse(joint, POSES[:1], 1)
    fuse(parts, POSES[:1])
    parts.correct(SubmapChange(hidden=frozenset({0}), submap=1))
    fuse(parts, POSES[:1], 1)
    parts.correct(SubmapChange(shown=frozenset({0}), submap=2))
    expected, found = scene_of(joint), scene_of(parts)
    for blocks in np.arange(expected.volume.voxels.block_count, dtype=np.int32)[:, None]:
        others = found.volume.voxels.find(expected.volume.voxels.grid.block_coords[blocks])
        own, other = expected.labels.voxels_of(blocks)[0], found.labels.voxels_of(others)[0]
        np.testing.assert_array_equal(own >= 0, other >= 0)
        for name in ("instance_ids", "instance_value", "class_ids", "class_value"):
            values = getattr(expected.labels.evidence, name)[own[own >= 0]]
            np.testing.assert_allclose(getattr(found.labels.evidence, name)[other[other >= 0]], values, rtol=1e-6)


@pytest.mark.parametrize("is_hidden", [False, True])
def test_moved_submap_is_moved_surface(is_hidden: bool) -> None:
    fuser = new_fuser()
    fuse(fuser, POSES)
    scene = scene_of(fuser)
    before = room().distance(scene.mesh().vertices)
    T = np.eye(4)
    T[:3, 3] = 0.03, -0.11, 0.05
    hidden = frozenset({0}) if is_hidden else frozenset()
    fuser.correct(SubmapChange(hidden=hidden, submap=1))
    fuser.correct(SubmapChange({0: T, 5: T}, submap=1))
    assert (not scene.submaps.hidden) == (not is_hidden)
    after = room().distance(scene.mesh().vertices - T[:3, 3])
    assert np.median(after) < np.median(before) + 0.05 * VOXEL
    assert set(scene.instances()) == {1, 2, 3}


def test_moved_parts_keep_number_of_submap() -> None:
    fuser = new_fuser()
    fuse(fuser, [LEFT])
    fuser.correct(SubmapChange(submap=1))
    fuse(fuser, [RIGHT], 1)
    T = np.eye(4)
    T[:3, 3] = 0.03, 0.01, 0.05
    fuser.correct(SubmapChange({0: T, 1: T}, hidden=frozenset({0, 1}), submap=2))
    assert scene_of(fuser).volume.voxels.block_count == 0
    assert set(scene_of(fuser).submaps.hidden) == {0, 1}


def test_hidden_submap_follows_merged_and_removed_instances() -> None:
    fuser = new_fuser()
    fuse(fuser, POSES)
    scene = scene_of(fuser)
    fuser.correct(SubmapChange(hidden=frozenset({0}), submap=1))
    scene.merge(1, 2)
    scene.remove([3])
    scene.relabel()
    assert set(np.unique(scene.mesh().instance_ids)) == {0, 1}
    fuser.correct(SubmapChange(shown=frozenset({0}), submap=2))
    assert set(np.unique(scene.mesh().instance_ids)) == {0, 1}
    assert set(scene.labels.best_ids().tolist()) == {1}


def test_hidden_submap_follows_removal_after_merge(tmp_path: Path) -> None:
    fuser = new_fuser()
    fuse(fuser, POSES)
    scene = scene_of(fuser)
    fuser.correct(SubmapChange(hidden=frozenset({0}), submap=1))
    kept = scene.table.create(len(scene.classes), 0).id
    scene.merge(kept, 1)
    scene.remove([kept])
    scene.relabel()
    scene.save(tmp_path / "map.npz")
    assert set(InstanceMap.load(tmp_path / "map.npz").instances()) == {2, 3}
    fuser.correct(SubmapChange(shown=frozenset({0}), submap=2))
    assert set(scene.labels.best_ids().tolist()) <= {0, 2, 3}


def test_map_with_hidden_submaps_is_saved_whole(tmp_path: Path) -> None:
    fuser = new_fuser()
    fuse(fuser, POSES[:4])
    fuser.correct(SubmapChange(hidden=frozenset({0}), submap=1))
    fuse(fuser, POSES[4:], 4)
    scene = scene_of(fuser)
    scene.save(tmp_path / "map.npz")
    loaded = InstanceMap.load(tmp_path / "map.npz")
    assert loaded.volume.voxels.max_blocks == scene.volume.voxels.max_blocks
    np.testing.assert_array_equal(loaded.gravity().up, scene.gravity().up)
    for found, expected in zip(sorted_mesh(loaded), sorted_mesh(scene), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_class_evidence_of_voxels_includes_hidden_submaps() -> None:
    fuser = new_fuser("bayesian_tsdf", "fuser.instance_class=VOXELS")
    fuse(fuser, POSES)
    scene = scene_of(fuser)
    before = scene.class_evidence()
    fuser.correct(SubmapChange(hidden=frozenset({0}), submap=1))
    after = scene.class_evidence()
    assert before.keys() == after.keys() == {1, 2, 3}
    for k, evidence in before.items():
        np.testing.assert_array_equal(after[k], evidence)


def test_removed_blocks_are_observed_again() -> None:
    fuser, again = new_fuser(), new_fuser()
    fuse(fuser, POSES)
    fuser.correct(SubmapChange(hidden=frozenset({0}), submap=1))
    fuse(fuser, POSES[2:5], 8)
    fuse(again, POSES[2:5], 8)
    found, expected = scene_of(fuser), scene_of(again)
    depths = [scene.render_visible(CAMERA, POSES[3]).depth for scene in (found, expected)]
    # the rounding of distances depends on the number of frames
    assert (np.abs(depths[0] - depths[1]) < 1e-4).mean() > 0.999


def test_map_without_changes_has_one_submap() -> None:
    fuser = new_fuser()
    fuse(fuser, POSES)
    assert scene_of(fuser).whole() is fuser.scene
    assert scene_of(fuser).submaps.byte_count == 0


def test_layer_keep_equals_copy_of_the_blocks() -> None:
    fuser = new_fuser()
    fuse(fuser, POSES)
    layer = scene_of(fuser).submaps.visible
    blocks = np.flatnonzero(np.random.default_rng(0).random(layer.voxels.block_count) < 0.6).astype(np.int32)
    copy = layer.part(blocks)
    layer.keep(blocks)
    kept, expected, count = layer.voxels.grid, copy.voxels.grid, len(blocks)
    assert layer.voxels.block_count == count
    for name in ("block_coords", "neighbors", "tsdf", "weight", "color", "solid"):
        np.testing.assert_array_equal(getattr(kept, name)[:count], getattr(expected, name)[:count])
    np.testing.assert_array_equal(layer.voxels.find(expected.block_coords[:count]), np.arange(count))
    numbers = np.arange(count, dtype=np.int32)
    voxels, other = layer.labels.voxels_of(numbers), copy.labels.voxels_of(numbers)
    np.testing.assert_array_equal(voxels >= 0, other >= 0)
    own, theirs = layer.labels.in_use(), copy.labels.in_use()
    for name in ("instance_ids", "instance_value", "class_ids", "class_value"):
        np.testing.assert_array_equal(getattr(own, name)[voxels[voxels >= 0]], getattr(theirs, name)[other[other >= 0]])
    assert layer.labels.voxel_count == copy.labels.voxel_count


def test_layer_after_keep_grows_again() -> None:
    fuser = new_fuser()
    fuse(fuser, [LEFT])
    fuser.correct(SubmapChange(submap=1))
    fuse(fuser, [RIGHT], 1)
    fuser.correct(SubmapChange(hidden=frozenset({0}), submap=2))
    fuse(fuser, [LEFT], 2)
    grid, count = scene_of(fuser).volume.voxels.grid, scene_of(fuser).volume.voxels.block_count
    np.testing.assert_array_equal(scene_of(fuser).volume.voxels.find(grid.block_coords[:count]), np.arange(count))
    assert len(np.unique(grid.block_coords[:count], axis=0)) == count

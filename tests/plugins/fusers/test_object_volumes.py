"""Tests for the baseline with one volume per object."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from framework.data import Frame, PointClusters, Pose
from framework.errors import ConfigError, DataError, MapFullError
from framework.mapping.instances.overlaps import OverlapRule
from framework.refinement.lifting import lift
from framework.registry import assemble
from plugins.fusers.object_volumes import ObjectVolumes, existence
from tests.support.scenes.box_scene import CAMERA, BoxScene, bled, detected, look_from
from tests.support.thread_counts import by_one_thread_and_two

BOXES = BoxScene([[(-0.8, 0.2, 0.0, -0.2, 0.8, 0.6)], [(0.3, 0.2, 0.0, 0.9, 0.8, 0.6)]])
VOXEL = 0.04  # m
MASK_FUSION = {"overlap_rule": OverlapRule.CLUSTER, "min_overlap": 0.05, "require_same_class": True}


def new_fuser(**parameters: object) -> ObjectVolumes:
    return assemble(ObjectVolumes, voxel_size=VOXEL, **parameters)


def pan(width: float) -> list[Frame]:
    """Return ten views of both boxes. The camera moves by `width` m."""
    places = np.linspace(-width / 2, width / 2, 10)
    return [BOXES.frame(look_from(x, -1.4, 1.5, (0.0, 0.6, 0.2)), k) for k, x in enumerate(places)]


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return pan(1.6)


def masks_of(frame: Frame) -> list[np.ndarray]:
    assert frame.truth is not None
    return [frame.truth.instance_ids == k for k in (1, 2)]


def clusters_of(frame: Frame, masks: list[np.ndarray], class_ids: list[int] | None = None) -> PointClusters:
    assert frame.T_world_camera is not None
    return lift(detected(masks, class_ids or [0] * len(masks)), frame, Pose(frame.T_world_camera))


def fuse(
    fuser: ObjectVolumes, frame: Frame, masks: list[np.ndarray], class_ids: list[int] | None = None
) -> ObjectVolumes:
    assert frame.T_world_camera is not None
    fuser.fuse(frame, Pose(frame.T_world_camera), clusters_of(frame, masks, class_ids))
    return fuser


@pytest.fixture(scope="module")
def mapped(frames: list[Frame]) -> ObjectVolumes:
    fuser = new_fuser()
    for k, frame in enumerate(frames):
        fuse(fuser, frame, masks_of(frame)[:: -1 if k % 2 else 1])
    return fuser


# Mapped surfaces


def test_object_volumes_each_box_is_one_instance(mapped: ObjectVolumes) -> None:
    scene = mapped.scene
    mesh, instances = scene.mesh(), scene.instances()
    assert sorted(instances) == [1, 2]
    assert {record.observations for record in scene.table.records.values()} == {10}
    for key, instance in instances.items():
        points = mesh.vertices[instance.vertices].astype(np.float64)
        owners = BOXES.owners(points, VOXEL / 2)
        assert np.isin(owners, (key, -1)).mean() > 0.97, (
            "expected vertices of the box, or where it touches the floor (-1)"
        )
        assert (owners == key).sum() > 300


def test_object_volumes_label_complete_object_surface(mapped: ObjectVolumes) -> None:
    """The surface of the background also needs labels, because half of the true points are nearest to its vertices."""
    mesh = mapped.scene.mesh()
    owners = BOXES.owners(mesh.vertices.astype(np.float64), VOXEL / 4)
    for key in (1, 2):
        assert (mesh.instance_ids[owners == key] == key).mean() > 0.97


def test_object_volumes_rendered_ids_match_ground_truth(mapped: ObjectVolumes, frames: list[Frame]) -> None:
    frame = frames[4]
    assert frame.truth is not None
    assert frame.T_world_camera is not None
    view = mapped.scene.render(CAMERA, frame.T_world_camera)
    assert (view.instance_ids == frame.truth.instance_ids).mean() > 0.98
    assert (view.class_ids == np.where(view.instance_ids > 0, 0, -1)).all()


def test_object_volumes_statistics_include_all_volumes(mapped: ObjectVolumes) -> None:
    scene = mapped.scene
    objects = sum(volume.block_count for volume in scene.volumes.values())
    assert scene.statistics.voxels == 512 * (scene.background.voxels.block_count + objects)
    per_object_voxel = 8 + 4  # bytes per voxel for the grid and two counts
    assert scene.statistics.bytes > 8 * 512 * scene.background.voxels.block_count + per_object_voxel * 512 * objects
    assert 0 < objects < scene.background.voxels.block_count


def room_fraction(fuser: ObjectVolumes) -> float:
    """Return the fraction of the first object's vertices that lie on the surface of the room."""
    mesh = fuser.scene.mesh()
    points = mesh.vertices[mesh.instance_ids == 1].astype(np.float64)
    return float((BOXES.owners(points, VOXEL) == 0).mean())


def test_object_volumes_remove_only_temporary_mask_bleed() -> None:
    """With constant bleed and little camera motion, the mask covers the same voxels in all frames."""
    once, always = new_fuser(), new_fuser()
    for k, frame in enumerate(pan(0.1)):
        mask = masks_of(frame)[0]
        fuse(once, frame, [bled(mask, 12) if k == 3 else mask])
        fuse(always, frame, [bled(mask, 12)])
    assert room_fraction(once) < 0.02
    assert room_fraction(always) > 0.2, "expected the known weakness: constant errors are not removed"


def test_object_volumes_remove_bled_voxels_after_unmasked_view(frames: list[Frame]) -> None:
    """After two frames, the foreground probability is Beta(2, 2) with mean 1/2, which is not sufficient."""
    frame, fuser = frames[0], new_fuser(min_observations=1)
    mask = masks_of(frame)[0]
    fuse(fuser, frame, [bled(mask, 12)])
    assert room_fraction(fuser) > 0.2
    fuse(fuser, replace(frame, index=1), [mask])
    assert room_fraction(fuser) < 0.02


def test_object_volumes_change_only_when_detected(frames: list[Frame]) -> None:
    fuser = fuse(new_fuser(), frames[0], masks_of(frames[0]))
    first, second = ({k: a.copy() for k, a in v.arrays().items()} for v in fuser.scene.volumes.values())
    fuse(fuser, frames[1], masks_of(frames[1])[:1])
    assert not np.array_equal(fuser.scene.volumes[1].arrays()["weight"], first["weight"])
    for name, array in fuser.scene.volumes[2].arrays().items():
        assert np.array_equal(array, second[name]), name


# Association


def part_of(mask: np.ndarray, share: float) -> np.ndarray:
    """Return the first pixels of a mask, row by row. `share` is their fraction."""
    v, u = np.nonzero(mask)
    part = np.zeros_like(mask)
    part[v[: round(share * len(v))], u[: round(share * len(v))]] = True
    return part


@pytest.mark.parametrize(
    ("parameters", "share", "class_id", "same"),
    [
        ({}, 0.25, 0, True),  # IoU 0.25 > 0.2
        ({}, 0.15, 0, False),
        ({}, 0.25, 1, True),
        (MASK_FUSION, 0.15, 0, True),  # the whole detection is on the object
        (MASK_FUSION, 0.15, 1, False),  # of another class
    ],
)
def test_object_volumes_partial_detection_matches_by_rule(
    frames: list[Frame], parameters: dict[str, object], share: float, class_id: int, same: bool
) -> None:
    fuser = new_fuser(**parameters)
    whole = masks_of(frames[0])[0]
    fuse(fuser, frames[0], [whole])
    fuse(fuser, replace(frames[0], index=1), [part_of(whole, share)], [class_id])
    assert len(fuser.scene.table.records) == (1 if same else 2)


def test_object_volumes_large_mask_creates_new_instance(frames: list[Frame]) -> None:
    whole = masks_of(frames[0])[0]
    for parameters in ({}, MASK_FUSION):
        fuser = new_fuser(**parameters)
        fuse(fuser, frames[0], [part_of(whole, 0.02)])
        fuse(fuser, replace(frames[0], index=1), [whole])
        assert len(fuser.scene.table.records) == 2


def test_object_volumes_detection_matches_largest_overlap(frames: list[Frame]) -> None:
    frame = frames[4]
    left, right = masks_of(frame)
    fuser = fuse(new_fuser(), frame, [left, right])
    fuse(fuser, replace(frame, index=1), [part_of(left, 0.4) | right])
    assert [record.observations for record in fuser.scene.table.records.values()] == [1, 2]


def test_object_volumes_two_detections_are_one_observation(frames: list[Frame]) -> None:
    frame, fuser = frames[0], new_fuser()
    whole = masks_of(frame)[0]
    fuse(fuser, frame, [whole])
    first = part_of(whole, 0.5)
    fuse(fuser, replace(frame, index=1), [first, whole & ~first])
    (record,) = fuser.scene.table.records.values()
    assert (record.observations, record.detections, record.visible) == (2, 3, 2)
    counts = fuser.scene.volumes[1].arrays()
    assert (counts["foreground"][counts["foreground"] > 0] == 2).mean() > 0.95, (
        "expected each voxel to count once per frame"
    )


def test_object_volumes_weak_or_far_detection_creates_no_object(frames: list[Frame]) -> None:
    frame = frames[0]
    mask = masks_of(frame)[0]
    for fuser in (new_fuser(create_score=0.9), new_fuser(max_depth=0.9)):
        fuse(fuser, frame, [mask])
        assert not fuser.scene.table.records
        assert not fuser.scene.volumes


# Attributes of an object


def test_object_volumes_probabilities_are_mean_of_detections(frames: list[Frame]) -> None:
    fuser = new_fuser(min_observations=1)
    for k, class_id in enumerate([0, 1, 1]):
        fuse(fuser, replace(frames[0], index=k), masks_of(frames[0])[:1], [class_id])
    (instance,) = fuser.scene.instances().values()
    expected = np.array([[0.6, 0.2, 0.2], [0.2, 0.6, 0.2], [0.2, 0.6, 0.2]]).mean(axis=0)
    np.testing.assert_allclose(instance.class_probabilities, expected, atol=1e-6)
    mesh = fuser.scene.mesh()
    assert set(mesh.class_ids[mesh.instance_ids == 1]) == {1}


def test_object_volumes_unconfirmed_object_in_view_is_removed(frames: list[Frame]) -> None:
    """After one detection and n misses, the probability of existence is 2 / (3 + n). At n = 18, it is below 0.1."""
    frame, fuser = frames[0], new_fuser(min_observations=1)
    wall = np.zeros(CAMERA.shape, np.bool_)
    wall[10:50, 100:180] = True
    fuse(fuser, frame, [wall])
    assert existence(fuser.scene.table.records[1]) == 2 / 3
    elsewhere = replace(frame, depth=np.zeros_like(frame.depth))
    for k in range(30):
        fuse(fuser, replace(elsewhere, index=1 + k), [])
    assert set(fuser.scene.instances()) == {1}, "expected the object: its region is unobserved"
    for k in range(17):
        fuse(fuser, replace(frame, index=31 + k), [])
    assert set(fuser.scene.instances()) == {1}
    fuse(fuser, replace(frame, index=48), [])
    assert not fuser.scene.instances()
    assert not fuser.scene.volumes
    assert (fuser.scene.mesh().instance_ids == 0).all()
    fuse(fuser, replace(frame, index=49), [wall])
    assert set(fuser.scene.table.records) == {2}, "expected a new id"


def test_object_volumes_below_min_area_are_excluded(frames: list[Frame]) -> None:
    fuser = new_fuser(min_observations=1, min_area=40.0)
    fuse(fuser, frames[0], masks_of(frames[0]))
    assert not fuser.scene.instances()
    assert (fuser.scene.mesh().instance_ids == 0).all()


# The map


def test_object_volumes_incremental_mesh_equals_loaded_mesh(frames: list[Frame], tmp_path: Path) -> None:
    fuser = new_fuser(min_observations=1)
    for frame in frames[::3]:
        fuse(fuser, frame, masks_of(frame)[: 1 + frame.index % 2])
        fuser.scene.mesh()
    fuser.scene.save(tmp_path / "map.npz")
    loaded = type(fuser.scene).load(tmp_path / "map.npz")
    for name in ("vertices", "triangles", "colors", "instance_ids", "class_ids"):
        assert np.array_equal(getattr(loaded.mesh(), name), getattr(fuser.scene.mesh(), name)), name
    assert loaded.statistics.bytes == fuser.scene.statistics.bytes
    assert loaded.instances()[2].confidence == fuser.scene.instances()[2].confidence
    loaded.save(tmp_path / "again.npz")
    assert (tmp_path / "map.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()


def test_object_volumes_keep_surfaces_of_overlapping_objects(frames: list[Frame]) -> None:
    """The second mask covers a small part of the first object, so that its IoU is too low for a match."""
    fuser = new_fuser(min_observations=1)
    whole = masks_of(frames[0])[0]
    for k, mask in enumerate([whole, part_of(whole, 0.15)]):
        fuse(fuser, replace(frames[0], index=k), [mask])
    mesh = fuser.scene.mesh()
    first, second = (mesh.vertices[mesh.instance_ids == k] for k in (1, 2))
    shared = (np.abs(first[:, None] - second[None]).max(axis=2) < 1e-6).any(axis=0)
    assert shared.mean() > 0.2
    assert len(second) > 20


def test_object_volumes_overlap_renders_most_probable_object(frames: list[Frame]) -> None:
    frame, scene = frames[0], new_fuser().scene
    T = frame.T_world_camera
    assert T is not None
    mask = masks_of(frame)[0]
    first, second = scene.create(0), scene.create(0)
    for ids, expected in [((first, second), first), ((second,), second), ((first,), first)]:
        scene.integrate(frame, T, dict.fromkeys(ids, mask), 2 * VOXEL)
        seen = scene.instances_seen(frame.camera, T, frame.depth, 2)
        assert (seen[mask[::2, ::2]] == expected).mean() > 0.9, expected


def test_object_volumes_do_not_depend_on_thread_count(frames: list[Frame], tmp_path: Path) -> None:
    def saved() -> bytes:
        fuser = new_fuser()
        for frame in frames[::2]:
            fuse(fuser, frame, [bled(mask, 3) for mask in masks_of(frame)])
        fuser.scene.save(tmp_path / "map.npz")
        return (tmp_path / "map.npz").read_bytes()

    by_one, by_two = by_one_thread_and_two(saved)
    assert by_one == by_two


def test_object_volumes_full_map_raises(frames: list[Frame]) -> None:
    background = fuse(new_fuser(), frames[0], []).scene.background.voxels.block_count
    with pytest.raises(MapFullError, match=f"at most {background} blocks in the background and 2 objects"):
        fuse(new_fuser(max_blocks=background), frames[0], masks_of(frames[0]))


def test_object_volumes_pixel_outside_image_raises(frames: list[Frame]) -> None:
    frame = frames[0]
    clusters = clusters_of(frame, masks_of(frame))
    fuser = fuse(new_fuser(), frame, [])
    with pytest.raises(
        DataError, match=r"clusters: expected pixels in the image of .*x.*, got u in \[.*, .*\], v in \[.*, .*\]"
    ):
        fuser.fuse(frame, Pose(np.eye(4)), replace(clusters, pixels=clusters.pixels + 200))


def test_object_volumes_different_label_space_raises(frames: list[Frame]) -> None:
    frame = frames[0]
    clusters = clusters_of(frame, masks_of(frame))
    fuser = fuse(new_fuser(), frame, [])
    with pytest.raises(DataError, match=r"got a different label space \(length 3\)"):
        fuser.fuse(frame, Pose(np.eye(4)), replace(clusters, classes=("a", "b", "c")))


def test_object_volumes_invalid_parameter_raises() -> None:
    for wrong in ({"min_overlap": 1.5}, {"min_existence": -0.1}, {"create_points": 0}, {"label_band": 9.0}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            assemble(ObjectVolumes, **wrong)

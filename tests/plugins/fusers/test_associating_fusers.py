"""Tests for association and the instance table in all fusers that use them."""

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from framework.data import Detections, Frame, PointClusters, Pose
from framework.errors import ConfigError, DataError
from framework.interfaces import MapFuser
from framework.mapping.instance_map import InstanceMap
from framework.mapping.instances.association import MIN_PAIRS, Association, Matches
from framework.mapping.instances.instance_table import InstanceTable
from framework.mapping.instances.overlaps import OverlapRule, Overlaps
from framework.mapping.labels.label_rule import floored_log
from framework.refinement.lifting import lift
from framework.registry import assemble
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from plugins.fusers.open3d_vbg import Open3DVoxelBlockGrid
from tests.support.scenes.analytic_scene import CAMERA, Scene, room, walk
from tests.support.true_masks import fuse_masks, masks_of

NewFuser = Callable[..., MapFuser]


@pytest.fixture(params=[BayesianTsdf, Open3DVoxelBlockGrid], ids=["bayesian_tsdf", "open3d_vbg"])
def new_fuser(request: pytest.FixtureRequest) -> NewFuser:
    return lambda **parameters: assemble(request.param, **{"voxel_size": 0.02, "max_depth": 4.0} | parameters)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [room().frame(T, k) for k, T in enumerate(walk(10))]


def test_fuser_instance_ids_do_not_depend_on_detection_order(new_fuser: NewFuser, frames: list[Frame]) -> None:
    fuser = new_fuser()
    for k, frame in enumerate(frames):
        order = np.roll(np.arange(3), k)
        fuse_masks(fuser, frame, [masks_of(frame)[i] for i in order], [0.9] * 3)
    assert len(fuser.scene.table.records) == 3
    assert {record.observations for record in fuser.scene.table.records.values()} == {10}


def test_fuser_weak_detection_creates_no_instance(new_fuser: NewFuser, frames: list[Frame]) -> None:
    fuser = new_fuser()
    first, second, _ = masks_of(frames[0])
    fuse_masks(fuser, frames[0], [first, second], [0.9, 0.1])
    assert len(fuser.scene.table.records) == 1
    fuse_masks(fuser, frames[1], masks_of(frames[1])[:2], [0.1, 0.1])
    [record] = fuser.scene.table.records.values()
    assert record.observations == 2
    assert record.score_sum == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("part", "score", "parameters", "matches"),
    [
        (0.3, 0.29, {}, False),
        (0.3, 0.3, {}, True),
        (0.3, 0.29, {"extend_score": 0.0}, True),
        (0.3, 0.29, {"extend_iou": 0.2}, True),
        (0.7, 0.29, {}, True),  # the IoU is above 0.5
    ],
)
def test_fuser_weak_detection_does_not_extend_smaller_instance(
    new_fuser: NewFuser, frames: list[Frame], part: float, score: float, parameters: dict[str, float], matches: bool
) -> None:
    """First, a part of the object is detected, and then the whole object with a low score."""
    fuser = new_fuser(create_score=0.2, **parameters)
    whole = masks_of(frames[0])[0]
    first = whole & (np.arange(CAMERA.width) < np.quantile(np.nonzero(whole)[1], part))
    fuse_masks(fuser, frames[0], [first], [0.9])
    fuse_masks(fuser, dataclasses.replace(frames[0], index=1), [whole], [score])
    assert (len(fuser.scene.table.records) == 1) == matches


def test_fuser_weak_detection_matches_larger_instance(new_fuser: NewFuser, frames: list[Frame]) -> None:
    fuser = new_fuser()
    whole = masks_of(frames[0])[0]
    part = whole & (np.arange(CAMERA.width) < np.quantile(np.nonzero(whole)[1], 0.3))
    fuse_masks(fuser, frames[0], [whole], [0.9])
    fuse_masks(fuser, dataclasses.replace(frames[0], index=1), [part], [0.2])
    [record] = fuser.scene.table.records.values()
    assert record.observations == 2


@pytest.mark.parametrize(
    ("parameters", "updates"),
    [
        ({}, True),
        ({"overlap_rule": OverlapRule.IOU}, False),  # the IoU of a part is low
        ({"min_class_agreement": 0.9}, True),
        ({"min_class_agreement": 1.0}, False),  # the floor of the class probabilities prevents complete agreement
    ],
)
def test_fuser_match_requires_overlap_and_class_agreement(
    new_fuser: NewFuser, frames: list[Frame], parameters: dict[str, Any], updates: bool
) -> None:
    fuser = new_fuser(**parameters)
    whole = masks_of(frames[0])[0]
    u = np.nonzero(whole)[1]
    part = whole & (np.arange(CAMERA.width) < np.quantile(u, 0.3))
    fuse_masks(fuser, frames[0], [whole], [0.9])
    fuse_masks(fuser, frames[0], [part], [0.9])
    assert (len(fuser.scene.table.records) == 1) == updates


def test_fuser_split_instance_is_merged_by_complete_mask(new_fuser: NewFuser, frames: list[Frame]) -> None:
    """First, the object is detected in two parts, and later as a whole."""
    fuser = new_fuser()
    whole = masks_of(frames[0])[0]
    u = np.flatnonzero(whole.any(axis=0))
    left = whole & (np.arange(CAMERA.width) < (u[0] + u[-1]) // 2)
    for k in range(4):
        fuse_masks(fuser, dataclasses.replace(frames[0], index=k), [left, whole & ~left], [0.9, 0.9])
    assert len(fuser.scene.instances()) == 2
    for k in range(4, 12):
        fuse_masks(fuser, dataclasses.replace(frames[0], index=k), [whole], [0.5])
    [instance] = fuser.scene.instances().values()
    assert instance.observations == 12, "expected a frame with both halves to count once"
    assert set(np.unique(fuser.scene.mesh().instance_ids)) == {0, instance.id}


@pytest.mark.parametrize(
    ("fuser_class", "merge_frames"),
    [(BayesianTsdf, 3), (Open3DVoxelBlockGrid, 1)],  # with unweighted votes, voxels are relabeled earlier
)
def test_fuser_merges_instances_covered_by_one_cluster(
    fuser_class: type[MapFuser], merge_frames: int, frames: list[Frame]
) -> None:
    """The scores of the complete masks are so low that the voxels are relabeled slowly."""
    fuser = assemble(fuser_class, voxel_size=0.02, max_depth=4.0, merge_overlap=0.5, merge_frames=merge_frames)
    whole = masks_of(frames[0])[0]
    u = np.flatnonzero(whole.any(axis=0))
    left = whole & (np.arange(CAMERA.width) < (u[0] + u[-1]) // 2)
    fuse_masks(fuser, frames[0], [left, whole & ~left], [0.9, 0.8])
    for k in range(1, 1 + merge_frames):
        fuse_masks(fuser, dataclasses.replace(frames[0], index=k), [whole], [0.1])
    assert len(fuser.scene.table.records) == 2, "expected no merge yet: one frame with both halves delays it"
    last = 1 + merge_frames
    fuse_masks(fuser, dataclasses.replace(frames[0], index=last), [whole], [0.1])
    [record] = fuser.scene.table.records.values()
    assert record.id == 1
    assert record.observations == 1 + last
    assert record.visible == 1 + last, "expected a frame with both halves in view to count once"
    assert record.detections == 2 + last
    assert record.score_sum == pytest.approx(0.9 + 0.8 + last * 0.1)
    odds = (0.68 / 0.32) ** record.detections
    assert fuser.scene.table.class_probabilities(record)[0] == pytest.approx(odds / (1 + odds), abs=1e-4)
    assert set(np.unique(fuser.scene.instances_seen(frames[0], frames[0].T_world_camera, 1))) == {0, 1}
    fuse_masks(fuser, dataclasses.replace(frames[0], index=last + 1), [whole], [0.9])
    assert record.observations == 2 + last


@pytest.mark.parametrize(
    ("merge_agreement", "agrees", "merged"), [(0.1, False, False), (0, False, True), (0.1, True, True)]
)
def test_fuser_merges_supported_object_only_if_classes_agree(
    merge_agreement: float, agrees: bool, merged: bool, frames: list[Frame]
) -> None:
    """The mask of the table also covers the object on the table."""
    fuser = assemble(
        BayesianTsdf,
        voxel_size=0.02,
        max_depth=4.0,
        merge_overlap=0.5,
        merge_agreement=merge_agreement,
        occlusion_area_ratio=0.0,
    )
    whole = masks_of(frames[0])[0]
    u = np.flatnonzero(whole.any(axis=0))
    book = whole & (np.arange(CAMERA.width) < u[0] + (u[-1] - u[0]) // 3)
    table = (0.99, 0.01)
    for k in range(3):
        classes = [table, table if agrees else (0.01, 0.99)]
        fuse_masks(fuser, dataclasses.replace(frames[0], index=k), [whole & ~book, book], [0.9, 0.9], classes)
    for k in range(3, 12):
        fuse_masks(fuser, dataclasses.replace(frames[0], index=k), [whole], [0.1], [table])
    assert len(fuser.scene.table.records) == (1 if merged else 2)


def test_fuser_separate_objects_are_not_merged_by_shared_mask(new_fuser: NewFuser, frames: list[Frame]) -> None:
    fuser = new_fuser()
    first, second, _ = masks_of(frames[0])
    for _ in range(5):
        fuse_masks(fuser, frames[0], [first, second], [0.9, 0.9])
    for _ in range(4):
        fuse_masks(fuser, frames[0], [first | second], [0.9])
    assert len(fuser.scene.table.records) == 2
    view = fuser.scene.render(CAMERA, frames[0].T_world_camera)
    ids = [np.bincount(view.instance_ids[mask & (view.depth > 0)]).argmax() for mask in (first, second)]
    assert ids[0] != ids[1]
    assert 0 not in ids


def test_fuser_confidence_decreases_without_detections(new_fuser: NewFuser, frames: list[Frame]) -> None:
    fuser = new_fuser()
    for k, frame in enumerate(frames):
        fuse_masks(fuser, frame, masks_of(frame)[:1] if k % 2 == 0 else [], [0.8] if k % 2 == 0 else [])
    [record] = fuser.scene.table.records.values()
    assert record.observations == 5
    assert record.visible == 10
    assert record.confidence == pytest.approx(0.4)


@pytest.mark.parametrize("confirmed", [False, True])
def test_fuser_only_tentative_instances_expire(new_fuser: NewFuser, frames: list[Frame], confirmed: bool) -> None:
    """Frames without a run of the detector do not count. The second instance is detected again before it expires."""
    fuser = new_fuser(tentative_max_age=3, min_observations=2 if confirmed else 4)
    first, second, _ = masks_of(frames[0])
    numbered = (dataclasses.replace(frames[0], index=k) for k in itertools.count())
    for _ in range(2):
        fuse_masks(fuser, next(numbered), [first, second], [0.9, 0.9])
    for _ in range(2):
        fuse_masks(fuser, next(numbered), [], [])
    fuse_masks(fuser, next(numbered), [second], [0.9])
    kept = {1, 2} if confirmed else {2}
    table = fuser.scene.table
    assert table.records.keys() == kept
    assert set(np.unique(fuser.scene.instances_seen(frames[0], frames[0].T_world_camera, 1))) == {0, *kept}
    fuse_masks(fuser, next(numbered), [first], [0.9])
    assert table.records.keys() == ({1, 2} if confirmed else {2, 3}), "expected a new id"


def test_fuser_without_maximum_age_keeps_instances(new_fuser: NewFuser, frames: list[Frame]) -> None:
    fuser = new_fuser(tentative_max_age=0)
    fuse_masks(fuser, frames[0], masks_of(frames[0])[:1], [0.9])
    for frame in frames[1:]:
        fuse_masks(fuser, frame, [], [])
    assert len(fuser.scene.table.records) == 1


def test_fuser_resumed_map_expires_like_single_run(frames: list[Frame], tmp_path: Path) -> None:
    def new() -> MapFuser:
        return assemble(BayesianTsdf, voxel_size=0.02, max_depth=4.0, tentative_max_age=4)

    def fuse(fuser: MapFuser, k: int) -> list[int]:
        masks = [masks_of(frames[k])[i] for i, frame in enumerate((0, 2, 5)) if k == frame]
        fuse_masks(fuser, frames[k], masks, [0.9] * len(masks))
        return [*fuser.scene.table.records]

    single, resumed = new(), new()
    whole = [fuse(single, k) for k in range(10)]
    parts = [fuse(resumed, k) for k in range(3)]
    resumed.scene.save(tmp_path / "map.npz")
    resumed = new()
    resumed.resume(InstanceMap.load(tmp_path / "map.npz"))
    assert parts + [fuse(resumed, k) for k in range(3, 10)] == whole
    assert whole[4:] == [[2], [2, 3], [3], [3], [3], []]
    for fuser, name in ((single, "single.npz"), (resumed, "resumed.npz")):
        fuser.scene.save(tmp_path / name)
    first, second = (InstanceMap.load(tmp_path / name) for name in ("single.npz", "resumed.npz"))
    np.testing.assert_array_equal(first.labels.in_use().instance_ids, second.labels.in_use().instance_ids)


def test_association_votes_of_removed_instances_are_bounded() -> None:
    """Each frame detects two instances that are then removed."""
    association, table = Association(merge_overlap=0.5), InstanceTable()
    scene = SimpleNamespace(table=table)
    nothing = np.zeros((0, 1), np.float32)
    clusters = PointClusters(
        np.zeros((0, 3), np.float32), np.zeros((0, 2), np.int32), np.int32([]), nothing, nothing[:, 0], ("a",)
    )
    overlaps = Overlaps(*np.zeros((3, 0), np.int32), np.zeros((0, 0), np.int32), np.zeros((1, 1), np.int32), 1)
    for k in range(5 * MIN_PAIRS):
        ids = [table.create(1, k).id for _ in range(2)]
        association.merge(scene, Matches(k, clusters, overlaps, np.int32(ids), np.zeros(3)))
        for instance_id in ids:
            table.remove(instance_id)
    assert len(association._merge_votes) <= MIN_PAIRS + 1


def test_fuser_class_posterior_is_product_of_measurements(new_fuser: NewFuser, frames: list[Frame]) -> None:
    fuser = new_fuser(class_floor=1e-6)
    for frame in frames[:3]:
        fuse_masks(fuser, frame, masks_of(frame)[:1], [0.9])
    [instance] = fuser.scene.instances().values()
    assert instance.class_probabilities[0] == pytest.approx(0.7**3 / (0.7**3 + 0.3**3), abs=1e-4)


def test_fuser_different_label_space_raises(new_fuser: NewFuser, frames: list[Frame]) -> None:
    fuser = new_fuser()
    fuse_masks(fuser, frames[0], [], [])
    clusters = dataclasses.replace(
        lift(Detections.none(CAMERA.shape, ("cup",)), frames[1], Pose(np.eye(4))), classes=("cup",)
    )
    with pytest.raises(DataError, match="label space"):
        fuser.fuse(frames[1], Pose(np.eye(4)), clusters)


def test_fuser_empty_frame_keeps_map_unchanged(new_fuser: NewFuser) -> None:
    fuser = new_fuser()
    frame = Scene().frame(np.eye(4))
    fuse_masks(fuser, frame, [np.ones(CAMERA.shape, np.bool_)], [0.9])
    assert fuser.scene.statistics.voxels == 0
    assert len(fuser.scene.table.records) == 0


def test_fuser_instance_with_few_visible_pixels_is_not_counted(new_fuser: NewFuser, frames: list[Frame]) -> None:
    """If only a small part of the instance is visible, its confidence must not decrease."""
    fuser = new_fuser(create_points=50)
    mask = masks_of(frames[0])[0]
    fuse_masks(fuser, frames[0], [mask], [0.9])
    [record] = fuser.scene.table.records.values()
    v, u = np.nonzero(mask)
    middle = (abs(v - int(np.median(v))) <= 2) & (abs(u - int(np.median(u))) <= 2)
    for rows, visible in (((v[middle], u[middle]), 1), ((v, u), 2)):
        depth = np.zeros_like(frames[0].depth)
        depth[rows] = frames[0].depth[rows]
        fuse_masks(fuser, dataclasses.replace(frames[0], index=1, depth=depth), [], [])
        assert record.visible == visible


@pytest.mark.parametrize("voxel_size", [0.01, 0.02, 0.04])
def test_fuser_min_area_does_not_depend_on_voxel_size(new_fuser: NewFuser, voxel_size: float) -> None:
    """The object is a poster of known area on a slanted surface, which is not a wall."""
    depth, poster = 1.5, np.zeros(CAMERA.shape, np.bool_)
    poster[30:90, 40:120] = True
    area = poster.sum() * depth**2 / (CAMERA.fx * CAMERA.fy)
    surface = Scene(planes=[(np.array([0.0, 0.0, -1.0]), -depth)])
    for share, count in ((0.9, 1), (1.1, 0)):
        fuser = new_fuser(voxel_size=voxel_size, min_area=share * area)
        for k in range(3):
            frame = dataclasses.replace(surface.frame(np.eye(4), k), up=np.array([0.0, -1.0, -1.0]) / np.sqrt(2))
            fuse_masks(fuser, frame, [poster], [0.9])
        assert len(fuser.scene.instances()) == count
        assert len(fuser.scene.instance_ids()) == 1, "expected one instance id for any min_area"


@pytest.mark.parametrize(
    "wrong",
    [
        {"voxel_size": 0.0},
        {"max_depth": 0.1},
        {"label_band": 9.0},
        {"min_overlap": 1.5},
        {"extend_score": 1.1},
        {"extend_iou": -0.1},
        {"min_class_agreement": -0.1},
        {"merge_frames": 0},
        {"merge_agreement": 1.1},
        {"min_confidence": float("nan")},
        {"min_area": -0.001},
    ],
)
def test_fuser_invalid_shared_parameter_raises(new_fuser: NewFuser, wrong: dict[str, float]) -> None:
    [name] = wrong
    with pytest.raises(ConfigError, match=name):
        new_fuser(**wrong)


def test_fuser_floored_distribution_is_positive_and_normalized() -> None:
    p = np.exp(floored_log(np.float32([[1, 0, 0, 0], [0.25, 0.25, 0.25, 0.25]]), 0.2))
    assert np.allclose(p, [[0.85, 0.05, 0.05, 0.05], [0.25, 0.25, 0.25, 0.25]])
    assert floored_log(np.zeros((0, 0), np.float32), 0.2).shape == (0, 0)


@pytest.mark.parametrize(
    ("support_overlap", "same_class", "keeps"), [(0.6, False, True), (1.0, False, False), (0.6, True, False)]
)
def test_fuser_supported_object_keeps_voxels_under_larger_mask(
    support_overlap: float, same_class: bool, keeps: bool, frames: list[Frame]
) -> None:
    """The object is confirmed. After that, only the desk is detected, and the mask of the desk covers the object.

    An object of the same class is part of the desk and is merged.
    """
    fuser = assemble(
        BayesianTsdf,
        voxel_size=0.02,
        max_depth=4.0,
        support_overlap=support_overlap,
        occlusion_area_ratio=0.0,
        merge_agreement=1.0,
    )
    whole = masks_of(frames[0])[0]
    u = np.flatnonzero(whole.any(axis=0))
    keyboard = whole & (np.arange(CAMERA.width) < u[0] + (u[-1] - u[0]) // 3)
    desk, small = (0.99, 0.01), (0.99, 0.01) if same_class else (0.01, 0.99)
    for k in range(3):
        fuse_masks(
            fuser, dataclasses.replace(frames[0], index=k), [whole & ~keyboard, keyboard], [0.9, 0.9], [desk, small]
        )
    for k in range(3, 20):
        fuse_masks(fuser, dataclasses.replace(frames[0], index=k), [whole], [0.9], [desk])
    seen = fuser.scene.instances_seen(frames[0], frames[0].T_world_camera, 1)
    assert (seen[keyboard] == 2).mean() > 0.9 if keeps else (seen[keyboard] == 2).mean() < 0.1
    assert (seen[whole & ~keyboard] == 1).mean() > 0.9

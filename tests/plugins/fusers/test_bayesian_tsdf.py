"""Association and evidence as the fuser puts them together, on spheres whose masks are known exactly."""

import dataclasses

import numba
import numpy as np
import pytest

from framework.data import Detections, Frame, Pose
from framework.errors import ConfigError, DataError, MapFullError
from framework.geometry import lift
from framework.mapping.association import OverlapRule
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from tests.analytic_scene import CAMERA, Scene, room, walk

CLASSES = ("chair", "bed")


def detections(masks: list[np.ndarray], scores: list[float]) -> Detections:
    n = len(masks)
    return Detections(
        masks=np.array(masks, np.bool_).reshape(n, *CAMERA.shape),
        boxes=np.zeros((n, 4), np.float32),
        scores=np.array(scores, np.float32),
        class_probabilities=np.tile(np.float32([0.7, 0.3]), (n, 1)),
        classes=CLASSES,
    )


def masks_of(frame: Frame) -> list[np.ndarray]:
    assert frame.truth is not None
    return [frame.truth.instance_ids == i for i in frame.truth.class_names]


def fused(fuser: BayesianTsdf, frame: Frame, masks: list[np.ndarray], scores: list[float]) -> None:
    assert frame.T_world_camera is not None
    pose = Pose(frame.T_world_camera)
    fuser.fuse(frame, pose, lift(detections(masks, scores), frame, pose))


def new_fuser(**parameters: object) -> BayesianTsdf:
    return BayesianTsdf(voxel_size=0.02, max_depth=4.0, **parameters)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [room().frame(T, k) for k, T in enumerate(walk(10))]


def test_ids_stay_with_their_objects_whatever_the_order_of_detections(frames: list[Frame]) -> None:
    fuser = new_fuser()
    for k, frame in enumerate(frames):
        order = np.roll(np.arange(3), k)
        fused(fuser, frame, [masks_of(frame)[i] for i in order], [0.9] * 3)
    assert len(fuser.scene.table.records) == 3
    assert {record.observations for record in fuser.scene.table.records.values()} == {10}


def test_a_weak_detection_updates_but_does_not_create(frames: list[Frame]) -> None:
    fuser = new_fuser()
    first, second, _ = masks_of(frames[0])
    fused(fuser, frames[0], [first, second], [0.9, 0.2])
    assert len(fuser.scene.table.records) == 1
    fused(fuser, frames[1], masks_of(frames[1])[:2], [0.2, 0.2])
    [record] = fuser.scene.table.records.values()
    assert record.observations == 2
    assert record.score_sum == pytest.approx(1.1)


@pytest.mark.parametrize(
    ("parameters", "updates"),
    [
        ({}, True),
        ({"overlap_rule": OverlapRule.IOU}, False),  # a part shares little of all that is covered
        ({"class_gate": 0.9}, True),
        ({"class_gate": 1.0}, False),  # the floor alone keeps distributions from agreeing wholly
    ],
)
def test_what_must_overlap_and_agree_is_a_parameter(frames: list[Frame], parameters: dict, updates: bool) -> None:
    fuser = new_fuser(**parameters)
    whole = masks_of(frames[0])[0]
    u = np.nonzero(whole)[1]
    part = whole & (np.arange(CAMERA.width) < np.quantile(u, 0.3))
    fused(fuser, frames[0], [whole], [0.9])
    fused(fuser, frames[0], [part], [0.9])
    assert (len(fuser.scene.table.records) == 1) == updates


def test_the_same_object_detected_twice_is_created_once(frames: list[Frame]) -> None:
    fuser = new_fuser()
    mask = masks_of(frames[0])[0]
    fused(fuser, frames[0], [mask, mask], [0.9, 0.8])
    assert len(fuser.scene.table.records) == 1


def test_two_halves_become_one_when_they_are_seen_as_one(frames: list[Frame]) -> None:
    """A detector splits an object at first and finds it whole afterwards."""
    fuser = new_fuser()
    whole = masks_of(frames[0])[0]
    u = np.flatnonzero(whole.any(axis=0))
    left = whole & (np.arange(CAMERA.width) < (u[0] + u[-1]) // 2)
    for k in range(4):
        fused(fuser, dataclasses.replace(frames[0], index=k), [left, whole & ~left], [0.9, 0.9])
    assert len(fuser.scene.instances()) == 2
    for k in range(4, 12):
        fused(fuser, dataclasses.replace(frames[0], index=k), [whole], [0.5])
    [instance] = fuser.scene.instances().values()
    assert instance.observations == 12, "a frame that saw both halves counts once"
    assert set(np.unique(fuser.scene.mesh().instance_ids)) == {0, instance.id}


def test_two_instances_that_keep_lying_under_one_cluster_are_merged(frames: list[Frame]) -> None:
    """Weak detections of the whole, which would take long to outvote the voxels of the other half."""
    fuser = new_fuser(merge_frames=3)
    whole = masks_of(frames[0])[0]
    u = np.flatnonzero(whole.any(axis=0))
    left = whole & (np.arange(CAMERA.width) < (u[0] + u[-1]) // 2)
    fused(fuser, frames[0], [left, whole & ~left], [0.9, 0.8])
    for k in range(1, 4):
        fused(fuser, dataclasses.replace(frames[0], index=k), [whole], [0.1])
    assert len(fuser.scene.table.records) == 2, "once apart and three times together is not yet three more"
    fused(fuser, dataclasses.replace(frames[0], index=4), [whole], [0.1])
    [record] = fuser.scene.table.records.values()
    assert record.id == 1
    assert record.observations == 5
    assert record.visible == 5, "a frame that had both in view counts once"
    assert record.detections == 6
    assert record.score_sum == pytest.approx(0.9 + 0.8 + 4 * 0.1)
    assert fuser.scene.table.class_probabilities(record)[0] == pytest.approx(0.68**6 / (0.68**6 + 0.32**6), abs=1e-4)
    labels = fuser.scene.labels
    assert set(np.unique(labels.evidence.instance_ids[: labels.row_count])) == {0, 1}
    fused(fuser, dataclasses.replace(frames[0], index=5), [whole], [0.9])
    assert record.observations == 6


def test_two_objects_seen_apart_stay_two_under_a_mask_that_covers_both(frames: list[Frame]) -> None:
    fuser = new_fuser()
    first, second, _ = masks_of(frames[0])
    for _ in range(5):
        fused(fuser, frames[0], [first, second], [0.9, 0.9])
    for _ in range(4):
        fused(fuser, frames[0], [first | second], [0.9])
    assert len(fuser.scene.table.records) == 2
    view = fuser.scene.render(CAMERA, frames[0].T_world_camera)
    ids = [np.bincount(view.instance_ids[mask & (view.depth > 0)]).argmax() for mask in (first, second)]
    assert ids[0] != ids[1]
    assert 0 not in ids


def test_confidence_falls_with_frames_that_see_but_do_not_detect(frames: list[Frame]) -> None:
    fuser = new_fuser()
    for k, frame in enumerate(frames):
        fused(fuser, frame, masks_of(frame)[:1] if k % 2 == 0 else [], [0.8] if k % 2 == 0 else [])
    [record] = fuser.scene.table.records.values()
    assert record.observations == 5
    assert record.visible == 10
    assert record.confidence == pytest.approx(0.4)


def test_a_class_posterior_is_the_product_of_the_measurements(frames: list[Frame]) -> None:
    fuser = new_fuser(class_floor=1e-6)
    for frame in frames[:3]:
        fused(fuser, frame, masks_of(frame)[:1], [0.9])
    [instance] = fuser.scene.instances().values()
    assert instance.class_probabilities[0] == pytest.approx(0.7**3 / (0.7**3 + 0.3**3), abs=1e-4)


def test_another_label_space_is_an_error(frames: list[Frame]) -> None:
    fuser = new_fuser()
    fused(fuser, frames[0], [], [])
    clusters = dataclasses.replace(
        lift(Detections.none(CAMERA.shape, ("cup",)), frames[1], Pose(np.eye(4))), classes=("cup",)
    )
    with pytest.raises(DataError, match="label space"):
        fuser.fuse(frames[1], Pose(np.eye(4)), clusters)


def test_a_full_map_says_so_and_keeps_what_it_has(frames: list[Frame]) -> None:
    fuser = new_fuser(max_blocks=300)
    with pytest.raises(MapFullError, match="300 blocks"):
        fused(fuser, frames[0], [], [])
    assert fuser.scene.voxel_count == 300 * 512
    fuser.scene.mesh()


def test_parameters_are_checked() -> None:
    for wrong in ({"voxel_size": 0.0}, {"max_depth": 0.1}, {"overlap": 1.5}, {"absence": float("nan")}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            BayesianTsdf(**wrong)  # type: ignore[arg-type]


def test_the_map_does_not_depend_on_the_number_of_threads(frames: list[Frame]) -> None:
    default = numba.get_num_threads()
    if default < 2:
        pytest.skip("this machine has one core")
    maps = []
    try:
        for threads in (1, 2):
            numba.set_num_threads(threads)
            fuser = new_fuser()
            for frame in frames:
                fused(fuser, frame, masks_of(frame), [0.9, 0.5, 0.4])
            grid, labels = fuser.scene.voxels.grid, fuser.scene.labels
            b, r = fuser.scene.voxels.block_count, labels.row_count
            maps.append(
                [a[:b].tobytes() for a in (grid.block_coords, grid.tsdf, grid.weight, grid.color, grid.label_row)]
            )
            maps[-1] += [a[:r].tobytes() for a in labels.evidence]
    finally:
        numba.set_num_threads(default)
    assert maps[0] == maps[1]


def test_nothing_changes_where_the_scene_is_empty() -> None:
    fuser = new_fuser()
    frame = Scene().frame(np.eye(4))
    fused(fuser, frame, [np.ones(CAMERA.shape, np.bool_)], [0.9])
    assert fuser.scene.voxel_count == 0
    assert len(fuser.scene.table.records) == 0


def test_only_what_becomes_an_instance_takes_rows_of_evidence(frames: list[Frame]) -> None:
    fuser = new_fuser()
    first, second, _ = masks_of(frames[0])
    fused(fuser, frames[0], [second], [0.2])
    assert fuser.scene.labels.row_count == 0
    fused(fuser, frames[0], [first], [0.9])
    alone = fuser.scene.labels.row_count
    assert alone > 0
    fused(fuser, frames[0], [first, second], [0.9, 0.2])
    assert fuser.scene.labels.row_count == alone


def test_an_instance_of_which_a_few_pixels_show_is_not_in_view(frames: list[Frame]) -> None:
    """Else its confidence would fall in every frame at whose border or behind whose objects a bit of it shows."""
    fuser = new_fuser(create_points=50)
    mask = masks_of(frames[0])[0]
    fused(fuser, frames[0], [mask], [0.9])
    [record] = fuser.scene.table.records.values()
    v, u = np.nonzero(mask)
    middle = (abs(v - int(np.median(v))) <= 2) & (abs(u - int(np.median(u))) <= 2)
    for rows, visible in (((v[middle], u[middle]), 1), ((v, u), 2)):
        depth = np.zeros_like(frames[0].depth)
        depth[rows] = frames[0].depth[rows]
        fused(fuser, dataclasses.replace(frames[0], index=1, depth=depth), [], [])
        assert record.visible == visible

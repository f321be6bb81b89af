"""Tests for resumed maps and for localization in a stored map."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from framework.api import Mapper, load_map
from framework.data import Frame, Pose
from framework.datasets.frames.sequence_reader import Recording
from framework.datasets.rgbd_folder import RgbdFolder
from framework.datasets.tum_rgbd import TumRgbd
from framework.errors import ConfigError, DataError
from framework.evaluation.trajectory import evaluate
from framework.geometry import inverse, rotation_angle
from framework.tracking.keyframes import read_keyframes, write_keyframes
from tests.support.scenes.corner_room import CornerRoom

pytestmark = pytest.mark.integration

GIVEN = ("detector=ground_truth", "tracker=ground_truth", "refiner=identity", "fuser.voxel_size=0.04")
TRACKED = ("detector=none", "fuser.voxel_size=0.02")
DESK = TumRgbd(Path("data/desk"), scene="rgbd_dataset_freiburg1_rpy")


def stored_files(mapper: Mapper, place: Path) -> Path:
    """Write the map and the keyframes of a mapper to the new folder `place` and return the folder."""
    place.mkdir()
    mapper.scene.save(place / "map.npz")
    if keyframes := mapper.pipeline.tracker.keyframes():
        write_keyframes(place / "keyframes.npz", keyframes)
    return place


def mapped(frames: Iterable[Frame], *overrides: str) -> tuple[Mapper, list[Pose]]:
    mapper = Mapper(*overrides)
    return mapper, [mapper.add(frame) for frame in frames]


@pytest.mark.parametrize("fuser", ["bayesian_tsdf", "label_count", "max_confidence", "last_write"])
def test_resumed_map_is_identical_to_single_run(tmp_path: Path, room: CornerRoom, fuser: str) -> None:
    stages = (*GIVEN, f"fuser={fuser}")
    first, _ = mapped([room[k] for k in range(3)], *stages)
    before = stored_files(first, tmp_path / "first")
    continued, _ = mapped([room[k] for k in range(3, len(room))], *stages, f"resume_from={before}")
    whole, _ = mapped(room, *stages)
    continued.scene.save(tmp_path / "continued.npz")
    whole.scene.save(tmp_path / "whole.npz")
    assert (tmp_path / "continued.npz").read_bytes() == (tmp_path / "whole.npz").read_bytes()


def test_resumed_map_continues_frame_numbers(tmp_path: Path, room: CornerRoom) -> None:
    """The frame numbers of both recordings start at 0. Both recordings show the same objects."""
    first, _ = mapped(room, *GIVEN)
    again, _ = mapped(room, *GIVEN, f"resume_from={stored_files(first, tmp_path / 'first')}")
    for key, instance in first.instances().items():
        assert again.instances()[key].observations == 2 * instance.observations
        assert again.instances()[key].first_frame == instance.first_frame
        assert again.instances()[key].last_frame == len(room) + instance.last_frame


def ate_mm(recording: Recording, poses: list[Pose]) -> float:
    return 1000 * evaluate([recording.contents.frames[k].T_world_camera for k in recording.chosen], poses).ate_rmse_m


def check_halves(tmp_path: Path, recording: Recording) -> None:
    """Check that mapping in two halves gives a similar map, and an ATE that is at most 5 mm larger than in one run."""
    half = len(recording) // 2
    whole, poses = mapped(recording, *TRACKED)
    first, in_first = mapped([recording[k] for k in range(half)], *TRACKED)
    stored_files(first, tmp_path / "first")
    continued, in_second = mapped(
        [recording[k] for k in range(half, len(recording))], *TRACKED, f"resume_from={tmp_path / 'first'}"
    )
    assert not any(pose.lost for pose in [*poses, *in_first, *in_second])
    assert ate_mm(recording, [*in_first, *in_second]) < ate_mm(recording, poses) + 5
    assert continued.scene.statistics.voxels == pytest.approx(whole.scene.statistics.voxels, rel=0.02)


def test_resumed_desk_tracking_matches_single_run(tmp_path: Path) -> None:
    check_halves(tmp_path, DESK)


@pytest.mark.acceptance
def test_resumed_kitchen_tracking_matches_single_run(tmp_path: Path, shared_data: Path) -> None:
    check_halves(tmp_path, RgbdFolder(shared_data / "redkitchen", stride=3))


@pytest.fixture(scope="module")
def stored_desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder with the map and the keyframes of 15 tracked frames of the desk."""
    desk, _ = mapped([DESK[k] for k in range(0, 30, 2)], *TRACKED)
    return stored_files(desk, tmp_path_factory.mktemp("stored") / "desk")


@pytest.mark.parametrize("tracker", ["voxel_hashing_icp", "pycolmap_pnp"])
def test_resume_in_another_room_leaves_map_unchanged(
    stored_desk: Path, tmp_path: Path, shared_data: Path, tracker: str
) -> None:
    stages = (*TRACKED, f"tracker={tracker}")
    elsewhere, poses = mapped(RgbdFolder(shared_data / "redkitchen", stride=30), *stages, f"resume_from={stored_desk}")
    assert all(pose.lost for pose in poses)
    assert len(poses) == 10
    elsewhere.scene.save(tmp_path / "after.npz")
    assert (tmp_path / "after.npz").read_bytes() == (stored_desk / "map.npz").read_bytes()


def test_resume_lost_camera_relocalizes_in_known_view(stored_desk: Path) -> None:
    black = replace(DESK[5], color=np.zeros_like(DESK[5].color))
    empty = replace(DESK[6], depth=np.zeros_like(DESK[6].depth))
    _, poses = mapped([black, empty, DESK[11], DESK[12]], *TRACKED, f"resume_from={stored_desk}")
    assert [pose.lost for pose in poses] == [True, True, False, False]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("fuser.voxel_size=0.05",), r"fuser.voxel_size: expected 0.04 \(as in the stored map\), got 0.05"),
        (("fuser.max_depth=4",), "fuser.max_depth"),
        (("fuser=label_count",), "fuser: expected the label rule of the stored map"),
        (("fuser=object_volumes",), "expected a fuser with support for stored maps, got ObjectVolumes"),
        (
            ("tracker=voxel_hashing_icp",),
            "resume_from or localize_in: expected a run with stored keyframes, got no keyframes",
        ),
        (("tracker=open3d_odometry",), "expected a tracker with relocalization in a stored map, got Open3dOdometry"),
    ],
)
def test_resume_with_incompatible_config_raises(
    tmp_path: Path, room: CornerRoom, overrides: tuple[str, ...], message: str
) -> None:
    first, _ = mapped([room[0]], *GIVEN)
    before = stored_files(first, tmp_path / "first")
    with pytest.raises(ConfigError, match=message):
        Mapper(*GIVEN, *overrides, f"resume_from={before}")


def test_resume_from_missing_map_raises(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"resume_from: expected a run directory with map.npz, got .* without"):
        Mapper(*GIVEN, f"resume_from={tmp_path}")
    with pytest.raises(DataError, match=r"resume_from: expected a run directory with map.npz, got .*7 without it"):
        Mapper(*GIVEN, "resume_from=7")  # a path, not a number


@pytest.fixture(scope="module")
def desk() -> Mapper:
    """Return a mapper after six tracked frames of the desk."""
    return mapped([DESK[k] for k in range(0, 30, 5)], *TRACKED)[0]


def test_keyframes_file_round_trip_is_exact(desk: Mapper, tmp_path: Path) -> None:
    keyframes = desk.pipeline.tracker.keyframes()
    path = tmp_path / "keyframes.npz"
    assert read_keyframes(path) == {}
    write_keyframes(path, keyframes)
    back = read_keyframes(path)
    assert list(back) == sorted(keyframes)
    for name, array in keyframes.items():
        np.testing.assert_array_equal(back[name], array)
        assert back[name].dtype == array.dtype
    again = Mapper(*TRACKED).pipeline.tracker
    again.load_keyframes(back, desk.scene)
    for name, array in again.keyframes().items():
        np.testing.assert_array_equal(array, keyframes[name])


def test_keyframes_invalid_arrays_or_file_raise(desk: Mapper, tmp_path: Path) -> None:
    keyframes = desk.pipeline.tracker.keyframes()
    scaled = np.array(keyframes["poses"]) * 2
    for damage in (
        {"counts": keyframes["counts"][:-1]},
        {"counts": -np.asarray(keyframes["counts"], np.int32)},
        {"points_world": keyframes["points_world"][:-1]},
        {"poses": scaled},
        {"descriptors": np.asarray(keyframes["descriptors"]).astype(np.int32)},
    ):
        with pytest.raises(DataError):
            Mapper(*TRACKED).pipeline.tracker.load_keyframes({**keyframes, **damage}, desk.scene)
    with pytest.raises(DataError, match="keyframes: expected"):
        Mapper(*TRACKED).pipeline.tracker.load_keyframes({"poses": keyframes["poses"]}, desk.scene)
    path = tmp_path / "keyframes.npz"
    write_keyframes(path, keyframes)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DataError, match=r"keyframes\.npz"):
        read_keyframes(path)


@pytest.mark.parametrize("damage", ["scaled", "none", "cut", "folder", "dangling"])
def test_resumed_keyframes_error_has_file_name_once(desk: Mapper, tmp_path: Path, damage: str) -> None:
    path = stored_files(desk, tmp_path / "run") / "keyframes.npz"
    keyframes = dict(desk.pipeline.tracker.keyframes())
    path.unlink(missing_ok=True)
    if damage == "folder":
        path.mkdir()
    elif damage == "dangling":
        path.symlink_to(tmp_path / "missing")
    else:
        scaled = keyframes | {"poses": np.array(keyframes["poses"]) * 2}
        write_keyframes(path, {"scaled": scaled, "none": {}, "cut": keyframes}[damage])
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DataError) as refused:
        Mapper(*TRACKED, f"resume_from={path.parent}")
    assert str(refused.value).count("keyframes.npz") == 1


def test_resumed_map_of_two_recordings_round_trips(tmp_path: Path, room: CornerRoom) -> None:
    first, _ = mapped(room, *GIVEN)
    again, _ = mapped(room, *GIVEN, f"resume_from={stored_files(first, tmp_path / 'first')}")
    again.scene.save(tmp_path / "again.npz")
    assert list(load_map(tmp_path / "again.npz").instances()) == list(again.instances())


def test_localize_in_gives_new_map_in_stored_world_frame(tmp_path: Path) -> None:
    """Neither recording has ground-truth poses. The second one is tracked in the world frame of the first one."""
    unposed = [replace(DESK[k], T_world_camera=None) for k in range(40)]
    first, poses = mapped(unposed[:25], *TRACKED)
    own, in_its_world = mapped(unposed[20:], *TRACKED, f"localize_in={stored_files(first, tmp_path / 'first')}")
    assert not any(pose.lost for pose in in_its_world)
    for k in range(5):
        apart = inverse(poses[20 + k].T_world_camera) @ in_its_world[k].T_world_camera
        assert np.linalg.norm(apart[:3, 3]) < 0.01
        assert rotation_angle(apart[:3, :3]) < 0.01
    alone, _ = mapped(unposed[20:], *TRACKED)
    assert own.scene.statistics.voxels == pytest.approx(alone.scene.statistics.voxels, rel=0.05)
    with pytest.raises(ConfigError, match="resume_from and localize_in"):
        Mapper(*TRACKED, f"localize_in={tmp_path / 'first'}", f"resume_from={tmp_path / 'first'}")
    with pytest.raises(DataError, match="localize_in: expected a run directory"):
        Mapper(*TRACKED, f"localize_in={tmp_path}")

"""Tests for original recordings of datasets, apps and drivers, compared with known values."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from framework.api import begin
from framework.commands.recordings.convert_oni import convert
from framework.config.composition import composed
from framework.data import Camera
from framework.datasets.scannet.scannet import ScanNet
from framework.datasets.scannet.scannet_annotation import read_aggregation
from framework.datasets.scenenn.oni import read_frames
from framework.datasets.scenenn.oni_records import Stream, read_contents
from framework.datasets.scenenn.scene_files import write_intrinsics
from framework.datasets.seven_scenes import BASELINE, COLOR_CAMERA, SevenScenes, register
from framework.datasets.tum_rgbd import PUBLISHED, Intrinsics, TumRgbd
from framework.errors import DataError, FrameError
from framework.interfaces import PoseTracker, RGBDSequence
from framework.pipeline import Pipeline
from framework.registry import build
from framework.runtime.run_log import RunResult
from plugins.detectors.none import NoDetections
from plugins.trackers.ground_truth import GroundTruth
from plugins.trackers.trajectory_file import TrajectoryFile
from tests.framework.datasets.scenenn.test_oni import played
from tests.support.scenes.corner_room import GridFuser, KeepAll

pytestmark = pytest.mark.integration

VGA = (480, 640)
KINECT = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)  # default intrinsics of OpenNI
KITCHEN = "redkitchen/seq-01"
FREIBURG1_RPY = "rgbd_dataset_freiburg1_rpy"
GAP = (1305031244.897635, 1305031244.997688)  # times of the color images with depth but without a pose, s


@pytest.fixture(scope="module")
def originals(shared_data: Path) -> Path:
    """Return `shared/data/originals`. Skip the test if the folder is missing."""
    if not (shared_data / "originals").is_dir():
        pytest.skip(f"{shared_data / 'originals'} does not exist")
    return shared_data / "originals"


def readings(depth: np.ndarray) -> tuple[float, float, float]:
    """Return the minimum and the maximum of the valid depth, and the fraction of valid pixels."""
    return float(depth[depth > 0].min()), float(depth[depth > 0].max()), float((depth > 0).mean())


def raw(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def run(*overrides: str) -> tuple[RGBDSequence, RunResult]:
    """Run the default stages without a detector, and return the sequence and the result."""
    config = composed("detector=none", "fuser.voxel_size=0.02", *overrides)
    sequence = build(RGBDSequence, config.dataset)
    return sequence, begin(config).run(sequence)


def check_map_shows_its_frames(sequence: RGBDSequence, result: RunResult) -> None:
    """Check that the depth rendered at each tracked pose has a median error below 0.01 m, half a voxel."""
    for k, tracked in enumerate(result.tracked):
        frame = sequence[k]
        seen = result.scene.render(frame.camera, tracked.pose.T_world_camera).depth
        both = (seen > 0) & (frame.depth > 0)
        assert both.sum() > 0.8 * (frame.depth > 0).sum()
        assert np.median(np.abs(seen - frame.depth)[both]) < 0.01


# OpenNI 1


def test_openni_1_records_are_complete(originals: Path) -> None:
    contents = read_contents(originals / "oni/test.oni")
    counted = {stream: (images.node, images.count, images.last) for stream, images in contents.streams.items()}
    assert counted == {Stream.DEPTH: (2, 12, 12), Stream.COLOR: (3, 12, 12)}
    assert (contents.cut_off, contents.end, contents.largest_node) == (False, 2124474, 3)


@pytest.mark.parametrize(("size", "end", "count"), [(2124473, 2124446, 12), (2_000_000, 1950114, 11)])
def test_openni_1_recording_without_end_is_truncated(
    originals: Path, tmp_path: Path, size: int, end: int, count: int
) -> None:
    path = tmp_path / "cut.oni"
    path.write_bytes((originals / "oni/test.oni").read_bytes()[:size])
    contents = read_contents(path)
    assert (contents.cut_off, contents.end) == (True, end)
    assert {images.count for images in contents.streams.values()} == {count}


def test_openni_1_without_images_raises_one_line_error(originals: Path, tmp_path: Path) -> None:
    path = originals / "oni/no_images.oni"
    with pytest.raises(DataError) as caught:
        convert(path, tmp_path / "out")
    assert str(caught.value) == f"{path}: expected depth and color images, got no depth and no color"
    assert not (tmp_path / "out").exists()


@played
def test_openni_1_recording_plays_completely(originals: Path, tmp_path: Path) -> None:
    frames = list(read_frames(read_contents(originals / "oni/test.oni"), tmp_path))
    assert len(frames) == 12
    assert [(f.color_time, f.depth_time) for f in (frames[0], frames[-1])] == [(0, 11680), (366719, 378742)]
    for frame in frames:
        assert (frame.color.shape, frame.color.dtype) == ((*VGA, 3), np.uint8)
        assert (frame.depth_mm.shape, frame.depth_mm.dtype) == (VGA, np.uint16)
    assert readings(frames[0].depth_mm) == pytest.approx((628, 4521, 0.764785), abs=1e-6)
    content = (originals / "oni/test.oni").read_bytes()
    for frame, at, size in (
        (frames[0], 31288 + 40, 68970),
        (frames[11], 1950114 + 40, 68663),
    ):  # byte offset and size of the JPEG
        decoded = cv2.imdecode(np.frombuffer(content, np.uint8, size, at), cv2.IMREAD_COLOR_RGB)
        np.testing.assert_allclose(frame.color, decoded, atol=4)


@played
def test_openni_1_recording_is_converted_and_mapped(
    originals: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    convert(originals / "oni/test.oni", tmp_path / "011")
    assert capsys.readouterr().out.startswith(f"{tmp_path / '011'}: 12 frames; skipped 0 color and 0 depth")
    (tmp_path / "intrinsic").mkdir()
    write_intrinsics(tmp_path / "intrinsic/asus.ini", KINECT)
    overrides = ("dataset=scenenn", f"dataset.root={tmp_path}", "dataset.stop=3")
    sequence, result = run(*overrides, "tracker=voxel_hashing_icp")
    assert sequence.camera == KINECT
    assert [sequence[k].timestamp for k in range(3)] == pytest.approx([0.01168, 0.045049, 0.078419], abs=2e-6)
    assert (result.frames, result.frames_skipped, result.frames_lost) == (3, 0, 0)
    check_map_shows_its_frames(sequence, result)
    with pytest.raises(DataError, match="expected ground-truth poses, got none for the 3 frames; add the poses"):
        run(*overrides, "tracker=ground_truth")


# 7-Scenes


def test_seven_scenes_published_frame_matches_files(originals: Path) -> None:
    sequence = SevenScenes(originals / "seven_scenes", scene=KITCHEN)
    assert (len(sequence), sequence.name, sequence.camera) == (3, "redkitchen-seq-01", COLOR_CAMERA)
    assert sequence.camera.shape == VGA
    assert [sequence[k].timestamp for k in range(3)] == pytest.approx([150 / 30, 151 / 30, 152 / 30])
    frame, stem = sequence[0], originals / "seven_scenes" / KITCHEN / "frame-000150"
    np.testing.assert_array_equal(frame.color[..., ::-1], raw(stem.with_suffix(".color.png")))
    depth_mm = raw(stem.with_suffix(".depth.png"))
    assert readings(depth_mm) == pytest.approx((939, 2857, 0.879967), abs=1e-6)
    np.testing.assert_allclose(frame.depth, register(depth_mm) / 1000, rtol=1e-6)
    assert readings(frame.depth) == pytest.approx((0.939, 2.857, 0.72362), abs=1e-5)
    T_world_depthcamera = np.array(
        [  # values of the file, which has tabs and CRLF
            [7.0352107e-001, 3.1905547e-001, -6.3492483e-001, -9.1287065e-001],
            [-3.7097296e-001, 9.2696339e-001, 5.4754097e-002, -3.4388667e-001],
            [6.0605687e-001, 1.9703214e-001, 7.7053267e-001, 7.5986093e-001],
            [0, 0, 0, 1],
        ]
    )
    T_depthcamera_camera = np.eye(4)
    T_depthcamera_camera[0, 3] = BASELINE
    # the axes in the file have a length of 0.9999
    np.testing.assert_allclose(frame.T_world_camera, T_world_depthcamera @ T_depthcamera_camera, atol=1e-4)


def test_seven_scenes_is_mapped(originals: Path) -> None:
    root = originals / "seven_scenes"
    sequence, result = run(
        "dataset=seven_scenes", f"dataset.root={root}", f"dataset.scene={KITCHEN}", "tracker=ground_truth"
    )
    assert (result.frames, result.frames_skipped, result.frames_lost) == (3, 0, 0)
    check_map_shows_its_frames(sequence, result)


# Replica


def test_replica_nice_slam_frames_match_files(originals: Path) -> None:
    root = originals / "replica_nice_slam"
    config = composed("dataset=replica_nice_slam", f"dataset.root={root}", "dataset.scene=office0")
    sequence = build(RGBDSequence, config.dataset)
    assert (len(sequence), sequence.name) == (4, "office0")
    assert sequence.camera == Camera(1200, 680, 600.0, 600.0, 599.5, 339.5)
    lines = (root / "office0/traj.txt").read_text().splitlines()
    assert len(lines) == 2000
    for k in range(4):
        frame = sequence[k]
        assert (frame.color.shape, frame.depth.shape) == ((680, 1200, 3), (680, 1200))
        np.testing.assert_allclose(
            frame.T_world_camera, np.array(lines[k].split(), float).reshape(4, 4), rtol=0, atol=1e-12
        )
        stored = raw(root / f"office0/results/depth{k:06d}.png")
        np.testing.assert_allclose(frame.depth, stored / 6553.5, rtol=1e-6)
    assert readings(sequence[0].depth) == pytest.approx((1.11574, 3.62707, 0.998496), abs=1e-5)


def test_replica_is_mapped(originals: Path) -> None:
    root = originals / "replica_nice_slam"
    sequence, result = run(
        "dataset=replica_nice_slam",
        f"dataset.root={root}",
        "dataset.scene=office0",
        "dataset.stop=2",
        "tracker=ground_truth",
    )
    assert (result.frames, result.frames_skipped, result.frames_lost) == (2, 0, 0)
    check_map_shows_its_frames(sequence, result)


def test_replica_excerpt_skips_frames_with_missing_images(originals: Path, tmp_path: Path) -> None:
    root = shutil.copytree(originals / "replica_nice_slam", tmp_path / "replica")
    (root / "office0/results/frame000001.jpg").unlink()
    (root / "office0/results/depth000003.png").unlink()
    config = composed("dataset=replica_nice_slam", f"dataset.root={root}", "dataset.scene=office0")
    sequence = build(RGBDSequence, config.dataset)
    result = given_poses(GroundTruth(), sequence)
    assert (result.frames, result.frames_skipped) == (4, 2)
    assert [frame.index for frame in result.tracked] == [0, 2]
    with pytest.raises(FrameError, match=r"frame000001\.jpg: expected a readable file"):
        sequence[1]


# TUM RGB-D


def given_poses(tracker: PoseTracker, sequence: RGBDSequence) -> RunResult:
    """Run with given poses and minimal stages, which is faster than tracking."""
    return Pipeline(NoDetections(), tracker, KeepAll(), GridFuser(), prefetch=0).run(sequence)


def test_tum_excerpt_reads_available_images(originals: Path) -> None:
    sequence = TumRgbd(originals / "tum_rgbd", scene=FREIBURG1_RPY, undistort=False)
    assert (len(sequence), sequence.name) == (694, FREIBURG1_RPY)
    assert sequence.camera == PUBLISHED[Intrinsics.FREIBURG1].camera
    there = [k for k, recorded in enumerate(sequence.contents.frames) if Path(recorded.images.color_name).exists()]
    assert there == [99, 100, 101, 102, 103, 104]
    frame, folder = sequence[99], originals / "tum_rgbd" / FREIBURG1_RPY
    assert frame.timestamp == 1305031232.825767
    np.testing.assert_array_equal(frame.color[..., ::-1], raw(folder / "rgb/1305031232.825767.png"))
    stored = raw(folder / "depth/1305031232.834645.png")
    assert stored.shape == frame.camera.shape == VGA
    np.testing.assert_allclose(frame.depth, stored / 5000, rtol=1e-6)
    assert readings(frame.depth) == pytest.approx((0.7518, 2.7042, 0.727184), abs=1e-5)
    with pytest.raises(FrameError, match=r"rgb/1305031229\.528748\.png: expected a readable file"):
        sequence[0]


def test_tum_pose_is_interpolated_between_neighbors(originals: Path) -> None:
    """The time of the frame is between those of lines 689 and 690 of groundtruth.txt, at a fraction of 0.26."""
    T_world_camera = TumRgbd(originals / "tum_rgbd", scene=FREIBURG1_RPY)[99].T_world_camera
    assert T_world_camera is not None
    share = (0.825767 - 0.8231) / (0.8332 - 0.8231)
    position = (1 - share) * np.array([1.2956, 0.6608, 1.5464]) + share * np.array([1.2962, 0.6607, 1.5472])
    np.testing.assert_allclose(T_world_camera[:3, 3], position, atol=1e-7)
    x, y, z, w = (1 - share) * np.array([-0.6501, -0.5416, -0.0898, 0.5253]) + share * np.array(
        [-0.6498, -0.5398, -0.0937, 0.5269]
    )
    forwards = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z])
    np.testing.assert_allclose(T_world_camera[:3, 2], forwards / np.linalg.norm(forwards), atol=1e-5)


def test_tum_is_mapped(originals: Path) -> None:
    sequence, result = run(
        "dataset=tum_rgbd",
        f"dataset.root={originals / 'tum_rgbd'}",
        f"dataset.scene={FREIBURG1_RPY}",
        "dataset.start=99",
        "dataset.stop=102",
        "tracker=ground_truth",
    )
    assert (result.frames, result.frames_skipped, result.frames_lost) == (3, 0, 0)
    check_map_shows_its_frames(sequence, result)


def around_the_gap(originals: Path, folder: Path) -> TumRgbd:
    """Return the frames around a gap in the motion capture. All frames share one color and one depth image."""
    source = originals / "tum_rgbd" / FREIBURG1_RPY
    target = folder / FREIBURG1_RPY
    target.mkdir()
    shutil.copy(source / "groundtruth.txt", target)
    for name, images in (("rgb", "rgb/1305031232.825767.png"), ("depth", "depth/1305031232.834645.png")):
        times = [line.split()[0] for line in (source / f"{name}.txt").read_text().splitlines() if line[0] != "#"]
        near = [time for time in times if GAP[0] - 0.1 < float(time) < GAP[1] + 0.1]
        (target / f"{name}.txt").write_text("".join(f"{time} {source / images}\n" for time in near))
    return TumRgbd(target)


def test_tum_frames_in_motion_capture_gap_are_skipped(
    originals: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    sequence = around_the_gap(originals, tmp_path)
    times = [recorded.timestamp for recorded in sequence.contents.frames]
    unposed = [recorded.timestamp for recorded in sequence.contents.frames if recorded.T_world_camera is None]
    assert unposed == list(GAP)
    results = {}
    for tracker in (GroundTruth(), TrajectoryFile(sequence.folder / "groundtruth.txt")):
        result = given_poses(tracker, sequence)
        assert (result.frames, result.frames_skipped, result.frames_lost) == (len(times), 2, 0)
        assert [tracked.timestamp for tracked in result.tracked] == [time for time in times if time not in GAP]
        results[type(tracker)] = result
    output = [record.message for record in caplog.records if "skipped because they have no pose" in record.message]
    expected = f"2 of {len(times)} frames skipped because they have no pose; the first: frame {times.index(GAP[0])}"
    assert [message.startswith(expected) for message in output] == [True, True]
    for ours, theirs in zip(results[GroundTruth].tracked, results[TrajectoryFile].tracked, strict=True):
        # poses are interpolated in one run; in the other, the nearest pose is up to 20 ms away, at 0.3 m/s
        np.testing.assert_allclose(ours.pose.T_world_camera[:3, 3], theirs.pose.T_world_camera[:3, 3], atol=0.01)


def test_tum_run_in_motion_capture_gap_raises_one_line_error(originals: Path, tmp_path: Path) -> None:
    sequence = around_the_gap(originals, tmp_path)
    first = [recorded.timestamp for recorded in sequence.contents.frames].index(GAP[0])
    alone = TumRgbd(sequence.folder, start=first, stop=first + 1)
    for tracker, message in (
        (GroundTruth(), "expected ground-truth poses, got none for the 1 frames;"),
        (TrajectoryFile(sequence.folder / "groundtruth.txt"), "expected poses, got none for the 1 frames"),
    ):
        with pytest.raises(DataError, match=f"{FREIBURG1_RPY}: {message}") as caught:
            given_poses(tracker, alone)
        assert "\n" not in str(caught.value)


# ScanNet


def test_scannet_first_release_names_are_known(shared_data: Path) -> None:
    """The label table has `trash can` and `dish rack` with a space. Neither has a class in COCO."""
    root = shared_data / "scannet_scene0000"
    if not root.is_dir():
        pytest.skip(f"{root} does not exist")
    scene = ScanNet(root, "scene0000_00")
    mesh = scene.mesh
    assert mesh is not None
    names = sorted(name for name in mesh.class_names.values() if name is not None)
    assert len(names) == 17
    assert names.count("chair") == 4  # stools
    unknown = [instance for instance, name in mesh.class_names.items() if name is None]
    assert unknown == [56], "expected the unlabeled part as an instance after the 55 objects"
    groups = read_aggregation(scene.folder / "scene0000_00.aggregation.json")
    segments = json.loads((scene.folder / "scene0000_00_vh_clean_2.0.010000.segs.json").read_text())["segIndices"]
    for label, count in (("trashcan", 3), ("dishrack", 1)):
        objects = [group.segments for group in groups if group.label == label]
        assert len(objects) == count
        of_label = np.isin(segments, np.concatenate(objects))
        assert of_label.sum() > 100
        assert (
            np.count_nonzero(mesh.instance_ids[of_label]) < 0.1 * of_label.sum()
        )  # some segments can belong to a later object

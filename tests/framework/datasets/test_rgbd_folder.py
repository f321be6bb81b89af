"""Tests for RGB-D folders, including folders with missing or invalid files."""

import errno
import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from framework.datasets.frames.conventions import DepthReading
from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import ConfigError, DataError, FrameError, StorageError
from framework.sensors.noise_models import SensorChoice, SensorKind

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data"
WIDTH, HEIGHT, FRAMES = 24, 16, 4
CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": 20.0, "fy": 21.0, "cx": 11.5, "cy": 7.5, "depth_scale": 1000.0}


def picture(k):
    return np.random.default_rng(k).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def depth_mm(k):
    return (1000 + 10 * k + np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)).astype(np.uint16)


def write_frame(folder, k):
    cv2.imwrite(str(folder / f"color/{k:06d}.png"), picture(k)[..., ::-1])
    cv2.imwrite(str(folder / f"depth/{k:06d}.png"), depth_mm(k))
    ids = np.zeros((HEIGHT, WIDTH), np.uint16)
    ids[4:9, 5:12] = 7
    ids[10:14] = 300
    cv2.imwrite(str(folder / f"instance/{k:06d}.png"), ids)


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "kitchen"
    for name in ("color", "depth", "instance"):
        (root / name).mkdir(parents=True)
    (root / "camera.json").write_text(json.dumps(CAMERA))
    for k in range(FRAMES):
        write_frame(root, k)
    lines = [f"{k / 10:.3f} {0.1 * k} 0 -0.5 0 0.6 0 0.8" for k in range(FRAMES)]
    (root / "poses.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n")
    (root / "instances.json").write_text(
        json.dumps({"7": {"name": "arm chair", "class": "chair"}, "300": {"name": "floor", "class": None}})
    )
    return root


def set_pose_line(folder, k, line):
    lines = (folder / "poses.txt").read_text().splitlines()
    lines[1 + k] = line
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")


def change_camera(folder, **changes):
    (folder / "camera.json").write_text(json.dumps(CAMERA | changes))


def test_rgbd_folder_frames_know_their_file_names(folder):
    for name in ("color", "depth", "instance"):
        for k in reversed(range(FRAMES)):
            (folder / name / f"{k:06d}.png").rename(folder / name / f"frame_{3 * k + 1:06d}.png")
    sequence = RgbdFolder(folder, start=1, stride=2)
    names = {0: "frame_000001.png", 1: "frame_000004.png", 2: "frame_000007.png", 3: "frame_000010.png"}
    assert sequence.image_names() == names
    assert [(frame.index, frame.image_name) for frame in sequence] == [(1, names[1]), (3, names[3])]


def test_rgbd_folder_frame_matches_files(folder):
    sequence = RgbdFolder(folder)
    assert (len(sequence), sequence.name) == (FRAMES, "kitchen")
    frame = sequence[2]
    assert (frame.index, frame.timestamp) == (2, 0.2)
    np.testing.assert_array_equal(frame.color, picture(2))
    np.testing.assert_array_equal(frame.depth, depth_mm(2).astype(np.float32) / np.float32(1000))
    # A rotation about y with sin(a/2) = 0.6, cos(a/2) = 0.8: cos a = 0.28, sin a = 0.96.
    expected = [[0.28, 0, 0.96, 0.2], [0, 1, 0, 0], [-0.96, 0, 0.28, -0.5], [0, 0, 0, 1]]
    np.testing.assert_allclose(frame.T_world_camera, expected, atol=1e-12)
    assert frame.truth.class_names == {7: "chair", 300: None}
    assert set(np.unique(frame.truth.instance_ids)) == {0, 7, 300}


def test_rgbd_folder_frame_fraction_keeps_order_and_contents(folder):
    sequence = RgbdFolder(folder, frame_fraction=0.5, seed=1)
    indices = [frame.index for frame in sequence]
    assert len(indices) == 2
    assert indices == sorted(indices)
    for frame in sequence:
        assert frame.timestamp == pytest.approx(frame.index / 10)
        np.testing.assert_array_equal(frame.color, picture(frame.index))
    assert {tuple(frame.index for frame in RgbdFolder(folder, frame_fraction=0.5, seed=seed)) for seed in range(9)} > {
        tuple(indices)
    }
    with pytest.raises(ConfigError, match=r"dataset.frame_fraction"):
        RgbdFolder(folder, frame_fraction=1.5)


def test_rgbd_folder_start_stop_stride_keep_frame_index(folder):
    sequence = RgbdFolder(folder, start=1, stop=4, stride=2)
    assert [frame.index for frame in (sequence[0], sequence[1])] == [1, 3]
    assert len(sequence) == 2
    with pytest.raises(IndexError):
        sequence[2]


def test_rgbd_folder_scene_selects_subfolder(folder):
    assert RgbdFolder(folder.parent, scene="kitchen").name == "kitchen"


def test_rgbd_folder_depth_65535_or_beyond_max_is_invalid(folder):
    image = depth_mm(0)
    image[0, :3] = 65535, 2500, 0
    cv2.imwrite(str(folder / "depth/000000.png"), image)
    assert RgbdFolder(folder, max_depth=0)[0].depth[0, :3].tolist() == [0, 2.5, 0]
    assert RgbdFolder(folder, max_depth=2.0)[0].depth[0, :3].tolist() == [0, 0, 0]


def test_rgbd_folder_frame_number_gaps_are_accepted(folder):
    for name in ("color", "depth", "instance"):
        (folder / name / "000001.png").rename(folder / name / "frame-12345.png")
    sequence = RgbdFolder(folder)
    np.testing.assert_array_equal(sequence[3].color, picture(1))
    np.testing.assert_array_equal(sequence[1].color, picture(2))


def test_rgbd_folder_missing_poses_give_no_pose(folder):
    (folder / "poses.txt").unlink()
    sequence = RgbdFolder(folder)
    assert sequence[3].T_world_camera is None
    assert sequence[3].timestamp == pytest.approx(3 / 30)
    assert sequence.scene_truth() is None


@pytest.mark.parametrize("times", [(0, 0, 0, 0), (5, 6, 7, 6.5), (5, 6, 6, 7)])
def test_rgbd_folder_nonincreasing_timestamps_default_to_30_hz(folder, caplog, times):
    for k, time in enumerate(times):
        set_pose_line(folder, k, f"{time} {k} 0 0 0 0 0 1")
    sequence = RgbdFolder(folder)
    assert [frame.timestamp for frame in sequence] == [0, 1 / 30, 2 / 30, 3 / 30]
    assert [frame.T_world_camera[0, 3] for frame in sequence] == [0, 1, 2, 3]
    assert caplog.text.count("kitchen: expected increasing timestamps") == 1


def test_rgbd_folder_timestamp_of_unusable_frame_is_ignored(folder, caplog):
    set_pose_line(folder, 1, "0 nan nan nan nan nan nan nan")
    assert [RgbdFolder(folder)[k].timestamp for k in (0, 2, 3)] == [0, 0.2, 0.3]
    assert not caplog.records


def test_rgbd_folder_has_poses_if_pose_file_exists(folder):
    for k in range(FRAMES):
        set_pose_line(folder, k, f"{k} nan nan nan nan nan nan nan")
    assert RgbdFolder(folder).has_poses()  # the errors are reported when the frames are read
    (folder / "poses.txt").unlink()
    assert not RgbdFolder(folder).has_poses()


def test_rgbd_folder_missing_instances_give_no_truth(folder):
    shutil.rmtree(folder / "instance")
    (folder / "instances.json").unlink()
    sequence = RgbdFolder(folder)
    assert sequence[0].truth is None
    assert sequence.scene_truth() is None


def test_rgbd_folder_scene_truth_lies_on_labeled_surface(folder):
    truth = RgbdFolder(folder, stop=1).scene_truth()
    assert truth.class_names == {7: "chair", 300: None}
    depth, ids = depth_mm(0) / 1000, RgbdFolder(folder)[0].truth.instance_ids
    v, u = np.nonzero(ids == 7)
    z = depth[v, u]
    camera = np.stack([(u - 11.5) / 20 * z, (v - 7.5) / 21 * z, z], axis=1)
    world = camera @ np.array([[0.28, 0, 0.96], [0, 1, 0], [-0.96, 0, 0.28]]).T + [0, 0, -0.5]
    mine = truth.points_world[truth.instance_ids == 7]
    nearest = np.linalg.norm(mine[:, None] - world[None], axis=-1).min(axis=1)
    assert len(mine) > 20
    assert nearest.max() < 0.02


def test_rgbd_folder_scene_truth_skips_unreadable_frames(folder):
    (folder / "depth/000001.png").write_bytes(b"")
    assert len(RgbdFolder(folder).scene_truth().points_world) > 100


def test_rgbd_folder_distant_pose_raises_for_its_frame(folder):
    set_pose_line(folder, 1, "0.1 0 1e4 0 0 0 0 1")
    RgbdFolder(folder)[1]
    set_pose_line(folder, 1, "0.1 0 1e5 0 0 0 0 1")
    assert "000001.png: expected a pose within 10000 m of dataset.world_offset, got 100000 m" in read_all_but(folder, 1)


def test_rgbd_folder_scene_truth_skips_frame_with_distant_pose(folder, caplog):
    set_pose_line(folder, 1, "0.1 0 1e5 0 0 0 0 1")
    others = RgbdFolder(folder).scene_truth()
    assert np.abs(others.points_world).max() < 10
    assert "ground truth: frame skipped: frame 1: " in caplog.text


# Errors that are raised when the sequence is built


def test_rgbd_folder_missing_folder_raises(tmp_path):
    with pytest.raises(DataError, match=r"dataset\.root: expected an existing folder, got .*nowhere"):
        RgbdFolder(tmp_path / "nowhere")


@pytest.mark.parametrize("name", ["color", "depth"])
def test_rgbd_folder_missing_image_folder_raises(folder, name):
    shutil.rmtree(folder / name)
    with pytest.raises(DataError, match=f"{name}: expected"):
        RgbdFolder(folder)


def test_rgbd_folder_missing_camera_json_raises(folder):
    (folder / "camera.json").unlink()
    with pytest.raises(DataError, match=r"camera\.json: expected a camera"):
        RgbdFolder(folder)


@pytest.mark.parametrize("key", list(CAMERA))
def test_rgbd_folder_missing_camera_key_raises(folder, key):
    (folder / "camera.json").write_text(json.dumps({k: v for k, v in CAMERA.items() if k != key}))
    with pytest.raises(DataError, match=f"camera.json: expected a key '{key}', got none"):
        RgbdFolder(folder)


@pytest.mark.parametrize("changes", [{"fx": "wide"}, {"fx": -1.0}, {"width": 24.5}, {"cx": float("nan")}, {"fy": True}])
def test_rgbd_folder_invalid_camera_value_raises(folder, changes):
    change_camera(folder, **changes)
    with pytest.raises(DataError, match=rf"camera\.json.*{next(iter(changes))}"):
        RgbdFolder(folder)


@pytest.mark.parametrize("scale", [0, -1000, 0.001, 1e7])
def test_rgbd_folder_depth_scale_out_of_range_raises(folder, scale):
    reported = r"depth_scale: expected 1 to 1e\+06 units per m \(1000 for millimeters\), got"
    change_camera(folder, depth_scale=scale)
    with pytest.raises(DataError, match=rf"camera\.json: {reported} {scale:g}".replace("+07", r"\+07")):
        RgbdFolder(folder)


def test_rgbd_folder_invalid_camera_json_raises(folder):
    (folder / "camera.json").write_text("{width: 3")
    with pytest.raises(DataError, match="expected valid JSON"):
        RgbdFolder(folder)


@pytest.mark.parametrize("name", ["color", "depth", "instance"])
def test_rgbd_folder_image_count_error_names_first_frame(folder, name):
    (folder / name / "000002.png").unlink()
    with pytest.raises(DataError, match=rf"{name}: expected .*4 images.*, got 3 images and none for frame 2"):
        RgbdFolder(folder)


def test_rgbd_folder_duplicate_frame_number_raises(folder):
    shutil.copy(folder / "color/000001.png", folder / "color/1.png")
    with pytest.raises(DataError, match="expected unique frame numbers, got 1 for"):
        RgbdFolder(folder)


@pytest.mark.parametrize(
    "names", [["9.95", "10.05", "10.1", "10.15"], ["1_8", "1_9", "2_0", "2_1"], ["1", "2", "3", "1 - Copy 4"]]
)
def test_rgbd_folder_names_differing_in_two_numbers_raise(folder, names):
    """Sorted by their last number alone, the frames would be in the wrong order."""
    for kind in ("color", "depth", "instance"):
        for k, name in enumerate(names):
            (folder / kind / f"{k:06d}.png").rename(folder / kind / f"{name}.png")
    with pytest.raises(DataError, match=r"color: expected names that differ in one number"):
        RgbdFolder(folder)


def test_rgbd_folder_file_name_without_number_raises(folder):
    shutil.copy(folder / "color/000001.png", folder / "color/cover.png")
    with pytest.raises(DataError, match="expected names that end in a frame number"):
        RgbdFolder(folder)


@pytest.mark.parametrize("name", ["poses.txt", "instances.json", "instance"])
@pytest.mark.parametrize("kind", ["folder", "dangling link"])
def test_rgbd_folder_unreadable_optional_file_raises(folder, name, kind):
    path = folder / name
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    if kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("nowhere")
    with pytest.raises(DataError, match=name):
        RgbdFolder(folder)


@pytest.mark.parametrize("key", ["Distortion", "distorsion", "depthscale", "Width"])
def test_rgbd_folder_misspelled_camera_key_error_has_suggestion(folder, key):
    change_camera(folder, **{key: 1})
    with pytest.raises(DataError, match=f"expected a known key, got '{key}'; did you mean"):
        RgbdFolder(folder)


def test_rgbd_folder_unused_camera_keys_are_logged(folder, caplog):
    change_camera(folder, serial="A7", k1=0.1)
    assert len(RgbdFolder(folder)) > 0
    [record] = caplog.records
    assert "camera.json: ignored unknown keys: serial, k1; known keys: width, height, fx" in record.message


def test_rgbd_folder_fewer_poses_than_frames_raises(folder):
    lines = (folder / "poses.txt").read_text().splitlines()
    (folder / "poses.txt").write_text("\n".join(lines[:-1]))
    with pytest.raises(DataError, match="expected one line per frame, got 3 poses for 4 frames in color/"):
        RgbdFolder(folder)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0.2 1 2 3 0 0 0", "line 4: expected 8 numbers .*, got 7"),
        ("0.2 1 2 three 0 0 0 1", "line 4: expected 8 numbers .*'three'"),
        ("nan 1 2 3 0 0 0 1", "line 4: expected a finite timestamp"),
    ],
)
def test_rgbd_folder_invalid_pose_line_error_gives_line_number(folder, line, message):
    set_pose_line(folder, 2, line)
    with pytest.raises(DataError, match=rf"poses\.txt, {message}"):
        RgbdFolder(folder)


def test_rgbd_folder_instance_images_without_names_raise(folder):
    (folder / "instances.json").unlink()
    with pytest.raises(DataError, match=r"instances\.json: expected the class of each instance"):
        RgbdFolder(folder)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"0": {"class": None}}, "expected instance ids .*, got '0'"),
        ({"chair": {"class": "chair"}}, "expected instance ids from 1 to 65535, got 'chair'"),
        ({"1" * 5000: {"class": None}}, "expected instance ids from 1 to 65535, got '11"),
        ({"٣": {"class": None}}, "expected instance ids"),
        (
            {"7": {"class": None}, "07": {"class": "chair"}},
            "expected unique instance ids, got 7 twice, the second time as '07'",
        ),
        ({"7": "chair"}, "instance 7: expected .* got 'chair'"),
        ({"7": {"name": "n" * 5000}}, r"instance 7: expected .*, or null if unknown\), got {'name': 'nnn"),
        ({"7": {"class": 3}}, "instance 7: class: expected a name of at most 100 characters .*, got 3$"),
        ({"7": {"class": "flurb" * 1000}}, "instance 7: class: expected a name of at most 100 .* got 'flurb"),
        ({"7": {"class": " chair"}}, r"instance 7: .* without outer spaces, or null if unknown, got ' chair'"),
        ({"7": {"class": "sofa"}}, r"instance 7: class: expected the COCO name 'couch', got 'sofa'; rename the class"),
    ],
)
def test_rgbd_folder_invalid_instances_entry_raises(folder, entry, message):
    (folder / "instances.json").write_text(json.dumps(entry))
    with pytest.raises(DataError, match=rf"instances\.json: {message}") as caught:
        RgbdFolder(folder)
    assert len(str(caught.value)) < 300


def test_rgbd_folder_image_and_camera_size_mismatch_raises(folder):
    change_camera(folder, width=48)
    with pytest.raises(DataError, match=r"000000\.png: expected 48x16 px as in .*camera\.json, got 24x16 px"):
        RgbdFolder(folder)


@pytest.mark.parametrize("values", [{"max_depth": -1.0}, {"ground_truth_spacing": 0.0}, {"stride": 0}])
def test_rgbd_folder_parameter_out_of_range_raises(folder, values):
    with pytest.raises(ConfigError, match=f"dataset.{next(iter(values))}"):
        RgbdFolder(folder, **values)


# Errors that are raised when a frame is read; the other frames are readable


def read_all_but(folder, bad):
    sequence = RgbdFolder(folder)
    for k in range(FRAMES):
        if k != bad:
            assert sequence[k].index == k
    with pytest.raises(FrameError) as caught:
        sequence[bad].truth.instance_ids  # noqa: B018  # decoded on demand
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_rgbd_folder_truncated_color_raises_for_its_frame(folder, suffix, share):
    (folder / "color/000002.png").unlink()
    path = folder / f"color/000002.{suffix}"
    cv2.imwrite(str(path), np.repeat(np.repeat(picture(2), 1, axis=0), 1, axis=1))
    assert RgbdFolder(folder)[2].color.shape == (HEIGHT, WIDTH, 3)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    assert "000002" in read_all_but(folder, 2)


@pytest.mark.parametrize("padding", [b"\0" * 10, b"\0" * 100_000, b"\n", b"\r\n", b"\0" * 100 + b"\n"])
def test_rgbd_folder_jpeg_with_trailing_padding_is_read(folder, padding):
    (folder / "color/000002.png").unlink()
    path = folder / "color/000002.jpg"
    cv2.imwrite(str(path), picture(2))
    path.write_bytes(path.read_bytes() + padding)
    assert RgbdFolder(folder)[2].index == 2


def test_rgbd_folder_damaged_depth_raises_for_its_frame(folder):
    path = folder / "depth/000001.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    assert "damaged" in read_all_but(folder, 1)


def test_rgbd_folder_non_image_file_raises_for_its_frame(folder):
    (folder / "color/000001.png").write_bytes(b"hello world" * 20)
    assert "expected a JPEG or PNG file" in read_all_but(folder, 1)


@pytest.mark.parametrize("name", ["color", "depth", "instance"])
def test_rgbd_folder_size_mismatch_raises_for_its_frame(folder, name):
    path = folder / name / "000003.png"
    cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:-2])
    message = read_all_but(folder, 3)
    assert "24x14" in message
    assert "24x16" in message


def test_rgbd_folder_non_uint16_depth_raises_for_its_frame(folder):
    cv2.imwrite(str(folder / "depth/000001.png"), picture(1))
    assert "1 channel of uint16, got 3 of uint8" in read_all_but(folder, 1)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0.1 nan 0 0 0 0 0 1", "expected a finite pose"),
        ("0.1 0 0 inf 0 0 0 1", "expected a finite pose"),
        ("0.1 -1.#IND -1.#IND -1.#IND 0 0 0 1", "expected a finite pose"),
        ("0.1 0 0 0 0 0 0 0.5", "expected a quaternion qx qy qz qw of length 1, got 0.5"),
        ("0.1 1 0 0 0 0 0 0", "expected a quaternion qx qy qz qw of length 1, got 0"),
    ],
)
def test_rgbd_folder_invalid_pose_raises_for_its_frame(folder, line, message):
    set_pose_line(folder, 1, line)
    found = read_all_but(folder, 1)
    assert message in found
    assert "poses.txt, line 3" in found


def test_rgbd_folder_rounded_quaternion_is_made_rigid(folder):
    set_pose_line(folder, 1, "0.1 0 0 0 0 0.601 0 0.801")
    R = RgbdFolder(folder)[1].T_world_camera[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_rgbd_folder_instance_images_are_decoded_on_demand(folder):
    path = folder / "instance/000001.png"
    path.write_bytes(path.read_bytes()[:60] + b"damaged" + path.read_bytes()[67:])
    frame = RgbdFolder(folder)[1]
    assert frame.truth.shape == frame.depth.shape
    assert not frame.truth.of_depth
    with pytest.raises(FrameError, match=r"instance.000001\.png: expected a valid image"):
        frame.truth.instance_ids  # noqa: B018


def test_rgbd_folder_unnamed_instance_raises_for_its_frame(folder):
    ids = np.full((HEIGHT, WIDTH), 9, np.uint16)
    cv2.imwrite(str(folder / "instance/000001.png"), ids)
    assert "instances.json, got 9" in read_all_but(folder, 1)


# Real data


@pytest.mark.parametrize(
    ("scene", "frames", "shape", "labeled"),
    [
        ("redkitchen", 300, (480, 640), True),
        ("replica_floor2", 123, (512, 512), True),
        ("mit76", 5, (480, 640), False),
        ("redwood5", 5, (480, 640), False),
    ],
)
def test_rgbd_folder_real_recordings_are_read(scene, frames, shape, labeled):
    if not (SHARED / scene).is_dir():
        pytest.skip(f"{SHARED / scene} does not exist")
    sequence = RgbdFolder(SHARED, scene=scene)
    assert len(sequence) == frames
    frame = sequence[frames - 1]  # Frame checks the types and the rigidity of the pose
    assert frame.depth.shape == shape
    assert 0.3 < np.median(frame.depth[frame.depth > 0]) < 8
    assert frame.T_world_camera is not None
    assert (frame.truth is not None) == labeled


def test_rgbd_folder_replica_truth_has_plausible_extent():
    if not (SHARED / "replica_floor2").is_dir():
        pytest.skip(f"{SHARED / 'replica_floor2'} does not exist")
    truth = RgbdFolder(SHARED, scene="replica_floor2", stride=12).scene_truth()
    extent = np.ptp(truth.points_world, axis=0)
    assert (extent > 2).all()
    assert (extent < 25).all()
    assert {truth.class_names[i] for i in np.unique(truth.instance_ids) if i} >= {"bed", None}


def test_rgbd_folder_images_are_undistorted(folder):
    change_camera(folder, distortion=[0.3, 0, 0, 0.01, 0])
    K, lens = np.array([[20.0, 0, 11.5], [0, 21.0, 7.5], [0, 0, 1]]), np.array([0.3, 0, 0, 0.01, 0])
    u, v = cv2.initUndistortRectifyMap(K, lens, None, K, (WIDTH, HEIGHT), cv2.CV_32FC1)
    frame = RgbdFolder(folder)[0]
    assert np.array_equal(frame.color, cv2.remap(picture(0), u, v, cv2.INTER_LINEAR))
    ids = cv2.imread(str(folder / "instance/000000.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(frame.truth.instance_ids, cv2.remap(ids, u, v, cv2.INTER_NEAREST))
    depth = cv2.remap(depth_mm(0), u, v, cv2.INTER_NEAREST) / 1000
    np.testing.assert_allclose(frame.depth, depth, atol=1e-6)
    assert not np.array_equal(frame.color, picture(0))


def test_rgbd_folder_gravity_file_is_read_as_up_vector(folder):
    (folder / "gravity.txt").write_text("0 -9.81 0\nnan nan nan\n0 0 -2\n# the last one\n0.6 -0.8 0\n")
    ups = [frame.up for frame in RgbdFolder(folder, start=1)]
    assert ups[0] is None
    np.testing.assert_allclose(ups[1:], [[0, 0, -1], [0.6, -0.8, 0]])
    (folder / "poses.txt").unlink()
    np.testing.assert_allclose(RgbdFolder(folder)[0].up, [0, -1, 0])
    (folder / "gravity.txt").unlink()
    assert all(frame.up is None for frame in RgbdFolder(folder))


@pytest.mark.parametrize(
    ("content", "output"),
    [
        ("0 -1 0\n" * 3, r"gravity\.txt: expected one line per frame, got 3 directions for 4 frames in color/"),
        ("0 -1 0\n" * 3 + "0 0 0\n", r"gravity\.txt, line 4: expected a direction"),
    ],
)
def test_rgbd_folder_invalid_gravity_file_raises(folder, content, output):
    (folder / "gravity.txt").write_text(content)
    with pytest.raises(DataError, match=output):
        RgbdFolder(folder)


def test_rgbd_folder_timestamps_file_gives_times_of_both_images(folder):
    (folder / "timestamps.txt").write_text("# color depth\n" + "".join(f"{k}.25 {k}.26\n" for k in range(FRAMES)))
    frame = RgbdFolder(folder)[2]
    assert (frame.timestamp, frame.color_time, frame.depth_time) == (0.2, 2.25, 2.26)
    (folder / "poses.txt").unlink()
    assert RgbdFolder(folder)[2].timestamp == 2.25
    (folder / "timestamps.txt").unlink()
    frame = RgbdFolder(folder)[2]
    assert frame.color_time == frame.depth_time == frame.timestamp


@pytest.mark.parametrize(
    ("content", "output"),
    [
        ("1 1\n" * 3, r"timestamps\.txt: expected one line per frame, got 3 timestamps for 4 frames in color/"),
        ("1 1\n" * 3 + "1\n", r"timestamps\.txt, line 4: expected 2 numbers \(color depth\), got 1"),
        ("1 1\n" * 3 + "nan 1\n", r"timestamps\.txt, line 4: expected finite timestamps, got 'nan 1'"),
    ],
)
def test_rgbd_folder_invalid_timestamps_file_raises(folder, content, output):
    (folder / "timestamps.txt").write_text(content)
    with pytest.raises(DataError, match=output):
        RgbdFolder(folder)


def test_rgbd_folder_times_far_apart_are_not_used(folder, caplog):
    (folder / "timestamps.txt").write_text("".join(f"{k} {k + 9}\n" for k in range(FRAMES)))
    frame = RgbdFolder(folder)[1]
    assert frame.color_time == frame.depth_time == frame.timestamp
    assert "expected timestamps of color and depth within 0.2 s of each other, got -9 s; using one" in caplog.text


def test_recording_depth_delay_discards_image_timestamps(folder):
    (folder / "timestamps.txt").write_text("".join(f"{k}.25 {k}.26\n" for k in range(FRAMES)))
    frame = RgbdFolder(folder, depth_reading=DepthReading(depth_delay=1))[0]
    assert frame.color_time == frame.depth_time == frame.timestamp


def test_recording_color_delay_parameter_is_read_or_raises(folder):
    assert RgbdFolder(folder).constant_color_delay() is None
    assert RgbdFolder(folder, color_delay="0.02").constant_color_delay() == 0.02
    for wrong in ("0.3", "soon", "nan"):
        with pytest.raises(ConfigError, match=r"dataset\.color_delay: expected AUTO or a value in \[-0\.2, 0\.2\] s"):
            RgbdFolder(folder, color_delay=wrong)


def test_rgbd_folder_sensor_is_read_from_camera_json(folder):
    assert {frame.sensor for frame in RgbdFolder(folder)} == {SensorKind.KINECT_V1}
    change_camera(folder, sensor="PHONE_LIDAR")
    assert {frame.sensor for frame in RgbdFolder(folder)} == {SensorKind.PHONE_LIDAR}


def test_rgbd_folder_sensor_parameter_overrides_camera_json(folder):
    change_camera(folder, sensor="PHONE_LIDAR")
    assert RgbdFolder(folder, sensor=SensorChoice.TIME_OF_FLIGHT)[0].sensor is SensorKind.TIME_OF_FLIGHT


@pytest.mark.parametrize("name", ["D435", "kinect_v1", "AUTO", 7, None])
def test_rgbd_folder_unknown_sensor_in_camera_json_raises(folder, name):
    change_camera(folder, sensor=name)
    names = "EXACT, KINECT_V1, REALSENSE_D435, TIME_OF_FLIGHT, PHONE_LIDAR"
    with pytest.raises(DataError, match=rf"camera\.json: sensor: expected one of {names}, got {name}; set the kind"):
        RgbdFolder(folder)


# Other depth files, pose folders and orientations


def write_tiff(path, image):
    cv2.imwrite(f"{path}.tiff", image)


def write_npy(path, image):
    np.save(f"{path}.npy", image)


def write_exr(path, image, channel="Z"):
    OpenEXR = pytest.importorskip("OpenEXR")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    other = {"A": np.ones_like(image)} if channel == "ViewLayer.Depth.Z" else {}
    OpenEXR.File(header, {channel: np.ascontiguousarray(image)} | other).write(f"{path}.exr")


def in_meters(k):
    return depth_mm(k).astype(np.float32) / np.float32(1000)


def with_depth(folder, write, image_of):
    for k in range(FRAMES):
        (folder / f"depth/{k:06d}.png").unlink()
        write(folder / f"depth/{k:06d}", image_of(k))
    return RgbdFolder(folder)


@pytest.mark.parametrize(
    ("write", "image_of", "tolerance"),
    [
        (write_tiff, depth_mm, 0),
        (write_npy, depth_mm, 0),
        (write_npy, lambda k: depth_mm(k)[..., None], 0),
        (write_tiff, in_meters, 0),
        (write_npy, in_meters, 0),
        (write_npy, lambda k: in_meters(k).astype(np.float64), 0),
        (write_npy, lambda k: in_meters(k).astype(np.float16), 1e-3),
        (write_npy, lambda k: in_meters(k).astype(">f4"), 0),
        (write_npy, lambda k: depth_mm(k).astype(np.int32), 0),
        (write_npy, lambda k: depth_mm(k).astype(np.int64), 0),
        (write_npy, lambda k: depth_mm(k).astype(np.int16), 0),
        (write_tiff, lambda k: in_meters(k).astype(np.float64), 0),
        (write_exr, in_meters, 0),
        (lambda path, image: write_exr(path, image, "R"), lambda k: in_meters(k).astype(np.float16), 1e-3),
        (lambda path, image: write_exr(path, image, "ViewLayer.Depth.Z"), in_meters, 0),
    ],
)
def test_rgbd_folder_depth_of_other_formats_is_read(folder, write, image_of, tolerance):
    sequence = with_depth(folder, write, image_of)
    for k, frame in enumerate(sequence):
        np.testing.assert_allclose(frame.depth, in_meters(k), rtol=tolerance)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1.0, 0.0])
def test_rgbd_folder_float_depth_without_reading_is_0(folder, value):
    image = in_meters(0)
    image[3, 4] = value
    depth = with_depth(folder, write_npy, lambda k: image)[0].depth
    assert depth[3, 4] == 0
    assert np.count_nonzero(depth) == WIDTH * HEIGHT - 1


def test_rgbd_folder_float_depth_in_millimeters_needs_scale(folder):
    with pytest.raises(DataError, match=r"expected float depth in meters, got a median of .*; set dataset.depth_scale"):
        with_depth(folder, write_npy, lambda k: depth_mm(k).astype(np.float32))
    frame = RgbdFolder(folder, depth_reading=DepthReading(depth_scale=1000))[1]
    np.testing.assert_allclose(frame.depth, in_meters(1))


def spoil_npy(path):
    path.write_bytes(path.read_bytes()[:-9])


@pytest.mark.parametrize(
    ("write", "suffix", "spoil"),
    [
        (write_npy, ".npy", spoil_npy),
        (write_npy, ".npy", lambda path: np.save(path, np.array([{}]), allow_pickle=True)),
        (write_npy, ".npy", lambda path: np.save(path, np.zeros((HEIGHT, WIDTH, 3), np.float32))),
        (write_tiff, ".tiff", lambda path: path.write_bytes(path.read_bytes()[:60])),
        (write_exr, ".exr", lambda path: path.write_bytes(path.read_bytes()[:90])),
    ],
)
def test_rgbd_folder_damaged_depth_skips_one_frame(folder, write, suffix, spoil):
    with_depth(folder, write, in_meters)
    spoil(folder / f"depth/000002{suffix}")
    assert f"000002{suffix}: expected" in read_all_but(folder, 2)


def test_rgbd_folder_unsupported_depth_suffix_is_named(folder):
    for path in (folder / "depth").iterdir():
        path.rename(path.with_suffix(".pgm"))
    with pytest.raises(DataError, match=r"expected files \(\.png, .*\), got 4 \.pgm files"):
        RgbdFolder(folder)


def T_world_camera(k):
    T = np.array([[0.28, 0, 0.96, 0], [0, 1, 0, 0], [-0.96, 0, 0.28, -0.5], [0, 0, 0, 1]])
    T[0, 3] = 0.1 * k
    return T


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("pose/{:06d}.txt", (4, 4)),
        ("pose/{}.txt", (4, 4)),
        ("poses/frame_{:04d}.txt", (4, 4)),
        ("pose/{:06d}.txt", (3, 4)),
        ("pose/{:06d}.txt", (1, 16)),
    ],
)
def test_rgbd_folder_pose_folder_is_read(folder, caplog, name, shape):
    (folder / "poses.txt").unlink()
    (folder / name).parent.mkdir()
    for k in range(FRAMES):
        np.savetxt(folder / name.format(k), T_world_camera(k).ravel()[: np.prod(shape)].reshape(shape))
    with caplog.at_level("INFO"):
        sequence = RgbdFolder(folder)
    assert sequence.has_poses()
    for k, frame in enumerate(sequence):
        np.testing.assert_allclose(frame.T_world_camera, T_world_camera(k), atol=1e-12)
    assert "read T_world_camera of 4 of 4 frames" in caplog.text


def test_rgbd_folder_pose_folder_keeps_unknown_and_invalid_poses(folder):
    (folder / "poses.txt").unlink()
    (folder / "pose").mkdir()
    for k in range(3):
        np.savetxt(folder / f"pose/{k:06d}.txt", [T_world_camera(k), np.zeros((4, 4)), np.full((4, 4), -np.inf)][k])
    sequence = RgbdFolder(folder)
    np.testing.assert_allclose(sequence[0].T_world_camera, T_world_camera(0))
    assert sequence[1].T_world_camera is None
    assert sequence[3].T_world_camera is None
    with pytest.raises(FrameError, match=r"000002\.txt"):
        sequence[2]


def test_rgbd_folder_pose_folder_of_other_frames_raises(folder):
    (folder / "poses.txt").unlink()
    (folder / "pose").mkdir()
    np.savetxt(folder / "pose/000100.txt", np.eye(4))
    with pytest.raises(DataError, match=r"pose: expected a pose of frame 0, got 1 files from 000100\.txt"):
        RgbdFolder(folder)


def test_rgbd_folder_poses_file_precedes_pose_folder(folder, caplog):
    (folder / "pose").mkdir()
    np.savetxt(folder / "pose/000000.txt", np.eye(4))
    with caplog.at_level("INFO"):
        np.testing.assert_allclose(RgbdFolder(folder)[1].T_world_camera, T_world_camera(1), atol=1e-12)
    assert "poses are read from poses.txt; pose/ is not read" in caplog.text


@pytest.mark.parametrize("name", ["traj.txt", "trajectory.log", "camera_poses.json"])
def test_rgbd_folder_unread_pose_file_is_logged(folder, caplog, name):
    (folder / "poses.txt").unlink()
    (folder / name).touch()
    assert not RgbdFolder(folder).has_poses()
    assert f"expected poses in poses.txt or pose/, got {name}, which is not read" in caplog.text


def test_rgbd_folder_zero_poses_count_as_unknown(folder, caplog):
    set_pose_line(folder, 1, "0.1 0 0 0 0 0 0 0")
    sequence = RgbdFolder(folder)
    assert sequence[1].T_world_camera is None
    assert sequence[2].T_world_camera is not None
    assert "1 of 4 poses contain only zeros and count as unknown" in caplog.text
    for k in range(FRAMES):
        set_pose_line(folder, k, f"{k} 0 0 0 0 0 0 0")
    sequence = RgbdFolder(folder)
    assert not sequence.has_poses()
    assert [frame.timestamp for frame in sequence] == [0, 1, 2, 3]


@pytest.mark.parametrize("name", ["timestamps.txt", "times.txt"])
def test_rgbd_folder_one_column_timestamps_are_of_both_images(folder, name):
    (folder / "poses.txt").unlink()
    (folder / name).write_text("".join(f"{1700000000 + k / 10}\n" for k in range(FRAMES)))
    frame = RgbdFolder(folder)[1]
    assert frame.timestamp == frame.depth_time == pytest.approx(1700000000.1)


def write_oriented(folder, k, orientation, pixels):
    exif = Image.Exif()
    exif[0x0112] = orientation
    (folder / f"color/{k:06d}.png").unlink()
    Image.fromarray(pixels).save(folder / f"color/{k:06d}.jpg", exif=exif, quality=95)


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_rgbd_folder_size_error_names_exif_orientation(folder, orientation):
    for k in range(FRAMES):
        write_oriented(folder, k, orientation, np.rot90(picture(k)).copy())
    expected = (
        f"expected 24x16 px .*, got 16x24 px with the EXIF orientation {orientation}, which is not applied; rotate"
    )
    with pytest.raises(FrameError, match=f"{expected} the pixels: mogrify -auto-orient"):
        RgbdFolder(folder)


def test_rgbd_folder_exif_orientation_is_logged_once(folder, caplog):
    for k in range(FRAMES):
        write_oriented(folder, k, 3, picture(k))
    assert len(RgbdFolder(folder)) == FRAMES
    assert caplog.text.count("the EXIF orientation 3 is not applied; the pixels are used as stored") == 1


@pytest.mark.parametrize("lost", ["", "color"])
def test_rgbd_folder_lost_folder_raises_storage_error(folder, tmp_path, lost):
    sequence = RgbdFolder(folder)
    (folder / lost).rename(tmp_path / "elsewhere")
    with pytest.raises(StorageError, match="expected available storage, got an error"):
        sequence[2]


def test_rgbd_folder_device_error_raises_storage_error(folder, monkeypatch):
    def fail(path):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    sequence = RgbdFolder(folder)
    monkeypatch.setattr(Path, "read_bytes", fail)
    with pytest.raises(StorageError, match="Input/output error"):
        sequence[2]


def test_rgbd_folder_missing_image_is_unusable_frame(folder):
    sequence = RgbdFolder(folder)
    for image in ("color/000002.jpg", "depth/000002.png"):
        stored = next((folder / image).parent.glob("*2.*"))
        stored.rename(folder / "moved")
        with pytest.raises(FrameError, match=r"expected a readable file, got an error \(No such file"):
            sequence[2]
        (folder / "moved").rename(stored)


def test_rgbd_folder_scene_truth_of_lost_folder_raises(folder, tmp_path):
    sequence = RgbdFolder(folder)
    folder.rename(tmp_path / "elsewhere")
    with pytest.raises(StorageError):
        sequence.scene_truth()

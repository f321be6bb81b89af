"""Tests for ScanNet scans, both `.sens` files and exported folders."""

from __future__ import annotations

import json
import logging
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from framework.datasets.calibration.color_registration import ColorRegistration
from framework.datasets.scannet.scannet import ScanNet
from framework.datasets.scannet.scannet_annotation import read_aggregation, read_label_table, read_labeled_mesh
from framework.errors import DataError, FrameError
from framework.files.ply import write_ply
from framework.geometry import back_project, transform
from tests.support.recordings.damaged_files import EXAMPLES, check, damaged
from tests.support.recordings.recordings import fault_of, mapped, opened
from tests.support.recordings.scannet_files import (
    COLOR_CAMERA,
    DEPTH_CAMERA,
    NO_POSE,
    Shot,
    sens,
    shots,
    write_exported,
    write_sens,
)

SCENE = "scene0000_00"
CHAIR, WALL, UNLABELED = 1, 0, 3
Writer = Callable[[Path, list[Shot]], None]


def as_sens(scene: Path, frames: list[Shot]) -> None:
    write_sens(scene / f"{SCENE}.sens", frames)


@pytest.fixture(params=[as_sens, write_exported])
def write(request: pytest.FixtureRequest) -> Writer:
    written: Writer = request.param
    return written


def write_labels(scene: Path) -> None:
    """Write the labeled mesh of a wall in front of the first camera. The part at x < 0 is a chair."""
    x, y = np.meshgrid(np.linspace(-1.5, 1.5, 31), np.linspace(-1.5, 1.5, 31))
    vertices = np.stack([x, y, np.full_like(x, 2)], axis=-1).reshape(-1, 3).astype(np.float32)
    a = (np.arange(30)[:, None] * 31 + np.arange(30)).ravel()
    triangles = np.concatenate([np.stack([a, a + 1, a + 31], 1), np.stack([a + 1, a + 32, a + 31], 1)])
    segments = np.digitize(vertices[:, 0], [-0.01, 0.31]) * 10
    write_ply(scene / f"{SCENE}_vh_clean_2.ply", vertices, triangles.astype(np.int32), {})
    (scene / f"{SCENE}_vh_clean_2.0.010000.segs.json").write_text(json.dumps({"segIndices": segments.tolist()}))
    groups = [
        {"objectId": 0, "label": "folding chair", "segments": [0]},
        {"objectId": 1, "label": "wall", "segments": [10]},
    ]
    (scene / f"{SCENE}.aggregation.json").write_text(json.dumps({"segGroups": groups}))
    (scene.parent / "scannetv2-labels.combined.tsv").write_text("raw_category\tnyu40class\nfolding chair\tchair\n")


def test_scannet_frame_matches_files(tmp_path: Path, write: Writer) -> None:
    written = shots()
    write(tmp_path / SCENE, written)
    sequence = ScanNet(tmp_path, SCENE)
    assert (len(sequence), sequence.name, sequence.camera) == (3, SCENE, DEPTH_CAMERA)
    frame = sequence[2]
    assert (frame.index, frame.truth) == (2, None)
    np.testing.assert_array_equal(frame.depth, written[2].depth.astype(np.float32) / np.float32(1000))
    np.testing.assert_allclose(frame.T_world_camera, written[2].T_world_camera, atol=1e-7)
    assert frame.color.shape == (24, 32, 3)
    registered = ColorRegistration(COLOR_CAMERA, DEPTH_CAMERA).apply(written[2].color)
    np.testing.assert_array_equal(frame.color, registered)
    u_color = (np.arange(32) - DEPTH_CAMERA.cx) / DEPTH_CAMERA.fx * COLOR_CAMERA.fx + COLOR_CAMERA.cx
    assert np.abs(frame.color[:, 2:-2, 0] - 3 * u_color[2:-2]).max() < 1
    assert sequence.scene_truth() is None
    assert sequence.annotation == ""


def test_scannet_sens_and_exported_frames_are_equal(tmp_path: Path) -> None:
    as_sens(tmp_path / "a" / SCENE, shots())
    write_exported(tmp_path / "b" / SCENE, shots())
    for one, other in zip(ScanNet(tmp_path / "a" / SCENE), ScanNet(tmp_path / "b", SCENE), strict=True):
        np.testing.assert_array_equal(one.color, other.color)
        np.testing.assert_array_equal(one.depth, other.depth)
        np.testing.assert_allclose(one.T_world_camera, other.T_world_camera, atol=1e-6)


def test_scannet_sens_file_takes_precedence_over_images(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    as_sens(tmp_path / SCENE, shots(3))
    write_exported(tmp_path / SCENE, shots(2))
    with caplog.at_level(logging.INFO):
        assert len(ScanNet(tmp_path, SCENE)) == 3
    assert f"{SCENE}.sens: preferred to the exported images" in caplog.text


def test_scannet_timestamps_are_depth_times_if_increasing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    frames = shots()
    as_sens(tmp_path / SCENE, frames)
    assert [frame.timestamp for frame in ScanNet(tmp_path, SCENE)] == [7e-6, 0.03334, 0.066673]
    assert not caplog.records
    frames[2].times = (0, 0)
    as_sens(tmp_path / SCENE, frames)
    assert [frame.timestamp for frame in ScanNet(tmp_path, SCENE)] == pytest.approx([0, 1 / 30, 2 / 30])
    assert caplog.text.count("expected increasing timestamps") == 1


def test_scannet_points_are_mapped_at_their_positions(tmp_path: Path, write: Writer) -> None:
    frames = shots(2)
    write(tmp_path / SCENE, frames)
    result, points = mapped(ScanNet(tmp_path, SCENE))
    assert (result.frames, result.frames_skipped) == (2, 0)
    pixels = np.argwhere(frames[1].depth)[:, ::-1].astype(np.float32)
    depth = frames[1].depth.ravel().astype(np.float32) / 1000
    expected = transform(frames[1].T_world_camera, back_project(DEPTH_CAMERA, pixels, depth))
    distance = np.linalg.norm(points[:, None] - expected[None], axis=-1).min(axis=0)
    assert distance.max() < 0.1  # m


def test_scannet_invalid_pose_raises_for_its_frame(tmp_path: Path, write: Writer) -> None:
    frames = shots()
    frames[1].T_world_camera = NO_POSE
    write(tmp_path / SCENE, frames)
    assert "pose: expected finite values" in fault_of(ScanNet(tmp_path, SCENE), 1)


def test_scannet_frames_missing_in_truncated_sens_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    content = sens(shots(4))
    path = tmp_path / SCENE / f"{SCENE}.sens"
    path.parent.mkdir()
    path.write_bytes(content[: len(content) - 1500])
    sequence = ScanNet(tmp_path, SCENE)
    assert len(sequence) == 4
    assert "the last 1 of 4 frames are missing" in caplog.text
    assert "within frame 3 of 4" in fault_of(sequence, 3)
    assert "expected increasing timestamps" not in caplog.text
    result, _ = mapped(sequence)
    assert (result.frames, result.frames_skipped) == (4, 1)


@pytest.mark.parametrize("name", ["color/1.png", "depth/1.png", "pose/1.txt"])
def test_scannet_missing_file_raises_for_its_frame(tmp_path: Path, name: str) -> None:
    write_exported(tmp_path / SCENE, shots())
    (tmp_path / SCENE / name).unlink()
    assert name.rpartition(".")[0] in fault_of(ScanNet(tmp_path, SCENE), 1)


def test_scannet_exported_gaps_and_padded_names_are_accepted(tmp_path: Path) -> None:
    written = shots(4)
    write_exported(tmp_path / SCENE, written)
    for k in range(4):
        for path in sorted((tmp_path / SCENE).glob(f"[cdp]*/{k}.*")):
            path.rename(path.with_stem(f"{100 * k:06d}")) if k % 2 else path.unlink()
    frames = list(ScanNet(tmp_path, SCENE))
    assert [(frame.index, frame.timestamp) for frame in frames] == [(0, 100 / 30), (1, 10)]
    np.testing.assert_array_equal(frames[1].depth, written[3].depth.astype(np.float32) / np.float32(1000))
    np.testing.assert_allclose(frames[1].T_world_camera, written[3].T_world_camera, atol=1e-6)


def test_scannet_missing_poses_give_no_pose(tmp_path: Path) -> None:
    write_exported(tmp_path / SCENE, shots(1))
    (tmp_path / SCENE / "pose/0.txt").unlink()
    (tmp_path / SCENE / "pose").rmdir()
    assert ScanNet(tmp_path, SCENE)[0].T_world_camera is None


def test_scannet_color_size_mismatch_raises_for_its_frame(tmp_path: Path, write: Writer) -> None:
    frames = shots()
    frames[1].color = frames[1].color[:-1]
    write(tmp_path / SCENE, frames)
    assert "expected 65x49 px as in the color camera, got 65x48 px" in fault_of(ScanNet(tmp_path, SCENE), 1)


def test_scannet_downsized_color_scales_published_intrinsics(tmp_path: Path) -> None:
    write_exported(tmp_path / SCENE, shots(1))
    published = np.array([[1170.188, 0, 647.75, 0], [0, 1170.188, 483.75, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.savetxt(tmp_path / SCENE / "intrinsic/intrinsic_color.txt", published, fmt="%f")
    frame = ScanNet(tmp_path, SCENE).contents.frames[0]
    camera = frame.images.color.args[1].color  # type: ignore[attr-defined]
    view = (camera.width / camera.fx, camera.height / camera.fy)
    assert view == pytest.approx((1296 / 1170.188, 968 / 1170.188))
    to_the_left_and_up = ((camera.cx + 0.5) / camera.fx, (camera.cy + 0.5) / camera.fy)
    assert to_the_left_and_up == pytest.approx((648.25 / 1170.188, 484.25 / 1170.188))


@pytest.mark.parametrize("which", ["color", "depth"])
def test_scannet_intrinsics_of_other_image_size_raise(tmp_path: Path, which: str) -> None:
    write_exported(tmp_path / SCENE, shots(1))
    path = tmp_path / SCENE / f"intrinsic/intrinsic_{which}.txt"
    matrix = np.loadtxt(path)
    matrix[:2] *= 3
    np.savetxt(path, matrix)
    with pytest.raises(DataError, match=rf"intrinsic_{which}\.txt: expected intrinsics for images of"):
        ScanNet(tmp_path, SCENE)


def test_scannet_camera_offset_is_logged_in_pixels(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    extrinsics = np.eye(4)
    extrinsics[0, 3] = 0.1
    path = tmp_path / SCENE / f"{SCENE}.sens"
    write_sens(path, shots(1), color_extrinsics=extrinsics)
    ScanNet(tmp_path, SCENE)
    assert "extrinsics of 100 mm and 0.00 degrees between color and depth" in caplog.text
    assert "color is shifted by up to 1 px at 2 m" in caplog.text
    caplog.clear()
    extrinsics[0, 3] = 0.01
    write_sens(path, shots(1), color_extrinsics=extrinsics)
    ScanNet(tmp_path, SCENE)
    assert not caplog.text
    write_sens(path, shots(1), color_extrinsics=np.zeros((4, 4)))
    ScanNet(tmp_path, SCENE)
    assert "expected rigid extrinsics" in caplog.text


def test_scannet_folder_without_scan_error_names_files(tmp_path: Path) -> None:
    (tmp_path / SCENE).mkdir()
    with pytest.raises(DataError, match=rf"expected {SCENE}\.sens, color/ or intrinsic\.txt, got none of them"):
        ScanNet(tmp_path, SCENE)
    for name in ("a.sens", "b.sens"):
        write_sens(tmp_path / SCENE / name, shots(1))
    with pytest.raises(DataError, match=r"expected one \.sens file, got 2"):
        ScanNet(tmp_path, SCENE)


def test_scannet_truth_matches_labeled_mesh(tmp_path: Path, write: Writer) -> None:
    write(tmp_path / SCENE, shots())
    write_labels(tmp_path / SCENE)
    sequence = opened(
        "scannet", f"dataset.root={tmp_path}", f"dataset.scene={SCENE}", "dataset.frame_ground_truth=true"
    )
    assert sequence.annotation == "ScanNet v2"
    truth = sequence.scene_truth()
    assert truth is not None
    assert truth.class_names == {CHAIR: "chair", UNLABELED: None}
    x = truth.points_world[:, 0]
    np.testing.assert_array_equal(truth.instance_ids, np.where(x < -0.01, CHAIR, np.where(x > 0.31, UNLABELED, WALL)))
    seen = sequence[1].truth
    assert seen is not None
    ray = (np.arange(32) - DEPTH_CAMERA.cx) / DEPTH_CAMERA.fx * 2 + 0.05
    sure = (np.abs(ray + 0.05) > 0.06) & (np.abs(ray - 0.35) > 0.06)  # away from label borders
    expected = np.where(ray < -0.05, CHAIR, np.where(ray > 0.35, UNLABELED, WALL))
    np.testing.assert_array_equal(seen.instance_ids[12, sure], expected[sure])


def test_scannet_truth_moves_with_world_offset(tmp_path: Path, write: Writer) -> None:
    write(tmp_path / SCENE, shots())
    write_labels(tmp_path / SCENE)
    words = f"dataset.root={tmp_path}", f"dataset.scene={SCENE}", "dataset.frame_ground_truth=true"
    near, moved = opened("scannet", *words), opened("scannet", *words, "dataset.world_offset=5 0 -2")
    points, ids = (np.asarray(getattr(moved.scene_truth(), name)) for name in ("points_world", "instance_ids"))
    np.testing.assert_allclose(points + np.array([5, 0, -2]), near.scene_truth().points_world, atol=1e-5)
    np.testing.assert_array_equal(ids, near.scene_truth().instance_ids)
    assert (moved[1].truth.instance_ids != near[1].truth.instance_ids).mean() < 0.01


def test_scannet_missing_label_table_changes_annotation_name(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Without the label table, the metrics differ. Tables must not mix such runs with others."""
    as_sens(tmp_path / SCENE, shots())
    write_labels(tmp_path / SCENE)
    (tmp_path / "scannetv2-labels.combined.tsv").unlink()
    sequence = ScanNet(tmp_path, SCENE)
    assert sequence.annotation == "ScanNet v2, no label table"
    assert f"{tmp_path / 'scannetv2-labels.combined.tsv'}: expected a label table" in caplog.text
    truth = sequence.scene_truth()
    assert truth is not None
    assert set(truth.class_names.values()) == {None}, "expected no class for 'folding chair' without the label table"


def test_scannet_first_release_names_use_first_release_table(tmp_path: Path) -> None:
    as_sens(tmp_path / SCENE, shots())
    write_labels(tmp_path / SCENE)
    table = tmp_path / "scannetv2-labels.combined.tsv"
    of_both = ScanNet(tmp_path, SCENE).scene_truth()
    table.write_text("id\traw_category\tnyu40class\n1\twall\twall\n")
    with pytest.raises(
        DataError,
        match=r"expected labels from scannetv2-labels\.combined\.tsv, got 'folding chair'.* or put scannet-labels",
    ):
        ScanNet(tmp_path, SCENE)
    (tmp_path / "scannet-labels.combined.tsv").write_text(
        "category\tcount\tnyu40class\nfolding chair\t9\tchair\nwall\t9\tceiling\nthing\t1\totherprop\n"
    )
    truth = ScanNet(tmp_path, SCENE).scene_truth()
    assert truth is not None
    assert of_both is not None
    assert truth.class_names == of_both.class_names


def test_scannet_incomplete_truth_files_give_no_truth(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    as_sens(tmp_path / SCENE, shots(1))
    write_labels(tmp_path / SCENE)
    (tmp_path / SCENE / f"{SCENE}.aggregation.json").unlink()
    sequence = ScanNet(tmp_path, SCENE)
    assert sequence.scene_truth() is None
    assert sequence.annotation == ""
    assert f"{SCENE}.aggregation.json: expected a file of the labeled mesh, got none" in caplog.text
    with pytest.raises(DataError, match=r"dataset\.frame_ground_truth: .*aggregation"):
        ScanNet(tmp_path, SCENE, frame_ground_truth=True)


# Damaged files


def read_all(path: Path) -> None:
    """Read every frame of the scan and raise the error of the last invalid frame."""
    sequence = ScanNet(path.parent)
    fault = None
    for k in range(len(sequence)):
        try:
            sequence[k]
        except FrameError as error:
            fault = error
            assert str(path) in str(error)
            assert str(error).isprintable()
    if fault:
        raise fault


MESH = f"{SCENE}_vh_clean_2.ply"
SEGS = f"{SCENE}_vh_clean_2.0.010000.segs.json"
OBJECTS = f"{SCENE}.aggregation.json"
FUZZED = {
    f"{SCENE}.sens": (read_all, (struct.pack("<Q", 2**64 - 1), struct.pack("<Q", 10**6), struct.pack("<f", np.nan))),
    SEGS: (
        lambda path: read_labeled_mesh(path.with_name(MESH), path, path.with_name(OBJECTS), {}),
        (b"[", b"]", b"{", b'"', b"null", b"1e400", b"NaN", b"[" * 5000),
    ),
    OBJECTS: (read_aggregation, (b"[", b"]", b"{", b'"', b"null", b'"label"', b"NaN", b"\\ud800", b"[" * 5000)),
    "scannetv2-labels.combined.tsv": (read_label_table, (b"\t", b"\n", b"\r", b"nyu40class", b"\xc3")),
}


@pytest.mark.parametrize("name", FUZZED)
def test_scannet_fuzzed_file_is_read_or_raises_one_line_error(tmp_path: Path, name: str) -> None:
    scene = tmp_path / SCENE
    scene.mkdir()
    write_labels(scene)
    as_sens(scene, shots(2))
    path = scene / name if (scene / name).exists() else tmp_path / name
    content = path.read_bytes()
    for other in (MESH,) if name.endswith(".sens") else ():
        (scene / other).unlink()  # reading the mesh is slow and tested elsewhere
    read, tokens = FUZZED[name]

    @settings(max_examples=EXAMPLES, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
    @given(damaged(content, tokens))
    def refuse(found: bytes) -> None:
        check(read, path, found)

    assert check(read, path, content) == ""
    refuse()


def test_scannet_file_with_inverted_byte_is_read_or_raises(tmp_path: Path) -> None:
    path = tmp_path / SCENE / f"{SCENE}.sens"
    path.parent.mkdir()
    content = sens(shots(1))
    for k in range(12 + 15 + 256 + 36 + 96):
        check(read_all, path, content[:k] + bytes([content[k] ^ 0xFF]) + content[k + 1 :])


def test_scannet_sens_file_gives_times_of_both_images(tmp_path: Path) -> None:
    frames = shots()
    for k, frame in enumerate(frames):
        frame.times = (100_000 * k, 100_000 * k + 5_000)
    as_sens(tmp_path / SCENE, frames)
    frame = ScanNet(tmp_path, SCENE)[1]
    assert (frame.timestamp, frame.color_time, frame.depth_time) == (0.105, 0.1, 0.105)

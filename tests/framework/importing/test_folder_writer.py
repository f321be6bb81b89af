"""Tests for the writer of RGB-D folders. If there is an error, no folder may remain."""

from __future__ import annotations

from dataclasses import replace
from errno import ENOSPC
from pathlib import Path

import numpy as np
import pytest

from framework.data import Camera
from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import ConfigError, DataError, FrameError
from framework.importing.folder_writer import Writing, write_folder
from framework.importing.formats import open_source
from framework.importing.source import DeviceFrame, Source, without_poses
from tests.support.recordings.phone_exports import room_frames, write_scanner_app

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def frame(k: int, **changed: object) -> DeviceFrame:
    color = np.full((48, 64, 3), 10 * k, np.uint8)
    sound = DeviceFrame(f"frame {k}", k / 30, CAMERA, color, np.full((12, 16), 2.0, np.float32), None, np.eye(4))
    return replace(sound, **changed)


def source(*frames: DeviceFrame | DataError, posed: bool = True) -> Source:
    def reading(stored: DeviceFrame | DataError):
        def read() -> DeviceFrame:
            if isinstance(stored, DataError):
                raise stored
            return stored

        return read

    return Source("a test", map(reading, frames), len(frames), posed)


def test_folder_writer_skips_and_counts_unusable_frames(tmp_path: Path) -> None:
    stored = source(frame(0), FrameError("one is torn"), frame(2, T_world_camera=None), frame(3))
    written = write_folder(stored, tmp_path / "out", Writing())
    expected = "frame 2: expected a pose, got none; --poses none imports without poses"
    assert written.errors == ["one is torn", expected]
    assert str(written) == "2 frames; skipped 2, first error: one is torn"
    assert [seen.timestamp for seen in RgbdFolder(tmp_path / "out")] == pytest.approx([0, 0.1])


def test_folder_writer_frames_without_poses_write_no_pose_file(tmp_path: Path) -> None:
    write_folder(source(*(frame(k, T_world_camera=None) for k in range(3)), posed=False), tmp_path / "out", Writing())
    assert not (tmp_path / "out/poses.txt").exists()
    assert len(RgbdFolder(tmp_path / "out")) == 3


def test_folder_writer_keeps_times_without_poses(tmp_path: Path) -> None:
    posed = source(*(frame(k, timestamp=1.7e9 + k / 10) for k in range(3)))
    write_folder(without_poses(posed), tmp_path / "out", Writing())
    assert not (tmp_path / "out/poses.txt").exists()
    found = [seen.timestamp for seen in RgbdFolder(tmp_path / "out")]
    assert found == pytest.approx([1.7e9, 1.7e9 + 0.1, 1.7e9 + 0.2], abs=1e-6)


def test_folder_writer_without_usable_frame_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected usable frames, got none; first error: one is torn"):
        write_folder(source(FrameError("one is torn")), tmp_path / "out", Writing())
    assert not (tmp_path / "out").exists()


def test_folder_writer_nonempty_output_folder_raises(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    write_folder(source(frame(0)), tmp_path / "empty", Writing())
    before = sorted(tmp_path.rglob("*"))
    for place in (tmp_path / "empty", tmp_path / "empty/camera.json"):
        with pytest.raises(DataError, match="expected a new or empty folder"):
            write_folder(source(frame(0)), place, Writing())
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(ENOSPC, "No space left on device")])
def test_folder_writer_starts_interrupted_import_again(tmp_path: Path, error: BaseException) -> None:
    def frames():
        yield lambda: frame(0)
        yield lambda: frame(1)
        raise error

    with pytest.raises(type(error)):
        write_folder(Source("a test", frames(), 3, posed=True), tmp_path / "out", Writing())
    assert (tmp_path / "out/color/000001.jpg").exists()
    with pytest.raises(DataError, match=r"out: expected complete data, got an unfinished import; repeat"):
        RgbdFolder(tmp_path / "out")
    (tmp_path / "out/notes.txt").write_text("mine")
    for name in ("out", "undisturbed"):
        write_folder(source(*(frame(k) for k in range(3))), tmp_path / name, Writing(stride=2))
    left, expected = (
        {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for folder in (tmp_path / "out", tmp_path / "undisturbed")
    )
    assert left == expected | {Path("notes.txt"): b"mine"}
    assert len(RgbdFolder(tmp_path / "out")) == 2


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"timestamp": float("nan")}, "expected a finite timestamp, got nan"),
        ({"color": np.zeros((48, 60, 3), np.uint8)}, "expected color of 64x48 px as in the camera, got 60x48 px"),
        ({"depth": np.zeros((1, 16), np.float32)}, "expected depth of at least 2x2 px, got 16x1 px"),
        (
            {"confidence": np.zeros((12, 15), np.uint8)},
            r"expected confidence of shape \(12, 16\) as for depth, got \(12, 15\)",
        ),
    ],
)
def test_folder_writer_inconsistent_frame_data_raises(changed: dict[str, object], message: str) -> None:
    with pytest.raises(FrameError, match=f"frame 1: {message}"):
        frame(1, **changed)


def test_folder_writer_depth_above_uint16_range_is_zero(tmp_path: Path) -> None:
    depth = np.full((12, 16), 70.0, np.float32)
    depth[:6] = 65.5
    write_folder(source(frame(0, depth=depth)), tmp_path / "out", Writing())
    [seen] = RgbdFolder(tmp_path / "out", max_depth=0)
    assert set(np.unique(seen.depth)) == {0, np.float32(65.5)}


@pytest.mark.parametrize("bad", [{"width": -1}, {"stride": 0}, {"confidence": 3}, {"rotate": 45}])
def test_folder_writer_option_out_of_range_raises(bad: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=f"--{next(iter(bad))}: expected"):
        Writing(**bad)


def test_folder_writer_limits_longer_side_without_upscaling() -> None:
    portrait = Camera(1440, 1920, 1400.0, 1400.0, 724.0, 963.0)
    assert Writing().camera(portrait) == portrait.scaled(1 / 3)
    assert Writing(width=720).camera(portrait) == portrait.scaled(0.5)
    assert Writing(width=4000).camera(portrait) == portrait
    assert Writing().camera(CAMERA) == CAMERA


def test_folder_writer_resamples_images_to_first_camera(tmp_path: Path) -> None:
    """The second frame shows the same image at twice the size."""
    stripes = np.kron(np.arange(8) % 2, np.full(8, 200))[None, :, None].repeat(48, axis=0).repeat(3, axis=2)
    other = frame(1, camera=CAMERA.scaled(2), color=stripes.astype(np.uint8).repeat(2, axis=0).repeat(2, axis=1))
    write_folder(source(frame(0, color=stripes.astype(np.uint8)), other), tmp_path / "out", Writing())
    first, second = RgbdFolder(tmp_path / "out")
    assert np.abs(first.color.astype(int) - second.color).max() < 5
    np.testing.assert_array_equal(first.depth, second.depth)


def test_open_source_unknown_format_error_lists_formats(tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"expected a supported format \(stray_scanner, .*\), got an unknown format; run instancemap"
    ):
        open_source(tmp_path)
    with pytest.raises(DataError, match="expected a recording, got no such file or folder"):
        open_source(tmp_path / "nowhere")


def test_open_source_of_oni_file_names_conversion(tmp_path: Path) -> None:
    (tmp_path / "room.oni").touch()
    expected = r"run instancemap convert-oni .*room.oni .*room, then instancemap dataset=scenenn .* dataset.scene=room$"
    with pytest.raises(DataError, match=expected):
        open_source(tmp_path / "room.oni")


def test_open_source_of_rgbd_folder_names_dataset(tmp_path: Path) -> None:
    write_folder(source(frame(0)), tmp_path / "out", Writing())
    with pytest.raises(DataError, match=r"got an RGB-D folder; run instancemap dataset=rgbd_folder dataset.root=.*out"):
        open_source(tmp_path / "out")


def test_open_source_of_tum_sequence_names_dataset(tmp_path: Path) -> None:
    for name in ("rgb.txt", "depth.txt"):
        (tmp_path / name).touch()
    with pytest.raises(DataError, match=r"got a TUM RGB-D sequence; run instancemap dataset=tum_rgbd dataset\.root="):
        open_source(tmp_path)


def test_open_source_finds_nested_export_folder(tmp_path: Path) -> None:
    write_scanner_app(tmp_path / "outer/2026_11_23", room_frames(1))
    assert open_source(tmp_path / "outer").format == "3D Scanner App"
    (tmp_path / "outer/other").mkdir()
    with pytest.raises(DataError, match="expected a supported format"):
        open_source(tmp_path / "outer")


def test_open_source_zip_file_error_has_fix(tmp_path: Path) -> None:
    (tmp_path / "scan.zip").touch()
    with pytest.raises(DataError, match=r"scan\.zip: expected a folder or recording, got a zip archive; unpack it"):
        open_source(tmp_path / "scan.zip")

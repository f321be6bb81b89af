"""Tests for a watched folder.

Complete frames must be read in order, and skipped files must be reported.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from framework.data import Frame, Pose
from framework.datasets.cameras import folder_watch
from framework.datasets.cameras.folder_watch import FolderWatch
from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import ConfigError, DataError, FrameError
from framework.files.storage import check_storage
from framework.interfaces import FrameReader, PoseTracker, SceneMap
from framework.runtime.frame_stream import LiveFrames
from framework.sensors.noise_models import SensorChoice, SensorKind
from plugins.detectors.none import NoDetections
from tests.framework.test_pipeline import mapped, pipeline
from tests.support.scenes.corner_room import CAMERA, CornerRoom, pose_at

CALIBRATION = {"width": CAMERA.width, "height": CAMERA.height, "fx": 90, "fy": 90, "cx": 47.5, "cy": 35.5}
ROOM = CornerRoom(frames=30)


def encoded(k: int) -> dict[str, bytes]:
    """Return the encoded color and depth image of frame k, keyed by the file name."""
    frame = ROOM[k % len(ROOM)]
    color = cv2.imencode(".jpg", frame.color[..., ::-1])[1]
    return {
        f"color/{k:06d}.jpg": color.tobytes(),
        f"depth/{k:06d}.png": cv2.imencode(".png", (frame.depth * 1000).astype(np.uint16))[1].tobytes(),
    }


def write(folder: Path, *numbers: int) -> None:
    for k in numbers:
        for name, data in encoded(k).items():
            (folder / name).write_bytes(data)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("color", "depth"):
        (tmp_path / name).mkdir()
    (tmp_path / "camera.json").write_text(json.dumps(CALIBRATION | {"depth_scale": 1000}))
    return tmp_path


class Watched:
    """Watched folder that is scanned on request."""

    def __init__(self, folder: Path, **parameters: Any) -> None:
        self.over = False
        self._frames = FolderWatch(folder, poll_interval=0.001, **parameters).frames()

    def found(self) -> Iterator[FrameReader | FrameError]:
        """Yield the frame readers and the errors of one scan."""
        while (found := next(self._frames, self)) is not None:
            if isinstance(found, Watched):
                self.over = True
                return
            yield found

    def readers(self) -> Iterator[FrameReader]:
        """Yield the frame readers of one scan without an unusable frame."""
        for found in self.found():
            assert not isinstance(found, FrameError)
            yield found

    def look(self) -> list[int | str]:
        """Scan the folder and return the index of each readable frame and the error message of each other frame."""
        return [outcome(found) for found in self.found()]


def outcome(found: FrameReader | FrameError) -> int | str:
    try:
        if isinstance(found, FrameError):
            raise found
        return found().index
    except FrameError as error:
        assert "\n" not in str(error)
        return str(error)


def test_folder_watch_frames_match_recorded_folder(folder: Path) -> None:
    watched, before = Watched(folder), time.time()
    assert watched.look() == []
    found: list[Frame] = []
    for k in range(3):
        write(folder, k)
        found += [reader() for reader in watched.readers()]
    for live, recorded in zip(found, RgbdFolder(folder), strict=True):
        assert (live.index, live.image_name, live.camera) == (recorded.index, recorded.image_name, recorded.camera)
        np.testing.assert_array_equal(live.color, recorded.color)
        np.testing.assert_array_equal(live.depth, recorded.depth)
    times = [before, *(frame.timestamp for frame in found), time.time()]
    assert times == sorted(set(times))


@pytest.mark.parametrize(
    ("choice", "kind"), [(SensorChoice.AUTO, SensorKind.PHONE_LIDAR), (SensorChoice.EXACT, SensorKind.EXACT)]
)
def test_watched_frames_have_chosen_sensor(folder: Path, choice: SensorChoice, kind: SensorKind) -> None:
    (folder / "camera.json").write_text(json.dumps(CALIBRATION | {"depth_scale": 1000, "sensor": "PHONE_LIDAR"}))
    write(folder, 0)
    [reader] = Watched(folder, sensor=choice).readers()
    assert reader().sensor is kind


@pytest.mark.parametrize("share", [0, 0.3, 0.999])
@pytest.mark.parametrize("late", ["color", "depth"])
def test_folder_watch_emits_frame_once_both_files_are_complete(folder: Path, late: str, share: float) -> None:
    watched, files = Watched(folder), encoded(4)
    [slow] = [name for name in files if name.startswith(late)]
    [fast] = files.keys() - {slow}
    (folder / fast).write_bytes(files[fast])
    assert watched.look() == []
    (folder / slow).write_bytes(files[slow][: int(share * len(files[slow]))])
    assert watched.look() == watched.look() == []
    with (folder / slow).open("ab") as file:
        file.write(files[slow][int(share * len(files[slow])) :])
    assert watched.look() == [4]
    assert watched.look() == []


def test_folder_watch_reports_earlier_incomplete_frame_once(folder: Path) -> None:
    watched, files = Watched(folder), encoded(1)
    color, depth = files
    write(folder, 0)
    (folder / color).write_bytes(files[color])
    assert watched.look() == [0]
    write(folder, 2)
    missing = f"{folder / color}: expected the frame's other image before frame 2, got none"
    assert watched.look() == [missing, 2]
    (folder / depth).write_bytes(files[depth])
    assert watched.look() == []
    (folder / "depth/000003.png").write_bytes(files[depth][:99])
    (folder / "color/000003.jpg").write_bytes(files[color])
    assert watched.look() == []
    write(folder, 4)
    assert watched.look() == [
        f"{folder}/depth/000003.png: expected an image with an end marker, got none in 99 bytes (truncated file)",
        4,
    ]


def test_folder_watch_reports_decreasing_frame_number(folder: Path) -> None:
    watched = Watched(folder)
    write(folder, 7)
    assert watched.look() == [7]
    write(folder, 3)
    assert watched.look() == [f"{folder}/color/000003.jpg: expected a frame number > 7, got 3"]
    write(folder, 9)
    assert watched.look() == [9]


def test_folder_watch_reads_existing_frames_in_order(folder: Path) -> None:
    write(folder, *range(12))
    watched = Watched(folder)
    assert watched.look() == list(range(12))


def test_folder_watch_continues_after_files_are_removed(folder: Path) -> None:
    watched = Watched(folder)
    write(folder, 0, 1)
    first, second = watched.readers()
    assert outcome(first) == 0
    (folder / "color/000001.jpg").unlink()
    assert "color/000001.jpg: expected a readable file, got an error (No such file" in str(outcome(second))
    for path in (folder / "depth").iterdir():
        path.unlink()
    write(folder, 2)
    assert watched.look() == [2]


def test_folder_watch_frame_in_emptied_folder_is_skipped(folder: Path) -> None:
    """The other program may delete all images while a frame waits. The storage is still available."""
    write(folder, 0)
    (reader,) = Watched(folder).readers()
    for path in (folder / "color").iterdir():
        path.unlink()
    with pytest.raises(FrameError) as caught:
        reader()
    check_storage(caught.value)


def test_folder_watch_raises_for_ambiguous_names_only(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    watched = Watched(folder)
    for name in (".000000.jpg", "000000.jpg.part", "preview.jpg", f"{2**53}.jpg"):
        (folder / "color" / name).write_bytes(b"?")
    assert watched.look() == watched.look() == []
    expected = f"{folder}/color: expected a frame number below 2^53 at the end of the name, got %r; image ignored"
    assert sorted(caplog.messages) == [expected % f"{2**53}.jpg", expected % "preview.jpg"]
    for k in (4, 3):
        (folder / "color" / f"1305031102.1753{k}.jpg").write_bytes(b"?")
        (folder / "depth" / f"130503110{k}.175304.png").write_bytes(b"?")
    with pytest.raises(DataError, match="expected names that differ in one number"):
        watched.look()


def test_folder_watch_reports_image_size_mismatch(folder: Path) -> None:
    (folder / "camera.json").write_text(json.dumps(CALIBRATION | {"depth_scale": 1000, "width": 97}))
    write(folder, 0)
    assert str(*Watched(folder).look()).endswith(f"expected 97x72 px as in {folder}/camera.json, got 96x72 px")


@pytest.mark.parametrize("half", [False, True])
def test_folder_watch_end_file_stops_after_remaining_frames(folder: Path, half: bool) -> None:
    watched = Watched(folder)
    assert watched.look() == []
    write(folder, 5)
    if half:
        (folder / "depth/000006.png").write_bytes(b"?")
    (folder / "end").touch()
    left = [f"{folder}/depth/000006.png: expected the frame's other image before the end, got none"] if half else []
    assert watched.look() == [5, *left]
    assert watched.over


def test_folder_watch_stops_after_idle_timeout(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now=100.0, time=time.time, sleep=lambda _: None, monotonic=lambda: clock.now)
    monkeypatch.setattr(folder_watch, "time", clock)
    watched = Watched(folder, idle_timeout=5.0)
    for k in range(3):
        write(folder, k)
        assert watched.look() == [k]
        clock.now += 4.0
        assert watched.look() == []
    assert not watched.over
    clock.now += 2.0
    assert watched.look() == []
    assert watched.over


def test_folder_watch_waits_for_camera_file(folder: Path) -> None:
    whole = (folder / "camera.json").read_text()
    (folder / "camera.json").unlink()
    write(folder, 0)
    watched = Watched(folder)
    assert watched.look() == []
    (folder / "camera.json").write_text(whole[:20])
    assert watched.look() == []
    (folder / "camera.json").write_text(whole)
    assert watched.look() == [0]


@pytest.mark.parametrize(
    ("text", "output"), [(None, "No such file"), ("{", "expected valid JSON"), ("{}", "expected a key 'width'")]
)
def test_folder_watch_unusable_camera_file_raises_after_timeout(folder: Path, text: str | None, output: str) -> None:
    (folder / "camera.json").unlink()
    if text is not None:
        (folder / "camera.json").write_text(text)
    watched = Watched(folder, camera_timeout=0)
    with pytest.raises(DataError, match=output):  # noqa: PT012
        while True:
            watched.look()


@pytest.mark.parametrize(
    ("key", "value", "found"),
    [
        ("fx", 45, "fx: expected 90.0 as at the start of the run, got 45.0"),
        ("depth_scale", 5000, "depth_scale: expected 1000.0 as at the start of the run, got 5000.0"),
        ("distortion", [0.1, 0, 0, 0, 0], "distortion: expected None as at the start of the run, got Distortion"),
        ("sensor", "PHONE_LIDAR", "sensor: expected KINECT_V1"),
        ("height", "72", "height: expected a number, got '72'"),
    ],
)
def test_folder_watch_changed_camera_raises(folder: Path, key: str, value: object, found: str) -> None:
    """The frames that appear after the change are not read with the camera of the start."""
    watched = Watched(folder)
    write(folder, 0)
    assert watched.look() == [0]
    (folder / "camera.json").write_text(json.dumps(CALIBRATION | {"depth_scale": 1000, key: value}))
    write(folder, 1)
    with pytest.raises(DataError, match=re.escape(f"{folder}/camera.json: {found}")):
        watched.look()


def test_folder_watch_rewritten_camera_file_is_accepted(folder: Path) -> None:
    """Frames wait while the file is incomplete or missing."""
    watched = Watched(folder)
    assert watched.look() == []
    for number, part in enumerate((b"{", b"", None)):
        write(folder, number)
        if part is None:
            (folder / "camera.json").unlink()
        else:
            (folder / "camera.json").write_bytes(part)
        assert watched.look() == watched.look() == []
        values = CALIBRATION | {"depth_scale": 1000}
        (folder / "camera.json").write_text(json.dumps(values, indent=number))
        assert watched.look() == [number]


def test_folder_watch_camera_file_lost_for_too_long_raises(folder: Path) -> None:
    watched = Watched(folder, camera_timeout=0)
    assert watched.look() == []
    (folder / "camera.json").unlink()
    with pytest.raises(DataError, match=r"camera\.json: expected a readable file"):  # noqa: PT012
        while True:
            watched.look()


@pytest.mark.parametrize("with_camera", [True, False])
def test_folder_watch_removed_root_raises(folder: Path, with_camera: bool) -> None:
    if not with_camera:
        (folder / "camera.json").unlink()
    watched = Watched(folder)
    assert watched.look() == []
    shutil.rmtree(folder)
    message = f"dataset.root: expected the folder {folder} until the end of the run, got an error (No such file"
    with pytest.raises(DataError, match=re.escape(message)):
        watched.look()


@pytest.mark.parametrize("name", ["color", "depth"])
def test_folder_watch_image_folder_may_appear_but_not_vanish(folder: Path, name: str) -> None:
    (folder / name).rmdir()
    watched = Watched(folder)
    assert watched.look() == []
    (folder / name).mkdir()
    write(folder, 0)
    assert watched.look() == [0]
    shutil.rmtree(folder / name)
    with pytest.raises(DataError, match=f"{name}: expected a folder of images until the end of the run"):
        watched.look()


def test_folder_watch_file_in_place_of_image_folder_raises(folder: Path) -> None:
    (folder / "color").rmdir()
    (folder / "color").touch()
    with pytest.raises(DataError, match=r"color: expected a folder of images .*, got an error \(Not a directory\)"):
        Watched(folder).look()


def test_folder_watch_dangling_root_raises(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "missing")
    with pytest.raises(DataError, match=r"dataset\.root: expected an existing folder, got .*link"):
        FolderWatch(tmp_path / "link")


def test_folder_watch_timestamps_increase_when_clock_goes_back(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    watched, times = Watched(folder), [time.time()]
    for k in range(3):
        write(folder, k)
        [reader] = watched.readers()
        times.append(reader().timestamp)
        monkeypatch.setattr(time, "time", lambda hours=k + 1: times[0] - 3600 * hours)
    assert times == sorted(times)
    assert times[-1] - times[0] < 600


def test_folder_watch_unusable_frames_do_not_replace_waiting_frame(folder: Path) -> None:
    """The frames are taken only after all of them have arrived, and all files are counted."""
    write(folder, 5)
    for number, name in ((3, "color/000003.jpg"), (4, "depth/000004.png"), (6, "color/000006.jpg")):
        (folder / name).write_bytes(encoded(number)[name])
    for name in ("color/000007.jpg", "depth/000007.png"):
        (folder / name).write_bytes(encoded(7)[name][:99])
    (folder / "end").touch()
    video = FolderWatch(folder)
    with LiveFrames(video, lambda: False) as stream:
        stream._listener.join()
        taken = []
        while (found := stream.take()) is not None:
            taken.append(outcome(found))
    assert [one for one in taken if isinstance(one, int)] == [5]
    assert len(taken) == 5
    assert stream.dropped == stream.dropped_of(len(taken)) == 0


@pytest.mark.parametrize(
    "parameter",
    [{"idle_timeout": -1}, {"camera_timeout": float("nan")}, {"poll_interval": 0.2}, {"max_depth": -1}],
    ids=str,
)
def test_folder_watch_parameter_out_of_range_raises(folder: Path, parameter: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(parameter))):
        FolderWatch(folder, **parameter)


@dataclass
class Known(PoseTracker):
    """Tracker that returns the ground-truth pose of each frame."""

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        return Pose(pose_at(frame.index))


def test_watched_folder_is_mapped_while_written(folder: Path) -> None:
    """The images are written slowly and in place. The file `end` is created at the end."""

    def writer() -> None:
        for k in range(len(ROOM)):
            for name, data in encoded(k).items():
                with (folder / name).open("wb", buffering=0) as file:
                    for part in range(0, len(data), 2000):
                        file.write(data[part : part + 2000])
                        time.sleep(0.0005)
        os.close(os.open(folder / "end", os.O_CREAT))

    writing = threading.Thread(target=writer)
    writing.start()
    result = pipeline(detector=NoDetections(), tracker=Known()).run(FolderWatch(folder))
    writing.join()
    assert result.live is not None
    assert result.frames + result.live.frames_dropped == len(ROOM)
    assert result.frames_skipped == 0
    assert len(mapped(result).vertices) == result.frames > 0


def test_watched_folder_with_changed_camera_is_partial_run(folder: Path) -> None:
    @dataclass
    class Changes(Known):
        def track(self, frame: Frame, scene: SceneMap) -> Pose:
            (folder / "camera.json").write_text(json.dumps(CALIBRATION | {"depth_scale": 1}))
            write(folder, frame.index + 1)
            return super().track(frame, scene)

    write(folder, 0)
    result = pipeline(detector=NoDetections(), tracker=Changes()).run_to_any_end(FolderWatch(folder))
    assert "depth_scale: expected 1000.0" in str(result.stopped_by)
    assert len(mapped(result).vertices) == result.frames == 1

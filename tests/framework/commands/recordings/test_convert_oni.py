"""Tests for the command `convert-oni`."""

import sys

import cv2
import numpy as np
import pytest

from framework.commands.recordings import convert_oni
from framework.datasets.scenenn.oni import OniFrame
from framework.datasets.scenenn.scene_files import read_timestamps
from framework.datasets.scenenn.scenenn import SceneNN
from framework.errors import DataError
from tests.framework.datasets.scenenn.test_oni import colors, depths, played, recording
from tests.support.recordings.oni_file import OniFile

pytestmark = pytest.mark.integration

FRAMES = [OniFrame(c, d, 1000 * k + 7, 1000 * k) for k, (c, d) in enumerate(zip(colors(), depths(), strict=True))]


@pytest.fixture
def source(tmp_path):
    return OniFile(recording()).write(tmp_path / "011.oni")


def command(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["convert_oni", *map(str, arguments)])
    convert_oni.main()


def deliver(monkeypatch, count, fault=None):
    """Replace OpenNI 2 with a reader of `count` frames.

    If `fault` is given, the reader raises it after the last frame.
    """

    def read_frames(contents, scratch):
        yield from FRAMES[:count]
        if fault:
            raise fault

    monkeypatch.setattr(convert_oni, "read_frames", read_frames)


def names(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def written(count):
    numbers = range(1, count + 1)
    return [
        *(f"depth/depth{k:05d}.png" for k in numbers),
        *(f"image/image{k:05d}.png" for k in numbers),
        "timestamp.txt",
    ]


def check_images(folder, count):
    for k in range(count):
        color = cv2.imread(str(folder / f"image/image{k + 1:05d}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(color[..., ::-1], colors()[k])
        depth = cv2.imread(str(folder / f"depth/depth{k + 1:05d}.png"), cv2.IMREAD_UNCHANGED)
        assert depth.dtype == np.uint16
        np.testing.assert_array_equal(depth, depths()[k])


@played
def test_convert_oni_writes_scene_images(tmp_path, monkeypatch, capsys, source):
    command(monkeypatch, source, tmp_path / "011")
    assert names(tmp_path / "011") == written(4)
    check_images(tmp_path / "011", 4)
    assert (tmp_path / "011/timestamp.txt").read_text().splitlines()[0] == "1 33338 33333"
    assert f"{tmp_path / '011'}: 4 frames; skipped 0 color" in capsys.readouterr().out


def test_convert_oni_color_and_depth_timestamps_are_kept(tmp_path, monkeypatch, source):
    deliver(monkeypatch, 3)
    convert_oni.convert(source, tmp_path / "011")
    assert (tmp_path / "011/timestamp.txt").read_text() == "1 7 0\n2 1007 1000\n3 2007 2000\n"
    assert read_timestamps(tmp_path / "011/timestamp.txt") == {
        1: (0.000007, 0.0),
        2: (0.001007, 0.001),
        3: (0.002007, 0.002),
    }


def test_convert_oni_skipped_images_are_counted(tmp_path, monkeypatch, capsys, source):
    deliver(monkeypatch, 3)
    convert_oni.convert(source, tmp_path / "011")
    assert "3 frames; skipped 1 color and 1 depth" in capsys.readouterr().out


def test_convert_oni_folder_with_other_files_is_accepted(tmp_path, monkeypatch, source):
    folder = tmp_path / "011"
    folder.mkdir()
    (folder / "trajectory.log").write_text("0 0 1\n")
    deliver(monkeypatch, 2)
    convert_oni.convert(source, folder)
    assert names(folder) == [*written(2), "trajectory.log"]


@pytest.mark.parametrize("file", ["image/image00001.png", "depth/depth00001.png", "timestamp.txt"])
def test_convert_oni_existing_output_is_not_overwritten(tmp_path, monkeypatch, source, file):
    (tmp_path / "011" / file).parent.mkdir(parents=True)
    (tmp_path / "011" / file).write_bytes(b"mine")
    deliver(monkeypatch, 4)
    message = "expected a missing path or an empty folder, got existing files; remove them or choose another OUT"
    with pytest.raises(DataError, match=message):
        convert_oni.convert(source, tmp_path / "011")
    assert names(tmp_path / "011") == [file]


def test_convert_oni_interrupted_is_started_again(tmp_path, monkeypatch, capsys, source):
    deliver(monkeypatch, 3, KeyboardInterrupt())
    (tmp_path / "011").mkdir()
    (tmp_path / "011/trajectory.log").write_text("0 0 1\n")
    with pytest.raises(SystemExit, match="130"):
        command(monkeypatch, source, tmp_path / "011")
    assert capsys.readouterr().err.splitlines()[-1] == "interrupted"
    assert set(written(3)) < set(names(tmp_path / "011"))
    with pytest.raises(DataError, match="got an unfinished convert-oni; repeat `instancemap convert-oni`"):
        SceneNN(tmp_path, "011")
    deliver(monkeypatch, 2)
    command(monkeypatch, source, tmp_path / "011")
    assert names(tmp_path / "011") == [*written(2), "trajectory.log"]
    check_images(tmp_path / "011", 2)
    assert list(read_timestamps(tmp_path / "011/timestamp.txt")) == [1, 2]


def test_convert_oni_damaged_recording_keeps_read_frames(tmp_path, monkeypatch, capsys, source):
    deliver(monkeypatch, 3, DataError("it is damaged"))
    with pytest.raises(SystemExit, match="1"):
        command(monkeypatch, source, tmp_path / "011")
    assert names(tmp_path / "011") == written(3)
    assert capsys.readouterr().err.splitlines()[-1] == "error: it is damaged"


def test_convert_oni_truncated_recording_names_last_image(tmp_path, monkeypatch, capsys, source):
    source.write_bytes(source.read_bytes()[:-400])
    deliver(monkeypatch, 3)
    with pytest.raises(SystemExit, match="1"):
        command(monkeypatch, source, tmp_path / "011")
    assert names(tmp_path / "011") == written(3)
    fault = capsys.readouterr().err.splitlines()[-1]
    assert fault.startswith(f"error: {source}: expected a complete file, got a truncated or damaged file at byte")
    assert "up to image00003.png; download it again" in fault


def test_convert_oni_recording_without_frames_raises(tmp_path, monkeypatch, source):
    deliver(monkeypatch, 0)
    with pytest.raises(DataError, match="expected color and depth images with equal timestamps, got none"):
        convert_oni.convert(source, tmp_path / "011")
    assert names(tmp_path / "011") == []


def test_convert_oni_invalid_file_leaves_no_output(tmp_path, monkeypatch, capsys):
    (tmp_path / "a.oni").write_bytes(b"PK\3\4 a zip file")
    with pytest.raises(SystemExit, match="1"):
        command(monkeypatch, tmp_path / "a.oni", tmp_path / "011")
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {tmp_path / 'a.oni'}: expected an OpenNI recording")
    assert not (tmp_path / "011").exists()

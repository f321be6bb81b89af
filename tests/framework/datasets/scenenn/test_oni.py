"""Tests for the frames of .oni files. If OpenNI 2 is installed, files are also played back."""

import ctypes
import signal

import numpy as np
import pytest

from framework.datasets.scenenn import oni
from framework.datasets.scenenn.oni import LARGEST_TIME_DIFFERENCE, LIBRARIES, WAITING, OniImage, pair, read_frames
from framework.datasets.scenenn.oni_records import Images, Stream, read_contents
from framework.errors import ConfigError, DataError
from tests.support.recordings.oni_file import COLOR, DEPTH, YUV422, Node, OniFile, crash

TIMES = [33_333, 66_666, 100_000, 133_333]


def is_installed():
    try:
        ctypes.CDLL(LIBRARIES[0])
    except OSError:
        return False
    return True


played = pytest.mark.skipif(
    not is_installed(), reason="OpenNI 2: expected an installed library, got none; run apt-get install libopenni2-0"
)


def depths(shape=(6, 8), dtype=np.uint16):
    return [np.random.default_rng(k).integers(0, 10_000, shape).astype(dtype) for k in range(len(TIMES))]


def colors(shape=(6, 8)):
    return [np.full((*shape, 3), (10 * k, 200 - k, 50), np.uint8) for k in range(len(TIMES))]


def recording(**of_depth):
    return [Node(DEPTH, depths(), TIMES, **of_depth), Node(COLOR, colors(), [time + 5 for time in TIMES])]


def frames_of(path):
    return list(read_frames(read_contents(path), path.parent))


@played
@pytest.mark.parametrize("wide", [True, False])
def test_openni_plays_uncompressed_recording_completely(tmp_path, wide):
    frames = frames_of(OniFile(recording(), wide).write(tmp_path / "a.oni"))
    assert [(frame.color_time, frame.depth_time) for frame in frames] == [(time + 5, time) for time in TIMES]
    np.testing.assert_array_equal([frame.depth_mm for frame in frames], depths())
    np.testing.assert_array_equal([frame.color for frame in frames], colors())
    assert frames[0].depth_mm.dtype == np.uint16


@played
def test_openni_decodes_compressed_streams(tmp_path):
    nodes = recording(codec=b"16zT")
    nodes[1].codec = b"JPEG"
    frames = frames_of(OniFile(nodes).write(tmp_path / "a.oni"))
    np.testing.assert_array_equal([frame.depth_mm for frame in frames], depths())
    np.testing.assert_allclose([frame.color for frame in frames], colors(), atol=3)


@played
def test_oni_depth_in_100_um_is_rounded_to_millimeters(tmp_path):
    frames = frames_of(OniFile(recording(pixel_format=oni.DEPTH_100_UM)).write(tmp_path / "a.oni"))
    expected = np.floor(np.array(depths()) / 10 + 0.5)
    np.testing.assert_array_equal([frame.depth_mm for frame in frames], expected)


@played
def test_oni_truncated_recording_plays_complete_frames(tmp_path):
    path = OniFile(recording()).write(tmp_path / "a.oni")
    second = OniFile(recording())
    second.write(tmp_path / "b.oni")
    path.write_bytes(path.read_bytes()[: second.nodes[1].positions[2] + 50])
    frames = frames_of(path)
    np.testing.assert_array_equal([frame.depth_mm for frame in frames], depths()[:2])
    assert sorted(tmp_path.iterdir()) == [path, tmp_path / "b.oni"]


@played
def test_oni_unsupported_pixel_format_raises(tmp_path):
    nodes = recording()
    nodes[1].pixel_format = YUV422
    with pytest.raises(DataError, match=r"a\.oni: color: expected OpenNI pixel format 200 .*, got 201"):
        frames_of(OniFile(nodes).write(tmp_path / "a.oni"))


@played
def test_oni_stalled_player_raises_after_timeout(tmp_path, monkeypatch):
    monkeypatch.setattr(oni, "PATIENCE", 200)
    path = OniFile(recording()).write(tmp_path / "a.oni")
    streams = {stream: Images(node=1, count=9, last=9) for stream in Stream}
    with pytest.raises(DataError, match="got a stall of OpenNI 2 after depth image 4 of 9 and color image 4 of 9"):
        list(oni.play(path, streams))


def test_oni_player_crash_raises_one_line_error(tmp_path, monkeypatch):
    monkeypatch.setattr(oni, "_deliver", crash)
    path = OniFile(recording()).write(tmp_path / "a.oni")
    with pytest.raises(DataError) as caught:
        frames_of(path)
    assert f"got an OpenNI 2 crash (exit status {-signal.SIGKILL})" in str(caught.value)


def test_oni_missing_openni_error_names_package(tmp_path, monkeypatch):
    monkeypatch.setattr(oni, "LIBRARIES", ("libNotThere.so",))
    with pytest.raises(
        ConfigError, match="OpenNI 2: expected an installed library, got none; run apt-get install libopenni2-0"
    ):
        next(oni.play(tmp_path / "a.oni", {}))


@played
def test_oni_path_over_255_bytes_raises(tmp_path):
    with pytest.raises(DataError, match="expected a path of at most 255 bytes"):
        next(oni.play(tmp_path / ("a" * 250 + ".oni"), {}))


def image(stream, time, shape=(2, 3)):
    return OniImage(stream, time, np.zeros(shape))


def times_of(frames):
    return [(frame.color_time, frame.depth_time) for frame in frames]


def play_back(color_times, depth_times):
    """Pair frames like SceneNN's PlaybackSync, which advances the earlier stream until both times are close."""
    paired, color_reader, depth_reader = [], iter(color_times), iter(depth_times)
    try:
        while True:
            depth, color = next(depth_reader), next(color_reader)
            while abs(color - depth) > LARGEST_TIME_DIFFERENCE:
                if color > depth:
                    depth = next(depth_reader)
                else:
                    color = next(color_reader)
            paired.append((color, depth))
    except StopIteration:
        return paired


@pytest.mark.parametrize("seed", range(20))
def test_frame_pairing_matches_scenenn_playback(seed):
    rng = np.random.default_rng(seed)
    times = {stream: 33_333 * np.flatnonzero(rng.random(60) < 0.8) + rng.integers(0, 30_000) for stream in Stream}
    images = sorted((image(stream, int(time)) for stream in Stream for time in times[stream]), key=lambda one: one.time)
    expected = play_back(times[Stream.COLOR], times[Stream.DEPTH])
    assert len(expected) > 20
    assert times_of(pair(images)) == expected


def test_frame_pairing_accepts_maximum_time_difference():
    at_limit = [image(Stream.DEPTH, 0), image(Stream.COLOR, LARGEST_TIME_DIFFERENCE)]
    assert times_of(pair(at_limit)) == [(LARGEST_TIME_DIFFERENCE, 0)]
    assert times_of(pair([image(Stream.DEPTH, 0), image(Stream.COLOR, LARGEST_TIME_DIFFERENCE + 1)])) == []


def test_oni_unpaired_stream_buffer_is_bounded():
    alone = [image(Stream.DEPTH, time) for time in range(WAITING + 1)]
    assert times_of(pair([*alone, image(Stream.COLOR, 0)])) == [(0, 1)]


def test_oni_color_and_depth_size_mismatch_raises():
    with pytest.raises(DataError, match="expected color and depth of the same size, got 6x4 px and 3x2 px"):
        list(pair([image(Stream.DEPTH, 0), image(Stream.COLOR, 0, (4, 6, 3))]))

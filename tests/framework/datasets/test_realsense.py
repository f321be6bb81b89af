"""RealSense cameras, by a fake of their library: what is asked of it, and what its faults become."""

from __future__ import annotations

import sys
from collections.abc import Generator
from contextlib import closing

import numpy as np
import pytest

from framework.data import Frame
from framework.datasets import realsense
from framework.datasets.realsense import RealSense
from framework.datasets.undistortion import Distortion, Undistortion
from framework.errors import ConfigError, DataError, FrameError
from tests.scenes.corner_room import CAMERA, CornerRoom
from tests.scenes.fake_realsense import BROWN, INVERSE, SERIAL, UNIT, FakeRealSense

SIZE = {"width": CAMERA.width, "height": CAMERA.height}


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> FakeRealSense:
    plugged = FakeRealSense()
    monkeypatch.setitem(sys.modules, "pyrealsense2", plugged.module())
    return plugged


def sent(video: RealSense, frames: int) -> Generator[Frame]:
    with closing(video.frames()) as readers:
        for _, reader in zip(range(frames), (reader for reader in readers if reader), strict=False):
            yield reader()


def test_frames_are_the_cameras_registered_to_colour(device: FakeRealSense) -> None:
    found = list(sent(RealSense(**SIZE), 3))
    assert [frame.index for frame in found] == [0, 1, 2]
    for frame, true in zip(found, CornerRoom(), strict=False):
        assert frame.camera == CAMERA
        np.testing.assert_array_equal(frame.color, true.color)
        np.testing.assert_allclose(frame.depth, true.depth, atol=UNIT)
    assert device.registered == 3
    assert not device.running


def test_what_is_asked_of_the_device(device: FakeRealSense) -> None:
    video = RealSense(serial=SERIAL, fps=60, **SIZE)
    assert video.name == f"realsense_{SERIAL}"
    assert not device.started, "nothing before frames are asked for"
    assert len(list(sent(video, 1))) == len(list(sent(video, 1))) == 1
    modes = {"depth": (96, 72, "z16", 60), "color": (96, 72, "rgb8", 60)}
    assert device.started == 2 * [{"serial": SERIAL, **modes}]
    list(sent(RealSense(**SIZE), 1))
    assert "serial" not in device.started[-1]


def test_far_readings_are_none(device: FakeRealSense) -> None:
    [frame] = sent(RealSense(max_depth=2.5, **SIZE), 1)
    assert 2.4 < frame.depth.max() <= 2.5
    [whole] = sent(RealSense(max_depth=0, **SIZE), 1)
    assert whole.depth.max() > 2.9


def test_a_lens_is_undone_where_its_model_is_ours_and_told_where_it_is_not(
    device: FakeRealSense, caplog: pytest.LogCaptureFixture
) -> None:
    device.coeffs = [0.1, -0.05, 0.01, 0.02, 0.001]
    [as_it_is] = sent(RealSense(**SIZE), 1)
    np.testing.assert_array_equal(as_it_is.color, CornerRoom()[0].color)
    [said] = caplog.messages
    assert said == f"realsense: its lens distortion, {INVERSE}, is of another model than ours and is not undone"
    device.model = BROWN
    [undone] = sent(RealSense(**SIZE), 1)
    lens = Undistortion(CAMERA, Distortion(*device.coeffs))
    np.testing.assert_array_equal(undone.color, lens.smooth(CornerRoom()[0].color))
    np.testing.assert_allclose(undone.depth, lens.exact(CornerRoom()[0].depth), atol=UNIT)
    assert len(caplog.messages) == 1


def test_a_missing_package_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(ConfigError, match=r"^pyrealsense2, .* is not there: pip install instancemap\[realsense\]$"):
        next(RealSense().frames())


@pytest.mark.parametrize(
    ("parameters", "plugged_in", "said"),
    [
        ({}, False, "a device with 96x72 at 30 Hz could not be started: No device connected"),
        ({"serial": "999"}, True, "the device 999 with 96x72 at 30 Hz could not be started: No device connected"),
        ({"width": 640}, True, "a device with 640x72 at 30 Hz could not be started: Couldn't resolve requests"),
    ],
)
def test_a_device_that_cannot_be_started_is_one_line(
    device: FakeRealSense, parameters: dict[str, int], plugged_in: bool, said: str
) -> None:
    device.plugged_in = plugged_in
    with pytest.raises(DataError) as caught:
        next(RealSense(**SIZE | parameters).frames())  # type: ignore[arg-type]
    assert str(caught.value) == f"RealSense: {said}"


def test_a_cable_that_is_pulled_out_ends_it(device: FakeRealSense, monkeypatch: pytest.MonkeyPatch) -> None:
    device.unplugged_at = 2
    with pytest.raises(DataError, match="RealSense: Device disconnected"):
        list(sent(RealSense(**SIZE), 3))
    assert not device.running
    device.unplugged_at = -1
    monkeypatch.setattr(realsense, "LONGEST_SILENCE", 0.3)
    with pytest.raises(DataError, match=r"no frame has come for 0\.3 s"):
        list(sent(RealSense(**SIZE), 9))
    assert not device.running


def test_it_says_something_while_nothing_comes(device: FakeRealSense) -> None:
    device.frames = 0
    with closing(RealSense(**SIZE).frames()) as readers:
        assert [next(readers), next(readers)] == [None, None]


def test_a_frame_without_depth_is_of_no_use_and_the_next_one_is(device: FakeRealSense) -> None:
    device.without_depth = 1
    with closing(RealSense(**SIZE).frames()) as readers:
        first, second, third = (next(readers) for _ in range(3))
    assert None not in (first, second, third)
    with pytest.raises(FrameError, match="frame 1: the camera has sent no depth"):
        second()
    assert [first().index, third().index] == [0, 2]


@pytest.mark.parametrize("parameter", [{"width": 0}, {"height": 10_000}, {"fps": 0}, {"max_depth": -1.0}], ids=str)
def test_parameters_have_bounds(parameter: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=next(iter(parameter))):
        RealSense(**parameter)  # type: ignore[arg-type]

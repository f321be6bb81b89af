"""Tests for depth cameras with fake vendor libraries."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from framework.data import Frame
from framework.datasets.calibration.undistortion import Distortion, Undistortion
from framework.datasets.cameras import device_frames
from framework.datasets.cameras.orbbec import Orbbec
from framework.datasets.cameras.realsense import RealSense
from framework.errors import ConfigError, DataError, FrameError
from framework.interfaces import LiveVideo
from framework.sensors.noise_models import SensorChoice, SensorKind
from tests.support.scenes.corner_room import CAMERA, CornerRoom
from tests.support.scenes.fake_cameras import (
    DEPTH_AFTER_COLOR_US,
    SERIAL,
    UNIT,
    FakeCamera,
    orbbec_module,
    realsense_module,
)


@dataclass(frozen=True)
class Brand:
    """Camera reader with the fake of its vendor library."""

    name: str
    reader: type[RealSense] | type[Orbbec]
    library: str
    module: Callable[[FakeCamera], ModuleType]
    depth_size: tuple[int, int]  # requested width and height, px; 0 = any
    nothing_there: str  # expected error without a connected device

    def video(self, **parameters: object) -> LiveVideo:
        size = {"width": CAMERA.width, "height": CAMERA.height}
        return self.reader(**size | parameters)  # type: ignore[arg-type]


BRANDS = [
    Brand("realsense", RealSense, "pyrealsense2", realsense_module, (96, 72), "No device connected"),
    Brand("orbbec", Orbbec, "pyorbbecsdk", orbbec_module, (0, 0), "no device is connected"),
]


@pytest.fixture(params=BRANDS, ids=lambda brand: brand.name)
def brand(request: pytest.FixtureRequest) -> Brand:
    brand: Brand = request.param
    return brand


@pytest.fixture
def device(brand: Brand, monkeypatch: pytest.MonkeyPatch) -> FakeCamera:
    camera = FakeCamera()
    monkeypatch.setitem(sys.modules, brand.library, brand.module(camera))
    return camera


def sent(video: LiveVideo, frames: int) -> Generator[Frame]:
    with closing(video.frames()) as readers:
        for reader in islice((reader for reader in readers if reader), frames):
            yield reader()


def test_camera_frames_are_registered_to_color(brand: Brand, device: FakeCamera) -> None:
    found = list(sent(brand.video(), 3))
    assert [frame.index for frame in found] == [0, 1, 2]
    for frame, true in zip(found, CornerRoom(), strict=False):
        assert frame.camera == CAMERA
        np.testing.assert_array_equal(frame.color, true.color)
        np.testing.assert_allclose(frame.depth, true.depth, atol=UNIT)
    assert device.registered == 3
    assert not device.running


def test_camera_stream_request_matches_parameters(brand: Brand, device: FakeCamera) -> None:
    video = brand.video(serial=SERIAL, fps=60)
    assert video.name == f"{brand.name}_{SERIAL}"
    assert not device.started, "expected no started stream before the first frame is requested"
    assert len(list(sent(video, 1))) == len(list(sent(video, 1))) == 1
    for asked in device.started:
        assert asked["color"] == (96, 72, "rgb", 60)
        assert asked["depth"] == (*brand.depth_size, "depth", 60)
    assert len(device.started) == 2


def test_camera_depth_beyond_max_depth_is_invalid(brand: Brand, device: FakeCamera) -> None:
    [frame] = sent(brand.video(max_depth=2.5), 1)
    assert 2.4 < frame.depth.max() <= 2.5
    [whole] = sent(brand.video(max_depth=0.0), 1)
    assert whole.depth.max() > 2.9


def test_camera_images_are_undistorted_for_supported_model_only(
    brand: Brand, device: FakeCamera, caplog: pytest.LogCaptureFixture
) -> None:
    device.coeffs = (0.1, -0.05, 0.01, 0.02, 0.001)
    [as_it_is] = sent(brand.video(), 1)
    np.testing.assert_array_equal(as_it_is.color, CornerRoom()[0].color)
    expected = f"{brand.name}: expected Brown-Conrady lens distortion (k1, k2, p1, p2, k3), got inverse with the "
    assert [message.startswith(expected) for message in caplog.messages] == [True]
    device.model = "brown"
    [undone] = sent(brand.video(), 1)
    lens = Undistortion(CAMERA, Distortion(*device.coeffs))
    np.testing.assert_array_equal(undone.color, lens.smooth(CornerRoom()[0].color))
    np.testing.assert_allclose(undone.depth, lens.exact(CornerRoom()[0].depth), atol=UNIT)
    assert len(caplog.messages) == 1


def test_camera_missing_package_raises_one_line_error(brand: Brand, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, brand.library, None)
    with pytest.raises(
        ConfigError,
        match=rf"^{brand.library}: expected an installed package .*, .* pip install 'instancemap\[{brand.name}\]'$",
    ):
        next(brand.video().frames())


def test_camera_missing_device_raises_one_line_error(brand: Brand, device: FakeCamera) -> None:
    device.plugged_in = False
    with pytest.raises(DataError, match=f"device with 96x72 at 30 Hz, got an error .{brand.nothing_there}.;"):
        next(brand.video().frames())


@pytest.mark.parametrize(
    ("parameters", "message"),
    [({"serial": "999"}, "expected device 999 with 96x72"), ({"width": 640}, "expected a device with 640x72")],
)
def test_camera_unsupported_request_raises_one_line_error(
    brand: Brand, device: FakeCamera, parameters: dict[str, object], message: str
) -> None:
    with pytest.raises(DataError, match=f"{message} at 30 Hz, got an error ") as caught:
        next(brand.video(**parameters).frames())
    assert "\n" not in str(caught.value)
    assert not device.running


def test_camera_disconnect_raises_and_stops_stream(
    brand: Brand, device: FakeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    device.unplugged_at = 2
    with pytest.raises(DataError, match="Device disconnected"):
        list(sent(brand.video(), 3))
    assert not device.running
    device.unplugged_at = -1
    monkeypatch.setattr(device_frames, "LONGEST_SILENCE", 0.3)
    with pytest.raises(DataError, match=r"expected a frame within 0\.3 s, got none"):
        list(sent(brand.video(), 9))
    assert not device.running


def test_camera_pauses_below_timeout_are_tolerated(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now=100.0, monotonic=lambda: clock.now)
    monkeypatch.setattr(device_frames, "time", clock)
    received: list[str | None] = []
    coming = iter(["first", None, "second", None, "third", None, None])
    with pytest.raises(DataError, match="it: expected a frame within 5 s, got none"):  # noqa: PT012
        for images in device_frames.images_of("it", lambda: next(coming)):
            received.append(images)
            clock.now += 3.0
    assert received == ["first", None, "second", None, "third", None]


def test_camera_idle_device_yields_none(brand: Brand, device: FakeCamera) -> None:
    device.frames = 0
    with closing(brand.video().frames()) as readers:
        assert [next(readers), next(readers)] == [None, None]


def test_camera_missing_depth_raises_for_its_frame_only(brand: Brand, device: FakeCamera) -> None:
    device.without_depth = 1
    with closing(brand.video().frames()) as readers:
        first, second, third = (reader for reader in (next(readers) for _ in range(3)) if reader)
    with pytest.raises(FrameError, match="frame 1: expected color and depth, got no depth"):
        second()
    assert [first().index, third().index] == [0, 2]


def test_orbbec_waits_for_first_depth_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """The depth unit is only known from the first depth frame."""
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", orbbec_module(FakeCamera(without_depth=0)))
    [frame] = sent(BRANDS[1].video(), 1)
    np.testing.assert_allclose(frame.depth, CornerRoom()[1].depth, atol=UNIT)


@pytest.mark.parametrize("parameter", [{"width": 0}, {"height": 10_000}, {"fps": 0}, {"max_depth": -1.0}], ids=str)
def test_camera_parameter_out_of_range_raises(brand: Brand, parameter: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=next(iter(parameter))):
        brand.video(**parameter)


def test_camera_frame_has_time_of_depth_image(brand: Brand, device: FakeCamera) -> None:
    [frame] = sent(brand.video(), 1)
    assert frame.color_time == frame.timestamp
    assert frame.depth_time - frame.color_time == pytest.approx(1e-6 * DEPTH_AFTER_COLOR_US, abs=1e-6)


@pytest.mark.parametrize(
    ("module", "reader", "library", "name", "kind"),
    [
        (realsense_module, RealSense, "pyrealsense2", "Intel RealSense D455", SensorKind.REALSENSE_D435),
        (realsense_module, RealSense, "pyrealsense2", "Intel RealSense L515", SensorKind.TIME_OF_FLIGHT),
        (realsense_module, RealSense, "pyrealsense2", "a camera", SensorKind.REALSENSE_D435),
        (orbbec_module, Orbbec, "pyorbbecsdk", "Orbbec Femto Mega", SensorKind.TIME_OF_FLIGHT),
        (orbbec_module, Orbbec, "pyorbbecsdk", "Orbbec Gemini 2", SensorKind.REALSENSE_D435),
        (orbbec_module, Orbbec, "pyorbbecsdk", "a camera", SensorKind.KINECT_V1),
    ],
)
def test_camera_device_name_determines_sensor(
    module, reader, library, name, kind, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, module(FakeCamera(name=name)))
    [frame] = sent(reader(width=CAMERA.width, height=CAMERA.height), 1)
    assert frame.sensor is kind


def test_camera_sensor_parameter_overrides_device(brand: Brand, device: FakeCamera) -> None:
    [frame] = sent(brand.video(sensor=SensorChoice.EXACT), 1)
    assert frame.sensor is SensorKind.EXACT

"""Fake libraries of depth cameras, with a camera in the corner room.

The fakes contain only what the readers use. Names, arguments and return values are those of pyrealsense2 2.59 and
pyorbbecsdk2 2.1.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from tests.support.scenes.corner_room import CAMERA, CornerRoom

UNIT = 0.00025  # unit of the stored depth, m
SERIAL = "0123456789"
DEPTH_AFTER_COLOR_US = 4000  # time from the color to the depth image, microseconds


@dataclass
class FakeCamera:
    """Connected camera with configurable errors."""

    plugged_in: bool = True
    coeffs: tuple[float, ...] = (0.0,) * 5  # lens distortion: k1, k2, p1, p2, k3
    model: str = "inverse"  # lens model; brown = supported
    name: str = "a camera"  # name of the device
    frames: int = 4  # number of frames before the camera stops sending
    unplugged_at: int = -1  # index of the frame at which the library raises; -1 = never
    without_depth: int = -1  # index of the frame without depth; -1 = none
    running: bool = False
    started: list[dict[str, Any]] = field(default_factory=list)  # requested streams of each start
    registered: int = 0  # number of registered image pairs

    def start(self, asked: dict[str, Any]) -> None:
        assert not self.running
        self.running = True
        self.started.append(asked)
        self.sent = 0

    def stop(self) -> None:
        assert self.running
        self.running = False

    def wait(self, timeout_ms: int) -> _Images | None:
        assert self.running
        assert timeout_ms <= 100
        if self.sent == self.frames:
            time.sleep(1e-3 * timeout_ms)
            return None
        self.sent += 1
        return _Images(self, self.sent - 1)


@dataclass
class _Images:
    """Frame set of both libraries."""

    camera: FakeCamera
    k: int
    registered: bool = False

    def get_color_frame(self) -> SimpleNamespace:
        return _image(CornerRoom()[self.k].color)

    def get_depth_frame(self) -> SimpleNamespace | None:
        if self.k == self.camera.without_depth:
            return None
        shift = 0 if self.registered else 5
        return _image(np.round(CornerRoom()[self.k].depth / UNIT).astype(np.uint16), shift, DEPTH_AFTER_COLOR_US)

    def of_color(self) -> _Images:
        self.camera.registered += 1
        return _Images(self.camera, self.k, registered=True)

    def as_frame_set(self) -> _Images:
        return self


def _image(pixels: np.ndarray, shift: int = 0, time_us: int = 0) -> SimpleNamespace:
    """Return an image of both libraries. `shift`, px, moves depth as if it were not registered to color."""
    pixels = np.roll(pixels, shift, axis=1)
    pixels.setflags(write=False)  # read-only like an image that the library owns
    height, width = pixels.shape[:2]
    return SimpleNamespace(
        get_data=lambda: pixels,
        get_width=lambda: width,
        get_height=lambda: height,
        get_depth_scale=lambda: 1000 * UNIT,
        get_frame_timestamp_domain=lambda: "hardware",
        get_timestamp=lambda: 1e-3 * time_us,  # ms
        get_timestamp_us=lambda: time_us,
    )


def realsense_module(camera: FakeCamera) -> ModuleType:
    """Return the fake of `pyrealsense2`."""

    class Config:
        def __init__(self) -> None:
            self.asked: dict[str, Any] = {}

        def enable_device(self, serial: str) -> None:
            self.asked["serial"] = serial

        def enable_stream(self, stream_type: str, width: int, height: int, format: str, framerate: int) -> None:
            self.asked[stream_type] = (width, height, format, framerate)

    class Pipeline:
        def start(self, config: Config) -> SimpleNamespace:
            if not camera.plugged_in or config.asked.get("serial", SERIAL) != SERIAL:
                raise RuntimeError("No device connected")
            if config.asked["color"][:2] != (CAMERA.width, CAMERA.height):
                raise RuntimeError("Couldn't resolve requests")
            camera.start(config.asked)
            intrinsics = SimpleNamespace(
                width=CAMERA.width, height=CAMERA.height, fx=CAMERA.fx, fy=CAMERA.fy, ppx=CAMERA.cx, ppy=CAMERA.cy,
                coeffs=list(camera.coeffs), model=camera.model,
            )  # fmt: skip
            color = SimpleNamespace(as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: intrinsics))
            sensor = SimpleNamespace(get_depth_scale=lambda: UNIT)
            return SimpleNamespace(
                get_stream={"color": color}.__getitem__,
                get_device=lambda: SimpleNamespace(
                    first_depth_sensor=lambda: sensor, get_info={"name": camera.name}.__getitem__
                ),
            )

        def try_wait_for_frames(self, timeout_ms: int = 5000) -> tuple[bool, _Images | None]:
            if getattr(camera, "sent", 0) == camera.unplugged_at:
                raise RuntimeError("Device disconnected")
            images = camera.wait(timeout_ms)
            return images is not None, images

        def stop(self) -> None:
            camera.stop()

    def align(align_to: str) -> SimpleNamespace:
        assert align_to == "color"
        return SimpleNamespace(process=_Images.of_color)

    return _module(
        "pyrealsense2",
        stream=SimpleNamespace(depth="depth", color="color"),
        format=SimpleNamespace(z16="depth", rgb8="rgb"),
        camera_info=SimpleNamespace(name="name"),
        distortion=SimpleNamespace(brown_conrady="brown", inverse_brown_conrady="inverse"),
        config=Config,
        pipeline=Pipeline,
        align=align,
    )


def orbbec_module(camera: FakeCamera) -> ModuleType:
    """Return the fake of `pyorbbecsdk`."""

    class OBError(Exception):
        pass

    device = SimpleNamespace(get_device_info=lambda: SimpleNamespace(get_name=lambda: camera.name))

    def device_of(serial: str) -> SimpleNamespace:
        if serial != SERIAL:
            raise OBError(f"Device not found by serial number: {serial}")
        return device

    devices = SimpleNamespace(
        get_count=lambda: int(camera.plugged_in),
        get_device_by_index=lambda index: device,
        get_device_by_serial_number=device_of,
    )

    class Config:
        def __init__(self) -> None:
            self.asked: dict[str, Any] = {}

        def enable_stream(self, profile: SimpleNamespace) -> None:
            self.asked[profile.sensor] = profile.asked

        def set_frame_aggregate_output_mode(self, mode: str) -> None:
            assert mode == "both"

    class Pipeline:
        def __init__(self, given: SimpleNamespace) -> None:
            assert given is device

        def get_stream_profile_list(self, sensor: str) -> SimpleNamespace:
            def profile(width: int, height: int, format: str, fps: int) -> SimpleNamespace:
                if (width, height) not in ((0, 0), (CAMERA.width, CAMERA.height)):
                    raise OBError("Couldn't resolve requests")
                k1, k2, p1, p2, k3 = camera.coeffs
                lens = SimpleNamespace(k1=k1, k2=k2, p1=p1, p2=p2, k3=k3, k4=0.0, k5=0.0, k6=0.0, model=camera.model)
                asked = width, height, format, fps
                return SimpleNamespace(
                    sensor=sensor, asked=asked, get_intrinsic=lambda: CAMERA, get_distortion=lambda: lens
                )

            return SimpleNamespace(get_video_stream_profile=profile)

        def start(self, config: Config) -> None:
            camera.start(config.asked)

        def wait_for_frames(self, timeout_ms: int) -> _Images | None:
            if camera.sent == camera.unplugged_at:
                raise OBError("Device disconnected")
            return camera.wait(timeout_ms)

        def stop(self) -> None:
            camera.stop()

    def align(align_to_stream: str) -> SimpleNamespace:
        assert align_to_stream == "color"
        return SimpleNamespace(process=_Images.of_color)

    return _module(
        "pyorbbecsdk",
        OBError=OBError,
        OBSensorType=SimpleNamespace(COLOR_SENSOR="color", DEPTH_SENSOR="depth"),
        OBFormat=SimpleNamespace(RGB="rgb", Y16="depth"),
        OBStreamType=SimpleNamespace(COLOR_STREAM="color"),
        OBFrameAggregateOutputMode=SimpleNamespace(FULL_FRAME_REQUIRE="both"),
        OBCameraDistortionModel=SimpleNamespace(BROWN_CONRADY="brown"),
        Context=lambda: SimpleNamespace(query_devices=lambda: devices),
        Pipeline=Pipeline,
        Config=Config,
        AlignFilter=align,
    )


def _module(name: str, **content: object) -> ModuleType:
    module = ModuleType(name)
    vars(module).update(content)
    return module

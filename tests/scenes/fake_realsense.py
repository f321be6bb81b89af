"""A module like pyrealsense2, with a camera in the corner room: what dataset=realsense asks of it, and no more.

Names and signatures are those of pyrealsense2 2.59. The camera's depth has units of a quarter of a millimetre.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from tests.scenes.corner_room import CAMERA, CornerRoom

UNIT = 0.00025  # m
SERIAL = "0123456789"
BROWN, INVERSE = "distortion.brown_conrady", "distortion.inverse_brown_conrady"


@dataclass
class FakeRealSense:
    """The camera that is plugged in, and what happens to it."""

    plugged_in: bool = True
    coeffs: list[float] = field(default_factory=lambda: [0.0] * 5)
    model: str = INVERSE
    frames: int = 4  # then it sends nothing more
    unplugged_at: int = -1  # the frame at which the library raises; -1 = never
    without_depth: int = -1  # this frame has no depth; -1 = none
    running: bool = False
    started: list[dict[str, Any]] = field(default_factory=list)  # what each start asked for
    registered: int = 0  # framesets

    def module(self) -> ModuleType:
        """What `import pyrealsense2` finds."""
        found = ModuleType("pyrealsense2")
        vars(found).update(
            stream=SimpleNamespace(depth="depth", color="color"),
            format=SimpleNamespace(z16="z16", rgb8="rgb8"),
            distortion=SimpleNamespace(brown_conrady=BROWN, inverse_brown_conrady=INVERSE),
            config=_Config,
            pipeline=lambda: _Pipeline(self),
            align=lambda align_to: _Align(self, align_to),
        )
        return found


class _Config:
    def __init__(self) -> None:
        self.asked: dict[str, Any] = {}

    def enable_device(self, serial: str) -> None:
        self.asked["serial"] = serial

    def enable_stream(self, stream_type: str, width: int, height: int, format: str, framerate: int) -> None:
        self.asked[stream_type] = (width, height, format, framerate)


class _Pipeline:
    def __init__(self, device: FakeRealSense) -> None:
        self.device = device

    def start(self, config: _Config) -> SimpleNamespace:
        device, asked = self.device, config.asked
        if not device.plugged_in or asked.get("serial", SERIAL) != SERIAL:
            raise RuntimeError("No device connected")
        if asked["depth"][:2] != (CAMERA.width, CAMERA.height):
            raise RuntimeError("Couldn't resolve requests")
        assert not device.running
        device.running = True
        device.started.append(asked)
        self.coming = deque(range(device.frames))
        intrinsics = SimpleNamespace(
            width=CAMERA.width, height=CAMERA.height, fx=CAMERA.fx, fy=CAMERA.fy, ppx=CAMERA.cx, ppy=CAMERA.cy
        )
        intrinsics.coeffs, intrinsics.model = device.coeffs, device.model
        color = SimpleNamespace(as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: intrinsics))
        sensor = SimpleNamespace(get_depth_scale=lambda: UNIT)
        return SimpleNamespace(
            get_stream={"color": color}.__getitem__,
            get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor),
        )

    def try_wait_for_frames(self, timeout_ms: int = 5000) -> tuple[bool, _Images]:
        assert self.device.running
        assert timeout_ms <= 100
        if not self.coming:
            time.sleep(1e-3 * timeout_ms)
            return False, _Images(self.device, -1)
        k = self.coming.popleft()
        if k == self.device.unplugged_at:
            raise RuntimeError("Device disconnected. Failed to reconnect")
        return True, _Images(self.device, k)

    def stop(self) -> None:
        assert self.device.running
        self.device.running = False


@dataclass
class _Images:
    device: FakeRealSense
    k: int
    registered: bool = False

    def get_color_frame(self) -> _Image:
        return _Image(CornerRoom()[self.k].color)

    def get_depth_frame(self) -> _Image | None:
        assert self.registered, "of another camera than the colour"
        if self.k == self.device.without_depth:
            return None
        return _Image(np.round(CornerRoom()[self.k].depth / UNIT).astype(np.uint16))


@dataclass
class _Image:
    pixels: np.ndarray

    def get_data(self) -> np.ndarray:
        self.pixels.setflags(write=False)  # it is the library's
        return self.pixels


@dataclass
class _Align:
    device: FakeRealSense
    align_to: str

    def process(self, images: _Images) -> _Images:
        assert self.align_to == "color"
        self.device.registered += 1
        return _Images(images.device, images.k, registered=True)

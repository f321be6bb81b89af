"""Synthetic RGB-D sequences, rendered on demand."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import numpy as np

from framework.config.validation import require
from framework.data import Camera, Float32, Float64, Frame, FrameTruth, Int32, SceneTruth
from framework.datasets.frames.conventions import AUTO, LONGEST_COLOR_DELAY, color_delay_of
from framework.datasets.frames.sequence_reader import TO_THE_END, check_selection, choose_frames
from framework.datasets.ground_truth.scene_truth import LabeledDepth, check_truth_voxel, fuse_scene_truth
from framework.detection.domain import RENDERED_ROOMS
from framework.errors import ConfigError
from framework.interfaces import RGBDSequence
from framework.sensors.noise_models import SensorChoice, SensorKind
from framework.synthetic.dynamics import Dynamics, MovingObject, in_front, opening_door, walking_person
from framework.synthetic.renderer import Renderer, Rendering, cast_ids
from framework.synthetic.rgbd_camera import DepthSensor, noisy_color
from framework.synthetic.room import RoomKind, furnish, shell_structure
from framework.synthetic.surfaces import Surfaces, assemble
from framework.synthetic.walk import FRAME_RATE, plan_path

MAX_FRAMES = 10**6  # nine hours at 30 Hz
MAX_SIDE = 5792  # px, maximum width and height; its square is just below MAX_PIXELS
FOCAL_LENGTH = 525.0 / 640  # fraction of the image width, as in the color camera of a Kinect
TRUTH_VIEWS = 60  # maximum number of frames for the ground-truth surface; views of neighboring frames are nearly equal


@dataclass
class Synthetic(RGBDSequence):
    """RGB-D sequence of a hand-held camera in a random furnished room.

    Frames are bit-identical for equal parameters, in any order and from any thread. `room.surfaces` is the exact
    geometry.
    """

    seed: int = 0  # seed of the scene and the camera path, >= 0; combined with the scene name
    scene: str = "room0"  # name of the scene; every name gives a different scene
    kind: RoomKind = RoomKind.STUDIO  # type of room; a studio contains all nine classes
    frames: int = 240  # number of frames, at 30 Hz, >= 1
    width: int = 640  # width of the images, px, >= 16
    height: int = 480  # height of the images, px, >= 16
    sensor: SensorChoice = SensorChoice.AUTO  # kind of the depth sensor; AUTO = KINECT_V1, or EXACT without noise
    noise: float = 1.0  # scale of the sensor noise, >= 0; 0 = none, 1 = noise model of the sensor
    max_depth: float = 6.0  # maximum depth of the sensor, m, > 0
    # change during the sequence: a walking person, a door that opens, lights that change, or a camera that stops
    dynamics: Dynamics = Dynamics.NONE
    # simulated delay of color relative to depth at equal timestamps, s, in [-0.2, 0.2]; positive = color captured later
    simulated_color_delay: float = 0.0
    # delay of color relative to depth assumed by the pipeline, s, in [-0.2, 0.2]; positive = color captured later; AUTO
    # = estimated during the run, 0 until then
    color_delay: str = AUTO
    start: int = 0  # index of the first frame
    stop: int = TO_THE_END  # index of the first frame after the selection, >= 0; -1 = end of the sequence
    stride: int = 1  # step between selected frames, in frames, >= 1; 1 = every frame
    frame_fraction: float = 1.0  # randomly selected fraction of the frames, in (0, 1]; 1 = all frames
    ground_truth_spacing: float = 0.02  # spacing of the ground-truth surface points, m, in [0.001, 1]
    domain = RENDERED_ROOMS

    def __post_init__(self) -> None:
        check_selection(self.start, self.stop, self.stride, self.frame_fraction)
        bounds = {"frames": (1, MAX_FRAMES), "width": (16, MAX_SIDE), "height": (16, MAX_SIDE)}
        for name, (lowest, most) in bounds.items():
            if not lowest <= getattr(self, name) <= most:
                raise ConfigError(f"dataset.{name}: expected a value in [{lowest}, {most}], got {getattr(self, name)}")
        if self.seed < 0:
            raise ConfigError(f"seed: expected at least 0, got {self.seed}")
        if not (math.isfinite(self.noise) and self.noise >= 0):
            raise ConfigError(f"dataset.noise: expected 0 (exact) or a positive value, got {self.noise}")
        if not self.max_depth > 0:
            raise ConfigError(f"dataset.max_depth: expected a value > 0 m, got {self.max_depth}")
        delay, limit = self.simulated_color_delay, LONGEST_COLOR_DELAY
        require(abs(delay) <= limit, "dataset.simulated_color_delay", delay, f"a value in [-{limit:g}, {limit:g}] s")
        color_delay_of(self.color_delay)
        check_truth_voxel(self.ground_truth_spacing)
        self._chosen = choose_frames(self.frames, self.start, self.stop, self.stride, self.frame_fraction, self.seed)
        self.name = self.scene
        focal = FOCAL_LENGTH * self.width
        self.camera = Camera(self.width, self.height, focal, focal, (self.width - 1) / 2, (self.height - 1) / 2)
        self._stream = zlib.crc32(self.scene.encode())  # each scene has its own random stream
        rng = np.random.default_rng([self.seed, self._stream])
        self.room = furnish(self.kind, rng)
        self.class_names = dict(self.room.surfaces.class_names)
        self.moving: MovingObject | None = None  # object that moves; None = none
        static = self.room.surfaces
        if self.dynamics is Dynamics.DOOR:
            static, self.moving = self._with_opening_door()
        self._renderer = Renderer(static, list(self.room.lamps))
        self.sensor_kind = self.sensor.kind(SensorKind.KINECT_V1 if self.noise else SensorKind.EXACT)
        self._sensor = DepthSensor(self.noise, self.max_depth, self.sensor_kind)
        wanted = {i for i, name in self.class_names.items() if name is not None}
        small = Camera(80, 60, FOCAL_LENGTH * 80, FOCAL_LENGTH * 80, 39.5, 29.5)
        self.path = plan_path(
            self.room.layout,
            self.frames,
            lambda T_world_camera: cast_ids(static, self._renderer.caster, small, T_world_camera),
            wanted,
            rng,
        )
        self._frame_names = self.class_names
        if self.dynamics is Dynamics.PERSON:
            instance = max(self.class_names) + 1
            self.moving = walking_person(instance, self.path, self.frames, rng)
            self._frame_names = self.class_names | dict(self.moving.surfaces.class_names)

    def _with_opening_door(self) -> tuple[Surfaces, MovingObject]:
        """Return the room without the leaf of its door, and the leaf."""
        instance, door = next((i, piece) for i, piece in self.room.objects if piece.kind == "door")
        frame, leaf = opening_door(instance, door)
        return assemble((i, frame if i == instance else piece) for i, piece in self.room.objects), leaf

    def __len__(self) -> int:
        return len(self._chosen)

    def constant_color_delay(self) -> float | None:
        return color_delay_of(self.color_delay)

    def __getitem__(self, k: int) -> Frame:
        index = self._chosen[k]
        picture = seen = self._rendering(index)
        if self.simulated_color_delay:
            seen = self._rendering(index + self.simulated_color_delay * FRAME_RATE)
        rng = np.random.default_rng([self.seed, self._stream, index])
        depth = self._sensor.measure(picture.depth, picture.incidence, self.camera, rng)
        return Frame(
            index=index,
            timestamp=index / FRAME_RATE,
            color=noisy_color(seen.color, self.noise, rng),
            depth=depth,
            camera=self.camera,
            T_world_camera=self._pose(index),
            truth=FrameTruth(seen.instance_ids, self._frame_names),
            sensor=self.sensor_kind,
        )

    def _pose(self, frame: float) -> Float64:
        """Return the camera pose T_world_camera (4, 4) at a frame."""
        return self.path.pose(self.dynamics.camera_frame(frame))

    def _rendering(self, frame: float) -> Rendering:
        """Return the images at a frame, without noise."""
        T_world_camera, brightness = self._pose(frame), self.dynamics.brightness(frame)
        room = self._renderer.render(self.camera, T_world_camera, brightness=brightness)
        if self.moving is None:
            return room
        return in_front(self.moving.render(self.camera, T_world_camera, frame, brightness), room)

    def exact_view(self, T_world_camera: Float64) -> tuple[Float32, Int32]:
        """Return the exact depth (H, W), m along z, and the instance ids (H, W) of a view, without moving objects.

        Both are 0 for pixels without a surface.
        """
        return self._renderer.depth_and_ids(self.camera, T_world_camera)

    def scene_truth(self) -> SceneTruth:
        """Return labeled surface points, fused from the exact depth of selected frames."""
        every = max(1, -(-len(self._chosen) // TRUTH_VIEWS))
        chosen = sorted({*self._chosen[::every], self._chosen[-1]})
        views = (self._exact(index) for index in chosen)
        return shell_structure(fuse_scene_truth(views, self.class_names, self.ground_truth_spacing))

    def _exact(self, index: int) -> LabeledDepth:
        T_world_camera = self._pose(index)
        depth, ids = self.exact_view(T_world_camera)
        depth[depth > self.max_depth] = 0
        return LabeledDepth(depth, ids, self.camera, T_world_camera)

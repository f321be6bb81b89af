"""Synthetic RGB-D sequences of buildings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import platformdirs

from framework.config.validation import check_bounds
from framework.data import Camera, Float32, Float64, Frame, FrameTruth, Int32, SceneTruth
from framework.datasets.frames.sequence_reader import TO_THE_END, check_selection, choose_frames
from framework.datasets.ground_truth.scene_truth import LabeledDepth, check_truth_voxel, fuse_scene_truth
from framework.detection.domain import RENDERED_ROOMS
from framework.interfaces import RGBDSequence
from framework.sensors.noise_models import SensorChoice, SensorKind
from framework.synthetic.buildings.building import MIN_ROOMS, plan_building
from framework.synthetic.buildings.building_tour import plan_tour
from framework.synthetic.buildings.rendering_cache import RenderingCache
from framework.synthetic.renderer import Renderer, Rendering
from framework.synthetic.rgbd_camera import DepthSensor, blurred, device_distortion, noisy_color
from framework.synthetic.room import shell_structure
from framework.synthetic.sequence import FOCAL_LENGTH, MAX_FRAMES, MAX_SIDE
from framework.synthetic.walk import FRAME_RATE

EXPOSURE = 1 / 60  # s, exposure time of color images, centered at the time of the pose
TRUTH_STEP = 10  # frames between two views of the ground-truth surface
STREAM = 0x6275696C  # separates these random numbers from others with the same seed


@dataclass
class SyntheticBuilding(RGBDSequence):
    """RGB-D sequence of a hand-held camera on a tour through a random building.

    Frames are bit-identical for equal parameters, in any order and from any thread. `building.surfaces` is the exact
    geometry. Images are rendered once and cached. The cache takes 1.5 GB for 3,000 frames.
    """

    seed: int = 0  # seed of the building, the camera path and the sensor, >= 0
    rooms: int = 8  # number of rooms, in [4, 40]
    designs: int = 5  # number of different designs of rooms, in [1, 40]; 1 = all rooms are identical
    frames: int = 3000  # number of frames, at 30 Hz, >= 1; the tour is repeated after its last frame
    width: int = 640  # width of the images, px, >= 16
    height: int = 480  # height of the images, px, >= 16
    sensor: SensorChoice = SensorChoice.KINECT_V1  # kind of the depth sensor; AUTO = KINECT_V1
    noise: float = 1.0  # scale of the sensor noise, in [0, 10]; 0 = none, 1 = noise model of the sensor
    distortion: float = 1.0  # scale of the fixed depth error of the device, in [0, 10]; 0 = none
    blur: bool = True  # true = simulate motion blur of the color images
    max_depth: float = 5.0  # maximum depth of the sensor, m, in [0.5, 6.5]
    start: int = 0  # index of the first frame
    stop: int = TO_THE_END  # index of the first frame after the selection, >= 0; -1 = end of the sequence
    stride: int = 1  # step between selected frames, in frames, >= 1; 1 = every frame
    frame_fraction: float = 1.0  # randomly selected fraction of the frames, in (0, 1]; 1 = all frames
    ground_truth_spacing: float = 0.02  # spacing of the ground-truth surface points, m, in [0.001, 1]
    cache_dir: str | None = None  # folder of the rendered images; None = the user's cache folder
    domain = RENDERED_ROOMS

    def __post_init__(self) -> None:
        check_selection(self.start, self.stop, self.stride, self.frame_fraction)
        check_bounds(
            self, seed=(0, 2**32 - 1), rooms=(MIN_ROOMS, 40), designs=(1, 40), frames=(1, MAX_FRAMES),
            width=(16, MAX_SIDE), height=(16, MAX_SIDE), noise=(0, 10), distortion=(0, 10), max_depth=(0.5, 6.5),
        )  # fmt: skip
        check_truth_voxel(self.ground_truth_spacing)
        self._chosen = choose_frames(self.frames, self.start, self.stop, self.stride, self.frame_fraction, self.seed)
        self.name = f"building{self.seed}"
        focal = FOCAL_LENGTH * self.width
        self.camera = Camera(self.width, self.height, focal, focal, (self.width - 1) / 2, (self.height - 1) / 2)
        self.building = plan_building(self.rooms, self.designs, (STREAM, self.seed))
        self.class_names = {
            k: piece.class_name for zone in self.building.zones for k, piece in zone.objects if k
        }  # COCO class of each instance, None = clutter
        self.tour = plan_tour(self.building, np.random.default_rng([STREAM, self.seed, 1]))
        self.sensor_kind = self.sensor.kind(SensorKind.KINECT_V1)
        pattern = None
        if self.distortion and self.sensor_kind is not SensorKind.EXACT:
            rng = np.random.default_rng([STREAM, self.seed, 2])
            pattern = np.float32(self.distortion) * device_distortion(self.sensor_kind, self.camera, rng)
        self._sensor = DepthSensor(self.noise, self.max_depth, self.sensor_kind, pattern)
        folder = Path(self.cache_dir or platformdirs.user_cache_path("instancemap", appauthor=False) / "buildings")
        self._cache = RenderingCache(folder, self.seed, self.rooms, self.designs, self.width, self.height)

    def __len__(self) -> int:
        return len(self._chosen)

    def __getitem__(self, k: int) -> Frame:
        index = self._chosen[k]
        exact = self._cache.get(index % self.tour.frames, self._rendering)
        T_world_camera, rng = self.tour.pose(index), np.random.default_rng([STREAM, self.seed, 3, index])
        depth = self._sensor.measure(exact.depth, exact.incidence, self.camera, rng, exact.unread)
        color = exact.color
        if self.blur:
            ends = (self.tour.pose(index + half * FRAME_RATE * EXPOSURE) for half in (-0.5, 0.5))
            color = blurred(color, exact.depth, self.camera, T_world_camera, *ends)
        return Frame(
            index=index,
            timestamp=index / FRAME_RATE,
            color=noisy_color(color, self.noise, rng),
            depth=depth,
            camera=self.camera,
            T_world_camera=T_world_camera,
            truth=FrameTruth(exact.instance_ids, self.class_names),
            sensor=self.sensor_kind,
        )

    @cached_property
    def _renderer(self) -> Renderer:
        return Renderer(self.building.surfaces, [], self.building.irradiance())

    @cached_property
    def _unlit(self) -> Renderer:
        """The renderer of depth and ids. The light takes half a minute to compute."""
        surfaces = self.building.surfaces
        return Renderer(surfaces, [], np.zeros_like(surfaces.vertices))

    def _rendering(self, index: int) -> Rendering:
        return self._renderer.render(self.camera, self.tour.pose(index))

    def exact_view(self, T_world_camera: Float64) -> tuple[Float32, Int32]:
        """Return the exact depth (H, W), m along z, and the instance ids (H, W) of a view, 0 = none."""
        return self._unlit.depth_and_ids(self.camera, T_world_camera)

    def scene_truth(self) -> SceneTruth:
        """Return labeled surface points, fused from the exact depth of selected frames."""
        chosen = sorted({*self._chosen[::TRUTH_STEP], self._chosen[-1]})
        views = (self._exact(index) for index in chosen)
        return shell_structure(fuse_scene_truth(views, self.class_names, self.ground_truth_spacing))

    def _exact(self, index: int) -> LabeledDepth:
        T_world_camera = self.tour.pose(index)
        depth, ids = self.exact_view(T_world_camera)
        depth[depth > self.max_depth] = 0
        return LabeledDepth(depth, ids, self.camera, T_world_camera)

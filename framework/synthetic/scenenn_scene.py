"""Scenes of the synthetic benchmark, written in SceneNN's format.

The room frame has z up, and SceneNN's world frame has y up. The output is therefore rotated.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from framework.data import Box, Camera, Float32, Int32
from framework.datasets.scenenn.scene_files import write_trajectory_log
from framework.datasets.scenenn.scenenn_annotation import Annotated, write_annotation
from framework.errors import ConfigError
from framework.files.atomic_write import atomic_write
from framework.files.image_files import write_image
from framework.files.ply import write_ply
from framework.geometry import transform
from framework.synthetic.benchmark import SceneSpec, plan_scene
from framework.synthetic.renderer import Renderer
from framework.synthetic.rgbd_camera import DepthSensor, blurred, noisy_color
from framework.synthetic.rgbd_camera_kernels import MIN_RANGE
from framework.synthetic.room_mesh import visible_mesh
from framework.synthetic.walk import FRAME_RATE
from framework.vocabulary.label_spaces import SCENENN_TO_COCO

GENERATION = 3  # version of the generated rooms; increment it with every change, so that no folder mixes versions
ASUS = Camera(640, 480, 544.47329, 544.47329, 320.0, 240.0)  # SceneNN's intrinsic/asus.ini
NOISE, MAX_RANGE = 1.0, 6.0  # scale of the sensor noise, 1 = Kinect v1; maximum depth of the sensor, m
EXPOSURE = 1 / 60  # s, exposure time of color images, centered at the time of the pose; typical of indoor light
TRUTH_VIEWS = 60  # maximum number of frames for the labeled mesh; views of neighboring frames are nearly equal
MAX_CAMERA_SPEED = 5.0  # maximum camera speed relative to the recommended speed; about 2.2 m/s
LARGEST_ID = 934338  # largest label in SceneNN; labels are not consecutive
PNG = (
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB),
)
"""PNG options for noisy images: no search for repetitions, and one filter for all rows. Encoding takes 10 ms. Files are
at most 5% larger than with slow options."""

T_YUP_ZUP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Rotation from the room frame to SceneNN's world frame. It only swaps and negates coordinates, without rounding."""

_COCO_TO_SCENENN = {coco: name for name, coco in SCENENN_TO_COCO.items()}
_NYU_CLASSES = {
    "cardboard box": "box",
    "ceiling lamp": "lamp",
    "clothes": "clothes",
    "cupboard": "cabinet",
    "cushion": "pillow",
    "door": "door",
    "floor lamp": "lamp",
    "kitchen counter": "counter",
    "low board": "dresser",
    "nightstand": "night stand",
    "picture": "picture",
    "pouf": "otherfurniture",
    "rug": "floor mat",
    "table lamp": "lamp",
    "window": "window",
}
"""NYU class by kind of clutter. Other clutter has a `text`, but no `nyu_class`, as in SceneNN."""


@dataclass(frozen=True)
class BenchmarkSettings:
    """Settings shared by all scenes of a benchmark folder."""

    seed: int = 0
    frames: int = 120  # number of frames of each scene
    rate: float = 10.0  # Hz, frame rate; a low rate limits redundant frames
    width: int = 640  # px; the height is 3/4 of the width
    camera_speed: float = 2.0  # relative to the recommended speed; higher speeds result in fewer views and more blur

    def __post_init__(self) -> None:
        for name, lowest in (("seed", 0), ("frames", 1), ("width", 16)):
            if getattr(self, name) < lowest:
                raise ConfigError(f"--{name}: expected at least {lowest}, got {getattr(self, name)}")
        if not 0 < self.rate <= FRAME_RATE:
            raise ConfigError(f"--rate: expected a value in (0, {FRAME_RATE:.0f}] Hz, got {self.rate}")
        if not 0 < self.camera_speed <= MAX_CAMERA_SPEED:
            raise ConfigError(f"--camera-speed: expected a value in (0, {MAX_CAMERA_SPEED:g}], got {self.camera_speed}")
        if self.width % 4:
            raise ConfigError(f"--width: expected a multiple of 4 px (4:3 aspect ratio), got {self.width}")

    @property
    def camera(self) -> Camera:
        return ASUS.scaled(self.width / ASUS.width)

    @property
    def stride(self) -> float:
        """Camera motion per frame, relative to the recommended speed at FRAME_RATE."""
        return self.camera_speed * FRAME_RATE / self.rate

    @property
    def release(self) -> str:
        """Name of the annotation release."""
        return f"synthetic {GENERATION}, seed {self.seed}, {self.frames} frames"


class SceneNNScene:
    """Writer of a scene."""

    def __init__(self, folder: Path, spec: SceneSpec, recording: BenchmarkSettings) -> None:
        self.folder, self.recording = folder, recording
        for kind in ("image", "depth"):
            (folder / kind).mkdir(parents=True, exist_ok=True)
        self.camera = recording.camera
        self._stream = [recording.seed, zlib.crc32(folder.name.encode())]  # each scene has its own random stream
        scene = plan_scene(spec, self._stream, recording.frames, recording.stride)
        self.room, self.path = scene.room, scene.path
        self.renderer = Renderer(self.room.surfaces, list(self.room.lamps))
        self._sensor = DepthSensor(NOISE, MAX_RANGE)
        ids = 1 + scene.rng.choice(LARGEST_ID, len(self.room.objects), replace=False)
        ids[0] = 0  # the shell is not an instance
        self.labels = ids.astype(np.int32)  # (N + 1,) label in the files by instance id
        self.colors = scene.rng.integers(64, 256, (len(ids), 3))  # RGB by instance id

    def write_frames(self, frames: Sequence[int]) -> int:
        """Write the images of several frames and return the number of frames."""
        for index in frames:
            self.write_frame(index)
        return len(frames)

    def write_frame(self, index: int) -> None:
        """Write the color and depth images of a frame."""
        T_world_camera = self.path.pose(index)
        picture = self.renderer.render(self.camera, T_world_camera)
        rng = np.random.default_rng([*self._stream, index])
        depth = self._sensor.measure(picture.depth, picture.incidence, self.camera, rng, picture.unread)
        ends = (self.path.pose(index + half * self.recording.rate * EXPOSURE) for half in (-0.5, 0.5))
        exposed = blurred(picture.color, picture.depth, self.camera, T_world_camera, *ends)
        color = noisy_color(exposed, NOISE, rng)
        color_file, depth_file = frame_files(self.folder, index)
        write_image(depth_file, np.rint(1000 * depth).astype(np.uint16), *PNG)
        write_image(color_file, cv2.cvtColor(color, cv2.COLOR_RGB2BGR), *PNG)

    def write_truth(self) -> int:
        """Write the labeled mesh and its annotation, and return 0 as the number of frames."""
        frames, name = self.recording.frames, self.folder.name
        every = -(-frames // TRUTH_VIEWS)
        views = (self.path.pose(index) for index in range(0, frames, every))
        caster = self.renderer.caster
        mesh = visible_mesh(self.room.surfaces, caster, self.camera, views, (MIN_RANGE, MAX_RANGE))
        vertices = transform(T_YUP_ZUP, mesh.vertices)
        write_ply(self.folder / f"{name}.ply", vertices, mesh.triangles, {"label": self.labels[mesh.instance_ids]})
        write_annotation(self.folder / f"{name}.xml", self._annotated(vertices, mesh.instance_ids))
        return 0

    def _annotated(self, vertices: Float32, instance_ids: Int32) -> list[Annotated]:
        """Return the annotation of each object in the mesh, sorted by label.

        Args:
            vertices: The vertices (V, 3) in SceneNN's world frame, m.
            instance_ids: The instance ids (V,), 0 = no instance.
        """
        annotated = []
        for instance, piece in self.room.objects[1:]:
            points = vertices[instance_ids == instance].astype(np.float64)
            if not len(points):
                continue
            low, high = points.min(axis=0), points.max(axis=0)
            red, green, blue = self.colors[instance]
            class_name = piece.class_name
            annotated.append(
                Annotated(
                    id=int(self.labels[instance]),
                    text=piece.kind,
                    nyu_class=_NYU_CLASSES.get(piece.kind, "") if class_name is None else _COCO_TO_SCENENN[class_name],
                    color=(int(red), int(green), int(blue)),
                    aabb=np.stack([low, high]),
                    obb=Box((low + high) / 2, high - low, np.eye(3)),  # furniture is aligned with the walls
                )
            )
        return sorted(annotated, key=lambda one: one.id)

    def write_walk(self) -> int:
        """Write the timestamps and the trajectory, and return 0 as the number of frames."""
        frames = range(self.recording.frames)
        with atomic_write(self.folder / "timestamp.txt") as temporary:
            times = [round(1e6 * index / self.recording.rate) for index in frames]
            temporary.write_text("".join(f"{k} {time} {time}\n" for k, time in enumerate(times, start=1)))
        poses = {index: T_YUP_ZUP @ self.path.pose(index) for index in frames}
        write_trajectory_log(trajectory_file(self.folder), poses)
        return 0


def frame_files(folder: Path, index: int) -> tuple[Path, Path]:
    """Return the paths of the color and depth images of a frame."""
    return folder / "image" / f"image{index + 1:05d}.png", folder / "depth" / f"depth{index + 1:05d}.png"


def trajectory_file(folder: Path) -> Path:
    """Return the path of the trajectory of a scene."""
    return folder / "trajectory.log"

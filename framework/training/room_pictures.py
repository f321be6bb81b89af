"""Training images of synthetic rooms, rendered from random poses.

The colors of surfaces are randomized in most images (domain randomization, Tobin et al. 2017), so that a network learns
shapes. The folder of a room contains 000000.jpg, 000000.png (16-bit instance ids), ... and classes.json.
"""

from __future__ import annotations

import multiprocessing
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numba
import numpy as np
from tqdm import tqdm

from framework.data import Bool, Camera, Float64, UInt8
from framework.errors import DataError
from framework.files.atomic_write import sync_folder
from framework.files.image_files import read_color, read_uint16, write_image
from framework.files.json_file import read_json, write_json
from framework.synthetic.layout import CELL
from framework.synthetic.renderer import Renderer
from framework.synthetic.rgbd_camera import noisy_color
from framework.synthetic.room import Room, RoomKind, furnish
from framework.synthetic.walk import look

STREAM = 0x7261_696E  # key of the random streams of rooms; differs from those of all datasets
WIDTH, HEIGHT = 320, 240  # size of the images, px
FOCAL = (0.7, 1.0)  # range of the focal length, in image widths
EYE_HEIGHT = (0.9, 1.75)  # m, range of the camera height
CLEAR = 0.35  # m, minimum distance of the camera to furniture and walls
TINT = 0.5  # logarithm of the maximum brightness factor of a material, and of each of its color channels
TINTED = 0.7  # fraction of the images with changed colors
STUDIOS = 0.5  # probability of RoomKind.STUDIO before a uniform choice among all kinds; some classes occur only there
QUALITY = 93  # JPEG quality of the images
MIN_PIXELS = 100  # px, minimum total area of the objects in an image
TRIES = 20  # maximum number of candidate views for each image


@dataclass(frozen=True)
class Example:
    """A training image with N objects."""

    color: UInt8  # (H, W, 3) RGB
    masks: Bool  # (N, H, W)
    class_names: tuple[str, ...]  # (N,)


def render_rooms(folder: Path, first: int, rooms: int, views: int, processes: int) -> None:
    """Render the images of rooms that do not exist yet.

    Args:
        folder: The output folder.
        first: The number of the first room.
        rooms: The number of rooms.
        views: The number of images per room.
        processes: The number of rendering processes.
    """
    folder.mkdir(parents=True, exist_ok=True)
    missing = [number for number in range(first, first + rooms) if not room_folder(folder, number, views).is_dir()]
    if not missing:
        return
    # Processes are spawned, because threads of numba and OpenCV do not work after a fork.
    workers = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), numba.set_num_threads, (1,))
    with workers, tqdm(total=len(missing), desc="rendering rooms", unit="room", disable=None) as bar:
        for _ in workers.map(partial(render_room, folder, views), missing):
            bar.update()


def room_folder(folder: Path, number: int, views: int) -> Path:
    """Return the folder of a room with this number of images."""
    return folder / f"room_{number:06d}_{views}"


def render_room(folder: Path, views: int, number: int) -> None:
    """Render the images of a room and write them to a new folder atomically.

    Raises:
        DataError: A file cannot be written.
    """
    with tempfile.TemporaryDirectory(dir=folder, prefix=".room_") as unfinished:
        target = Path(unfinished) / "room"
        target.mkdir()
        for k, (color, ids, names) in enumerate(pictures(number, views)):
            bgr = cv2.cvtColor(color, cv2.COLOR_RGB2BGR)
            write_image(target / f"{k:06d}.jpg", bgr, cv2.IMWRITE_JPEG_QUALITY, QUALITY)
            write_image(target / f"{k:06d}.png", ids)
            write_json(target / "classes.json", names)  # also syncs the entries of the images
        room = room_folder(folder, number, views)
        try:
            target.rename(room)
        except OSError:
            if not room.is_dir():  # another process has not rendered the room
                raise
    sync_folder(folder)


def pictures(number: int, views: int) -> Iterator[tuple[UInt8, np.ndarray, dict[int, str]]]:
    """Render random views of a room.

    Args:
        number: The number of the room, which determines its content.
        views: The number of views.

    Yields:
        The color (H, W, 3), the instance ids (H, W), and the COCO class of each instance id.
    """
    rng = np.random.default_rng([STREAM, number])
    kinds = list(RoomKind)
    room = furnish(RoomKind.STUDIO if rng.uniform() < STUDIOS else kinds[int(rng.integers(len(kinds)))], rng)
    names = {i: name for i, name in room.surfaces.class_names.items() if name is not None}
    renderer = Renderer(room.surfaces, list(room.lamps))
    for camera, T_world_camera in _random_views(room, renderer, names, views, rng):
        picture = renderer.render(camera, T_world_camera, _tinted(room.surfaces.material_table, rng))
        yield noisy_color(picture.color, rng.uniform(0, 2), rng), picture.instance_ids.astype(np.uint16), names


def _random_views(
    room: Room, renderer: Renderer, names: Mapping[int, str], views: int, rng: np.random.Generator
) -> Iterator[tuple[Camera, Float64]]:
    """Yield the camera and pose T_world_camera (4, 4) of random views of objects."""
    centers = [_centers(room, [i for i in names if names[i] == name]) for name in sorted(set(names.values()))]
    for _ in range(views):
        for _ in range(TRIES):
            focal = rng.uniform(*FOCAL) * WIDTH
            camera = Camera(WIDTH, HEIGHT, focal, focal, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
            T_world_camera = _view(room, centers, rng)
            _, ids = renderer.depth_and_ids(camera, T_world_camera)
            if np.isin(ids, list(names)).sum() >= MIN_PIXELS:
                break
        yield camera, T_world_camera


def _centers(room: Room, ids: Sequence[int]) -> Float64:
    """Return the centers (N, 3), m, of the bounding boxes of N objects."""
    surfaces = room.surfaces
    corners = [surfaces.vertices[surfaces.triangles[surfaces.instance_ids == i]].reshape(-1, 3) for i in ids]
    return np.array([(c.min(axis=0) + c.max(axis=0)) / 2 for c in corners], np.float64)


def _view(room: Room, centers: Sequence[Float64], rng: np.random.Generator) -> Float64:
    """Return a random pose T_world_camera (4, 4) above free floor, facing roughly towards a random object.

    `centers` contains the centers (N, 3), m, of the objects of each class.
    """
    layout = room.layout
    rows, columns = np.nonzero(layout.free >= CLEAR)
    at = int(rng.integers(len(rows)))
    x, y = (columns[at] + 0.5) * CELL - layout.width / 2, (rows[at] + 0.5) * CELL - layout.depth / 2
    eye = np.array([x, y, rng.uniform(*EYE_HEIGHT)])
    of_class = centers[int(rng.integers(len(centers)))]
    aim = of_class[int(rng.integers(len(of_class)))] - eye
    yaw = np.arctan2(aim[1], aim[0]) + rng.normal(0, 0.3)
    pitch = np.clip(np.arctan2(aim[2], np.hypot(aim[0], aim[1])) + rng.normal(0, 0.15), -0.9, 0.3)
    return look(eye, float(yaw), float(pitch), float(rng.normal(0, 0.05)))


def _tinted(table: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Multiply the colors of each material by random factors in most calls."""
    if rng.uniform() > TINTED:
        return table
    gains = np.exp(rng.uniform(-TINT, TINT, (len(table), 1)) + rng.uniform(-TINT, TINT, (len(table), 3)))
    tinted = table.copy()
    tinted[:, 1:4] = np.clip(tinted[:, 1:4] * gains, 0, 1)
    tinted[:, 4:7] = np.clip(tinted[:, 4:7] * gains, 0, 1)
    return tinted


class RoomPictures:
    """Training images of rendered rooms, read on demand."""

    def __init__(self, folder: Path, first: int, rooms: int, views: int) -> None:
        self.files: list[Path] = []
        self._names: dict[Path, dict[int, str]] = {}
        for number in range(first, first + rooms):
            room = room_folder(folder, number, views)
            if not room.is_dir():
                raise DataError(f"{room}: expected a rendered room, got no folder; call render_rooms first")
            self.files += sorted(room.glob("*.jpg"))
            classes = read_json(room / "classes.json")
            self._names[room] = {int(i): str(name) for i, name in classes.items()}

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, k: int) -> Example:
        file = self.files[k]
        names = self._names[file.parent]
        ids = read_uint16(file.with_suffix(".png"))
        seen = [i for i in np.unique(ids).tolist() if i in names]
        masks = ids == np.array(seen, np.uint16).reshape(-1, 1, 1)
        return Example(read_color(file), masks, tuple(names[i] for i in seen))

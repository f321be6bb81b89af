"""Pictures of single objects of furnished rooms, with their colour and class in words: what words are learned from.

On disk a room is one file, written whole or not at all: room_000000.npz with crops, colors and classes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from framework.data import Float32, Int32, UInt8
from framework.detection.embeddings.crops import square_crops
from framework.errors import DataError
from framework.files.atomic_write import written_whole
from framework.synthetic.depth_camera import noisy_color
from framework.synthetic.renderer import Renderer
from framework.synthetic.true_colors import NO_NAME, color_counts, color_of_materials, one_color
from framework.training.room_pictures import each_in_a_process, random_room, random_views
from framework.vocabulary.label_spaces import COCO

STREAM = 0x776F_7264  # apart from the streams of all datasets and of room_pictures
SIDE = 64  # px
CONTEXT = (1.05, 1.45)  # what is around the object, as `square_crops` has it
LEAST = 120  # px of an object worth a crop
REPAINTED = 0.6  # share of the pictures whose materials have colours of their own: all classes come in all colours
DULL = 0.35  # share of the repainted materials that are nearly without colour


@dataclass(frozen=True)
class Crops:
    """Pictures of N objects, and what they show."""

    pictures: UInt8  # (N, SIDE, SIDE, 4) RGB, and 255 on the object
    colors: Int32  # (N,) index in COLOR_NAMES, -1 = several, or one without a name
    classes: Int32  # (N,) index in COCO

    def __len__(self) -> int:
        return len(self.pictures)


def render_crops(folder: Path, first: int, rooms: int, views: int, processes: int) -> None:
    """Renders the objects of the rooms number `first` and following; those that are there already are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    missing = [number for number in range(first, first + rooms) if not crops_file(folder, number).is_file()]
    each_in_a_process(partial(render_room_crops, folder, views), missing, processes, "rendering objects")


def crops_file(folder: Path, number: int) -> Path:
    return folder / f"room_{number:06d}.npz"


def render_room_crops(folder: Path, views: int, number: int) -> None:
    """Writes the objects of `views` pictures of room `number`."""
    crops = room_crops(number, views)
    with written_whole(crops_file(folder, number)) as path, path.open("wb") as file:
        np.savez_compressed(file, crops=crops.pictures, colors=crops.colors, classes=crops.classes)


def read_crops(folder: Path, first: int, rooms: int) -> Crops:
    """The objects of rendered rooms. Raises DataError for a room that is not there."""
    parts: list[tuple[UInt8, Int32, Int32]] = []
    for number in range(first, first + rooms):
        path = crops_file(folder, number)
        if not path.is_file():
            raise DataError(f"{path} is missing: render the rooms first")
        with np.load(path, allow_pickle=False) as arrays:
            parts.append((arrays["crops"], arrays["colors"], arrays["classes"]))
    pictures, colors, classes = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Crops(pictures, colors, classes)


def room_crops(number: int, views: int) -> Crops:
    """The objects in `views` random pictures of room `number`."""
    rng = np.random.default_rng([STREAM, number])
    room, names = random_room(rng)
    renderer = Renderer(room.surfaces, list(room.lamps))
    pictures: list[UInt8] = [np.zeros((0, SIDE, SIDE, 4), np.uint8)]
    colors: list[int] = []
    classes: list[int] = []
    for camera, T_world_camera in random_views(room, renderer, names, views, rng):
        table = repainted(room.surfaces.material_table, rng)
        picture = renderer.render(camera, T_world_camera, table)
        color = noisy_color(picture.color, rng.uniform(0, 2), rng)
        ids = picture.instance_ids
        color_of_pixel = np.append(color_of_materials(table), np.int32(NO_NAME))[
            renderer.material_rows(camera, T_world_camera)
        ]
        for i in np.unique(ids).tolist():
            if i not in names or np.count_nonzero(ids == i) < LEAST:
                continue
            pictures.append(square_crops(color, (ids == i)[None], SIDE, rng.uniform(*CONTEXT)))
            colors.append(one_color(color_counts(color_of_pixel, ids, i)))
            classes.append(COCO.index(names[i]))
    return Crops(np.concatenate(pictures), np.array(colors, np.int32), np.array(classes, np.int32))


def repainted(table: Float32, rng: np.random.Generator) -> Float32:
    """The material table with other colours, or as it is.

    All materials have a new colour of any hue; the second colour keeps its relation to the first.
    """
    if rng.uniform() > REPAINTED:
        return table

    n = len(table)
    saturation = np.where(rng.uniform(size=n) < DULL, rng.uniform(0, 0.12, n), rng.uniform(0.25, 0.95, n))
    hsv = np.stack([rng.uniform(0, 360, n), saturation, rng.uniform(0.08, 0.97, n)], axis=1).astype(np.float32)
    srgb = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0]
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    ratio = np.clip(table[:, 4:7].mean(axis=1) / np.maximum(table[:, 1:4].mean(axis=1), 1e-3), 0.4, 1.6)[:, None]
    painted = table.copy()
    painted[:, 1:4] = linear
    painted[:, 4:7] = np.clip(linear * ratio, 0, 1)
    return painted

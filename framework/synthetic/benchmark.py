"""The ten scenes of the synthetic benchmark.

Each of the nine classes occurs in several scenes. Difficult cases are objects on beds and couches (`bedroom`,
`couches`, `student`, `one_room`), rows of identical chairs (`living_chairs`, `meeting`, `kitchen`), and many books
(`books`, `office`). All scenes have clutter without a class.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from framework.data import Camera, Float64, Int32
from framework.errors import DataError
from framework.synthetic.furniture import clutter, fixtures, small_things
from framework.synthetic.furniture.cluttered_groups import (
    board_group,
    chair_row,
    cluttered_bed_group,
    cluttered_couch,
    cluttered_couch_group,
    desk_row,
    laden,
    laid_table_group,
    strew_on,
)
from framework.synthetic.furniture.groups import Group, kitchen_group, single, toilet_group, tv_group
from framework.synthetic.furniture.piece import Rng
from framework.synthetic.ray_caster import RayCaster
from framework.synthetic.renderer import cast_ids
from framework.synthetic.room import Room, furnish_with
from framework.synthetic.walk import CameraPath, plan_path

MIN_ROOM_SIZE = (4.8, 4.2)  # m, width and depth of the smallest candidate room
STREWN = 9  # maximum number of objects on the floor next to furniture
ATTEMPTS = 6  # maximum number of candidate scenes; the scene with the best visibility is kept
JUDGED_VIEWS = 30  # maximum number of views for the visibility score of a scene
# minimum number of pixels of a visible object in a view, and minimum fraction of views in which it is visible
WELL_SEEN, LONG_SEEN = 10, 1 / 6
SMALL_VIEW = Camera(80, 60, 68.0, 68.0, 39.5, 29.5)  # camera of the scored views, with the field of view of a Kinect

MakeGroup = Callable[[Rng], Group]


@dataclass(frozen=True)
class SceneSpec:
    """Specification of a scene.

    All scenes also have a door, a window, a lamp and pictures.
    """

    role: str  # description of the scene in messages
    groups: tuple[MakeGroup, ...]  # furniture groups, placed largest first
    holds: Mapping[str, int]  # minimum number of objects by COCO class


def bag(rng: Rng) -> Group:
    """Return a group with a random backpack."""
    return single("bag", fixtures.backpack(rng))


def cupboard(rng: Rng) -> Group:
    """Return a group with a random cupboard and objects on top."""
    return laden("cupboard", clutter.cupboard(rng), rng)


def kitchen(rng: Rng) -> Group:
    """Return a group with kitchen furniture and an object on top of the refrigerator."""
    group = kitchen_group(rng)
    fridge = next(piece for piece in group.pieces if piece.kind == "refrigerator")
    strew_on(group, fridge, rng, small_things.some(rng, small_things.ON_TOPS, 1))
    return group


def shelf(rng: Rng) -> Group:
    """Return a group with a random shelf."""
    return single("shelf", small_things.shelf(rng))


SCENES: Mapping[str, SceneSpec] = {
    "living_chairs": SceneSpec(
        "living room with a row of identical chairs",
        (cluttered_couch_group, laid_table_group, partial(chair_row, count=4), tv_group),
        {"couch": 1, "chair": 7, "dining table": 2, "tv": 1, "book": 2},
    ),
    "bedroom": SceneSpec(
        "bedroom with a cluttered bed and a cluttered couch",
        (cluttered_bed_group, cluttered_couch, cupboard, shelf, partial(desk_row, count=1)),
        {"bed": 1, "couch": 1, "dining table": 1, "chair": 1, "backpack": 3, "book": 3},
    ),
    "books": SceneSpec(
        "living room with many books",
        (cluttered_couch_group, laid_table_group, board_group, board_group, shelf),
        {"couch": 1, "chair": 3, "dining table": 2, "book": 7, "backpack": 2},
    ),
    "couches": SceneSpec(
        "living room with two cluttered couches",
        (cluttered_couch_group, cluttered_couch, tv_group, shelf, bag, bag),
        {"couch": 2, "dining table": 1, "tv": 1, "backpack": 4, "book": 3},
    ),
    "office": SceneSpec(
        "office with three identical desks and a refrigerator",
        (partial(desk_row, count=3), partial(chair_row, count=2), kitchen, board_group, shelf),
        {"dining table": 3, "chair": 5, "refrigerator": 1, "book": 6, "backpack": 1},
    ),
    "meeting": SceneSpec(
        "office and meeting room with many identical chairs",
        (partial(chair_row, count=4), laid_table_group, partial(desk_row, count=2), tv_group, shelf, bag, bag),
        {"chair": 9, "dining table": 3, "tv": 1, "backpack": 3, "book": 3},
    ),
    "student": SceneSpec(
        "student's room with a cluttered bed",
        (cluttered_bed_group, partial(desk_row, count=1), partial(chair_row, count=2), tv_group, toilet_group, shelf),
        {"bed": 1, "chair": 3, "dining table": 1, "tv": 1, "toilet": 1, "backpack": 2, "book": 4},
    ),
    "one_room": SceneSpec(
        "one-room apartment with a cluttered bed and a cluttered couch",
        (cluttered_bed_group, cluttered_couch_group, partial(desk_row, count=1), toilet_group, shelf),
        {"bed": 1, "couch": 1, "dining table": 2, "chair": 1, "toilet": 1, "backpack": 3, "book": 6},
    ),
    "kitchen": SceneSpec(
        "kitchen with a table, a row of identical chairs and bags",
        (laid_table_group, kitchen, partial(chair_row, count=3), cupboard, bag, bag),
        {"dining table": 1, "chair": 6, "refrigerator": 1, "backpack": 3},
    ),
    "flat": SceneSpec(
        "kitchen with a bed and a toilet",
        (cluttered_bed_group, kitchen, laid_table_group, toilet_group, board_group),
        {"bed": 1, "refrigerator": 1, "dining table": 1, "chair": 3, "toilet": 1, "book": 5},
    ),
}
"""Scene specifications by scene name."""


@dataclass(frozen=True)
class Scene:
    """A furnished room with a camera path."""

    room: Room
    path: CameraPath
    rng: Rng


def plan_scene(spec: SceneSpec, stream: Sequence[int], frames: int, stride: float) -> Scene:
    """Generate random candidates for a scene and return the one with the best visibility of its objects.

    Args:
        spec: The specification of the scene.
        stream: The seed of the random numbers.
        frames: The number of frames of the camera path.
        stride: The camera motion per frame, relative to the recommended speed at FRAME_RATE.

    Raises:
        DataError: No candidate has space for the furniture and the camera path.
    """
    best: Scene | None = None
    most_shown = (-1.0, -1.0)
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([*stream, attempt])
        try:
            scene, shown = _draw_scene(spec, frames, stride, rng)
        except DataError:
            continue
        if shown > most_shown:
            best, most_shown = scene, shown
        if min(shown) == 1:
            break
    if best is None:
        raise DataError(f"{spec.role}: expected a furniture layout, got none in {ATTEMPTS} attempts; set another seed")
    return best


def _draw_scene(spec: SceneSpec, frames: int, stride: float, rng: Rng) -> tuple[Scene, tuple[float, float]]:
    """Return a random scene and the fractions of its classes and of its objects that are visible."""
    room = furnish_scene(spec, rng)
    surfaces = room.surfaces
    caster = RayCaster(surfaces.vertices, surfaces.triangles)
    wanted = {i: name for i, name in surfaces.class_names.items() if name is not None}

    def labels(T_world_camera: Float64) -> Int32:
        return cast_ids(surfaces, caster, SMALL_VIEW, T_world_camera)

    path = plan_path(room.layout, frames, labels, set(wanted), rng, stride)
    views = [labels(path.pose(k)) for k in range(0, frames, -(-frames // JUDGED_VIEWS))]
    seen = [i for i in wanted if np.mean([np.count_nonzero(view == i) >= WELL_SEEN for view in views]) >= LONG_SEEN]
    classes = len({wanted[i] for i in seen}) / len(set(wanted.values()))
    return Scene(room, path, rng), (classes, len(seen) / len(wanted))


def furnish_scene(spec: SceneSpec, rng: Rng) -> Room:
    """Return a random room for a scene specification.

    Raises:
        DataError: The furniture does not fit into the room.
    """
    contents = [make(rng) for make in spec.groups]
    contents += [
        single("door", clutter.door(rng)),
        single("window", clutter.window(rng), z=0.95, hung=True),
        single("lamp", clutter.floor_lamp(rng)),
        single("picture", clutter.painting(rng), z=1.35, hung=True),
        single("picture", clutter.painting(rng), z=1.4, hung=True),
    ]
    strewn = small_things.some(rng, small_things.ON_FLOORS, STREWN)
    return furnish_with(contents, *MIN_ROOM_SIZE, rng, strewn)

"""Places of the endurance run. Each place has its own map and is visited repeatedly."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from framework.api import Mapper, open_dataset
from framework.data import Frame, FrameTruth
from framework.interfaces import RGBDSequence
from framework.sensors.noise_models import SensorKind
from framework.synthetic.renderer import Renderer
from framework.synthetic.rgbd_camera import DepthSensor, noisy_color
from framework.synthetic.room import RoomKind
from framework.synthetic.sequence import Synthetic
from framework.synthetic.surfaces import assemble
from framework.synthetic.walk import FRAME_RATE
from tests.acceptance.runner import CHECKOUT

SHARED = CHECKOUT.parent / "shared" / "data"
PAUSE_S = 10.0  # s, time between two visits
FARTHEST = 10.0  # m, maximum depth of a simulated reading
MOVABLE = ("backpack", "book", "chair")  # classes of the objects that come and go


@dataclass(frozen=True)
class Moment:
    """The position of a frame in the visits of a place."""

    number: int  # number of the frame among all frames of the place
    visit: int  # number of the visit, from 0
    view: int  # view of the place, in [0, views)
    returning: bool  # True on the backward pass

    @property
    def time(self) -> float:
        """Time of the frame, s."""
        return self.number / FRAME_RATE + self.visit * PAUSE_S


class Place(ABC):
    """A place, its frames and the mapper of its map.

    A visit passes all views of the place from the first to the last one and back.
    """

    name: str
    overrides: tuple[str, ...]  # of the mapper

    def __init__(self, views: int) -> None:
        self.views = views  # number of views

    @property
    def visit_frames(self) -> int:
        """Number of frames of a visit."""
        return 2 * self.views

    def mapper(self) -> Mapper:
        """Return a mapper with an empty map."""
        return Mapper(*self.overrides)

    def frame(self, number: int) -> Frame:
        """Return a frame, given its number among all frames of the place. It has a reference pose if one is known."""
        visit, position = divmod(number, self.visit_frames)
        returning = position >= self.views
        return self.frame_at(
            Moment(number, visit, self.visit_frames - 1 - position if returning else position, returning)
        )

    @abstractmethod
    def frame_at(self, moment: Moment) -> Frame:
        """Return the frame of a moment, whose number is its index."""


class Recording(Place):
    """A real recording, played forward and backward."""

    def __init__(self, name: str, sequence: RGBDSequence, views: int, detections: Path) -> None:
        super().__init__(min(views, len(sequence)))
        self.name = name
        self.overrides = ("detection_cache=read_write", f"detection_cache_dir={detections}")
        self._sequence = sequence

    def frame_at(self, moment: Moment) -> Frame:
        frame = self._sequence[moment.view]
        color_late = frame.color_time - frame.depth_time  # s
        return replace(
            frame,
            index=moment.number,
            timestamp=moment.time,
            color_timestamp=moment.time + (-color_late if moment.returning else color_late),
            depth_timestamp=moment.time,
        )


class StandingCamera(Place):
    """A camera that does not move: the first frame of a recording with new sensor noise in each frame."""

    name = "standing"
    overrides = ()

    def __init__(self, sequence: RGBDSequence, views: int) -> None:
        super().__init__(views)
        self._frame = sequence[0]
        self._sensor = DepthSensor(1.0, FARTHEST)

    def frame_at(self, moment: Moment) -> Frame:
        rng = np.random.default_rng(moment.number)
        depth, facing = self._frame.depth, np.ones_like(self._frame.depth)
        return replace(
            self._frame,
            index=moment.number,
            timestamp=moment.time,
            color=noisy_color(self._frame.color, 1.0, rng),
            depth=self._sensor.measure(depth, facing, self._frame.camera, rng),
            color_timestamp=None,
            depth_timestamp=None,
        )


class ChangingRoom(Place):
    """A synthetic room whose objects come and go.

    On the backward pass, half of the movable objects replace the other half.
    """

    name = "room"
    overrides = ("detector=simulated_maskrcnn2go",)

    def __init__(self, views: int) -> None:
        super().__init__(views)
        synthetic = Synthetic(seed=3, kind=RoomKind.LIVING_ROOM, frames=views)
        self._camera, self._path = synthetic.camera, synthetic.path
        self._sensor = DepthSensor(1.0, synthetic.max_depth)
        room = synthetic.room
        movable = [k for k, piece in room.objects if piece.class_name in MOVABLE]
        self._renderers = [
            Renderer(assemble(one for one in room.objects if one[0] not in hidden), list(room.lamps))
            for hidden in (movable[1::2], movable[::2])
        ]

    def frame_at(self, moment: Moment) -> Frame:
        T_world_camera, rng = self._path.pose(moment.view), np.random.default_rng(moment.number)
        renderer = self._renderers[moment.returning]
        picture = renderer.render(self._camera, T_world_camera)
        return Frame(
            index=moment.number,
            timestamp=moment.time,
            color=noisy_color(picture.color, 1.0, rng),
            depth=self._sensor.measure(picture.depth, picture.incidence, self._camera, rng),
            camera=self._camera,
            T_world_camera=T_world_camera,
            truth=FrameTruth(picture.instance_ids, renderer.surfaces.class_names),
            sensor=SensorKind.KINECT_V1,
        )


def places_of(visits: int, frames: int, detections: Path) -> list[Place]:
    """Return the places.

    Args:
        visits: Number of visits of each place.
        frames: Approximate number of frames of all visits of all places.
        detections: Folder of the detection cache of the recordings.

    Raises:
        DataError: A recording in shared/data cannot be read.
    """
    kitchen = open_dataset("rgbd_folder", root=SHARED / "redkitchen")
    rpy = open_dataset("tum_rgbd", root=SHARED / "tum_fr1_rpy_a", scene="rgbd_dataset_freiburg1_rpy")
    views = frames // (2 * 4 * visits)  # a visit of one of the four places passes each view twice
    return [
        Recording("redkitchen", kitchen, views, detections),
        Recording("freiburg1_rpy", rpy, views, detections),
        StandingCamera(kitchen, views),
        ChangingRoom(views),
    ]

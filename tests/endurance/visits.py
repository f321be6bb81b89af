"""Visits of the places, and measurements over blocks of their frames."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from framework.data import Detections, Float64, Frame, Pose
from framework.interfaces import Viewer
from framework.mapping.instances.instance_list import InstanceTableMap
from framework.runtime.process_settings import frozen_garbage_collector
from framework.runtime.progress import Progress
from framework.runtime.run_log import STAGES
from tests.endurance.places import Place
from tests.support.process_memory import memory
from tests.support.reference_time import Reference

BLOCK = 50  # approximate number of frames of a block
MIN_BLOCKS = 4  # minimum number of blocks of a visit
REFERENCE_INTERVAL = 5  # frames, interval between two reference computations


@dataclass(frozen=True)
class Block:
    """Measurements over successive frames of a visit."""

    place: str
    visit: int  # number of the visit, from 0
    position: int  # number of the block in its visit, from 0
    all_frames: int  # number of frames of all places up to the end of the block
    cpu_ms: Float64  # (F,) processor time of each frame, all threads
    reference_ms: float  # median processor time of the reference computation
    stage_ms: Float64  # (F, stages) elapsed time of each frame in STAGES; NaN = the stage did not run
    errors_mm: Float64  # (F,) distance of the camera from its reference position; NaN = lost, or no reference
    lost: int  # number of lost frames
    heap: int  # memory allocated with malloc in the visits of this place up to the end of the block, bytes
    process: int  # unique set size of the process at the end of the block, bytes
    map_bytes: int  # size of the map at the end of the block
    confirmed: int  # number of confirmed instances at the end of the block
    tentative: int  # number of tentative instances at the end of the block

    @property
    def relative_time(self) -> float:
        """Median processor time of a frame, relative to the reference computation."""
        return float(np.median(self.cpu_ms)) / self.reference_ms


class Samples(Viewer):
    """Measurements of the frames of a block. All memory is allocated before the first frame."""

    def __init__(self, frames: int) -> None:
        self.cpu_ms, self.errors_mm, self.reference_ms = np.full((3, frames), np.nan)
        self.stage_ms = np.full((frames, len(STAGES)), np.nan)
        self.lost = 0
        self._shown = 0  # number of frames with stage times

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        for stage, milliseconds in stage_ms.items():
            self.stage_ms[self._shown, STAGES.index(stage)] = milliseconds
        self._shown += 1


class Survey:
    """A place with its map, and the memory allocated in its visits."""

    def __init__(self, place: Place) -> None:
        self.place = place
        self._mapper = place.mapper()
        self._frames = 0  # number of mapped frames
        self._heap = 0

    def block(self, visit: int, position: int, count: int, reference: Reference, frames_before: int) -> Block:
        """Map the next `count` frames of the place, and return their measurements.

        Args:
            visit: The number of the visit.
            position: The number of the block in its visit.
            count: The number of frames of the block.
            reference: The reference computation.
            frames_before: The number of frames of all places before the block.
        """
        samples = Samples(count)
        self._mapper.pipeline.viewer = samples
        before = memory()
        for k in range(count):
            self._map_frame(k, samples)
            if k % REFERENCE_INTERVAL == 0:
                samples.reference_ms[k] = reference.milliseconds()
        after = memory()
        self._heap += after.heap - before.heap
        scene = cast(InstanceTableMap, self._mapper.scene)
        confirmed = len(scene.instance_ids())
        return Block(
            place=self.place.name,
            visit=visit,
            position=position,
            all_frames=frames_before + count,
            cpu_ms=samples.cpu_ms,
            reference_ms=float(np.nanmedian(samples.reference_ms)),
            stage_ms=samples.stage_ms,
            errors_mm=samples.errors_mm,
            lost=samples.lost,
            heap=self._heap,
            process=after.unique,
            map_bytes=scene.statistics.bytes,
            confirmed=confirmed,
            tentative=len(scene.table.records) - confirmed,
        )

    def _map_frame(self, k: int, samples: Samples) -> None:
        """Map the next frame of the place, the k-th frame of a block."""
        frame = self.place.frame(self._frames)
        self._frames += 1
        began = time.process_time()
        found = self._mapper.add(frame)
        samples.cpu_ms[k] = 1e3 * (time.process_time() - began)
        if found.lost:
            samples.lost += 1
        elif frame.T_world_camera is not None:
            offset = found.T_world_camera[:3, 3] - frame.T_world_camera[:3, 3]
            samples.errors_mm[k] = 1e3 * np.linalg.norm(offset)


def visit_all(places: Sequence[Place], visits: int, reference: Reference) -> Iterator[Block]:
    """Visit the places in turn, and yield the measurements of each block of frames."""
    surveys = [Survey(place) for place in places]
    total = visits * sum(place.visit_frames for place in places)
    frames = 0
    with Progress(total, " frames") as progress, frozen_garbage_collector():
        for visit in range(visits):
            for survey in surveys:
                blocks = max(MIN_BLOCKS, round(survey.place.visit_frames / BLOCK))
                for position, numbers in enumerate(np.array_split(np.arange(survey.place.visit_frames), blocks)):
                    yield survey.block(visit, position, len(numbers), reference, frames)
                    frames += len(numbers)
                    progress.update(len(numbers))

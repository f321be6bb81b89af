"""Queries, saving and loading of a map of twenty rooms with several hundred objects."""

from __future__ import annotations

import functools
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from framework.api import Mapper, load_map
from framework.data import Frame
from framework.datasets.frames.sequence_reader import FRAME_RATE
from framework.datasets.rgbd_folder import RgbdFolder

ROOMS = 20
SPACING = 8.0  # m, distance between the origins of two rooms
STRIDE = 4  # interval between the mapped frames
CALLS = 21  # number of calls of each query
CHANGES = 3  # number of changes before the first calls of each query
REPETITIONS = 5  # number of times that the map is saved and loaded


class LargeMap(NamedTuple):
    """The median times of operations on a large map."""

    query_ms: float  # the slowest query of an unchanged map, ms
    saving: float  # s
    loading: float  # s


@functools.cache
def measure_large_map(source: Path) -> LargeMap:
    """Map twenty copies of a room with given poses, and measure and print the time of each operation.

    Repeated calls in one process return the first result.
    """
    room = list(RgbdFolder(source, stride=STRIDE))
    with tempfile.TemporaryDirectory() as folder:
        cache = {"detection_cache": "read_write", "detection_cache_dir": folder}  # each image is detected once
        mapper = Mapper("tracker=ground_truth", **cache)
        copies = (_moved(frame, number * SPACING) for number in range(ROOMS) for frame in room)
        for k, frame in enumerate(copies):
            mapper.add(replace(frame, index=k, timestamp=k / FRAME_RATE))
        query_ms = _slowest_query(mapper, replace(frame, index=k, timestamp=k / FRAME_RATE))
        path = Path(folder, "map.npz")
        saving = _seconds(lambda: mapper.save(path))
        loading = _seconds(lambda: load_map(path))
        content = path.read_bytes()
        writing = _seconds(lambda: _write(path, content))
        reading = _seconds(path.read_bytes)
    print(f"{len(content) / 1e6:.0f} MB")
    print(f"saving: {saving:.2f} s, {saving / writing:.1f} times the time to write the bytes")
    print(f"loading: {loading:.2f} s, {loading / reading:.1f} times the time to read the bytes")
    return LargeMap(query_ms, saving, loading)


def _moved(frame: Frame, x: float) -> Frame:
    assert frame.T_world_camera is not None
    T_world_camera = frame.T_world_camera.copy()
    T_world_camera[0, 3] += x
    return replace(frame, T_world_camera=T_world_camera)


def _slowest_query(mapper: Mapper, frame: Frame) -> float:
    """Return the time of the slowest query of an unchanged map, ms.

    The times after a change are also printed. Each change adds `frame` again.
    """
    assert frame.T_world_camera is not None
    camera, T_world_camera = frame.camera, frame.T_world_camera
    v, u = np.argwhere(mapper.view(camera, T_world_camera).instance_ids > 0)[0]
    seen = mapper.at_pixel(u, v, camera, T_world_camera)
    assert seen is not None
    name, point = mapper.name(seen), T_world_camera[:3, 3]
    queries: dict[str, Callable[[], object]] = {
        "instances()": mapper.instances,
        "instances(class)": lambda: mapper.instances(name),
        "at_pixel": lambda: mapper.at_pixel(u, v, camera, T_world_camera),
        "nearest": lambda: mapper.nearest(point),
        "nearest of a class": lambda: mapper.nearest(point, name),
        "mesh of an object": lambda: mapper.mesh(seen.id),
        "up": mapper.up,
        "floor": mapper.floor,
    }
    print(f"{len(mapper.instances())} objects, {len(mapper.mesh().vertices)} vertices")
    slowest = 0.0
    for query, ask in queries.items():
        after_change = []
        for _ in range(CHANGES):
            frame = replace(frame, index=frame.index + 1, timestamp=frame.timestamp + 1 / FRAME_RATE)
            mapper.add(frame)
            after_change.append(_seconds(ask, 1))
        unchanged = _seconds(ask, CALLS)
        slowest = max(slowest, unchanged)
        print(f"{query}: {1e3 * unchanged:.2f} ms, {1e3 * statistics.median(after_change):.0f} ms after a change")
    return 1e3 * slowest


def _write(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _seconds(operation: Callable[[], object], calls: int = REPETITIONS) -> float:
    """Return the median time of an operation, s."""
    times = []
    for _ in range(calls):
        begin = time.perf_counter()
        operation()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)

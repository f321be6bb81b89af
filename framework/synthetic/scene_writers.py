"""Parallel writing of benchmark scenes.

Each process writes one scene, because creating a room takes seconds. When all scenes have been started, free processes
help with the remaining scenes.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from multiprocessing.connection import wait as wait_for_end
from pathlib import Path

import cv2
import numba
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from framework.datasets.scenenn.scene_files import write_intrinsics
from framework.datasets.scenenn.scenenn import MADE_BY
from framework.errors import ConfigError, DataError
from framework.files.atomic_write import atomic_write, is_temporary
from framework.files.json_file import read_json
from framework.synthetic.benchmark import SceneSpec
from framework.synthetic.scenenn_scene import GENERATION, BenchmarkSettings, SceneNNScene, frame_files, trajectory_file

FRAMES_AT_ONCE = 8  # frames per task; small, so that all processes end at about the same time

Piece = Callable[[SceneNNScene], int]  # task that writes some files and returns the number of written frames


def write_scenes(root: Path, specs: Mapping[str, SceneSpec], recording: BenchmarkSettings, jobs: int) -> None:
    """Write the scenes of a benchmark in parallel.

    Existing files of these scenes are kept.

    Args:
        root: The output folder.
        specs: The specification of each scene by name.
        recording: The settings of the benchmark.
        jobs: The number of processes.

    Raises:
        ConfigError: `root` has other content.
        DataError: A file cannot be written, or a process fails.
    """
    _begin(root, recording)
    scenes = [_Scene(root / name, spec, recording) for name, spec in specs.items()]
    missing = sum(scene.missing for scene in scenes)
    total = len(scenes) * recording.frames
    bar = tqdm(total=total, initial=total - missing, desc="rendering", unit=" frames", disable=None)
    with ExitStack() as stack:
        stack.enter_context(bar)
        # Processes are spawned, because a forked process lacks the threads of numba and OpenCV. Each process has its
        # own pool, so that its tasks share the scene in its memory.
        spawn = multiprocessing.get_context("spawn")
        pools = [stack.enter_context(ProcessPoolExecutor(1, spawn, _begin_process)) for _ in range(jobs)]
        running: dict[Future[int], ProcessPoolExecutor] = {}
        last: dict[ProcessPoolExecutor, _Scene] = {}
        idle = pools
        while True:
            for pool in idle:
                scene = _choose(scenes, last.get(pool))
                if scene is not None:
                    running[pool.submit(_write, scene.folder, scene.spec, recording, scene.take())] = pool
                    last[pool] = scene
            if not running:
                return
            ended, _ = wait(running, return_when=FIRST_COMPLETED)
            idle = [running.pop(future) for future in ended]
            for future, pool in zip(ended, idle, strict=True):
                bar.update(_result(future, last[pool].folder))
                last[pool].running -= 1


def _begin(root: Path, recording: BenchmarkSettings) -> None:
    """Write the files that are common to all scenes."""
    made_by = root / MADE_BY
    wanted = {"generation": GENERATION, **asdict(recording)}
    if made_by.exists():
        try:
            found = read_json(made_by)
        except DataError as error:
            raise DataError(
                f"{made_by}: expected valid JSON, got a damaged file; delete {root} or set another folder"
            ) from error
        if found != wanted:
            raise ConfigError(f"{root}: expected scenes with the parameters {wanted}, got {found}; set another folder")
    elif root.exists() and (not root.is_dir() or any(not is_temporary(path.name) for path in root.iterdir())):
        found = f"a folder with {next(iter(root.iterdir())).name}" if root.is_dir() else "a file"
        raise ConfigError(
            f"{root}: expected a new or empty folder, or a benchmark folder, got {found}; set another folder"
        )
    root.mkdir(parents=True, exist_ok=True)
    with atomic_write(made_by) as temporary:  # first, so that the same command accepts the folder after an interruption
        temporary.write_text(json.dumps(wanted) + "\n")
    (root / "intrinsic").mkdir(exist_ok=True)
    with atomic_write(root / "release.txt") as temporary:
        temporary.write_text(recording.release + "\n")
    write_intrinsics(root / "intrinsic" / "asus.ini", recording.camera)


class _Scene:
    """The missing files of a scene."""

    def __init__(self, folder: Path, spec: SceneSpec, recording: BenchmarkSettings) -> None:
        self.folder, self.spec = folder, spec
        self.running = 0  # number of running tasks
        self.touched = False
        self.missing = 0  # number of missing frames
        self._left: list[Piece] = []
        self._complete = trajectory_file(folder).exists()  # the trajectory is written last
        if self._complete:
            return
        files = (frame_files(folder, index) for index in range(recording.frames))
        frames = [index for index, pair in enumerate(files) if not all(path.exists() for path in pair)]
        self.missing = len(frames)
        chunks = (frames[at : at + FRAMES_AT_ONCE] for at in range(0, len(frames), FRAMES_AT_ONCE))
        self._left = [SceneNNScene.write_truth, *(partial(SceneNNScene.write_frames, frames=chunk) for chunk in chunks)]

    @property
    def ready(self) -> int:
        """The number of tasks that can be started."""
        waiting_for_walk = not self._left and not self.running and not self._complete
        return len(self._left) + waiting_for_walk

    def take(self) -> Piece:
        self.running += 1
        self.touched = True
        if self._left:
            return self._left.pop(0)
        self._complete = True
        return SceneNNScene.write_walk


def _choose(scenes: list[_Scene], last: _Scene | None) -> _Scene | None:
    """Return the next scene for a process, or None if no task can be started.

    The order of preference is the last scene, a scene that has not been started, and the scene with the most remaining
    tasks.
    """
    if last is not None and last.ready:
        return last
    ready = [scene for scene in scenes if scene.ready]
    untouched = [scene for scene in ready if not scene.touched]
    return untouched[0] if untouched else max(ready, key=lambda scene: scene.ready, default=None)


def _result(future: Future[int], folder: Path) -> int:
    try:
        return future.result()
    except BrokenProcessPool as error:
        raise DataError(
            f"{folder}: expected a running writer process, got a terminated process (possibly out of memory); run the "
            "same command again to resume"
        ) from error


def _begin_process() -> None:
    """Initialize a writer process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    numba.set_num_threads(1)
    cv2.setNumThreads(1)
    threadpool_limits(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait_for_end([parent.sentinel])
        os._exit(1)


_in_memory: list[SceneNNScene] = []  # the latest scene of this process, if any


def _write(folder: Path, spec: SceneSpec, recording: BenchmarkSettings, piece: Piece) -> int:
    """Run a task in a writer process."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        if not _in_memory or _in_memory[0].folder != folder:
            _in_memory.clear()
            _in_memory.append(SceneNNScene(folder, spec, recording))
        return piece(_in_memory[0])
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)

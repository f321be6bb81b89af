"""A run that resumes from its own directory, once for each fault at each of its file operations.

    python -m tests.support.resumed_in_place FOLDER FAULT...

The map is made once. For each fault, a forked process begins and writes the run directory. The command prints the
number of faults and the damaged run directories.

The default threading layer of Numba does not support forked processes.
"""

from __future__ import annotations

import logging
import os
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from unittest import mock

os.environ |= {"NUMBA_THREADING_LAYER": "workqueue", "NUMBA_NUM_THREADS": "1"}

from omegaconf import DictConfig, OmegaConf
from PIL import Image

from framework.api import begin, load_map
from framework.config import composition
from framework.errors import InstanceMapError
from framework.files.atomic_write import atomic_write
from framework.files.manifest import MANIFEST, Manifest, RunStatus
from framework.interfaces import RGBDVideo
from framework.registry import build
from framework.runs import run_directory
from framework.runs.run_directory import RunRecord, WrittenRun
from framework.runs.stored_runs import KEYFRAMES, MAP, read_record
from framework.runtime.run_log import RunResult
from framework.tracking.keyframes import Keyframes, read_keyframes
from tests.support import reported_run
from tests.support.failing_disk import FailingDisk, Fault

CONFIG = reported_run.CONFIG | {
    "tracker": {"_target_": "plugins.trackers.ground_truth.GroundTruth"},
    "dataset": reported_run.CONFIG["dataset"] | {"frames": 3},
    "fuser": reported_run.CONFIG["fuser"] | {"voxel_size": 0.06},
}
NO_FAULT = 7  # exit status of a process that has fewer operations


@dataclass(frozen=True)
class ResumedRun:
    """A mapped but unwritten run that resumes from its own directory."""

    folder: Path  # parent of the run directory
    config: DictConfig
    video: RGBDVideo
    result: RunResult

    @classmethod
    def mapped(cls, folder: Path) -> ResumedRun:
        """Write a first run with keyframes, and map the second run, which has no keyframes."""
        config = OmegaConf.create(CONFIG)
        pipeline, video = begin(config), build(RGBDVideo, config.dataset)
        result = pipeline.run_to_any_end(video)
        keyframes = Keyframes()
        for k in range(len(video)):
            keyframes.add(video[k], video[k].T_world_camera)
        first = replace(result, keyframes=keyframes.saved())
        earlier = folder / "earlier"
        assert RunRecord.begin(earlier, config, {}).write(video, first) == WrittenRun(earlier, None)
        config.resume_from = str(earlier)
        resumed = begin(config)
        config.resume_from = str(folder / "run")
        return cls(folder, config, video, resumed.run_to_any_end(video))

    @property
    def directory(self) -> Path:
        return self.folder / "run"

    def interrupted(self, disk: FailingDisk) -> bool:
        """Write the run with a fault in another process. Return False if it has fewer operations."""
        for path in self.folder.glob("run*"):
            shutil.rmtree(path)
        shutil.copytree(self.folder / "earlier", self.directory)
        if (process := os.fork()) == 0:
            with disk.active():
                RunRecord.begin(self.directory, self.config, {}).write(self.video, self.result)
            os._exit(0 if len(disk.operations) > disk.at else NO_FAULT)
        _, status = os.waitpid(process, 0)
        return os.waitstatus_to_exitcode(status) != NO_FAULT

    def damage(self, fault: Fault) -> str:
        """Return a description of the damage to the run directory, "" = complete."""
        try:
            manifest = Manifest.read(self.directory)
            if manifest.status is not RunStatus.COMPLETE:
                return f"status {manifest.status.name}"
            if changed := manifest.changed_files(self.directory):
                return "; ".join(changed)
            read_record(self.directory)
            load_map(self.directory / MAP)
            is_earlier = _bytes(self.directory / MANIFEST) == _bytes(self.folder / "earlier" / MANIFEST)
            if is_earlier != bool(read_keyframes(self.directory / KEYFRAMES)):
                return "keyframes of another run"
        except InstanceMapError as error:
            return str(error)
        if fault in (Fault.FAILS, Fault.CUT) and is_earlier:
            return self._rescue_damage()
        return ""

    def _rescue_damage(self) -> str:
        """Return a description of the lost outputs of the run that could not be written to the run directory."""
        rescued = self.folder / "run_rescued"
        found = {path.name for path in rescued.iterdir()} if rescued.exists() else set[str]()
        lost = {path.name for path in (self.folder / "earlier").iterdir()} - {KEYFRAMES} - found
        return f"lost outputs {lost}" if len(lost - {"metrics.json"}) > 1 else ""


def damaged_runs(run: ResumedRun, fault: Fault) -> Iterator[str]:
    """Yield a description of each damaged run directory, and the number of faults."""
    for at in range(10_000):
        disk = FailingDisk(at, fault)
        if not run.interrupted(disk):
            yield f"{fault.name}: {at} faults"
            return
        if damage := run.damage(fault):
            yield f"DAMAGED: {fault.name} at operation {at}: {damage}"


def _bytes(path: Path) -> bytes:
    return path.read_bytes()


def _small_overview(path: Path, *_: object) -> None:
    with atomic_write(path) as temporary:
        Image.new("RGB", (8, 8)).save(temporary, "PNG")


def main(folder: str, *faults: str) -> None:
    logging.disable()
    with (
        mock.patch.object(composition, "_added", [reported_run.FAKES]),
        mock.patch.object(run_directory, "write_overview", _small_overview),
        mock.patch.object(run_directory, "frozen_environment", return_value="# Python\n"),
        mock.patch.object(run_directory, "code_version", dict),
    ):
        run = ResumedRun.mapped(Path(folder))
        for fault in faults:
            for line in damaged_runs(run, Fault[fault]):
                print(line, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])

"""One run from its config: build the stages, map the sequence, leave the record."""

from __future__ import annotations

import logging
import os
import random
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numba
import numpy as np
from omegaconf import DictConfig
from threadpoolctl import threadpool_limits

from framework.build import STAGES, build
from framework.detection.cache import cache_metrics, with_cache
from framework.errors import ConfigError
from framework.interfaces import ClusterRefiner, Detector, MapFuser, PoseTracker, RGBDSequence
from framework.journal import RunResult
from framework.pipeline import Pipeline
from framework.reports.run_record import RunRecord

log = logging.getLogger(__name__)

DEVICES = ("auto", "cpu", "cuda")


def run(config: DictConfig, directory: Path, choices: Mapping[str, str | None]) -> RunResult:
    """Maps the config's sequence with its stages and leaves the run's record in `directory`.

    `choices` are the options that were chosen, by config group. A run that ended early (Ctrl-C, full map) leaves its
    record too, marked as partial, and then raises what ended it.
    """
    Settings.of(config).apply()
    sequence = build(RGBDSequence, config.dataset)
    pipeline = Pipeline(
        detector=with_cache(build(Detector, config.detector), config),
        tracker=build(PoseTracker, config.tracker),
        refiner=build(ClusterRefiner, config.refiner),
        fuser=build(MapFuser, config.fuser),
        ahead=config.ahead,
    )
    record = RunRecord.begin(directory, config, choices)
    chosen = ", ".join(f"{stage} {choices.get(stage)}" for stage in STAGES if stage != "dataset")
    log.info("mapping %s: %d frames, %s", sequence.name, len(sequence), chosen)
    result = pipeline.run(sequence)
    record.write(sequence, result, cache_metrics(pipeline.detector))
    if result.stopped_by is not None:
        raise result.stopped_by
    return result


@dataclass(frozen=True)
class Settings:
    """What the top of the config says to all stages."""

    seed: int  # 0 or more
    device: str  # one of DEVICES; the stages that run networks read it
    threads: int  # 0 = all cores

    def __post_init__(self) -> None:
        for name in ("seed", "threads"):
            value: object = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 0:
                raise ConfigError(f"{name} must be a whole number, 0 or more, found {value!r}")
        if self.device not in DEVICES:
            raise ConfigError(f"device must be one of {', '.join(DEVICES)}, found {self.device!r}")

    @classmethod
    def of(cls, config: DictConfig) -> Settings:
        return cls(seed=config.seed, device=config.device, threads=config.threads)

    def apply(self) -> None:
        """Limits the threads of the libraries, and seeds the random states that they keep for themselves.

        The project's own code draws from generators seeded with `seed`; this is for what third-party plugins do.
        Open3D's own (TBB) threads have no switch: only the affinity of the process limits them.
        """
        cores = len(os.sched_getaffinity(0))
        threads = self.threads or cores
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        cv2.setNumThreads(threads)
        threadpool_limits(threads)  # OpenMP and BLAS, as far as they are loaded
        random.seed(self.seed)
        np.random.seed(self.seed % 2**32)  # noqa: NPY002
        os.environ["OMP_NUM_THREADS"] = str(threads)  # read by those that are loaded later; torch takes seconds
        if "torch" in sys.modules:
            import torch

            torch.set_num_threads(threads)
            torch.manual_seed(self.seed)

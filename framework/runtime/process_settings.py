"""Process-wide settings: environment variables, threads, seeds and memory.

Only the command line applies these settings automatically.
"""

from __future__ import annotations

import atexit
import gc
import logging
import os
import random
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from framework.errors import ConfigError

if TYPE_CHECKING:
    from omegaconf import DictConfig

log = logging.getLogger(__name__)

BOUNDS = {
    "seed": (0, 2**63 - 1),  # the range of torch
    "threads": (0, 4096),  # more than the cores of any supported machine
    "prefetch": (0, 1000),
    "detection_interval": (1, 10**6),
}
DEVICES = ("auto", "cpu", "cuda")

ENVIRONMENT = {
    # The detection threads and the mapping thread launch parallel kernels at the same time. Of numba's threading layers
    # only OpenMP and TBB support that. OpenMP is always installed, because torch requires it.
    "NUMBA_THREADING_LAYER": "omp",
    # Idle OpenMP threads spin by default and block cores for other threads. A few microseconds of spinning save time
    # between the kernels of one stage.
    "OMP_WAIT_POLICY": "passive",
    "GOMP_SPINCOUNT": "10000",
    # Threads of OpenBLAS (numpy, scipy and OpenCV each contain a copy) spin for 2^26 cycles by default. The copy in
    # OpenCV occupied a core for 30 ms after each keyframe. The value is the exponent.
    "OPENBLAS_THREAD_TIMEOUT": "14",
}
"""Environment variables that libraries read when they are loaded; values that the user has set are kept."""


def set_environment() -> None:
    """Set the environment variables in ENVIRONMENT for this process.

    The variables have no effect after numpy and numba are imported. numba stores compiled kernels next to the code or
    in the cache of the user. If both are read-only, such as in a container, this process uses a temporary cache.
    """
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    home = os.environ.get("XDG_CACHE_HOME") or os.environ.get("HOME") or os.environ.get("USERPROFILE") or "/"
    if "NUMBA_CACHE_DIR" not in os.environ and not any(map(_is_writable, (Path(__file__).parent, Path(home)))):
        with suppress(OSError):  # without any writable folder, kernels are kept in memory
            os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(prefix="instancemap-kernels-")
            atexit.register(shutil.rmtree, os.environ["NUMBA_CACHE_DIR"], ignore_errors=True)


def _is_writable(folder: Path) -> bool:
    """Return True if the folder, or its nearest existing parent, is writable."""
    existing = next((path for path in (folder, *folder.parents) if path.exists()), Path())
    return existing.is_dir() and os.access(existing, os.W_OK)


def configure_process(threads: int = 0, seed: int | None = None) -> None:
    """Apply the process-wide settings of the command line to this process.

    `import instancemap`, `Mapper` and `Pipeline` do not change process-wide settings. Call this function at the start
    of your program if process-wide changes are acceptable. Detection then runs in parallel with mapping on every
    platform, and the time per frame is shorter.

        import instancemap

        instancemap.configure_process()
        from instancemap import Mapper

    This function sets:

    - environment variables: `NUMBA_THREADING_LAYER`, `OMP_WAIT_POLICY`, `GOMP_SPINCOUNT`, `OPENBLAS_THREAD_TIMEOUT` and
      `OMP_NUM_THREADS`; existing values are kept, except for `OMP_NUM_THREADS`
    - the thread counts of numba, OpenCV, torch, OpenMP and BLAS
    - the malloc thresholds of glibc
    - the global random generators, if `seed` is given

    Libraries read environment variables when they are loaded. Therefore, call this function before you import numpy or
    numba. Otherwise, a warning lists the variables that may have no effect.

    Args:
        threads: Number of threads of each library; 0 = number of cores available to this process.
        seed: Seed of the global random generators of Python, numpy and torch (if loaded); None = not seeded.

    Raises:
        ConfigError: `threads` or `seed` is out of range.
    """
    settings = Settings(0 if seed is None else seed, "auto", threads)
    late = [name for name in ENVIRONMENT if name not in os.environ] if {"numpy", "numba"} & sys.modules.keys() else []
    set_environment()
    if late:
        log.warning(
            "configure_process: expected a call before numpy and numba are imported, got a later call; %s may have no "
            "effect; call it before these imports, or set the variables before Python starts",
            ", ".join(late),
        )
    settings.limit_threads()
    if seed is not None:
        settings.seed_generators()


def available_cores() -> int:
    """Return the number of cores that this process may use. On macOS and Windows, these are all cores."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class Settings:
    """Config settings shared by all stages."""

    seed: int  # 0 or more
    device: str  # one of DEVICES; the stages that run networks read it
    threads: int  # 0 = all cores
    prefetch: int = 0  # number of prefetched frames, about 10 MB each with masks
    detection_interval: int = 1  # interval between detections, frames

    def __post_init__(self) -> None:
        for name, (least, most) in BOUNDS.items():
            value: object = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
                raise ConfigError(f"{name}: expected an integer in [{least}, {most}], got {value!r}")
        if self.device not in DEVICES:
            raise ConfigError(f"device: expected one of {', '.join(DEVICES)}, got {self.device!r}")

    @classmethod
    def of(cls, config: DictConfig) -> Settings:
        run_settings = {name: config[name] for name in ("prefetch", "detection_interval") if name in config}
        return cls(seed=config.seed, device=config.device, threads=config.threads, **run_settings)

    def apply(self) -> None:
        """Limit the threads of the libraries and seed the global random generators.

        Only processes of the command line may call this method. Call it again after the stages are built, because torch
        is configured only if it is already loaded. The project itself uses separate generators, but third-party plugins
        may use the global ones.
        """
        self.limit_threads()
        self.seed_generators()

    def limit_threads(self) -> None:
        """Limit the threads of all libraries.

        The TBB threads of Open3D can only be limited by the CPU affinity of the process.
        """
        import cv2
        import numba
        from threadpoolctl import threadpool_limits

        from framework.runtime.memory import keep_freed_memory

        keep_freed_memory()
        threads = self.threads or available_cores()
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        cv2.setNumThreads(threads)
        threadpool_limits(threads)  # loaded OpenMP and BLAS libraries
        os.environ["OMP_NUM_THREADS"] = str(threads)  # for libraries that are loaded later, such as torch
        if torch := sys.modules.get("torch"):
            torch.set_num_threads(threads)

    def seed_generators(self) -> None:
        """Seed the global random generators of Python, numpy and torch (if loaded)."""
        import numpy as np

        random.seed(self.seed)
        np.random.seed(self.seed % 2**32)  # noqa: NPY002
        if torch := sys.modules.get("torch"):
            torch.manual_seed(self.seed)


@contextmanager
def frozen_garbage_collector() -> Iterator[None]:
    """Exclude all existing objects from garbage collection in the `with` body.

    Otherwise, garbage collection of the imported libraries (300,000 objects) takes 40 ms, longer than a frame. Nothing
    changes if objects are already frozen.
    """
    if gc.get_freeze_count():
        yield
        return
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()

"""What the top of a config says to all stages: seed, device and threads."""

from __future__ import annotations

import os
import random
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from omegaconf import DictConfig

from framework.errors import ConfigError

MOST = {"seed": 2**63 - 1, "threads": 4096, "prefetch": 1000}  # torch takes no larger seed; no machine has more cores
DEVICES = ("auto", "cpu", "cuda")


def available_cores() -> int:
    """The cores that this process may use. macOS and Windows do not tell a process's affinity: there, all."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class Settings:
    """What the top of the config says to all stages."""

    seed: int  # 0 or more
    device: str  # one of DEVICES; the stages that run networks read it
    threads: int  # 0 = all cores
    prefetch: int = 0  # frames that wait to be mapped; each with its masks takes some 10 MB

    def __post_init__(self) -> None:
        for name, most in MOST.items():
            value: object = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= most:
                raise ConfigError(f"{name} must be a whole number, 0 or more and at most {most}, found {value!r}")
        if self.device not in DEVICES:
            raise ConfigError(f"device must be one of {', '.join(DEVICES)}, found {self.device!r}")

    @classmethod
    def of(cls, config: DictConfig) -> Settings:
        prefetch = config.get("prefetch", 0)  # a training has none
        return cls(seed=config.seed, device=config.device, threads=config.threads, prefetch=prefetch)

    def apply(self) -> None:
        """Limits the threads of the libraries, and seeds the random states that they keep for themselves.

        The project's own code draws from generators seeded with `seed`; this is for what third-party plugins do.
        Open3D's own (TBB) threads have no switch: only the affinity of the process limits them.
        """
        import cv2
        import numba
        import numpy as np
        from threadpoolctl import threadpool_limits

        threads = self.threads or available_cores()
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        cv2.setNumThreads(threads)
        threadpool_limits(threads)  # OpenMP and BLAS, as far as they are loaded
        random.seed(self.seed)
        np.random.seed(self.seed % 2**32)  # noqa: NPY002
        os.environ["OMP_NUM_THREADS"] = str(threads)  # read by those that are loaded later

        def set_up(torch: ModuleType) -> None:
            torch.set_num_threads(threads)
            torch.manual_seed(self.seed)

        _once_imported("torch", set_up)  # it takes seconds to load, and many a run needs none


def _once_imported(name: str, set_up: Callable[[ModuleType], None]) -> None:
    """Calls `set_up` with the module: at once where it has been imported, else when it is."""
    for finder in [finder for finder in sys.meta_path if isinstance(finder, _Awaited) and finder.name == name]:
        sys.meta_path.remove(finder)
    if name in sys.modules:
        set_up(sys.modules[name])
    else:
        sys.meta_path.insert(0, _Awaited(name, set_up))


@dataclass
class _Awaited(MetaPathFinder):
    """Finds a module as Python does, and sets it up when it has been executed."""

    name: str
    set_up: Callable[[ModuleType], None]

    def find_spec(self, fullname: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        if fullname != self.name:
            return None
        others = (other.find_spec(fullname, path, target) for other in sys.meta_path if other is not self)
        spec = next(filter(None, others), None)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_set_up(module: ModuleType) -> None:  # who only asks for the spec executes nothing
                sys.meta_path.remove(self)
                execute(module)
                self.set_up(module)

            spec.loader.exec_module = execute_and_set_up  # type: ignore[method-assign]
        return spec

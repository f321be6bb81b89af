"""Directories, signals and tables of runs and sweeps, for all launchers."""

from __future__ import annotations

import os
import sys
import textwrap
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from multiprocessing import active_children
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from hydra.conf import HydraConf
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, flag_override
from omegaconf.errors import OmegaConfBaseException

from framework.commands.running.choices import check_outputs, checked_sweep, of_tables, swept_keys
from framework.config.composition import one_line
from framework.config.validation import checked_rows
from framework.errors import ConfigError, InstanceMapError
from framework.files.atomic_write import check_regular, remove_left_over
from framework.files.folders.directory_lock import holder, holder_name, is_locked, locked, new_directory
from framework.runs.objective import objective_keys
from framework.runs.stored_runs import LOG
from framework.runtime.process_settings import available_cores
from framework.runtime.signals import signals_passed_on
from framework.runtime.sweep_worker import end_with_parent

ending = ExitStack()
"""Stack of contexts that this process closes after its run or sweep."""


WITH_OBJECTIVE = (".OptunaSweeper", ".AxSweeper", ".NevergradSweeper")  # class names of sweepers
WORKER_START = f"{end_with_parent.__module__}.{end_with_parent.__name__}"
"""Function that joblib calls in each new worker."""


def cores_of(threads: int) -> int:
    """Return the number of cores for a job with `threads` threads, where 0 means all cores."""
    return threads or available_cores()


def jobs_at_once(threads: int) -> int:
    """Return the number of jobs that run concurrently on this machine, at least 1.

    Each job has `threads` threads, where 0 means all cores.
    """
    return max(1, available_cores() // cores_of(threads))


OmegaConf.register_new_resolver("cores_of", cores_of, replace=True)
OmegaConf.register_new_resolver("jobs_at_once", jobs_at_once, replace=True)
# cached: workers of a sweep use the directory that the main process resolved
OmegaConf.register_new_resolver("new_directory", new_directory, use_cache=True, replace=True)


@dataclass
class DirectoryLockCallback(Callback):
    """Hydra callback that locks the directory of a run or sweep at its start.

    Hydra calls it in the main process before it writes any file, but not in workers.
    """

    of_run: bool = True  # True if a run has its own directory; False for commands that write one file

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        # as Hydra does later; the resolver of the directory needs the name of the dataset
        HydraConfig.instance().set_config(config)
        if self.of_run:
            self.take(
                lambda: run_in(directory_of("hydra.run.dir", config.hydra.run.dir), wait=config.skip_completed is True)
            )

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        self.take(lambda: sweep_of(config, with_table=self.of_run))

    def take(self, lock: Callable[[], AbstractContextManager[None]]) -> None:
        try:
            ending.enter_context(lock())
        except (InstanceMapError, OSError, OmegaConfBaseException) as error:  # Hydra would only warn
            sys.exit(f"error: {one_line(error)}")


def directory_of(key: str, chosen: str) -> Path:
    """Return the directory of a config key.

    Raises:
        ConfigError: The name is empty, which would be the working directory.
    """
    if not chosen.strip():
        raise ConfigError(f"{key}: expected a folder, got an empty name; set {key}=. for the working directory")
    return Path(chosen)


@contextmanager
def run_in(directory: Path, wait: bool) -> Iterator[None]:
    """Lock the directory of a run in the `with` body.

    Raises:
        DataError: The directory is in use and `wait` is False.
    """
    with locked(directory, wait):
        if (directory / LOG).exists():
            check_regular(directory / LOG)  # Hydra would block on a pipe
        yield


def sweep_of(config: DictConfig, with_table: bool) -> AbstractContextManager[None]:
    """Return the context of a sweep.

    Raises:
        InstanceMapError: The sweep has no runs or its config is invalid.
    """
    own = config.hydra
    overrides, rows = overrides_of(own), checked_rows(config.get("rows"))
    runs = checked_sweep(overrides, rows)
    if with_table:
        check_outputs(config, overrides, rows)
    if not objective_keys(config.objective) and str(own.sweeper._target_).endswith(WITH_OBJECTIVE):
        raise ConfigError(
            "objective: expected a metric to optimize, got none; set objective=instances.ap50, for example"
        )
    _name_by(own, swept_keys(overrides), of_tables(overrides))
    workers = 0
    if by_joblib(own):
        # a signal from the terminal would end an idle worker, and joblib would then end all workers
        workers = min(joblib_workers(own.launcher.n_jobs), runs)
        with flag_override(own.launcher, ["readonly", "struct"], [False, False]):
            own.launcher.n_jobs = workers
            own.launcher.initializer = {"_target_": "hydra.utils.get_method", "path": WORKER_START}
    directory = directory_of("hydra.sweep.dir", own.sweep.dir)
    return sweep_in(directory, with_table, config.get("figure") is not None, workers > 1)


def overrides_of(own: DictConfig) -> list[str]:
    """Return the overrides of a sweep, those of the experiment first."""
    swept = [f"{key}={values}" for key, values in (own.sweeper.get("params") or {}).items()]
    return [*swept, *own.overrides.task]


def _name_by(own: DictConfig, swept: Collection[str], of_outputs: Collection[str]) -> None:
    """Include all swept keys in the names of the job directories, and omit the keys `of_outputs`.

    Otherwise, jobs that differ only in keys without effect on results would share a directory.
    """
    left_out = [*own.job.config.override_dirname.exclude_keys]
    still = [*(key for key in left_out if key not in swept), *(key for key in of_outputs if key not in left_out)]
    if still != left_out:
        with flag_override(own, ["readonly", "struct"], [False, False]):
            # workers compose each job again from these overrides
            own.overrides.hydra.append(f"hydra.job.config.override_dirname.exclude_keys=[{','.join(still)}]")


def by_joblib(own: DictConfig | HydraConf) -> bool:
    """Return True if joblib runs the jobs of the sweep."""
    return str(own.launcher._target_).endswith(".JoblibLauncher")


def joblib_workers(n_jobs: int | None) -> int:
    """Return the number of worker processes that joblib starts. With 1, jobs run in this process."""
    from joblib import effective_n_jobs  # type: ignore[import-untyped]

    return int(effective_n_jobs(n_jobs))


@contextmanager
def sweep_in(directory: Path, with_table: bool, with_figure: bool, workers: bool = False) -> Iterator[None]:
    """Lock the directory of a sweep in the `with` body, and print the table of its runs at the end.

    The table is also printed after an error.

    Args:
        directory: Directory of the sweep.
        with_table: Write and print the table.
        with_figure: Draw the figure, except after Ctrl-C.
        workers: Forward signals to worker processes, which write partial outputs before the sweep ends.

    Raises:
        InstanceMapError: A launcher failed because a worker was killed.
    """
    # Python's resource tracker would warn when joblib stops its workers
    os.environ["PYTHONWARNINGS"] = ",".join(filter(None, (os.environ.get("PYTHONWARNINGS"), "ignore:resource_tracker")))
    with locked(directory):
        remove_left_over(directory)
        try:
            with signals_passed_on(lambda: at_work_in(directory)) if workers else nullcontext():
                yield
        except BaseException as error:
            with suppress(InstanceMapError):  # report the first error, not the missing table
                _report(directory, with_table, with_figure and isinstance(error, Exception))
            if _is_of_a_launcher(error):
                reason = textwrap.shorten(one_line(error), 300)
                raise InstanceMapError(
                    f"the sweep stopped early: {reason}; run the same command to continue it"
                ) from error
            raise
        _report(directory, with_table, with_figure)


def at_work_in(directory: Path) -> list[BaseProcess]:
    """Return the worker processes that are executing a run in a directory of a sweep."""
    busy = {holder(run) for run in directory.iterdir() if is_locked(run)}
    return [worker for worker in active_children() if holder_name(worker.pid) in busy]


def _report(directory: Path, with_table: bool, with_figure: bool) -> None:
    if with_table:
        from framework.tables.experiment_tables import write_tables

        print(write_tables(directory))
        print(f"{os.path.relpath(directory / 'table.md')}, table.tex, table.csv")
    if with_figure:
        from framework.figures.experiment_figure import write_figure

        print(*write_figure(directory), sep="\n")


def _is_of_a_launcher(error: BaseException) -> bool:
    # joblib and submitit raise a RuntimeError
    return isinstance(error, RuntimeError) or type(error).__module__.partition(".")[0] == "ray"

"""What surrounds a run or a sweep, whoever runs its jobs: its place is its own, and its table is made in the end."""

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

from framework.commands.running.choices import checked_sweep, swept_keys
from framework.config.composition import one_line
from framework.config.validation import checked_rows
from framework.errors import ConfigError, InstanceMapError
from framework.files.atomic_write import check_regular, remove_left_over
from framework.files.directory_lock import holder, holder_name, is_locked, locked, new_directory
from framework.runs.stored_runs import LOG
from framework.runtime.process_settings import available_cores
from framework.runtime.signals import signals_passed_on

ending = ExitStack()
"""What this process still has to do when the run or the sweep that it began has ended, in whatever way."""


def cores_of(threads: int) -> int:
    """How many cores a job of so many threads (0 = all) takes of this machine."""
    return threads or available_cores()


def jobs_at_once(threads: int) -> int:
    """How many such jobs the cores of this machine take."""
    return max(1, available_cores() // cores_of(threads))


OmegaConf.register_new_resolver("cores_of", cores_of, replace=True)
OmegaConf.register_new_resolver("jobs_at_once", jobs_at_once, replace=True)
# once for a config: a sweep's workers, whose configs take over what this one's has resolved, get the same answer
OmegaConf.register_new_resolver("new_directory", new_directory, use_cache=True, replace=True)


@dataclass
class PlaceCallback(Callback):
    """How Hydra says that a run or a sweep begins, and where. It calls this in the process that was started, before it
    writes anything, and not in workers.
    """

    of_run: bool = True  # whether a run has its place to itself; a command that writes one file has none

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        HydraConfig.instance().set_config(config)  # as it does itself a moment later: the place names the dataset
        if self.of_run:
            self.take(
                lambda: run_in(place_of("hydra.run.dir", config.hydra.run.dir), wait=config.skip_completed is True)
            )

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        self.take(lambda: sweep_of(config, with_table=self.of_run))

    def take(self, place: Callable[[], AbstractContextManager[None]]) -> None:
        try:
            ending.enter_context(place())
        except (InstanceMapError, OSError, OmegaConfBaseException) as error:  # Hydra would warn of it, and go on
            sys.exit(f"error: {one_line(error)}")


def place_of(key: str, chosen: str) -> Path:
    """The directory that was chosen. Raises ConfigError for an empty name, which would be the working folder."""
    if not chosen.strip():
        raise ConfigError(f"{key} is empty; {key}=. is the working folder")
    return Path(chosen)


@contextmanager
def run_in(directory: Path, wait: bool) -> Iterator[None]:
    """Has `directory` to itself while the body runs. Raises DataError."""
    with locked(directory, wait):
        if (directory / LOG).exists():
            check_regular(directory / LOG)  # Hydra opens it, and would wait for who reads a pipe
        yield


def sweep_of(config: DictConfig, with_table: bool) -> AbstractContextManager[None]:
    """The place of a sweep, once it is known that it has runs, with a table of them or not. Raises InstanceMapError.

    Has joblib start no more workers than there are runs: the signals of a terminal reach all of them, and one that
    never had a run would die of them, and all others with it.
    """
    own = config.hydra
    swept = [f"{key}={values}" for key, values in (own.sweeper.get("params") or {}).items()]
    asked = [*swept, *own.overrides.task]
    runs = checked_sweep(asked, checked_rows(config.get("rows")))
    _name_by(own, swept_keys(asked))
    workers = 0
    if by_joblib(own):
        workers = min(joblib_workers(own.launcher.n_jobs), runs)
        with flag_override(own, "readonly", False):
            own.launcher.n_jobs = workers
    directory = place_of("hydra.sweep.dir", own.sweep.dir)
    return sweep_in(directory, with_table, config.get("figure") is not None, workers > 1)


def _name_by(own: DictConfig, keys: Collection[str]) -> None:
    """Has a job's directory be named by these keys, too, of those that change no result: jobs that differ in nothing
    else would share one. Every job is composed anew, by workers, too, from the overrides that this adds to.
    """
    left_out = [*own.job.config.override_dirname.exclude_keys]
    still = [key for key in left_out if key not in keys]
    if still != left_out:
        with flag_override(own, ["readonly", "struct"], [False, False]):
            own.overrides.hydra.append(f"hydra.job.config.override_dirname.exclude_keys=[{','.join(still)}]")


def by_joblib(own: DictConfig | HydraConf) -> bool:
    """Whether the jobs of a sweep are run by processes that this one has started, or a single one by itself."""
    return str(own.launcher._target_).endswith(".JoblibLauncher")


def joblib_workers(asked: int | None) -> int:
    """How many processes joblib makes of `n_jobs`; with 1 it starts none."""
    from joblib import effective_n_jobs  # type: ignore[import-untyped]

    return int(effective_n_jobs(asked))


@contextmanager
def sweep_in(directory: Path, with_table: bool, with_figure: bool, workers: bool = False) -> Iterator[None]:
    """Has `directory` to itself while the body runs, and prints the table of the runs in it however the body ends.

    The picture of the runs is drawn, too, but for Ctrl-C, which shall end at once. Raises InstanceMapError, in place of
    what the launchers raise when a worker is killed. Where it has `workers`, a signal is theirs, too: their runs leave
    a partial record, and the sweep ends after them.
    """
    # joblib ends its workers without their help, and Python's own clean-up warns of that
    os.environ["PYTHONWARNINGS"] = ",".join(filter(None, (os.environ.get("PYTHONWARNINGS"), "ignore:resource_tracker")))
    with locked(directory):
        remove_left_over(directory)
        try:
            with signals_passed_on(lambda: at_work_in(directory)) if workers else nullcontext():
                yield
        except BaseException as error:
            with suppress(InstanceMapError):  # more is to be said about how it ended than that nothing is there
                _report(directory, with_table, with_figure and isinstance(error, Exception))
            if _is_of_a_launcher(error):
                reason = textwrap.shorten(one_line(error), 300)
                raise InstanceMapError(
                    f"the sweep ended early, and the same command goes on with it: {reason}"
                ) from error
            raise
        _report(directory, with_table, with_figure)


def at_work_in(directory: Path) -> list[BaseProcess]:
    """The processes that this one has started and that have a run in work in the place of a sweep."""
    busy = {holder(run) for run in directory.iterdir() if is_locked(run)}
    return [worker for worker in active_children() if holder_name(worker.pid) in busy]


def _report(directory: Path, with_table: bool, with_figure: bool) -> None:
    """Makes of the runs in `directory` what is asked for, here and not where workers import this module."""
    if with_table:
        from framework.tables.experiment_tables import write_tables

        print(write_tables(directory))
        print(f"{os.path.relpath(directory / 'table.md')}, and beside it table.tex, table.csv")
    if with_figure:
        from framework.figures.experiment_figure import write_figure

        print(*write_figure(directory), sep="\n")


def _is_of_a_launcher(error: BaseException) -> bool:
    """Whether not a job but what runs the jobs has failed: joblib and submitit raise RuntimeErrors, Ray its own."""
    return isinstance(error, RuntimeError) or type(error).__module__.partition(".")[0] == "ray"

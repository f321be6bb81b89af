"""One run from its config, or with -m or an experiment a sweep of runs: what there is without a command."""

from __future__ import annotations

import gc
import logging
import sys
from collections.abc import Mapping
from contextlib import nullcontext
from multiprocessing import parent_process
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import ConfigCompositionException
from omegaconf import DictConfig

from framework.commands.command_line import Jobs, is_of_sweep
from framework.commands.running.choices import fault_of_first_run
from framework.commands.running.experiment import with_row
from framework.commands.running.sweep import by_joblib, ending
from framework.errors import PartialRunError
from framework.files.directory_lock import locked
from framework.files.search_paths import CONF
from framework.runs.stored_runs import is_recorded
from framework.runtime.signals import ENDING, Interruption, heard_from_sweep, raise_on_signals, signals_deferred

log = logging.getLogger(__name__)
jobs = Jobs()


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
@jobs.reported
def job(config: DictConfig) -> None:
    """One run: builds the stages that the config names, maps the sequence, leaves the record in Hydra's directory."""
    hydra_config = HydraConfig.get()
    if is_of_sweep(hydra_config) and by_joblib(hydra_config) and parent_process() is not None:
        heard_from_sweep().check()
    directory = Path(hydra_config.runtime.output_dir)
    config, choices = with_row(config, hydra_config)
    # where a sweep was killed and not its workers, they go on; a run by itself has its place since it was started
    with locked(directory, wait=True) if is_of_sweep(hydra_config) else nullcontext():
        if config.skip_completed and is_recorded(directory, config):
            return
        interruption = run(config, directory, choices)
    if is_of_sweep(hydra_config):  # which has not ended with this run
        interruption.check()


def run(config: DictConfig, directory: Path, choices: Mapping[str, str | None]) -> Interruption:
    """Maps the config's video with its stages and leaves the run's record in `directory`.

    `choices` are the options that were chosen, by config group. This is where it is decided how a run ends:

    - completed: the record is whole. A signal that came while it was written is in the Interruption that this returns,
      as is the one that ended a live video.
    - partial: there is a map, and a signal, a stage or the disk has ended the run. What was mapped is written as far as
      it goes, marked as partial; then Interrupted is raised, or PartialRunError from what ended it.
    - nothing to keep: raises what ended the run before anything was mapped.

    The first signal ends it after the frame, or the record, that is in work, the second one at once.
    """
    from framework.api import begin  # here: a misspelt name is answered before these load
    from framework.compilation.catalog import compile_for_run
    from framework.datasets.frames.sequence_reader import Recording
    from framework.detection.stored.cache import cache_metrics
    from framework.interfaces import RGBDSequence, RGBDVideo
    from framework.registry import STAGES, build
    from framework.runs.run_directory import RunRecord, reason
    from framework.runtime.process_settings import Settings, frozen_garbage_collector

    settings = Settings.of(config)
    settings.apply()
    pipeline = begin(config)
    settings.apply()  # to torch, if a stage has loaded it
    gc.collect()  # of itself, it would stop one of the first hundreds of frames for longer than they take
    video = build(RGBDVideo, config.get("dataset"))  # after the stages: making up a room takes longest
    compile_for_run()  # what renders it
    record = RunRecord.begin(directory, config, choices)
    chosen = ", ".join(f"{stage} {choices.get(stage)}" for stage in STAGES if stage != "dataset")
    length = f"{len(video)} frames" if isinstance(video, RGBDSequence) else "live until Ctrl-C"
    log.info("mapping %s: %s, %s", video.name, length, chosen)
    if isinstance(video, Recording):  # files of anybody's
        from framework.checking.recording_check import warn_of_poses

        warn_of_poses(video)
    with signals_deferred(*ENDING) as interruption:
        with frozen_garbage_collector():
            result = pipeline.run_to_any_end(video, directory)
        with interruption.second_ends_at_once("once the record is written"):
            fault = record.write(video, result, cache_metrics(pipeline.detector))
    if fault is None:
        return interruption
    if isinstance(fault, Exception):
        raise PartialRunError(reason(fault)) from fault
    raise fault


def main() -> None:
    raise_on_signals()
    jobs.run(job_or_sweep)


def job_or_sweep() -> None:
    with ending:
        try:
            job()
        except ConfigCompositionException as error:
            fault = fault_of_first_run(sys.argv[1:]) or error
            raise fault from fault.__cause__

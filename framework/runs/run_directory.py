"""Writing of the run directory.

Each file is written atomically. Files that cannot be recomputed are written first, the small ones before the map. Only
complete runs have metrics.json. The file manifest.json is written last. A run that reads files of an earlier run in its
own directory replaces this run when all its files are written.
"""

from __future__ import annotations

import csv
import gc
import logging
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from omegaconf import DictConfig, OmegaConf

from framework.compilation.catalog import compile_for_run
from framework.config.composition import one_line, resolved
from framework.config.validation import checked_path
from framework.data import LIKELY, Float64, Instance
from framework.datasets.frames.sequence_reader import Recording
from framework.datasets.frames.world_offset import ORIGIN, as_setting, as_text, origin_comments, stored_origin
from framework.detection.stored.cache import cache_metrics
from framework.errors import DataError, InstanceMapError, PartialRunError
from framework.evaluation.compared_classes import ComparedClasses
from framework.files.atomic_write import atomic_write, make_folder, remove_left_over
from framework.files.folders.output_folder import OutputFolder, reads_results_in
from framework.files.folders.staged_files import StagedFiles, finish_replacement
from framework.files.json_file import write_json
from framework.files.manifest import MANIFEST, RUN_FILES, Manifest, RunStatus
from framework.files.tum_trajectory import read_tum, write_tum
from framework.interfaces import PoseTracker, RGBDSequence, RGBDVideo
from framework.live_view.guarded_viewer import watched_run
from framework.pipeline import Pipeline
from framework.pose_graph.depth_distortion_file import write_depth_distortion
from framework.pose_graph.graph_file import write_pose_graph
from framework.registry import STAGES, build
from framework.rendering.overview import write_overview
from framework.runs.inputs import INPUTS, hash_of, input_hashes
from framework.runs.instances_file import write_instances
from framework.runs.mesh_file import write_mesh
from framework.runs.metrics import (
    Metrics,
    class_name,
    doubled_metrics,
    instance_metrics,
    room_metrics,
    run_metrics,
    trajectory_metrics,
)
from framework.runs.plugin_code import plugin_code
from framework.runs.provenance import code_version, config_hash, environment, frozen_environment, leaves, parameters_of
from framework.runs.stored_runs import (
    CHOICE,
    CONFIG,
    DEPTH_DISTORTION,
    DIGESTS,
    ENVIRONMENT,
    GROUPS,
    INSTANCES,
    KEYFRAMES,
    MAP,
    MAPPED,
    MESH,
    METRICS,
    PARTIAL_METRICS,
    POSE_GRAPH,
    REPORT,
    TRACKED_TRAJECTORY,
    TRAJECTORY,
    has_metrics,
    read_metrics,
)
from framework.runtime.corrected_frames import TrackedFrame
from framework.runtime.process_settings import frozen_garbage_collector
from framework.runtime.run_log import RunResult
from framework.runtime.signals import ENDING, Interruption, interruptible_imports, signals_deferred
from framework.tracking.keyframes import write_keyframes
from framework.vocabulary.label_spaces import label_space_of

log = logging.getLogger(__name__)

Arguments = ParamSpec("Arguments")
Made = TypeVar("Made")


OWN_FILES = (*RUN_FILES, MANIFEST, REPORT)  # files that a later run in the same directory replaces or removes


@dataclass(frozen=True)
class WrittenRun:
    """The result of writing a run directory."""

    folder: Path  # the run directory, or another folder if the run directory could not be written
    error: BaseException | None  # None = complete run in the run directory
    moved: str = ""  # message with the folder, if it is not the run directory


@dataclass(frozen=True)
class RunRecord:
    """Writer of a run directory."""

    directory: Path
    config: Mapping[str, Any]  # resolved config
    choices: Mapping[str, str | None]  # chosen option of each config group
    inputs: Mapping[str, str]  # SHA-256 of the input files, by config key
    provenance: Metrics  # code and machine at the start of the run
    compared_classes: ComparedClasses  # label space of the evaluation
    in_place: bool  # the run reads files of an earlier run in the same directory

    @classmethod
    def begin(cls, directory: Path, config: DictConfig, choices: Mapping[str, str | None]) -> RunRecord:
        """Prepare the directory for a run.

        The metrics, manifest and report of an earlier run are removed, unless the new run reads files of this run.
        """
        plain = resolved(config)
        compared_classes = ComparedClasses.of(plain)
        inputs = input_hashes(plain)
        provenance: Metrics = {**code_version(), **plugin_code(plain), **environment()}
        make_folder(directory)
        finish_replacement(directory)
        StagedFiles(directory).discard()
        remove_left_over(directory)
        in_place = reads_results_in(directory, (value for _, value in leaves(plain)), OWN_FILES)
        if not in_place:
            for name in (MANIFEST, CONFIG, METRICS, PARTIAL_METRICS, REPORT):  # the manifest is invalid from here on
                (directory / name).unlink(missing_ok=True)
            _write_config(directory / CONFIG, plain)
        _reset_peak_memory()
        return cls(directory, plain, choices, inputs, provenance, compared_classes, in_place)

    def write(self, video: RGBDVideo, result: RunResult, counts: Mapping[str, int] | None = None) -> WrittenRun:
        """Write all outputs and log the main metrics.

        An error does not prevent the writing of other files. The run is then partial. If the run directory cannot be
        written, or a file is missing of a run that reads an earlier run in the same directory, the outputs are written
        to a new folder next to it.

        Args:
            video: The mapped video.
            result: The result of the pipeline.
            counts: Additional metrics.

        Returns:
            The folder, and the reason for a partial run: `result.stopped_by` or the first write error.

        Raises:
            DataError: No folder can be written.
        """
        outputs = OutputFolder.open(self.directory, keep_earlier=self.in_place)
        folder, scene, attempt = outputs.path, result.scene, _Attempts(result.stopped_by)
        for name in (
            MANIFEST,
            *MAPPED,
            TRACKED_TRAJECTORY,
            POSE_GRAPH,
            DEPTH_DISTORTION,
            KEYFRAMES,
            DIGESTS,
            ENVIRONMENT,
        ):  # from an earlier run
            attempt((folder / name).unlink, missing_ok=True)
        if not (folder / CONFIG).exists():
            attempt(_write_config, folder / CONFIG, self.config)
        comments = origin_comments(video.world_origin)
        reliable = attempt(_reliable, result.tracked)
        if reliable is not None:
            attempt(write_tum, folder / TRAJECTORY, *reliable, comments)
        as_tracked = None if result.as_tracked is None else attempt(_reliable, result.as_tracked)
        if as_tracked is not None:
            attempt(write_tum, folder / TRACKED_TRAJECTORY, *as_tracked, comments)
        if result.graph is not None:
            attempt(write_pose_graph, folder / POSE_GRAPH, result.graph)
        if result.depth_distortion is not None:
            attempt(write_depth_distortion, folder / DEPTH_DISTORTION, result.depth_distortion)
        attempt(write_timings, folder / "timings.csv", result)
        attempt(write_digests, folder / DIGESTS, result)
        figures: Metrics = {**(attempt(run_metrics, result) or {}), **origin_metrics(video), **(counts or {})}
        attempt(self._write_partial, folder, video, figures, attempt.error)  # in case the process is killed
        attempt(scene.save, folder / MAP)
        if result.keyframes:
            attempt(write_keyframes, folder / KEYFRAMES, result.keyframes)
        attempt(lambda: _write_text(folder / ENVIRONMENT, frozen_environment()))
        found = attempt(lambda: (scene.mesh(), scene.instances()))
        if found is not None:
            attempt(write_instances, folder / INSTANCES, *found, scene.classes)
            figures |= attempt(room_metrics, scene, found[0]) or {}
            figures |= {"label_space": label_space_of(scene.classes), "instances.count": len(found[1])}
            attempt(self._write_partial, folder, video, figures, attempt.error)
            attempt(write_mesh, folder / MESH, found[0], comments)
            # the trajectory as written, so that a re-evaluation returns the same metrics
            stored = attempt(read_tum, folder / TRAJECTORY)
            if stored is not None:
                classes = self.compared_classes
                figures |= attempt(instance_metrics, video, *found, scene.classes, stored, classes) or {}
        figures |= attempt(trajectory_metrics, result) or {}
        shown = {"sequence": video.name, **figures}
        labels = {} if found is None else likely_labels(found[1], scene.classes)
        if found is not None and (self.config.get("evaluation") or {}).get("doubled_instances"):
            figures |= attempt(doubled_metrics, video, found[0], labels.keys(), result) or {}
        if found is not None and reliable is not None:
            attempt(write_overview, folder / "overview.png", found[0], labels, reliable[1], caption(shown))
        if attempt.error is None:
            attempt(write_json, folder / METRICS, self._metrics(video, figures))
        if attempt.error is None:
            attempt((folder / PARTIAL_METRICS).unlink, missing_ok=True)
        else:
            attempt(self._write_partial, folder, video, figures, attempt.error)
        attempt(self._write_manifest, folder, RunStatus.COMPLETE if attempt.error is None else RunStatus.PARTIAL)
        folder, error = outputs.close(attempt.failure is None, OWN_FILES)
        moved = f"the outputs are in {_from_here(folder)}" if folder != self.directory else ""
        if moved and self.in_place:
            moved += f", and the earlier run in {_from_here(self.directory)} is unchanged"
        written = WrittenRun(folder, attempt.error or error, moved)
        self._announce(written, headline(shown), labels, figures)
        return written

    def _metrics(self, video: RGBDVideo, figures: Metrics) -> Metrics:
        return {
            "sequence": video.name,
            **{f"{CHOICE}{group}": self.choices.get(group) for group in GROUPS},
            **figures,
            "peak_rss_bytes": peak_memory(),
            "seed": self.config.get("seed"),
            "detection_interval": self.config.get("detection_interval", 1),
            "config_hash": config_hash(self.config),
            INPUTS: hash_of(self.inputs),
            **self.provenance,
        }

    def _write_partial(self, folder: Path, video: RGBDVideo, figures: Metrics, error: BaseException | None) -> None:
        """Write the metrics of a partial run, and the reason for its early end.

        Without an error, the outputs are still being written.
        """
        why = "the outputs were not completed" if error is None else reason(error)
        write_json(folder / PARTIAL_METRICS, {"partial": why, **self._metrics(video, figures)})

    def _write_manifest(self, folder: Path, status: RunStatus) -> None:
        manifest = Manifest(status, {}, self.inputs, parameters_of(self.config))
        manifest.with_files(folder, RUN_FILES).write(folder)

    def _announce(self, run: WrittenRun, title: str, labels: Mapping[int, tuple[str, float]], figures: Metrics) -> None:
        log.info("%s", title)
        likely = Counter(name for name, _ in labels.values())
        counted = ", ".join(f"{count} {name}" for name, count in likely.most_common()) or "no likely instance"
        unlikely = int(figures.get("instances.count") or 0) - len(labels)
        rest = f"; {unlikely} with a probability below {LIKELY} are only in the files" if unlikely else ""
        log.info("objects: %s%s", counted, rest)
        written = [name for name in ("overview.png", "mesh.ply", "instances.json") if (run.folder / name).exists()]
        if written:  # one line: directories of sweep jobs have long names
            others = f", {', '.join(written[1:])}" if written[1:] else ""
            log.info("%s%s", _from_here(run.folder / written[0]), others)
        if run.error is not None and not (run.folder / METRICS).exists():
            log.warning("partial run (%s): its metrics are in %s", reason(run.error), PARTIAL_METRICS)


def write_run(
    pipeline: Pipeline, config: DictConfig, directory: Path, choices: Mapping[str, str | None]
) -> Interruption:
    """Map the sequence or live video of a config, and write the run directory.

    A signal, an error of a stage or a disk error ends a run early. If at least one frame was mapped, the available
    outputs are written and marked as partial. The first signal takes effect after the current frame or output, the
    second signal immediately.

    Args:
        pipeline: The stages of the config.
        config: The config of the run.
        directory: The run directory.
        choices: The chosen option of each config group.

    Returns:
        A record of the signal that arrived during writing or ended a live video, if any.

    Raises:
        Interrupted: A signal ended the run early.
        PartialRunError: An error ended the run early. The error is its cause. If no frame was mapped, the error itself
            is raised.
    """
    gc.collect()  # otherwise, a garbage collection would delay one of the first few hundred frames
    with interruptible_imports():
        video = build(RGBDVideo, config.get("dataset"))  # last, because a synthetic scene takes the longest to build
    compile_for_run()  # kernels of the synthetic renderer
    record = RunRecord.begin(directory, config, choices)
    chosen = ", ".join(f"{stage} {choices.get(stage)}" for stage in STAGES if stage != "dataset")
    length = f"{len(video)} frames" if isinstance(video, RGBDSequence) else "live until Ctrl-C"
    log.info("mapping %s: %s, %s", video.name, length, chosen)
    if config.get("resume_from") is not None:
        check_origin(video, checked_path("resume_from", config.resume_from))
    if isinstance(video, Recording):  # third-party datasets may have another class
        warn_of_recording(video, pipeline.tracker)
    with signals_deferred(*ENDING) as interruption, watched_run(pipeline.viewer, directory, record.config) as outcome:
        with frozen_garbage_collector():
            result = pipeline.run_to_any_end(video, directory)
        with interruption.second_ends_at_once("after the outputs are written"):
            written = record.write(video, result, cache_metrics(pipeline.detector))
        with suppress(DataError):  # the disk may be full
            outcome.metrics = read_metrics(written.folder)
        if isinstance(written.error, Exception):
            raise PartialRunError("; ".join(filter(None, (reason(written.error), written.moved)))) from written.error
        if written.error is not None:
            if written.moved:
                log.warning("%s", written.moved)
            raise written.error
    return interruption


def warn_of_recording(video: Recording, tracker: PoseTracker) -> None:
    """Log a warning if the images or the given poses of a recording are wrong in a few frames."""
    from framework.checking.changed_sequences import PosedSequence
    from framework.checking.recording_check import CHECK, warn_of_images, warn_of_poses

    if warn_of_images(video):
        return  # errors of the poses are consequences
    if tracker.poses_given and tracker.pose_source != "ground_truth":
        fix = f"check the times and the convention of the tracker's poses, or write them to poses.txt and {CHECK}"
        warn_of_poses(PosedSequence(video, tracker), fix)
    else:
        warn_of_poses(video)


def origin_metrics(video: RGBDVideo) -> Metrics:
    """Return the origin of the map in the world frame of the recording, m; {} if it is that of the recording."""
    if not any(video.world_origin):
        return {}
    return {f"{ORIGIN}{axis}": value for axis, value in zip("xyz", video.world_origin, strict=True)}


def check_origin(video: RGBDVideo, resumed: Path) -> None:
    """Raise DataError if the map of a stored run has another origin than the poses of the video."""
    if not video.has_poses() or not has_metrics(resumed):
        return
    origin = np.array(stored_origin(read_metrics(resumed)) or (0.0, 0.0, 0.0))
    found = np.array(video.world_origin)
    if not np.array_equal(origin, found):
        expected = f"expected poses relative to the origin of the map, {as_text(origin)} m"
        raise DataError(f"resume_from: {expected}, got {as_text(found)} m; set {as_setting(origin)}")


@dataclass
class _Attempts:
    """Callable that runs a function and logs its error instead of raising it."""

    stopped_by: BaseException | None  # reason for the early end of the run; None = complete run
    failure: Exception | None = None  # first error of a function; None = no error

    @property
    def error(self) -> BaseException | None:
        return self.stopped_by or self.failure

    def __call__(
        self, function: Callable[Arguments, Made], *arguments: Arguments.args, **named: Arguments.kwargs
    ) -> Made | None:
        """Return the result of the function, or None if it fails."""
        try:
            return function(*arguments, **named)
        except Exception as error:
            log.warning("%s", reason(error))
            self.failure = self.failure or error
            return None


def _reliable(frames: Sequence[TrackedFrame]) -> tuple[Float64, Float64]:
    """Return the timestamps (F,), s, and the poses (F, 4, 4) of the frames that are not lost."""
    reliable = [(one.timestamp, one.pose.T_world_camera) for one in frames if not one.pose.lost]
    poses = np.array([T_world_camera for _, T_world_camera in reliable]).reshape(-1, 4, 4)
    return np.array([timestamp for timestamp, _ in reliable]), poses


def _write_config(path: Path, config: Mapping[str, Any]) -> None:
    with atomic_write(path) as temporary:
        OmegaConf.save(OmegaConf.create(dict(config)), temporary)


def _from_here(path: Path) -> Path:
    """Return the path relative to the working directory, or the absolute path if it is elsewhere."""
    here, place = Path.cwd(), path.absolute()
    return place.relative_to(here) if place.is_relative_to(here) else place


def likely_labels(instances: Mapping[int, Instance], classes: tuple[str, ...]) -> dict[int, tuple[str, float]]:
    """Return the class name and the probability of existence of each likely instance, by id."""
    return {
        key: (class_name(instance, classes) or "object", instance.probabilities[0])
        for key, instance in instances.items()
        if instance.probabilities[0] >= LIKELY
    }


_DROPPED = {
    "frames_lost": "lost",
    "frames_skipped": "skipped",
    "frames_dropped": "dropped",
    "frames_disagreeing": "disagree with the map",
}
_QUALITY = {"instances.ap50": "AP50", "instances.ap25": "AP25"}
_TIMES = ("fps", "latency_ms")


def caption(metrics: Mapping[str, Any]) -> str:
    """Return the main metrics of a run without run times, which differ between runs with identical results."""
    return headline({key: value for key, value in metrics.items() if key not in _TIMES})


def headline(metrics: Mapping[str, Any]) -> str:
    """Return the main metrics of a run as one line of text."""
    parts = [str(metrics["sequence"])]
    if "frames" in metrics:
        speed = f" at {metrics['fps']:.1f}/s" if "fps" in metrics else ""
        parts += [f"{metrics['frames']} frames{speed}"]
    parts += [f"{metrics[key]} {word}" for key, word in _DROPPED.items() if metrics.get(key)]
    if metrics.get("latency_ms") is not None:
        parts.append(f"latency {metrics['latency_ms']:.0f} ms")
    if metrics.get("pose_source") == "ground_truth":
        parts.append("given poses")
    elif metrics.get("trajectory.ate_rmse_m") is not None:
        parts.append(f"ATE {metrics['trajectory.ate_rmse_m']:.3f} m")
    if "instances.count" in metrics:
        parts.append(f"{metrics['instances.count']} instances")
    parts += [f"{word} {metrics[key]:.2f}" for key, word in _QUALITY.items() if metrics.get(key) is not None]
    return " | ".join(parts)


def reason(error: BaseException) -> str:
    """Return the reason for a partial run as one line of text."""
    if isinstance(error, KeyboardInterrupt):
        return str(error) or "interrupted by Ctrl-C"
    return one_line(error) if isinstance(error, InstanceMapError) else f"{type(error).__name__}: {one_line(error)}"


def write_timings(path: Path, result: RunResult) -> None:
    """Write the time of each stage for each frame as CSV, in chronological order."""
    with atomic_write(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("frame", "stage", "milliseconds"))
        writer.writerows((time.frame, time.stage, f"{time.milliseconds:.3f}") for time in result.timings)


def write_digests(path: Path, result: RunResult) -> None:
    """Write the digest of each stage for each frame as CSV, in chronological order."""
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write("frame,stage,digest\n")
        file.writelines(f"{one.frame},{one.stage},{one.digest:08x}\n" for one in result.digests)


def _write_text(path: Path, text: str) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(text, "utf-8")


def peak_memory() -> int | None:
    """Return the peak resident memory of this process in bytes, or None on Windows.

    On Linux, it is measured from the start of the run. On macOS, it is measured from the start of the process.
    """
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # Linux counts in KiB


def _reset_peak_memory() -> None:
    """Reset the peak memory of this process on Linux."""
    # otherwise, it includes earlier jobs of the sweep
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")

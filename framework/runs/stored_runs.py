"""Search and reading of stored runs."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeGuard

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from framework.config.composition import resolved
from framework.config.renamed_keys import replace_in_config
from framework.errors import DataError, first_line
from framework.files.atomic_write import MAX_TEXT, path_exists, read_bytes
from framework.files.folders.staged_files import REPLACING, finish_replacement
from framework.files.json_file import read_json
from framework.files.manifest import MANIFEST, verified
from framework.files.yaml_file import load_yaml
from framework.registry import STAGES
from framework.runs.inputs import INPUTS, inputs_sha256
from framework.runs.plugin_code import changed_code, plugin_code
from framework.runs.provenance import (
    OF_SPEED,
    code_version,
    config_hash,
    environment,
    leaves,
    relevant,
    shows_speed,
    speed_settings,
)

CONFIG = "config.yaml"
METRICS = "metrics.json"  # exists only for completed runs
PARTIAL_METRICS = "metrics.partial.json"  # metrics of a partial run; the key `partial` contains the reason
LOG = "instancemap.log"
MAP = "map.npz"
MESH = "mesh.ply"
INSTANCES = "instances.json"
TRAJECTORY = "trajectory.txt"
TRACKED_TRAJECTORY = "trajectory_tracked.txt"  # poses before any correction by the back end; optional
POSE_GRAPH = "pose_graph.json"  # submaps and loops of the back end; optional
REPORT = "report.html"  # written by `instancemap report`
DEPTH_DISTORTION = "depth_distortion.json"  # correction of depth, also for runs that resume the map; optional
KEYFRAMES = "keyframes.npz"  # keyframes of the tracker, to resume the map; optional
MAPPED = (TRAJECTORY, "timings.csv", MAP, INSTANCES, MESH, "overview.png")
"""Files of a map in the order of writing. In case the disk becomes full, files that can be recomputed are last."""

DIGESTS = "digests.csv"  # digest of each stage for each frame, to locate differences between runs
ENVIRONMENT = "environment.txt"  # versions of all installed packages, as constraints for pip

EVALUATION = "evaluation."  # prefix of keys about the last re-evaluation
GROUND_TRUTH = EVALUATION + "ground_truth"  # key of the last re-evaluated `dataset.ground_truth`; optional
EDITED_FROM = "edited_from"  # key with the path of the run that `instancemap edit` has edited; optional
MERGED_FROM, MERGED_WITH = "merged_from", "merged_with"  # keys with the runs of `instancemap merge`; optional
MERGED_POSES = "merged_from_poses"  # key with the number of poses of the first of these runs

EXTERNAL = "external"  # value of `pose_source` and of the chosen stages of an imported map
CHOICE = "choice."  # prefix of the chosen options in metrics.json
GROUPS = (*STAGES, "preset", "sequences")  # config groups whose chosen option is stored
FIGURES = (
    "instances.",
    "panoptic.",
    "semantic.",
    "trajectory.",
    "stage_ms.",
    "map.",
    "frames",
    "fps",
)  # prefixes of numeric metrics

_LOG_LINE = re.compile(r"\S+ (?P<level>DEBUG|INFO|WARNING|ERROR|CRITICAL) +(?P<message>.*)")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Record:
    """A stored run."""

    directory: Path
    metrics: Mapping[str, Any]  # by key of metrics.json; a value of None = undefined
    config: Mapping[str, Any]  # resolved config
    written: float  # modification time of the metrics file, s since the epoch

    @property
    def commit(self) -> str:
        return commit_of(self.metrics)

    @property
    def code(self) -> str:
        """Commit of the run and, if different, of its re-evaluation."""
        prefix = len(EVALUATION)
        later = {key[prefix:]: value for key, value in self.metrics.items() if key.startswith(EVALUATION)}
        evaluator = commit_of(later) if later else self.commit
        return self.commit if evaluator == self.commit else f"{self.commit}, evaluated by {evaluator}"

    @property
    def dataset(self) -> dict[str, Any]:
        """Config of the dataset, with the ground truth of the last evaluation."""
        config = dict(self.config.get("dataset") or {})
        return config | ({"ground_truth": self.metrics[GROUND_TRUTH]} if GROUND_TRUTH in self.metrics else {})

    @property
    def annotation(self) -> str:
        """Release of the ground truth, or "" if unknown."""
        return str(self.metrics.get("annotation_release") or "")

    @property
    def derived(self) -> str:
        """Description of a run that `edit` or `merge` has derived from other runs, or "" for other runs."""
        if EDITED_FROM in self.metrics:
            return f"edited map of {self.metrics[EDITED_FROM]}"
        if MERGED_FROM in self.metrics:
            return f"merged map of {self.metrics[MERGED_FROM]} and {self.metrics.get(MERGED_WITH)}"
        return ""

    @property
    def is_imported(self) -> bool:
        """True for the map of another system, which has no trajectory, run times or map.npz."""
        return self.metrics.get("pose_source") == EXTERNAL

    @property
    def row(self) -> str:
        """Name of the row in an experiment or of an imported map, or "" for another run."""
        row = self.config.get("row")
        return "" if row is None else str(row)

    @cached_property
    def choices(self) -> dict[str, str]:
        """Chosen option of each config group."""
        chosen = {key.removeprefix(CHOICE): value for key, value in self.metrics.items() if key.startswith(CHOICE)}
        return {group: str(option) for group, option in chosen.items() if option is not None}

    @cached_property
    def parameters(self) -> dict[str, Any]:
        """Parameters that affect results, by dotted key."""
        return dict(leaves(relevant(self.config)))

    @cached_property
    def settings(self) -> dict[str, Any]:
        """All settings of the run by key.

        These are the row, the chosen options, the parameters and the settings that affect speed.
        """
        row = {"row": self.row} if self.row else {}
        speed = {key: self.config[key] for key in OF_SPEED if key in self.config}
        return (
            row
            | self.choices
            | {key: self.parameters[key] for key in self.parameters if key not in self.choices}
            | speed
        )


@dataclass(frozen=True)
class Incomplete:
    """An incomplete run, with the reason."""

    directory: Path
    reason: str


WITH_CHANGES = " with changes"  # suffix for a checkout with modified files


def commit_of(metrics: Mapping[str, Any]) -> str:
    """Return the short commit of a run, e.g. "7dcc5d0" or "7dcc5d0 with changes".

    The commit is "unknown" for runs outside of a checkout.
    """
    changes = WITH_CHANGES if metrics.get("git_dirty") is True else ""
    return f"{str(metrics.get('git_commit'))[:7]}{changes}"


def read_record(directory: Path, check_files: bool = True) -> Record:
    """Read the completed run in a directory.

    Args:
        directory: The run directory.
        check_files: Require that the config and the metrics have not changed since the run.

    Raises:
        DataError: A file is missing, invalid or inconsistent.
    """
    return _read(directory, METRICS, check_files)


def read_partial(directory: Path) -> tuple[Record, str]:
    """Read the partial run in a directory, and the reason for its early end.

    Raises:
        DataError: The metrics or the config are missing, invalid or from different runs.
    """
    record = _read(directory, PARTIAL_METRICS)
    return record, str(record.metrics.get("partial"))


def _read(directory: Path, name: str, check_files: bool = True) -> Record:
    finish_replacement(directory)
    path = directory / name
    with verified(path) if check_files else nullcontext():
        metrics = _read_flat(path)
    with verified(directory / CONFIG) if check_files else nullcontext():
        config = read_yaml(directory / CONFIG)
    if check_files and metrics.get("config_hash") != config_hash(config):
        raise DataError(
            f"{path}: expected the config_hash of {CONFIG}, {config_hash(config)[:8]}, got "
            f"{metrics.get('config_hash')!s:.8}; repeat the run"
        )
    try:
        written = path.stat().st_mtime
    except OSError as error:  # the run has been restarted
        raise DataError(f"{path}: expected a readable file, got an error ({error.strerror})") from error
    return Record(directory, metrics, replace_in_config(config), written)


def check_resolved(config: Mapping[str, Any]) -> None:
    """Check that a stored config contains no interpolation, because it could read environment variables.

    Raises:
        DataError: A value contains an interpolation.
    """
    for key, value in leaves(config):
        if "${" in str(value):
            raise DataError(f"{key}: expected a resolved value in the run's {CONFIG}, got {value}; repeat the run")


def find_records(root: Path) -> tuple[list[Record], list[Incomplete]]:
    """Return the completed and the incomplete runs in a folder and its subfolders, sorted by path."""
    records: list[Record] = []
    others: list[Incomplete] = []
    for directory in run_directories(root):
        try:
            finish_replacement(directory)
            if not (directory / METRICS).exists():
                others.append(Incomplete(directory, _why_incomplete(directory)))
                continue
            records.append(read_record(directory))
        except DataError as error:
            others.append(Incomplete(directory, str(error)))
    return records, others


def completed_runs(root: Path) -> tuple[list[Record], list[Incomplete]]:
    """Return the completed and the other runs in a folder that contains at least one completed run.

    Edited and merged runs are among the other runs.

    Raises:
        DataError: The folder is missing or contains no completed run.
    """
    if not root.is_dir():
        raise DataError(f"{root}: expected a folder of runs, got no folder")
    records, incomplete = without_derived(*find_records(root))
    if not records:
        raise no_run_error(root, incomplete)
    return records, incomplete


def without_derived(records: Sequence[Record], others: Sequence[Incomplete]) -> tuple[list[Record], list[Incomplete]]:
    """Move edited and merged runs to the other runs, because their maps are no results of a method."""
    derived = [Incomplete(one.directory, one.derived) for one in records if one.derived]
    return [one for one in records if not one.derived], [*others, *derived]


def no_run_error(root: Path, incomplete: Sequence[Incomplete]) -> DataError:
    """Return the error for a folder without a completed run."""
    why = "; ".join(f"{one.directory.name}: {one.reason}" for one in incomplete[:3])
    return DataError(f"{root}: expected a completed run, got none{f' ({why})' if why else ''}")


def is_recorded(directory: Path, config: DictConfig) -> bool:
    """Return True if a directory contains a completed run with this config, and log the decision.

    The input files and the code of the plugins must be the same, too. For experiments with a speed column, this also
    applies to the settings that affect speed. The commit may differ, because most commits do not change results.
    """
    finish_replacement(directory)
    if not (directory / METRICS).exists():
        return False
    if not path_exists(directory / MANIFEST):  # killed between the two files
        log.warning("repeating the run: %s: expected a file, got none", directory / MANIFEST)
        return False
    try:
        record = read_record(directory)
    except DataError as error:
        log.warning("repeating the run: %s", error)
        return False
    plain = resolved(config)
    if record.metrics["config_hash"] != config_hash(plain):
        log.info("repeating the run: the config in %s differs", directory)
        return False
    if changed := changed_code(record.metrics, plugin_code(plain)):
        log.info("repeating the run: the code changed since the run in %s: %s", directory, "; ".join(changed))
        return False
    if record.metrics.get(INPUTS) not in (None, inputs_sha256(plain)):  # None = written by a version without this key
        log.info("repeating the run: weights or data changed since the run in %s", directory)
        return False
    settings = speed_settings(record.config, record.metrics)
    if shows_speed(plain) and settings != speed_settings(plain, environment()):
        shown = ", ".join(f"{key.rpartition('.')[2]}={value}" for key, value in settings.items())
        log.info(
            "repeating the run: the times in %s were measured with other settings or on another machine: %s",
            directory,
            shown,
        )
        return False
    if lost := [name for name in MAPPED if not (directory / name).exists()]:
        log.warning("%s: expected %s, got none; set skip_completed=false to repeat the run", directory, ", ".join(lost))
    now = commit_of(code_version())
    if record.commit == now and not now.endswith(WITH_CHANGES):  # two checkouts with changes may differ
        log.info("skipped: the completed run in %s", directory)
    else:
        message = (
            "skipped: the completed run in %s, of commit %s; the current commit is %s; set "
            "skip_completed=false to repeat the run"
        )
        log.warning(message, directory, record.commit, now)
    return True


def read_yaml(path: Path) -> dict[str, Any]:
    """Read the keys and values in a YAML file, without resolving interpolations.

    Raises:
        DataError: The file is missing or invalid, or contains a list.
    """
    if not path.exists():
        raise DataError(f"{path}: expected a file, got none")
    try:
        content = OmegaConf.to_container(load_yaml(path), resolve=False)
    except OmegaConfBaseException as error:
        raise DataError(f"{path}: expected valid YAML, got an error ({first_line(error)})") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: expected keys and values, got a list")
    return {str(key): _with_text_keys(value) for key, value in content.items()}


def _with_text_keys(node: Any) -> Any:
    """Convert all keys of nested mappings to text."""
    # YAML keys such as 1 and true cannot be sorted
    if isinstance(node, dict):
        return {str(key): _with_text_keys(value) for key, value in node.items()}
    return [_with_text_keys(one) for one in node] if isinstance(node, list) else node


def read_config(directory: Path) -> dict[str, Any]:
    """Read the config of a run without resolving interpolations, {} without a config.

    Raises:
        DataError: The config is invalid or has changed since the run.
    """
    finish_replacement(directory)
    path = directory / CONFIG
    if not path_exists(path):
        return {}
    with verified(path):
        return replace_in_config(read_yaml(path))


def has_metrics(directory: Path) -> bool:
    """Return True for the directory of a completed or partial run."""
    return any(path_exists(directory / name) for name in (METRICS, PARTIAL_METRICS))


def read_metrics(directory: Path) -> dict[str, Any]:
    """Read the metrics of a completed or partial run.

    Raises:
        DataError: The metrics are missing or invalid.
    """
    finish_replacement(directory)
    for name in (METRICS, PARTIAL_METRICS):
        if path_exists(directory / name):
            with verified(directory / name):
                return _read_flat(directory / name)
    raise DataError(f"{directory}: expected a run directory with {METRICS} or {PARTIAL_METRICS}, got neither")


def _read_flat(path: Path) -> dict[str, Any]:
    content = read_json(path)
    if not isinstance(content, dict):
        raise DataError(f"{path}: expected a JSON object, got {content!r:.40}")
    if nested := [key for key, value in content.items() if isinstance(value, dict | list)]:
        raise DataError(f"{path}: expected flat values, got nested values below {nested[0]!r}")
    for key, value in content.items():
        if key.startswith(FIGURES) and value is not None and not is_number(value):
            raise DataError(f"{path}: {key}: expected a number or null, got {value!r}")
    return content


def is_number(value: Any) -> TypeGuard[float]:
    """Return True for a finite number that is not a boolean."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def run_directories(root: Path) -> Iterator[Path]:
    """Yield the run directories in a folder and its subfolders, sorted by path."""
    for path, folders, files in os.walk(root):
        is_run = not {METRICS, PARTIAL_METRICS, LOG, MANIFEST, REPLACING}.isdisjoint([*files, *folders])
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        if is_run:
            yield Path(path)


def _why_incomplete(directory: Path) -> str:
    """Return the reason why a run is incomplete."""
    if (directory / PARTIAL_METRICS).exists():
        try:
            return f"partial: {read_metrics(directory).get('partial')}"
        except DataError as error:
            return str(error)
    try:
        lines = read_bytes(directory / LOG, MAX_TEXT).decode(errors="replace").splitlines()
    except DataError:
        lines = []
    matches = [match for match in map(_LOG_LINE.match, lines) if match]
    # the error of a failed run is the last message in its log
    if matches and matches[-1]["level"] in ("ERROR", "CRITICAL"):
        return f"failed: {matches[-1]['message']}"
    return "incomplete: running or killed"

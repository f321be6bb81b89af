"""The records that runs have left behind, read back: which are complete, and what became of the others."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from framework.errors import DataError, first_line
from framework.files.atomic_write import MOST_TEXT, is_there, read_bytes
from framework.files.json_file import read_json
from framework.files.yaml_file import load_yaml
from framework.runs.inputs import INPUTS, inputs_sha256
from framework.runs.provenance import code_version, config_hash, environment, shows_speed, speed_settings

CONFIG = "config.yaml"
METRICS = "metrics.json"  # there exactly when the run completed
PARTIAL_METRICS = "metrics.partial.json"  # in its place when the run ended early, with the reason under `partial`
LOG = "instancemap.log"
MAP = "map.npz"
MESH = "mesh.ply"
INSTANCES = "instances.json"
TRAJECTORY = "trajectory.txt"
REPORT = "report.html"  # what `report` writes: made of a record, and no part of it
KEYFRAMES = "keyframes.npz"  # what the tracker remembers, for who goes on with the map; some remember nothing
MAPPED = (TRAJECTORY, "timings.csv", INSTANCES, MESH, MAP, "overview.png")
"""What is written of a map, in this order: on a disk that is full the small ones still find a place."""

EVALUATION = "evaluation."  # before the keys that name the code that evaluated anew; absent where it is that of the run

FIGURES = ("instances.", "trajectory.", "stage_ms.", "map.", "frames", "fps")  # begin the keys of numbers in METRICS

_LOG_LINE = re.compile(r"\S+ (?P<level>DEBUG|INFO|WARNING|ERROR|CRITICAL) +(?P<message>.*)")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Record:
    """A completed run."""

    directory: Path
    metrics: Mapping[str, Any]  # flat; None = not defined
    config: Mapping[str, Any]  # resolved
    written: float  # s, when, as the file system tells

    @property
    def commit(self) -> str:
        return commit_of(self.metrics)

    @property
    def code(self) -> str:
        """What ran, and what evaluated it where that is other code."""
        anew = {
            key.removeprefix(EVALUATION): value for key, value in self.metrics.items() if key.startswith(EVALUATION)
        }
        evaluator = commit_of(anew) if anew else self.commit
        return self.commit if evaluator == self.commit else f"{self.commit}, evaluated by {evaluator}"

    @property
    def annotation(self) -> str:
        """Which release of the true instances the run was compared with; "" = the dataset does not say."""
        return str(self.metrics.get("annotation_release") or "")


@dataclass(frozen=True)
class Incomplete:
    """A run without a record that can be used, and why."""

    directory: Path
    reason: str


WITH_CHANGES = " with changes"  # ends the name of code that is no commit


def commit_of(metrics: Mapping[str, Any]) -> str:
    """The code that ran, short: "7dcc5d0", "7dcc5d0 with changes" or "unknown"."""
    changes = WITH_CHANGES if metrics.get("git_dirty") is True else ""
    return f"{str(metrics.get('git_commit'))[:7]}{changes}"


def read_record(directory: Path) -> Record:
    """The record of the completed run in `directory`.

    Raises DataError, naming the file, when one cannot be read or the two are not of the same run.
    """
    metrics, config = _read_flat(directory / METRICS), read_yaml(directory / CONFIG)
    if metrics.get("config_hash") != config_hash(config):
        raise DataError(f"{directory / METRICS} is not of the config beside it: config_hash differs; run it again")
    try:
        written = (directory / METRICS).stat().st_mtime
    except OSError as error:  # the run has just begun again
        raise DataError(f"{directory / METRICS} cannot be read: {error.strerror}") from error
    return Record(directory, metrics, config, written)


def read_partial(directory: Path) -> tuple[Record, str]:
    """What there is of a run that ended early, and why it did.

    Raises DataError, naming the file, when one cannot be read or the two are not of the same run.
    """
    path = directory / PARTIAL_METRICS
    metrics, config = _read_flat(path), read_yaml(directory / CONFIG)
    if metrics.get("config_hash") != config_hash(config):
        raise DataError(f"{path} is not of the config beside it: config_hash differs; run it again")
    return Record(directory, metrics, config, path.stat().st_mtime), str(metrics.get("partial"))


def find_records(root: Path) -> tuple[list[Record], list[Incomplete]]:
    """All runs at and below `root`, by path: those that completed, and the others."""
    records: list[Record] = []
    others: list[Incomplete] = []
    for directory in _run_directories(root):
        if not (directory / METRICS).exists():
            others.append(Incomplete(directory, _why_incomplete(directory)))
            continue
        try:
            records.append(read_record(directory))
        except DataError as error:
            others.append(Incomplete(directory, str(error)))
    return records, others


def is_recorded(directory: Path, config: DictConfig) -> bool:
    """Whether `directory` holds the complete record of a run of this very config and inputs, and says so in the log.

    Where the experiment shows frames a second, its threads and the like must agree, too. The record may be of another
    commit: most commits change no result, and the tables name those of all their runs.
    """
    if not (directory / METRICS).exists():
        return False
    try:
        record = read_record(directory)
    except DataError as error:
        log.warning("run again: %s", error)
        return False
    resolved = OmegaConf.to_container(config, resolve=True)
    assert isinstance(resolved, dict)
    asked = {str(key): value for key, value in resolved.items()}
    if record.metrics["config_hash"] != config_hash(asked):
        log.info("run again: the record in %s is of another config", directory)
        return False
    if record.metrics.get(INPUTS) not in (None, inputs_sha256(asked)):  # None: older records do not tell
        log.info("run again: weights or data have changed since the record in %s", directory)
        return False
    settings = speed_settings(record.config, record.metrics)
    if shows_speed(asked) and settings != speed_settings(asked, environment()):
        said = ", ".join(f"{key.rpartition('.')[2]}={value}" for key, value in settings.items())
        log.info("run again: the times in %s are of other settings or another machine: %s", directory, said)
        return False
    if lost := [name for name in MAPPED if not (directory / name).exists()]:
        log.warning("%s has lost %s; skip_completed=false would make it again", directory, ", ".join(lost))
    now = commit_of(code_version())
    if record.commit == now and not now.endswith(WITH_CHANGES):  # two trees with changes may differ
        log.info("kept: the complete record in %s", directory)
    else:
        message = (
            "kept: the complete record in %s, of commit %s; this is %s, and skip_completed=false would run it again"
        )
        log.warning(message, directory, record.commit, now)
    return True


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML file with keys and values, interpolations unresolved. Raises DataError, naming the file."""
    if not path.exists():
        raise DataError(f"{path} is missing")
    try:
        content = OmegaConf.to_container(load_yaml(path), resolve=False)
    except OmegaConfBaseException as error:
        raise DataError(f"{path} cannot be read: {first_line(error)}") from error
    if not isinstance(content, dict):
        raise DataError(f"{path} must hold keys and values, found a list")
    return {str(key): _with_text_keys(value) for key, value in content.items()}


def _with_text_keys(node: Any) -> Any:
    """With text for every key, as in JSON: YAML takes 1 and true for something else, and such keys have no order."""
    if isinstance(node, dict):
        return {str(key): _with_text_keys(value) for key, value in node.items()}
    return [_with_text_keys(one) for one in node] if isinstance(node, list) else node


def read_figures(directory: Path) -> dict[str, Any]:
    """metrics.json, or metrics.partial.json of a run that ended early. Raises DataError where there is neither."""
    for name in (METRICS, PARTIAL_METRICS):
        if is_there(directory / name):
            return _read_flat(directory / name)
    raise DataError(f"there is no {directory / METRICS}, nor a {PARTIAL_METRICS}: expected the directory of a run")


def _read_flat(path: Path) -> dict[str, Any]:
    content = read_json(path)
    if not isinstance(content, dict):
        raise DataError(f"{path} must hold an object, found {type(content).__name__}")
    if nested := [key for key, value in content.items() if isinstance(value, dict | list)]:
        raise DataError(f"{path} must be flat, found more below {nested[0]!r}")
    for key, value in content.items():
        if key.startswith(FIGURES) and value is not None and not is_number(value):
            raise DataError(f"{path}: {key} must be a number or null, found {value!r}")
    return content


def is_number(value: Any) -> TypeGuard[float]:
    """Whether it is a finite number, and none of Python's truth values."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _run_directories(root: Path) -> Iterator[Path]:
    for path, folders, files in os.walk(root):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        if not {METRICS, PARTIAL_METRICS, LOG}.isdisjoint(files):
            yield Path(path)


def _why_incomplete(directory: Path) -> str:
    """In words. A job's fault is the last line of its log, but for a traceback."""
    if (directory / PARTIAL_METRICS).exists():
        try:
            return f"partial: {_read_flat(directory / PARTIAL_METRICS).get('partial')}"
        except DataError as error:
            return str(error)
    try:
        lines = read_bytes(directory / LOG, MOST_TEXT).decode(errors="replace").splitlines()
    except DataError:
        lines = []
    matches = [match for match in map(_LOG_LINE.match, lines) if match]
    if matches and matches[-1]["level"] in ("ERROR", "CRITICAL"):
        return f"failed: {matches[-1]['message']}"
    return "not complete: running, or killed"

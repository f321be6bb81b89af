"""Comparison of a stored run with its repetition."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from framework.config.renamed_keys import replace_in_config
from framework.errors import DataError
from framework.files.atomic_write import read_text
from framework.files.manifest import Manifest, verified
from framework.runs.inputs import ROOT, input_hashes
from framework.runs.plugin_code import changed_code, plugin_code
from framework.runs.provenance import code_version, leaves, package_version, parameters_of, public_version
from framework.runs.stored_runs import (
    CONFIG,
    DEPTH_DISTORTION,
    DIGESTS,
    ENVIRONMENT,
    INSTANCES,
    KEYFRAMES,
    MAP,
    MESH,
    POSE_GRAPH,
    TRACKED_TRAJECTORY,
    TRAJECTORY,
    Record,
    commit_of,
)
from framework.runtime.run_log import STAGE_ORDER

# result files, which contain no run times
COMPARED = (TRAJECTORY, TRACKED_TRAJECTORY, POSE_GRAPH, DEPTH_DISTORTION, INSTANCES, MESH, MAP, KEYFRAMES)
PACKAGES = ("numba", "numpy", "onnxruntime", "opencv-python-headless", "scipy", "torch", "transformers")
"""Packages that may affect the last digits of results."""

LARGE = (MAP, MESH, KEYFRAMES)  # files that are optional in a bundle


def causes(record: Record) -> list[str]:
    """Return the changes since a run that may make its repetition differ, one message each.

    The changes are in stored files, parameters, input files, plugin code, the commit and the versions of numerical
    packages.

    Raises:
        DataError: The manifest is missing or damaged.
    """
    manifest = Manifest.read(record.directory)
    changed_files = manifest.changed_files(record.directory, optional=LARGE)
    if record.is_imported:  # not made from its config by this code
        return changed_files
    return [
        *changed_files,
        *_changed_parameters(manifest.parameters, record),
        *_changed_inputs(manifest.inputs, input_hashes(record.config), record.config),
        *(f"plugin code of {change}" for change in changed_code(record.metrics, plugin_code(record.config))),
        *_changed_commit(record),
        *_changed_packages(record.directory / ENVIRONMENT),
    ]


def _changed_parameters(before: Mapping[str, str], record: Record) -> Iterator[str]:
    """Yield the parameters in config.yaml that differ from those in manifest.json."""
    before, now = replace_in_config(before), parameters_of(record.config)
    for key in dict.fromkeys([*before, *now]):
        expected, got = (values.get(key, "no value") for values in (before, now))
        if expected != got:
            yield f"{record.directory / CONFIG}: {key}: expected {expected}, got {got}"


def _changed_inputs(before: Mapping[str, str], now: Mapping[str, str], config: Mapping[str, Any]) -> Iterator[str]:
    values = dict(leaves(config))
    for key, sha256 in before.items():
        if now.get(key) == sha256:
            continue
        if key == ROOT:
            yield f"{key}: expected the file names, sizes and modification times as in the run, got different ones"
        else:
            found = f"the SHA-256 {now[key][:12]}" if key in now else "no file"
            yield f"{key}: expected the file with the SHA-256 {sha256[:12]}, got {found} in {values.get(key)}"


def _changed_commit(record: Record) -> Iterator[str]:
    now = commit_of(code_version())
    if record.commit != now:
        yield f"git_commit: expected {record.commit}, got {now}"


def _changed_packages(path: Path) -> Iterator[str]:
    """Yield the numerical packages whose installed version differs from environment.txt."""
    if not path.exists():
        return
    before = dict(line.split("==", 1) for line in read_text(path).splitlines() if "==" in line)
    for package in PACKAGES:
        now = package_version(package)
        if package in before and public_version(before[package]) != public_version(now or ""):
            yield (
                f"{package}: expected version {before[package]}, got {now or 'none'}; install with the constraints in "
                f"{path}"
            )


@dataclass(frozen=True)
class Reproduction:
    """Differences between a stored run and its repetition."""

    files: tuple[str, ...]  # names of the different result files; empty = all are byte-identical
    frame: int | None = None  # first frame with a different result; None = unknown or no difference
    stage: str = ""  # first different stage of this frame

    @classmethod
    def of(cls, before: Path, after: Path) -> Reproduction:
        """Compare the directories of a run and its repetition.

        Raises:
            DataError: A manifest or a file with digests is invalid.
        """
        old, new = Manifest.read(before).files, Manifest.read(after).files
        names = [name for name in COMPARED if name in old or name in new]
        different = tuple(name for name in names if old.get(name) != new.get(name))
        first = _first_difference(before / DIGESTS, after / DIGESTS)
        return cls(different, *first) if first else cls(different)

    @property
    def is_identical(self) -> bool:
        """True if all files and digests are equal."""
        return not self.files and self.frame is None

    def __str__(self) -> str:
        if self.is_identical:
            return "byte-identical"
        where = f"first difference: frame {self.frame}, {self.stage}; " if self.frame is not None else ""
        return f"{where}different files: {', '.join(self.files) or 'none'}"


def _first_difference(before: Path, after: Path) -> tuple[int, str] | None:
    """Return the first frame and stage with different digests, or None."""
    if not (before.exists() and after.exists()):
        return None
    old, new = _digests(before), _digests(after)
    different = [key for key in dict.fromkeys([*old, *new]) if old.get(key) != new.get(key)]
    return min(different, key=lambda key: (key[0], STAGE_ORDER.index(key[1])), default=None)


def _digests(path: Path) -> dict[tuple[int, str], str]:
    """Read the digests by frame and stage."""
    try:
        with verified(path):
            rows = list(csv.DictReader(read_text(path).splitlines()))
        return {(int(row["frame"]), row["stage"]): row["digest"] for row in rows if row["stage"] in STAGE_ORDER}
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: expected the columns frame, stage and digest, got an error ({error!r})") from error

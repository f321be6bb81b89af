"""Manifest of a run: status, inputs, parameters and hashes of the result files.

Readers of run files verify them with `verified`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

from framework.errors import DataError
from framework.files.atomic_write import path_exists, read_bytes
from framework.files.folders.restartable_folder import check_finished
from framework.files.folders.staged_files import finish_replacement
from framework.files.hashing import path_hash
from framework.files.json_file import parse_json, write_json

MANIFEST = "manifest.json"
MAX_SIZE = 2**24  # maximum size of a manifest, bytes; a usual one has 10 kB
RUN_FILES = (
    "config.yaml",
    "metrics.json",
    "metrics.partial.json",
    "trajectory.txt",
    "trajectory_tracked.txt",
    "pose_graph.json",
    "timings.csv",
    "instances.json",
    "mesh.ply",
    "map.npz",
    "overview.png",
    "keyframes.npz",
    "depth_distortion.json",
    "digests.csv",
    "environment.txt",
)
"""Files that are listed in a manifest if they exist."""

_START = b'{\n  "status": "'  # first bytes of a manifest

VERIFY = "instancemap verify"  # command that verifies all files of a run


class RunStatus(Enum):
    """Status of a run directory."""

    COMPLETE = "all frames are mapped and all files are written"
    PARTIAL = "the run ended early"


@dataclass(frozen=True)
class Manifest:
    """Contents of manifest.json."""

    status: RunStatus
    files: Mapping[str, tuple[int, str]]  # size in bytes and SHA-256 (hex) by file name
    inputs: Mapping[str, str]  # SHA-256 (hex) of the input files, by config key
    parameters: Mapping[str, str]  # values of the parameters that change results, by dotted key

    def with_files(self, directory: Path, names: Iterable[str]) -> Manifest:
        """Return a copy of the manifest with the current sizes and hashes of these files, without missing files.

        Raises:
            DataError: A file cannot be read.
        """
        names = list(names)
        paths = [directory / name for name in names if (directory / name).exists()]
        others = {name: entry for name, entry in self.files.items() if name not in names}
        return replace(self, files=others | {path.name: (path.stat().st_size, path_hash(path)) for path in paths})

    @classmethod
    def read(cls, directory: Path) -> Manifest:
        """Read the manifest of a run directory.

        Raises:
            DataError: The file is missing, damaged or invalid.
        """
        finish_replacement(directory)
        path = directory / MANIFEST
        return cls._parsed(path, read_bytes(path, MAX_SIZE))

    @classmethod
    def of_file(cls, path: Path) -> Manifest | None:
        """Read the manifest of the run that a file belongs to. The result is None if there is no manifest.

        A file manifest.json of another program is ignored.

        Raises:
            DataError: The manifest is damaged.
        """
        finish_replacement(path.parent)
        manifest = path.with_name(MANIFEST)
        if not path_exists(manifest):
            return None
        content = read_bytes(manifest, MAX_SIZE)
        is_ours = b'"digest"' in content or b'"parameters"' in content  # also if one of the keys is damaged
        is_cut_off = _START.startswith(content[: len(_START)].rstrip(b"\0"))  # or empty
        return cls._parsed(manifest, content) if is_ours or is_cut_off else None

    @classmethod
    def _parsed(cls, path: Path, text: bytes) -> Manifest:
        content = parse_json(path, text)
        if not isinstance(content, dict):
            raise DataError(f"{path}: expected a JSON object, got {type(content).__name__}")
        digest = content.pop("digest", None)
        if digest != _digest(content):
            raise DataError(f"{path}: expected the digest {_digest(content)[:12]}, got {digest!s:.12}; repeat the run")
        try:
            files = {
                _file_name(name): (int(one["bytes"]), str(one["sha256"])) for name, one in content["files"].items()
            }
            texts = [{key: str(one) for key, one in content[name].items()} for name in ("inputs", "parameters")]
            return cls(RunStatus[content["status"]], files, *texts)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise DataError(
                f"{path}: expected status, files, inputs and parameters, got an error ({error!r})"
            ) from error

    def write(self, directory: Path) -> None:
        """Write the manifest to a run directory.

        Raises:
            DataError: The file cannot be written.
        """
        content: dict[str, Any] = {
            "status": self.status.name,
            "files": {name: {"bytes": size, "sha256": sha256} for name, (size, sha256) in self.files.items()},
            "inputs": dict(self.inputs),
            "parameters": dict(self.parameters),
        }
        write_json(directory / MANIFEST, content | {"digest": _digest(content)})

    def changed_files(self, directory: Path, optional: Collection[str] = ()) -> list[str]:
        """Return one message for each changed, missing or additional file.

        Files in `optional` may be missing.
        """
        found = []
        for name, (size, _) in self.files.items():
            path = directory / name
            if path.is_file():
                found.append(self.change(path, path_hash(path)))
            elif name not in optional:
                found.append(f"{path}: expected a file of {size} bytes, got none")
        added = [directory / name for name in RUN_FILES if name not in self.files]
        return [one for one in [*found, *(self.change(path, "") for path in added if path_exists(path))] if one]

    def change(self, path: Path, sha256: str) -> str:
        """Return a message if the SHA-256 (hex) of a file differs from the manifest, otherwise ""."""
        if path.name not in self.files:
            return f"{path}: expected no file in this run, got one" if path.name in RUN_FILES else ""
        expected = self.files[path.name][1]
        different = f"{path}: expected the SHA-256 {expected[:12]} of {MANIFEST}, got {sha256[:12]}"
        return "" if sha256 == expected else different


@contextmanager
def verified(path: Path) -> Iterator[bool]:
    """Compare a file with the manifest of its run while the file is read in the `with` body.

    The value is whether the manifest contains a hash of the file. Files without a manifest are not verified. If the
    body fails because the file has changed, the change is reported instead.

    Raises:
        DataError: The file or the manifest has changed since the run, or the folder is unfinished.
    """
    check_finished(path.parent)
    manifest = Manifest.of_file(path)
    if manifest is None or not path.is_file():
        yield False
        return
    with ThreadPoolExecutor(1) as hashing:  # releases the GIL; the file is read from the disk only once
        pending = hashing.submit(path_hash, path)
        try:
            yield path.name in manifest.files
        except DataError as error:
            _check_hash(path, manifest, pending.result(), error)
            raise
    _check_hash(path, manifest, pending.result())


def _check_hash(path: Path, manifest: Manifest, sha256: str, cause: Exception | None = None) -> None:
    """Raise DataError if a file differs from its manifest."""
    before = None
    while change := manifest.change(path, sha256):
        if before == (manifest, sha256):
            fix = f"repeat the run, or accept an intended change with {VERIFY} {path.parent} --accept {path.name}"
            raise DataError(f"{change}; {fix}") from cause
        before = manifest, sha256  # `evaluate` may be replacing both files, so they are read until they are constant
        manifest, sha256 = Manifest.of_file(path) or manifest, path_hash(path)


def _file_name(name: str) -> str:
    """Return the name of a file, or raise ValueError for a path: a run lists only files in its own directory."""
    if name in ("", ".", "..") or not {"/", "\\", "\0"}.isdisjoint(name):
        raise ValueError(f"expected a file name, got {name!r:.60}")
    return name


def _digest(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 (hex) of the content as canonical JSON."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()

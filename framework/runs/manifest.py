"""Manifest of a run: status, inputs, parameters and hashes of the result files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

from framework.errors import DataError
from framework.files.hashing import path_hash
from framework.files.json_file import read_json, write_json

MANIFEST = "manifest.json"


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
        """Return a copy of the manifest with the existing files of these names.

        Raises:
            DataError: A file cannot be read.
        """
        paths = [directory / name for name in names if (directory / name).exists()]
        return replace(self, files={path.name: (path.stat().st_size, path_hash(path)) for path in paths})

    @classmethod
    def read(cls, directory: Path) -> Manifest:
        """Read the manifest of a run directory.

        Raises:
            DataError: The file is missing, damaged or invalid.
        """
        path = directory / MANIFEST
        content = read_json(path)
        if not isinstance(content, dict):
            raise DataError(f"{path}: expected a JSON object, got {type(content).__name__}")
        digest = content.pop("digest", None)
        if digest != _digest(content):
            raise DataError(f"{path}: expected the digest {_digest(content)[:12]}, got {digest!s:.12}; repeat the run")
        try:
            files = {str(name): (int(one["bytes"]), str(one["sha256"])) for name, one in content["files"].items()}
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
        """Return one message for each changed or missing file. Files in `optional` may be missing."""
        found = []
        for name, (size, sha256) in self.files.items():
            path = directory / name
            if name in optional and not path.exists():
                continue
            if not path.is_file():
                found.append(f"{path}: expected a file of {size} bytes, got none")
            elif (actual := path_hash(path)) != sha256:
                found.append(f"{path}: expected the SHA-256 {sha256[:12]} of {MANIFEST}, got {actual[:12]}")
        return found


def _digest(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 (hex) of the content as canonical JSON."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()

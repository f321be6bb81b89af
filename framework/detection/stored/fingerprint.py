"""Fingerprint of a detector: one hash of everything besides the frame that its detections depend on."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import sys
from collections.abc import Iterator
from enum import Enum
from pathlib import Path

from framework.errors import ConfigError
from framework.files.hashing import path_hash
from framework.files.search_paths import candidates

LIBRARIES = ("numpy", "opencv-python-headless", "torch", "onnxruntime", "transformers")
"""Libraries whose version may change the last digits."""

SHARED_SOURCES = ("detection/**/*.py", "vocabulary/label_spaces.*")  # in framework/: the code that detectors share
NOT_GIVEN = Path()  # value of `path: ""` in a config


def fingerprint(detector: object) -> str:
    """Return the SHA-256 (hex) of a dataclass instance's class, code and parameters.

    Code is the modules of its class and base classes, framework.detection, and the versions of numerical libraries. A
    Path, or a str that names an existing file or folder, is identified by its content, with all files below a folder;
    relative paths are searched in the working, then in the project folder. `device: auto` is identified by the device
    that is used. The number of threads is not included.

    Raises ConfigError for a missing path, and for code without a file (a notebook's): such a class needs its own method
    `fingerprint`.
    """
    kind = type(detector)
    digest = hashlib.sha256()
    for part in (f"{kind.__module__}.{kind.__qualname__}", *_code(kind), *_parameters(detector)):
        digest.update(f"{len(part)}:{part}".encode())
    return digest.hexdigest()


def _code(kind: type) -> Iterator[str]:
    modules = dict.fromkeys(base.__module__ for base in kind.__mro__ if base.__module__ not in ("builtins", "abc"))
    for module in modules:
        source = getattr(sys.modules.get(module), "__file__", None)
        if source is None:
            raise ConfigError(
                f"{kind.__qualname__}: expected a source file to identify it by, got none; implement fingerprint()"
            )
        yield path_hash(Path(source))
    framework = Path(__file__).resolve().parents[2]
    for pattern in SHARED_SOURCES:
        yield from map(path_hash, sorted(framework.glob(pattern)))
    for library in LIBRARIES:
        try:
            yield f"{library} {importlib.metadata.version(library)}"
        except importlib.metadata.PackageNotFoundError:
            yield f"{library} absent"


def _parameters(detector: object) -> Iterator[str]:
    if not dataclasses.is_dataclass(detector):
        raise ConfigError(
            f"{type(detector).__qualname__}: expected a dataclass, got another class; implement fingerprint()"
        )
    for field in dataclasses.fields(detector):
        value = getattr(detector, field.name)
        if isinstance(value, Path):
            yield f"{field.name} {content_hash(value)}"
        elif isinstance(value, Enum):
            yield f"{field.name} {value.name}"
        else:
            yield f"{field.name} {value!r}"
            if isinstance(value, str) and _is_path(value):
                yield f"{field.name} {content_hash(Path(value))}"
        if field.name == "device" and value in ("auto", "cuda"):
            import torch

            yield torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu"


def _is_path(value: str) -> bool:
    """Return whether a str parameter names an existing path, and is not a name such as `auto`."""
    try:
        return value not in ("", ".") and any(candidate.exists() for candidate in candidates(Path(value)))
    except (OSError, ValueError):  # too long for a file name
        return False


def content_hash(path: Path) -> str:
    """Return `path_hash` of the file or folder that a path leads to; "" for an empty path."""
    if path == NOT_GIVEN:
        return ""
    found = next((candidate for candidate in candidates(path) if candidate.exists()), None)
    if found is None:
        looked = " and ".join(str(candidate) for candidate in candidates(path))
        raise ConfigError(f"{looked}: expected a file to identify the detector by, got none; implement fingerprint()")
    return path_hash(found)

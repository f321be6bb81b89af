"""Fingerprint of a detector: a hash of everything that determines its detections, except the frame."""

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
"""Libraries whose versions may change the last digits of the results."""

SHARED_SOURCES = ("detection/**/*.py", "sensors/noise_models*.py", "vocabulary/label_spaces.*")
"""Code shared by detectors, in framework/."""

NOT_GIVEN = Path()  # value of an empty path in a config


def fingerprint(detector: object) -> str:
    """Return the SHA-256 of the code and parameters of a detector.

    The code includes the modules of the class and its base classes, framework.detection, the label spaces, and the
    versions of numerical libraries. Paths are replaced by the contents of their files. The number of threads is not
    included.

    Raises:
        ConfigError: A path does not exist, the detector is not a dataclass, or its class has no source file, for
            example in a notebook. Such a detector must define a method `fingerprint`.
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
                f"{kind.__qualname__}: expected a class defined in a source file, got the module {module} without a "
                "file; define a method fingerprint()"
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
            f"{type(detector).__qualname__}: expected a dataclass, got a plain class; make it a dataclass "
            "or implement fingerprint()"
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
    """Return True if a text is an existing path."""
    try:
        return value not in ("", ".") and any(candidate.exists() for candidate in candidates(Path(value)))
    except (OSError, ValueError):  # too long for a file name
        return False


def content_hash(path: Path) -> str:
    """Return the hash of a file or folder, or "" for an empty path."""
    if path == NOT_GIVEN:
        return ""
    found = next((candidate for candidate in candidates(path) if candidate.exists()), None)
    if found is None:
        looked = " and ".join(str(candidate) for candidate in candidates(path))
        raise ConfigError(f"{looked}: expected an existing file, got none; set another path or implement fingerprint()")
    return path_hash(found)

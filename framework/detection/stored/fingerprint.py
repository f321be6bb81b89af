"""What a detector's answers depend on beside the frame, as one hash."""

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
"""Another version may give other last digits."""

SHARED_SOURCES = ("detection/**/*.py", "vocabulary/label_spaces.*")  # in framework/: what detectors are built from
NOT_GIVEN = Path()  # what `path: ""` in a config becomes


def fingerprint(detector: object) -> str:
    """SHA-256 (hex) of a dataclass instance's class, code, parameters and of the files that its Path parameters name.

    Code is the module of its class and of each base class, framework.detection, and the versions of the numerical
    libraries. A path counts by what is there, not by its name: a relative one is looked for in the working, then in the
    project folder, and of a folder every file below it is read. So does a str that names a file or folder.
    `device: auto` counts as the device that it means. The number of threads is not part of it.

    Raises ConfigError when a path does not exist, or code has no file (a notebook's): such a class must say itself what
    identifies it, with a method `fingerprint`.
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
            raise ConfigError(f"{kind.__qualname__} has no source file to identify it by: give it a fingerprint()")
        yield path_hash(Path(source))
    framework = Path(__file__).resolve().parents[2]
    for pattern in SHARED_SOURCES:
        for source in sorted(framework.glob(pattern)):
            yield path_hash(source)
    for library in LIBRARIES:
        try:
            yield f"{library} {importlib.metadata.version(library)}"
        except importlib.metadata.PackageNotFoundError:
            yield f"{library} absent"


def _parameters(detector: object) -> Iterator[str]:
    if not dataclasses.is_dataclass(detector):
        raise ConfigError(f"{type(detector).__qualname__} is not a dataclass: give it a fingerprint()")
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
            yield _device()


def _is_path(value: str) -> bool:
    """Whether a parameter that may be a name or a path (labels, a model) is a path, and not a word like `auto`."""
    return value not in ("", ".") and any(_exists(candidate) for candidate in candidates(Path(value)))


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # too long for a file's name
        return False


def _device() -> str:
    import torch

    return torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu"


def content_hash(path: Path) -> str:
    """`path_hash` of where a path leads; "" for one that is not given."""
    if path == NOT_GIVEN:
        return ""
    found = next((candidate for candidate in candidates(path) if candidate.exists()), None)
    if found is None:
        looked = " and ".join(str(candidate) for candidate in candidates(path))
        raise ConfigError(f"there is no {looked}, by which the detector would be identified: give it a fingerprint()")
    return path_hash(found)

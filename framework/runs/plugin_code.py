"""Version and hash of the code of plugins."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from framework.config.composition import installed_config_dirs
from framework.files.module_imports import required_modules
from framework.registry import STAGES
from framework.runs.provenance import leaves, package_version

CODE = "code."  # prefix of keys in metrics.json, e.g. code.refiner = "my_package 0.1.0 3f2a9c41d0b7"
OWN = ("framework", "plugins")  # packages of this project
MAX_FILES = 2000  # maximum number of hashed files of a package
MAX_HASHED = 1_000_000  # maximum size of a file that is hashed by content, bytes
IGNORED = {"__pycache__", ".git"}  # folders without code
DIGITS = 12  # number of digits of a shown hash


def plugin_code(config: Mapping[str, Any]) -> dict[str, str]:
    """Return the package, version and hash of the plugins of each stage, by key of metrics.json.

    A stage may have several plugins, such as a chain of refiners.

    The hash of a third-party plugin covers the modules that it imports from its package. It also covers data files of
    the package, such as weights, but not config options. Files larger than MAX_HASHED bytes are hashed by size and
    modification time. The hash of a plugin of this project covers only its own module, without comments and docstrings.

    Args:
        config: The resolved config of a run.
    """
    found: dict[str, set[str]] = {}
    for stage, target in targets_of(config):
        found.setdefault(stage, set()).add(_described(target))
    return {f"{CODE}{stage}": ", ".join(sorted(codes)) for stage, codes in found.items()}


def targets_of(config: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the stage and the class name of each plugin in a resolved config, including nested plugins."""
    values = leaves({stage: config.get(stage) or {} for stage in STAGES})
    return [
        (key.partition(".")[0], value) for key, value in values if key.endswith("._target_") and isinstance(value, str)
    ]


def plugin_files(target: str) -> list[tuple[str, Path]]:
    """Return the files in the package of a third-party plugin, as pairs of a name and a path.

    A name includes the folder of the package, e.g. "my_package/refiner.py". The list is empty for plugins of this
    project.
    """
    package = target.partition(".")[0]
    return [] if package in OWN else _files_of(package)


def changed_code(metrics: Mapping[str, Any], now: Mapping[str, str]) -> list[str]:
    """Return one message for each stage whose plugin code has changed since a run.

    A message has the form "refiner: a 1.0 3f -> a 1.0 9c". Runs from before version 0.1.0 do not contain the code, and
    have no messages.

    Args:
        metrics: The metrics of the run.
        now: The current result of `plugin_code`.
    """
    if not any(key.startswith(CODE) for key in metrics):
        return []
    return [
        f"{key.removeprefix(CODE)}: {metrics.get(key)} -> {code}"
        for key, code in now.items()
        if metrics.get(key) != code
    ]


def _described(target: str) -> str:
    """Return the package, version and hash of a class as text."""
    module = target.rpartition(".")[0]
    package = module.partition(".")[0]
    own = package in OWN
    files = _files_of(module) if own else _required_files(target)
    if not files:
        return f"{package} missing"
    digest = hashlib.sha256()
    for name, path in files[:MAX_FILES]:
        content = _code_of(path) if own else _content_of(path)
        digest.update(f"{name} {len(content)};".encode())
        digest.update(content)
    known = None if own else package_version(package)
    return " ".join(filter(None, (module if own else package, known, digest.hexdigest()[:DIGITS])))


def _required_files(target: str) -> list[tuple[str, Path]]:
    """Return the names and paths of the package files that a class depends on."""
    files = _files_of(target.partition(".")[0])
    modules = {_dotted(name): path for name, path in files if path.suffix == ".py"}
    required = required_modules(target, modules)
    others = [path for _, path in files if path.suffix != ".py" and not _is_option(path)]
    return [(name, path) for name, path in files if _dotted(name) in required or path in others]


def _is_option(path: Path) -> bool:
    """Return True for a config option of an installed package."""
    return any(path.resolve().is_relative_to(folder) for folder in installed_config_dirs())


def _dotted(name: str) -> str:
    """Return the module name of a file, e.g. "a.b" for "a/b.py"."""
    return name.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def _files_of(name: str) -> list[tuple[str, Path]]:
    """Return the names and paths of the files of a package or module, or [] if it is not found."""
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):  # the error of a broken package is reported when the plugin is built
        return []
    if spec is None:
        return []
    if not spec.submodule_search_locations:
        return [(Path(spec.origin).name, Path(spec.origin))] if spec.origin and Path(spec.origin).is_file() else []
    files = []
    for folder in sorted(map(Path, spec.submodule_search_locations)):
        for path in sorted(folder.rglob("*")):
            inside = path.relative_to(folder)
            if path.is_file() and path.suffix != ".pyc" and IGNORED.isdisjoint(inside.parts):
                files.append((f"{name}/{inside.as_posix()}", path))
    return files


def _content_of(file: Path) -> bytes:
    try:
        stat = file.stat()
        return file.read_bytes() if stat.st_size <= MAX_HASHED else f"{stat.st_size} {stat.st_mtime_ns}".encode()
    except OSError:  # the file was just removed
        return b""


def _code_of(file: Path) -> bytes:
    """Return the code of a module without comments and docstrings."""
    try:
        tree = ast.parse(_content_of(file))
    except SyntaxError:  # reported when the plugin is built
        return _content_of(file)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            del node.body[0]
    return ast.unparse(tree).encode()

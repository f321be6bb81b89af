"""Version and hash of the code of a run's plugins."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
from collections.abc import Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from framework.registry import STAGES
from framework.runs.provenance import leaves

CODE = "code."  # prefix of the keys of metrics.json: code.refiner = "my_package 0.1.0 3f2a9c41d0b7"
OWN = ("framework", "plugins")  # packages of this project; tables list its commit
MAX_FILES = 2000  # maximum number of hashed files of a package
MAX_HASHED = 1_000_000  # maximum size of a file that is hashed by content, bytes
IGNORED = {"__pycache__", ".git"}  # folders without code
DIGITS = 12  # number of digits of a shown hash


def plugin_code(config: Mapping[str, Any]) -> dict[str, str]:
    """Return the package, version and hash of the plugins of each stage, by key of metrics.json.

    A stage with plugins of several packages, such as a chain of refiners, lists them all. The hash covers all files of
    a package, or a single file. Files above MAX_HASHED bytes are represented by size and modification time. For plugins
    of this project, only the plugin's own file is hashed, without comments and docstrings.

    Args:
        config: The resolved config of a run.
    """
    found: dict[str, set[str]] = {}
    for stage, target in targets_of(config):
        found.setdefault(stage, set()).add(_described(target))
    return {f"{CODE}{stage}": ", ".join(sorted(codes)) for stage, codes in found.items()}


def targets_of(config: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the stage and the dotted class name of each plugin of a resolved config, including nested plugins."""
    values = leaves({stage: config.get(stage) or {} for stage in STAGES})
    return [
        (key.partition(".")[0], value) for key, value in values if key.endswith("._target_") and isinstance(value, str)
    ]


def plugin_files(target: str) -> list[tuple[str, Path]]:
    """Return the relative names and the paths of the files of a third-party class; empty for this project's classes."""
    package = target.partition(".")[0]
    if package in OWN:
        return []
    found = []
    for path in _module_files(package):
        if path.is_dir():
            found += [(f"{package}/{file.relative_to(path).as_posix()}", file) for file in _files_below(path)]
        else:
            found.append((path.name, path))
    return found


def changed_code(metrics: Mapping[str, Any], now: Mapping[str, str]) -> list[str]:
    """Return the differences between the stored and the current plugin code: "refiner: a 1.0 3f -> a 1.0 9c".

    Runs without these keys are from before version 0.1.0 and have no known difference.

    Args:
        metrics: The metrics of the run.
        now: The result of `plugin_code` for its config.
    """
    if not any(key.startswith(CODE) for key in metrics):
        return []
    return [
        f"{key.removeprefix(CODE)}: {metrics.get(key)} -> {code}"
        for key, code in now.items()
        if metrics.get(key) != code
    ]


def _described(target: str) -> str:
    """Return "PACKAGE VERSION HASH" of the class with this dotted name; "PACKAGE missing" if it has no files."""
    module = target.rpartition(".")[0]
    package = module.partition(".")[0]
    own = package in OWN
    paths = _module_files(module if own else package)
    if not paths:
        return f"{package} missing"
    digest = hashlib.sha256()
    for name, content in _contents(paths, own):
        digest.update(f"{name} {len(content)};".encode())
        digest.update(content)
    return " ".join(filter(None, (module if own else package, _version(package), digest.hexdigest()[:DIGITS])))


def _module_files(name: str) -> list[Path]:
    """Return the file of a module, or the folders of a package; empty if it is not found."""
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):  # the error of a broken package is reported when the plugin is built
        return []
    if spec is None:
        return []
    if spec.submodule_search_locations:
        return sorted(map(Path, spec.submodule_search_locations))
    return [Path(spec.origin)] if spec.origin and Path(spec.origin).is_file() else []


def _contents(paths: list[Path], own: bool) -> Iterator[tuple[str, bytes]]:
    """Yield the relative name and the hashed content of each file."""
    for path in paths:
        files = [path] if path.is_file() else _files_below(path)
        for file in files[:MAX_FILES]:
            name = file.relative_to(path).as_posix() if path.is_dir() else file.name
            yield name, _code_of(file) if own else _content_of(file)


def _files_below(folder: Path) -> list[Path]:
    return sorted(
        file
        for file in folder.rglob("*")
        if file.is_file() and not IGNORED & set(file.relative_to(folder).parts) and file.suffix != ".pyc"
    )


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


def _version(package: str) -> str:
    """Return the version of the distribution with the package's name; "" = none."""
    try:
        return version(package) if package not in OWN else ""
    except PackageNotFoundError:
        return ""

"""Search for the modules that a class depends on, by the import statements in the source code."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.util import resolve_name
from pathlib import Path

DYNAMIC = {"__import__", "import_module", "iter_modules", "walk_packages"}  # functions that import modules by name


def required_modules(target: str, modules: Mapping[str, Path]) -> set[str]:
    """Return the modules of a package that a class depends on.

    These are the module of the class, its direct and indirect imports, and their parent packages. If a package only
    re-exports an imported name, its other imports are omitted.

    Args:
        target: The full name of the class.
        modules: The source files of the package by module name.

    Returns:
        The names of the modules. All modules are returned if a module cannot be parsed or uses dynamic imports.
    """
    pending, visited, found = [target], set(), set()
    while pending:
        name = pending.pop()
        module = next((parent for parent in _with_parents(name) if parent in modules), None)
        if name in visited or module is None:  # None = the module of another package
            continue
        visited.add(name)
        found |= {parent for parent in _with_parents(module) if parent in modules}
        path = modules[module]
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        imported = _imports(path.read_bytes(), package)
        if imported is None:
            return set(modules)
        attribute = name[len(module) + 1 :].partition(".")[0]
        of_module = [origin for origins in imported.values() for origin in origins]
        pending += imported.get(attribute, of_module)
    return found


def _with_parents(name: str) -> Iterator[str]:
    """Yield a dotted name, followed by the names of its parent packages."""
    while name:
        yield name
        name = name.rpartition(".")[0]


def _absolute(name: str, package: str) -> str:
    """Return the absolute name of a relative import."""
    try:
        return resolve_name(name, package)
    except ImportError:  # outside of the top-level package
        return name


@cache
def _imports(source: bytes, package: str) -> dict[str, list[str]] | None:
    """Return the imported names of a module by local name, or None if they are unknown.

    Star imports have the local name "*".
    """
    try:
        nodes = list(ast.walk(ast.parse(source)))
    except (SyntaxError, ValueError):  # reported when the plugin is built
        return None
    found: dict[str, list[str]] = {}
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                found.setdefault(alias.asname or alias.name.partition(".")[0], []).append(alias.name)
        elif isinstance(node, ast.ImportFrom):
            origin = _absolute("." * node.level + (node.module or ""), package)
            for alias in node.names:
                name = origin if alias.name == "*" else f"{origin}.{alias.name}"
                found.setdefault(alias.asname or alias.name, []).append(name)
        elif DYNAMIC & {getattr(node, "id", ""), getattr(node, "attr", "")}:
            return None
    return found

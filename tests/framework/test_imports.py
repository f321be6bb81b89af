"""Imports run one way, and heavy libraries load where they are needed."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
LAYERS = ["errors", "data", "geometry", "interfaces", "mapping", "journal", "pipeline", "reports"]
"""From the ground up: a module imports nothing from a layer above its own; modules not named here stand beside."""

OPTIONAL = {"onnxruntime", "transformers", "torchvision", "rerun", "evo", "pandas"}
MODULES = sorted(path for package in ("framework", "plugins") for path in (CHECKOUT / package).rglob("*.py"))


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(CHECKOUT).with_suffix("").parts).removesuffix(".__init__")


def imported(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield str(node.module)


def at_module_level(tree: ast.Module) -> Iterator[str]:
    for node in tree.body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield from imported(node)


def layer(module: str) -> int | None:
    part = module.partition(".")[2].partition(".")[0]
    return LAYERS.index(part) if part in LAYERS else None


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_imports_run_one_way(path: Path) -> None:
    name = name_of(path)
    for module in imported(ast.parse(path.read_text())):
        if name.startswith("framework"):
            assert not module.startswith("plugins"), f"{name} imports {module}: framework never imports plugins"
        own, other = layer(name), layer(module) if module.startswith("framework.") else None
        if name.startswith("framework") and own is not None and other is not None:
            assert other <= own, f"{name} imports {module}, which stands above it"
        if name.startswith("plugins.") and module.startswith("plugins."):
            assert module == name, f"{name} imports {module}: plugins never import each other"


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_optional_libraries_are_imported_where_they_are_used(path: Path) -> None:
    heavy = {module.split(".")[0] for module in at_module_level(ast.parse(path.read_text()))} & OPTIONAL
    assert not heavy, f"{name_of(path)} imports {', '.join(heavy)} at module level"


def test_only_tests_itself_is_a_package() -> None:
    """The folders in it must not be: as packages they could stand in for the real framework and plugins."""
    assert [path.parent.name for path in (CHECKOUT / "tests").rglob("__init__.py")] == ["tests"]

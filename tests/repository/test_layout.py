"""Imports run one way, and heavy libraries load where they are needed."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
LAYERS = [
    ["errors"],
    ["data"],
    ["geometry"],
    ["interfaces"],
    ["files", "sensors"],
    ["config", "registry", "runtime", "vocabulary"],
    ["compilation"],
    ["rendering"],
    ["detection", "tracking", "refinement", "mapping"],
    ["baselines", "datasets"],
    ["checking", "importing", "synthetic"],
    ["live_view"],
    ["pipeline"],
    ["evaluation"],
    ["runs", "training"],
    ["queries"],
    ["tables", "figures", "exporting"],
    ["reporting"],
    ["api"],
    ["doctor", "commands"],
    ["testing"],
    ["__main__"],
]
"""All of framework/, from the ground up: nothing imports from a layer above its own."""

LAYER = {part: k for k, layer in enumerate(LAYERS) for part in layer}

OPTIONAL = {
    "onnxruntime",
    "transformers",
    "torchvision",
    "rerun",
    "evo",
    "pandas",
    "pyorbbecsdk",
    "pyrealsense2",
    "OpenEXR",
    "lzfse",
    "rosbags",
    "pxr",
}
MODULES = sorted(path for package in ("framework", "plugins") for path in (CHECKOUT / package).rglob("*.py"))


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(CHECKOUT).with_suffix("").parts).removesuffix(".__init__")


def imported(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            whole = node.module in ("framework", "plugins")
            yield from (f"{node.module}.{alias.name}" for alias in node.names) if whole else [str(node.module)]


def at_module_level(tree: ast.Module) -> Iterator[str]:
    for node in tree.body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield from imported(node)


def part_of(module: str) -> str:
    """The package or root module of framework/ that a module of it is in."""
    return module.split(".")[1]


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_imports_run_one_way(path: Path) -> None:
    name = name_of(path)
    for module in imported(ast.parse(path.read_text())):
        if name.startswith("framework"):
            assert not module.startswith("plugins"), f"{name} imports {module}: framework never imports plugins"
        if name.startswith("framework.") and module.startswith("framework."):
            above = LAYER[part_of(module)] > LAYER[part_of(name)]
            assert not above, f"{name} imports {module}, which stands above it"
        if name.startswith("plugins.") and module.startswith("plugins."):
            assert module == name, f"{name} imports {module}: plugins never import each other"


def test_every_part_of_the_framework_has_its_layer() -> None:
    assert sorted(LAYER) == sorted({part_of(name) for name in map(name_of, MODULES) if name.startswith("framework.")})


def test_no_packages_import_each_other_in_a_circle() -> None:
    """Imports inside of functions count, too."""
    imports = {part: set[str]() for part in LAYER}
    for path in MODULES:
        if (name := name_of(path)).startswith("framework."):
            of_ours = {module for module in imported(ast.parse(path.read_text())) if module.startswith("framework.")}
            imports[part_of(name)] |= {part_of(module) for module in of_ours} - {part_of(name)}
    TopologicalSorter(imports).prepare()  # raises CycleError, which names the circle


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_optional_libraries_are_imported_where_they_are_used(path: Path) -> None:
    heavy = {module.split(".")[0] for module in at_module_level(ast.parse(path.read_text()))} & OPTIONAL
    assert not heavy, f"{name_of(path)} imports {', '.join(heavy)} at module level"


def test_only_tests_itself_is_a_package() -> None:
    """The folders in it must not be: as packages they could stand in for the real framework and plugins."""
    assert [path.parent.name for path in (CHECKOUT / "tests").rglob("__init__.py")] == ["tests"]

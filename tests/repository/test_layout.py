"""Tests for the layout of folders, names and imports, which CONTRIBUTING.md describes."""

from __future__ import annotations

import ast
import functools
from collections import Counter, defaultdict
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
LAYERS = [
    ["errors"],
    ["sensors"],
    ["data"],
    ["geometry"],
    ["interfaces"],
    ["files"],
    ["config", "registry", "runtime", "vocabulary"],
    ["compilation"],
    ["rendering"],
    ["detection", "tracking", "refinement", "mapping"],
    ["pose_graph"],
    ["baselines", "datasets"],
    ["checking", "importing", "synthetic"],
    ["live_view"],
    ["pipeline"],
    ["evaluation"],
    ["runs", "training"],
    ["queries", "explanation"],
    ["tables", "figures", "exporting", "editing"],
    ["reporting"],
    ["api"],
    ["doctor", "commands"],
    ["testing"],
    ["__main__"],
]
"""The packages and root modules of framework/, lowest layer first. A module imports only its own and lower layers."""

LAYER = {part: k for k, layer in enumerate(LAYERS) for part in layer}

ROOT = {"__init__", "__main__", "api", "data", "errors", "geometry", "interfaces", "pipeline", "registry"}
"""The modules at the root of framework/. Every other module is in the folder of its subject."""

MAX_FILES = 20  # maximum number of Python files in a folder

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
    "lz4",
    "lzfse",
    "rosbags",
    "pxr",
}
MODULES = sorted(path for package in ("framework", "plugins") for path in (CHECKOUT / package).rglob("*.py"))


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(CHECKOUT).with_suffix("").parts).removesuffix(".__init__")


@functools.cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def python_folders(package: str) -> set[Path]:
    """Return the folders of a package that contain Python files, relative to the checkout."""
    return {path.parent.relative_to(CHECKOUT) for path in MODULES if path.is_relative_to(CHECKOUT / package)}


def imported(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "expected an absolute import"
            whole = node.module in ("framework", "plugins")
            yield from (f"{node.module}.{alias.name}" for alias in node.names) if whole else [str(node.module)]


def at_module_level(tree: ast.Module) -> Iterator[str]:
    for node in tree.body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield from imported(node)


def part_of(module: str) -> str:
    """Return the package or root module of framework/ that contains a module."""
    return module.split(".")[1]


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_module_imports_only_lower_layers(path: Path) -> None:
    name = name_of(path)
    for module in imported(parsed(path)):
        if name.startswith("framework"):
            assert not module.startswith("plugins"), f"{name}: expected no import of a plugin, got {module}"
        if name.startswith("framework.") and module.startswith("framework."):
            above = LAYER[part_of(module)] > LAYER[part_of(name)]
            assert not above, f"{name}: expected imports of lower layers, got {module}"
        if name.startswith("plugins.") and module.startswith("plugins."):
            assert module == name, f"{name}: expected no import of another plugin, got {module}"


def test_layers_cover_all_packages() -> None:
    assert sorted(LAYER) == sorted({part_of(name) for name in map(name_of, MODULES) if name.startswith("framework.")})


def test_packages_have_no_import_cycle() -> None:
    """Imports inside of functions count as well."""
    imports = {part: set[str]() for part in LAYER}
    for path in MODULES:
        if (name := name_of(path)).startswith("framework."):
            of_ours = {module for module in imported(parsed(path)) if module.startswith("framework.")}
            imports[part_of(name)] |= {part_of(module) for module in of_ours} - {part_of(name)}
    TopologicalSorter(imports).prepare()  # raises CycleError, which names the cycle


def test_modules_have_no_import_cycle() -> None:
    """Imports inside of functions count as well, because they only hide a cycle."""
    modules = {name_of(path): path for path in MODULES}
    imports = {name: set(imported_modules(path, modules)) - {name} for name, path in modules.items()}
    TopologicalSorter(imports).prepare()


def imported_modules(path: Path, modules: dict[str, Path]) -> Iterator[str]:
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (name if name in modules else str(node.module) for name in names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def test_framework_root_has_only_shared_modules() -> None:
    assert {path.stem for path in (CHECKOUT / "framework").glob("*.py")} == ROOT


def test_folders_have_at_most_twenty_files() -> None:
    counts = Counter(path.parent.relative_to(CHECKOUT).as_posix() for path in MODULES)
    assert not {folder: count for folder, count in counts.items() if count > MAX_FILES}


def test_framework_file_names_are_unique() -> None:
    counts = Counter(path.name for path in MODULES if path.is_relative_to(CHECKOUT / "framework"))
    assert not {name for name, count in counts.items() if count > 1 and name != "__init__.py"}


def test_public_classes_are_defined_once() -> None:
    defined = defaultdict(list)
    for path in MODULES:
        for node in parsed(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                defined[node.name].append(name_of(path))
    assert not {name: places for name, places in defined.items() if len(places) > 1}


@pytest.mark.parametrize("package", ["framework", "plugins"])
def test_test_folders_mirror_package(package: str) -> None:
    folders = {path.parent.relative_to(CHECKOUT / "tests") for path in (CHECKOUT / "tests" / package).rglob("*.py")}
    assert folders <= python_folders(package) | {Path(package)}


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_optional_libraries_are_imported_lazily(path: Path) -> None:
    heavy = {module.split(".")[0] for module in at_module_level(parsed(path))} & OPTIONAL
    assert not heavy, f"{name_of(path)}: expected imports inside functions, got {', '.join(heavy)} at module level"


def test_test_folders_are_not_packages() -> None:
    """As packages, tests/framework and tests/plugins could shadow the packages of the project."""
    assert [path.parent.name for path in (CHECKOUT / "tests").rglob("__init__.py")] == ["tests"]

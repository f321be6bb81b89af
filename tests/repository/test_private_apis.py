"""Tests for the list of private APIs of Hydra and numba in CONTRIBUTING.md."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import hydra
import numba

from framework.compilation import worker
from framework.config import hydra_api

CHECKOUT = Path(__file__).resolve().parents[2]
SECTION = (
    (CHECKOUT / "CONTRIBUTING.md").read_text(encoding="utf-8").partition("## Private APIs")[2].partition("\n## ")[0]
)
PRIVATE = re.compile(r"(hydra\._internal|hydra\.core\.singleton|hydra\.version|numba\.core)(\.|$)|(hydra|numba)\..*\b_")


def private_imports() -> dict[tuple[str, str], set[str]]:
    """Return the files that import each private name, keyed by module and name."""
    found: dict[tuple[str, str], set[str]] = {}
    for path in (path for package in ("framework", "plugins") for path in (CHECKOUT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [(node.module, alias.name) for alias in node.names]
            elif isinstance(node, ast.Import):
                names = [(alias.name, "") for alias in node.names]
            else:
                continue
            for module, name in names:
                if PRIVATE.match(module) or PRIVATE.match(f"{module}.{name}"):
                    found.setdefault((module, name), set()).add(path.relative_to(CHECKOUT).as_posix())
    return found


def test_private_imports_are_listed_in_contributing() -> None:
    rows = re.findall(r"(?m)^\| `([\w.]+)` \| ([^|]+) \|", SECTION)
    listed = {(module, name) for module, names in rows for name in re.findall(r"`(\w+)`", names)}
    assert listed == set(private_imports())


def test_private_imports_of_hydra_are_in_one_module() -> None:
    files = {path for (module, _), paths in private_imports().items() if module.startswith("hydra") for path in paths}
    assert files == {"framework/config/hydra_api.py"}


def test_private_imports_list_has_installed_versions() -> None:
    assert hydra.__version__ in hydra_api.TESTED
    assert numba.__version__ in worker.TESTED
    assert f"hydra-core {hydra.__version__} and numba {numba.__version__}" in SECTION

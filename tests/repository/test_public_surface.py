"""Tests that other packages need only imports from `instancemap` and `instancemap.testing`."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import instancemap.testing
import pytest

import instancemap

CHECKOUT = Path(__file__).resolve().parents[2]
PUBLIC = {"instancemap": instancemap, "instancemap.testing": instancemap.testing}
SHOWN = [
    *(CHECKOUT / "framework" / "templates").rglob("*.template"),
    *(CHECKOUT / "examples").rglob("*.py"),
    *(CHECKOUT / "docs" / "tutorials").glob("*.md"),
    CHECKOUT / "docs" / "python.md",
    CHECKOUT / "README.md",
]


@pytest.mark.parametrize("path", SHOWN, ids=lambda path: str(path.relative_to(CHECKOUT)))
def test_documented_code_imports_only_public_names(path: Path) -> None:
    text = path.read_text()
    assert not re.findall(r"(?m)^ *(?:from|import) (?:framework|plugins|hydra)\b.*", text)
    for module, block, line in re.findall(r"(?m)^ *from (instancemap[.\w]*) import (?:\(([^)]*)\)|(.+))", text):
        if module in PUBLIC:
            names = re.findall(r"\w+", block or line.partition("#")[0])
            assert not set(names) - set(PUBLIC[module].__all__)


def test_public_names_exist() -> None:
    for module in PUBLIC.values():
        assert not [name for name in module.__all__ if not hasattr(module, name)]


def test_deprecated_public_names_state_replacement() -> None:
    """The message has the form that CONTRIBUTING.md prescribes, and the replacement exists."""
    for module in PUBLIC.values():
        for name in module.__all__:
            message = getattr(getattr(module, name), "__deprecated__", None)
            stated = message and re.fullmatch(r"use (\w+)[\w.()]* instead; removed in \d+\.\d+", message)
            assert message is None or (stated and stated[1] in module.__all__), f"{name}: {message}"


@pytest.mark.integration
def test_instancemap_import_loads_no_test_code() -> None:
    code = "import sys, instancemap; print([name for name in ('pytest', 'framework.testing') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=CHECKOUT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"

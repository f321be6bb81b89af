"""Checks of required Python packages and of extras."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from functools import cache
from importlib.metadata import PackageNotFoundError, metadata, version
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

from framework.doctor.check_result import Check
from framework.doctor.isolated import Outcomes

PYPROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"
MODULES = {
    "hydra-core": "hydra",
    "opencv-python-headless": "cv2",
    "pillow": "PIL",
    "pyyaml": "yaml",
    "scikit-learn": "sklearn",
}
"""Import name of each package whose import name differs from its package name, apart from - and _."""


@cache
def declared() -> tuple[str, list[Requirement], dict[str, list[Requirement]]]:
    """Return the Python version range, the required packages, and the packages of each extra.

    The source is pyproject.toml in a checkout, otherwise the metadata of the installed package.
    """
    if PYPROJECT.is_file():
        project: dict[str, Any] = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]
        extras = {name: [*map(Requirement, lines)] for name, lines in project["optional-dependencies"].items()}
        return project["requires-python"], [*map(Requirement, project["dependencies"])], extras
    found = metadata("instancemap")
    lines = [*map(Requirement, found.get_all("Requires-Dist") or [])]
    required = [line for line in lines if line.marker is None or line.marker.evaluate({"extra": ""})]
    extras = {
        name: [line for line in lines if line not in required and line.marker and line.marker.evaluate({"extra": name})]
        for name in found.get_all("Provides-Extra") or []
    }
    return str(found["Requires-Python"]), required, extras


def import_statement(package: str) -> str:
    """Return the statement that imports a package."""
    return f"import {MODULES.get(package, package.replace('-', '_'))}"


def libraries(outcomes: Outcomes) -> Iterator[Check]:
    """Check the version and the import of every required package."""
    for line in declared()[1]:
        fits, detail = _installed(line)
        fix = f"pip install '{line.name}{line.specifier}'"
        _, error = outcomes[import_statement(line.name)]
        if fits and error:
            fix = f"pip install --force-reinstall --no-deps '{line.name}=={detail}'"
            detail = f"{detail}, import fails: {error}"
        yield Check.of(line.name, fits and not error, detail, fix, required=True)


def extras() -> Iterator[Check]:
    """Check the versions of the packages of every extra."""
    for name, lines in declared()[2].items():
        found = {line.name: _installed(line) for line in lines}
        detail = ", ".join(f"{package} {detail}" for package, (_, detail) in found.items())
        yield Check.of(name, all(fits for fits, _ in found.values()), detail, f"pip install 'instancemap[{name}]'")


def _installed(line: Requirement) -> tuple[bool, str]:
    try:
        found = version(line.name)
    except PackageNotFoundError:
        return False, "not installed"
    fits = line.specifier.contains(found, prereleases=True)
    return fits, found if fits else f"expected {line.specifier}, got {found}"

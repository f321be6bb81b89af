"""Python packages: the required ones and the extras, as declared in the project's own metadata."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, metadata, packages_distributions, version
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from framework.doctor.check_result import Check, Status

PYPROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"


@cache
def declared() -> tuple[str, list[Requirement], dict[str, list[Requirement]]]:
    """Return the Python range, the required packages and those of each extra: of the checkout, else as installed."""
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


@cache
def modules() -> dict[str, str]:
    """Return the import name of each required package that is installed."""
    names: dict[str, list[str]] = {}
    for module, packages in packages_distributions().items():
        for package in packages:
            names.setdefault(canonicalize_name(package), []).append(module)
    found = {}
    for line in declared()[1]:
        package = canonicalize_name(line.name)
        public = sorted(name for name in names.get(package, []) if not name.startswith("_"))
        if public:
            own = package.replace("-", "_")
            found[line.name] = own if own in public else public[0]
    return found


def libraries(answers: Mapping[str, Mapping[str, Any]]) -> Iterator[Check]:
    """Check every required package; `answers` holds the import errors by module."""
    for line in declared()[1]:
        fits, detail = _installed(line)
        error = answers.get(modules().get(line.name, ""), {}).get("error")
        if not fits:
            yield Check(line.name, Status.ERROR, detail, f"pip install '{line.name}{line.specifier}'")
        elif error:
            fix = f"pip install --force-reinstall --no-deps '{line.name}=={detail}'"
            yield Check(line.name, Status.ERROR, f"{detail}, import fails: {error}", fix)
        else:
            yield Check(line.name, Status.OK, detail)


def extras() -> Iterator[Check]:
    """Check every extra that users can install."""
    for name, lines in declared()[2].items():
        yield extra(name, lines)


def extra(name: str, lines: Sequence[Requirement]) -> Check:
    found = {line.name: _installed(line) for line in lines}
    detail = ", ".join(f"{package} {detail}" for package, (_, detail) in found.items())
    if all(fits for fits, _ in found.values()):
        return Check(name, Status.OK, detail)
    return Check(name, Status.MISSING, detail, f"pip install 'instancemap[{name}]'")


def _installed(line: Requirement) -> tuple[bool, str]:
    try:
        found = version(line.name)
    except PackageNotFoundError:
        return False, "not installed"
    fits = line.specifier.contains(found, prereleases=True)
    return fits, found if fits else f"expected {line.specifier}, got {found}"

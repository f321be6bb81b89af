"""What the project says that it needs, and whether it is installed: by its own metadata, so that no list can drift."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from framework.doctor.check_result import Finding, State

PROJECT = "instancemap"
PYPROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"
NOT_OF_USERS = ("dev", "docs", "evaluation-oracle")  # extras that only developers need


@dataclass(frozen=True)
class Needs:
    """What the project needs."""

    python: SpecifierSet
    always: Sequence[Requirement]
    extras: Mapping[str, Sequence[Requirement]]


def needs() -> Needs:
    """Those of the checkout that runs; of the installed package where there is none."""
    if PYPROJECT.is_file():
        project = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]
        extras = {name: [*map(Requirement, of)] for name, of in project["optional-dependencies"].items()}
        return Needs(SpecifierSet(project["requires-python"]), [*map(Requirement, project["dependencies"])], extras)
    metadata = distribution(PROJECT).metadata
    required = [*map(Requirement, metadata.get_all("Requires-Dist") or [])]
    here = [of for of in required if of.marker is None or of.marker.evaluate({"extra": ""})]
    extras = {
        name: [of for of in required if of not in here and of.marker and of.marker.evaluate({"extra": name})]
        for name in metadata.get_all("Provides-Extra") or []
    }
    return Needs(SpecifierSet(metadata["Requires-Python"]), here, extras)


def installed(requirement: Requirement) -> tuple[bool, str]:
    """Whether it is there as it must be, and in which version."""
    try:
        found = version(requirement.name)
    except PackageNotFoundError:
        return False, "not installed"
    if requirement.specifier.contains(found, prereleases=True):
        return True, found
    return False, f"{found}, but {requirement.specifier} is needed"


def module_of(requirement: Requirement) -> str | None:
    """The module that an installed library is imported by; None where that is not known."""
    try:
        found = distribution(requirement.name)
    except PackageNotFoundError:
        return None
    names = (found.read_text("top_level.txt") or "").split()
    if not names:
        paths = [file.parts for file in found.files or [] if file.suffix == ".py"]
        names = [parts[0].removesuffix(".py") for parts in paths if len(parts) == 1 or parts[1:] == ("__init__.py",)]
    own = canonicalize_name(requirement.name).replace("-", "_")
    return own if own in names else next((name for name in names if not name.startswith("_")), None)


def of_library(requirement: Requirement, fault: str | None) -> Finding:
    """A library that every run needs; `fault` is why it cannot be imported."""
    there, detail = installed(requirement)
    wanted = f"pip install '{requirement.name}{requirement.specifier}'"
    if not there:
        return Finding(requirement.name, State.BROKEN, detail, wanted)
    if fault is not None:
        again = f"pip install --force-reinstall --no-deps '{requirement.name}=={detail}'"
        return Finding(requirement.name, State.BROKEN, f"{detail}, cannot be imported: {fault}", again)
    return Finding(requirement.name, State.THERE, detail)


def of_extra(name: str, requirements: Sequence[Requirement]) -> Finding:
    """An extra of the project."""
    found = {requirement.name: installed(requirement) for requirement in requirements}
    detail = ", ".join(f"{library} {detail}" for library, (_, detail) in found.items())
    if all(there for there, _ in found.values()):
        return Finding(name, State.THERE, detail)
    return Finding(name, State.OPTIONAL, detail, f"pip install '{PROJECT}[{name}]'")

"""Tests for the lock files in constraints/."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

CHECKOUT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())
PYTHONS = [
    classifier.rpartition(" ")[2]
    for classifier in PROJECT["project"]["classifiers"]
    if classifier.startswith("Programming Language :: Python :: 3.")
]
SDKS = {"orbbec", "realsense"}  # extras that are not in the extra `all`


def requirements() -> Iterator[Requirement]:
    """Yield the direct dependencies of the project, its extras and its development tools."""
    extras = PROJECT["project"]["optional-dependencies"]
    groups: dict[str, list[Any]] = PROJECT["dependency-groups"]
    lists = [PROJECT["project"]["dependencies"], *(groups[included["include-group"]] for included in groups["dev"])]
    lists += [extras[extra] for extra in extras if extra not in SDKS]
    for texts in lists:
        yield from (Requirement(text) for text in texts if isinstance(text, str))


def test_constraints_cover_supported_python_versions() -> None:
    assert {path.name for path in (CHECKOUT / "constraints").iterdir()} == {f"python{one}.txt" for one in PYTHONS}


@pytest.mark.parametrize("python", PYTHONS)
def test_constraints_satisfy_all_requirements(python: str) -> None:
    lines = (CHECKOUT / f"constraints/python{python}.txt").read_text().splitlines()
    locked = dict(line.split("==") for line in lines if not line.startswith("#"))
    versions = {canonicalize_name(name): version for name, version in locked.items()}
    environment = {"python_version": python, "python_full_version": f"{python}.0"}
    required = [one for one in requirements() if one.marker is None or one.marker.evaluate(environment)]
    assert len(required) > 30
    for one in required:
        name = canonicalize_name(one.name)
        if name != "instancemap":
            assert one.specifier.contains(versions[name]), one

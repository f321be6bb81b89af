"""Provenance of results: config, code and machine."""

from __future__ import annotations

import hashlib
import json
import platform
import subprocess
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, distributions, version
from pathlib import Path
from typing import Any

import framework
from framework.runtime.process_settings import available_cores

PACKAGES = ("torch", "numpy", "numba", "open3d")
UNKNOWN = "unknown"
WITHOUT_EFFECT = (
    *("hydra", "debug", "skip_completed", "prefetch", "detection_cache", "detection_cache_dir", "viewer", "objective"),
    "threads",  # affects only the last digits of network outputs
    *("row", "rows", "sequences", "table", "figure"),  # settings of an experiment
    "evaluation",  # label space of the evaluation, which can be repeated without mapping again
)
"""Config keys that do not affect results."""

OF_SPEED = ("threads", "prefetch", "detection_cache")  # config keys that affect speed
OF_MACHINE = ("environment.processor", "environment.cpus")  # keys of metrics.json that affect speed


def config_hash(resolved: Mapping[str, Any]) -> str:
    """Return the SHA-256 (hex) of the part of a config that affects results, independent of the order of keys."""
    return hashlib.sha256(json.dumps(relevant(resolved), sort_keys=True, default=str).encode()).hexdigest()


def relevant(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a config that affects results."""
    return {key: value for key, value in config.items() if key not in WITHOUT_EFFECT}


def parameters_of(config: Mapping[str, Any]) -> dict[str, str]:
    """Return the parameters that affect results as text, by dotted key."""
    return {key: str(value) for key, value in leaves(relevant(config))}


def leaves(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted key and the value of each parameter in a config. A list is one value."""
    for key, value in node.items():
        if isinstance(value, Mapping) and value:
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def shows_speed(config: Mapping[str, Any]) -> bool:
    """Return True if the table of the experiment has the column `fps`."""
    return "fps" in (config.get("table") or {}).get("columns", ())


def speed_settings(config: Mapping[str, Any], metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that affect the speed of a run but not its results."""
    return {key: config.get(key) for key in OF_SPEED} | {key: metrics.get(key) for key in OF_MACHINE}


def code_version() -> dict[str, str | bool]:
    """Return the commit of the checkout, and True if files are modified.

    Both values are "unknown" outside of a checkout.
    """
    checkout = Path(framework.__file__).resolve().parent.parent
    top = _git(checkout, "rev-parse", "--show-toplevel")
    if top is None or Path(top).resolve() != checkout:  # installed from a wheel, possibly inside another repository
        return {"git_commit": UNKNOWN, "git_dirty": UNKNOWN}
    return {
        "git_commit": _git(checkout, "rev-parse", "HEAD") or UNKNOWN,
        "git_dirty": bool(_git(checkout, "status", "--porcelain", "--untracked-files=no")),
    }


def environment() -> dict[str, str | int]:
    """Return the machine and the versions of the main libraries."""
    return {
        "environment.python": platform.python_version(),
        "environment.platform": platform.platform(),
        "environment.processor": processor(),
        "environment.cpus": available_cores(),
        "environment.instancemap": framework.__version__,
        **{f"environment.{package}": package_version(package) or "not installed" for package in PACKAGES},
    }


@cache
def frozen_environment() -> str:
    """Return the versions of Python and all installed packages in the format of pip constraints.

    PyPI has no local versions such as 2.13.0+cpu, so they are written as 2.13.0.
    """
    # interrupted installations leave packages without a name
    named = [package for package in distributions() if "Name" in package.metadata]
    packages = {f"{one.name}=={public_version(one.version)}" for one in named if one.name != "instancemap"}
    return "\n".join([f"# Python {platform.python_version()}", *sorted(packages, key=str.lower)]) + "\n"


def public_version(version: str) -> str:
    """Return a version without its local part: 2.13.0 for 2.13.0+cpu."""
    return version.partition("+")[0]


def _git(directory: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(directory), *arguments], capture_output=True, text=True, timeout=20, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def processor() -> str:
    """Return the name of the processor."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or UNKNOWN


def package_version(package: str) -> str | None:
    """Return the version of a package, or None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None

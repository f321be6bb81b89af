"""Renamed config keys, which still work for one minor version."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

log = logging.getLogger(__name__)

DEPRECATED: dict[str, str] = {}
"""New name of each key renamed since the previous minor version, in the same group.

Keys of a refiner in a chain (`refiner.links.NAME.KEY`) are listed as `refiner.KEY`.
"""


def _current(key: str) -> str:
    """Return the current name of a dotted config key, which may be deprecated."""
    parts = key.split(".")
    found = DEPRECATED.get(key) or (DEPRECATED.get(f"{parts[0]}.{parts[-1]}") if len(parts) > 2 else None)
    return f"{key[: key.rfind('.') + 1]}{found.rpartition('.')[2]}" if found else key


def replace_deprecated(key: str) -> str:
    """Return the current name of a dotted config key. Log a warning if it is deprecated, once per process."""
    if (new := _current(key)) != key:
        _warn(key, new)
    return new


@cache
def _warn(key: str, new: str) -> None:
    log.warning("%s: deprecated, removed in the next minor version; set %s instead", key, new)


def replace_in_overrides(overrides: Sequence[str]) -> list[str]:
    """Return overrides with the current names of deprecated keys, and log warnings."""
    return [re.sub(r"^([+~]*)([^=]+)", lambda found: found[1] + replace_deprecated(found[2]), one) for one in overrides]


def replace_in_config(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the config of a stored run with the current names of deprecated keys."""
    return {
        _current(f"{prefix}{key}").removeprefix(prefix): replace_in_config(value, f"{prefix}{key}.")
        if isinstance(value, Mapping)
        else value
        for key, value in config.items()
    }

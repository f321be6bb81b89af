"""Validation of parameters and config values."""

from __future__ import annotations

import importlib.util
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from difflib import get_close_matches
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_type_hints

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from framework.config.renamed_keys import replace_deprecated, replace_in_overrides
from framework.errors import ConfigError, ParameterError
from framework.files.search_paths import usable_path

MAX_DETECTIONS = 1000  # maximum number of detections per image; each has a mask of the image size; COCO evaluates 100
MAX_PROPOSALS = 100_000  # maximum number of proposals of a network per image
LONGEST_SIDE = 2**13  # px, maximum side length of the input image of a network
PHRASES: Mapping[Any, str] = {
    bool: "true or false",
    int: "an integer",
    float: "a number",
    str: "a string",
    Path: "a path",
    NoneType: "null",
    list[str]: "a list of strings",
    dict[str, Any]: "a mapping from keys to values",
    dict[str, str]: "a mapping from names to strings",
}
"""Valid values by type, for error messages."""


def check_bounds(plugin: object, **bounds: tuple[float, float]) -> None:
    """Check that parameters are in closed intervals. NaN is in no interval.

    Args:
        plugin: The plugin, or a part of it, with the parameters as attributes.
        bounds: The interval (low, high) of each parameter by name.

    Raises:
        ConfigError: A parameter is outside of its interval.
    """
    for name, (low, high) in bounds.items():
        value = getattr(plugin, name)
        if not low <= value <= high:
            allowed = f"at least {low:g}" if high == math.inf else f"a value in [{low:g}, {high:g}]"
            raise ParameterError(type(plugin).__name__, name, f"expected {allowed}, got {value}")


def check_intervals(stage: str, plugin: object, **intervals: str) -> None:
    """Check that parameters are in intervals such as nms_iou="(0, 1]". NaN is in no interval.

    Args:
        stage: Config group of the plugin.
        plugin: The plugin, or a part of it, with the parameters as attributes.
        intervals: The interval of each parameter by name.

    Raises:
        ConfigError: A parameter is outside of its interval.
    """
    for name, interval in intervals.items():
        low, high = map(float, interval[1:-1].split(","))
        value = getattr(plugin, name)
        inside = low <= value <= high and (value > low or interval[0] == "[") and (value < high or interval[-1] == "]")
        require(inside, f"{stage}.{name}", value, f"a value in {interval}")


def require(holds: bool, name: str, value: object, allowed: str) -> None:
    """Raise ConfigError with the message "NAME: expected ALLOWED, got VALUE" unless `holds`."""
    if not holds:
        raise ConfigError(f"{name}: expected {allowed}, got {value}")


def check_package(key: str, package: str, extra: str) -> None:
    """Raise ConfigError with the installation command if an optional package is missing."""
    if importlib.util.find_spec(package) is None:
        raise ConfigError(f"{key}: expected the package {package}, got none; run pip install 'instancemap[{extra}]'")


def checked_path(name: str, value: object) -> Path:
    """Return the value of a config key as an absolute path.

    Raises:
        ConfigError: The value is not a nonempty string.
        DataError: The value contains NUL or has a too long name.
    """
    require(isinstance(value, str) and value != "", name, repr(value), "a path (in quotes if it looks like a number)")
    return usable_path(name, value).expanduser().absolute()


def checked_file(name: str, value: object, suffix: str = "") -> Path:
    """Return the value of a config key as the absolute path of an output file.

    Args:
        name: Config key.
        value: Value of the key.
        suffix: Required suffix of the file name; "" = any.

    Raises:
        ConfigError: The suffix is wrong or the folder does not exist.
    """
    path = checked_path(name, value)
    if suffix and path.suffix.lower() != suffix:
        raise ConfigError(f"{name}: expected a name with the suffix {suffix}, got {path.name}")
    if not path.parent.is_dir():
        raise ConfigError(f"{name}: expected an existing parent folder, got none; create {path.parent}")
    return path


def check_count(name: str, value: int, most: int) -> None:
    """Raise ConfigError unless a count is in [1, most]."""
    require(1 <= value <= most, name, value, f"a value in [1, {most}]")


def check_page_columns(name: str, value: int | None) -> None:
    """Raise ConfigError unless the width `value` of a table or figure is 1 or 2 columns of a page, or None."""
    require(value in (None, 1, 2), name, value, "1, 2 or null")


def check_known(settings: Iterable[tuple[str, str]], known: Collection[str]) -> None:
    """Raise ConfigError for a key of a run that is not in `known`; `settings` are (setting, key) pairs."""
    for name, key in settings:
        if key not in known:
            close = get_close_matches(key, known, n=1)
            fix = f"did you mean {close[0]}?" if close else "set a group such as dataset, or a parameter of all runs"
            raise ConfigError(f"{name}: expected a group of options or a parameter, got {key}; {fix}")


def checked_rows(node: Any) -> dict[str, list[str]]:
    """Return the overrides of each row by name, from the value of the config key `rows`.

    Raises:
        ConfigError: The overrides of a row are not a list of strings.
    """
    if node is not None and not isinstance(node, Mapping):
        raise ConfigError(
            f"rows: expected a mapping of names to overrides, got {node!r}; write, for example, "
            "mine: [refiner=identity]"
        )
    rows = {str(name): overrides for name, overrides in (node or {}).items()}
    for name, overrides in rows.items():
        listed = isinstance(overrides, Sequence) and not isinstance(overrides, str)
        if not listed or not all(isinstance(one, str) for one in overrides):
            raise ConfigError(
                f"rows.{name}: expected a list of overrides, got {overrides!r}; write, for example, [refiner=identity]"
            )
    return {name: replace_in_overrides(overrides) for name, overrides in rows.items()}


def checked_block(kind: type, name: str, node: Any) -> dict[str, Any]:
    """Return the keyword arguments of a dataclass from a config node, with defaults for missing keys.

    Args:
        kind: Dataclass.
        name: Config key of the node, for error messages.
        node: Config node.

    Raises:
        ConfigError: A key is unknown or a value has a wrong type.
    """
    if not isinstance(node, Mapping):
        raise ConfigError(f"{name}: expected keys and values, got {node!r}")
    block, types = OmegaConf.structured(kind), get_type_hints(kind)
    for given in map(str, node):
        key = given if given in types else replace_deprecated(f"{name}.{given}").removeprefix(f"{name}.")
        if key not in types:
            raise ConfigError(f"{name}: expected one of {', '.join(types)}, got {key!r}")
        try:
            block = OmegaConf.merge(block, OmegaConf.create({key: node[given]}))
        except OmegaConfBaseException as error:
            raise ConfigError(f"{name}.{key}: expected {values_of(types[key])}, got {node[given]!r}") from error
    content = OmegaConf.to_container(block)
    assert isinstance(content, dict)
    return {str(key): value for key, value in content.items()}


def without_interpolation(text: str) -> str:
    """Return a text with escaped references `${`, which OmegaConf takes literally."""
    return re.sub(r"(\\*)\$\{", r"\1\1\\${", text)


def values_of(kind: Any) -> str:
    """Return the valid values of a type for error messages, such as "an integer"."""
    if isinstance(kind, type) and issubclass(kind, Enum):
        return f"one of {', '.join(kind.__members__)}"
    if isinstance(kind, UnionType):
        return " or ".join(map(values_of, get_args(kind)))
    return PHRASES.get(kind, str(kind))

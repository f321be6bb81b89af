"""How plugins check their parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from framework.errors import ConfigError, first_line

MOST_DETECTIONS = 1000  # of an image, each with a mask of its size; COCO's evaluation takes 100
MOST_PROPOSALS = 100_000  # that a network looks at
LONGEST_SIDE = 2**13  # px, of the image that a network takes


def check_bounds(plugin: object, **bounds: tuple[float, float]) -> None:
    """Raise ConfigError unless each named parameter is in its closed interval (low, high); NaN never is."""
    for name, (low, high) in bounds.items():
        value = getattr(plugin, name)
        require(low <= value <= high, f"{type(plugin).__name__}.{name}", value, f"in [{low:g}, {high:g}]")


def check_intervals(stage: str, plugin: object, **intervals: str) -> None:
    """Raise ConfigError unless each named parameter lies in its interval, such as "(0, 1]". NaN never does."""
    for name, interval in intervals.items():
        low, high = map(float, interval[1:-1].split(","))
        value = getattr(plugin, name)
        inside = low <= value <= high and (value > low or interval[0] == "[") and (value < high or interval[-1] == "]")
        require(inside, f"{stage}.{name}", value, f"in {interval}")


def require(holds: bool, name: str, value: object, allowed: str) -> None:
    """Raise ConfigError unless the condition holds: "detector.nms_iou must be in (0, 1], found 2"."""
    if not holds:
        raise ConfigError(f"{name} must be {allowed}, found {value}")


def checked_path(name: str, value: object) -> Path:
    """Return the absolute path in a config key. Raises ConfigError for a value that YAML does not read as text."""
    require(isinstance(value, str) and value != "", name, repr(value), "a path; quote what looks like a number")
    return Path(str(value)).expanduser().absolute()


def checked_file(name: str, value: object, suffix: str = "") -> Path:
    """Return the absolute path of an output file in a config key. Raises ConfigError if it cannot be written."""
    path = checked_path(name, value)
    if suffix and path.suffix.lower() != suffix:
        raise ConfigError(f"{name} must end in {suffix}, found {path.name}")
    if not path.parent.is_dir():
        raise ConfigError(f"{name}: there is no folder {path.parent}")
    return path


def check_count(name: str, value: int, most: int) -> None:
    """Raise ConfigError unless a count is from 1 to `most`, the limit of memory."""
    require(1 <= value <= most, name, value, f"at least 1 and at most {most}")


def checked_rows(node: Any) -> dict[str, list[str]]:
    """Return the overrides of each row of an experiment by name; empty without `rows`.

    Raises ConfigError when those of a row are no list of texts.
    """
    if node is not None and not isinstance(node, Mapping):
        raise ConfigError(f"rows must have names with overrides, like mine: [refiner=identity], found {node!r}")
    rows = {str(name): overrides for name, overrides in (node or {}).items()}
    for name, overrides in rows.items():
        listed = isinstance(overrides, Sequence) and not isinstance(overrides, str)
        if not listed or not all(isinstance(one, str) for one in overrides):
            raise ConfigError(f"rows.{name} must be a list of overrides, like [refiner=identity], found {overrides!r}")
    return {name: list(overrides) for name, overrides in rows.items()}


def checked_block(kind: type, name: str, node: Any) -> dict[str, Any]:
    """Return the keyword arguments of the dataclass `kind` from the config block `name`, with defaults.

    Raises ConfigError for keys and types that it does not have.
    """
    if not isinstance(node, Mapping):
        raise ConfigError(f"{name} must have keys and values, found {node!r}")
    try:
        content = OmegaConf.to_container(OmegaConf.merge(OmegaConf.structured(kind), OmegaConf.create(dict(node))))
    except OmegaConfBaseException as error:
        raise ConfigError(f"{name}: {first_line(error)}") from error
    assert isinstance(content, dict)
    return {str(key): value for key, value in content.items()}

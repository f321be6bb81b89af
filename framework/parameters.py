"""How plugins check their parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from framework.errors import ConfigError


def check_bounds(plugin: object, **bounds: tuple[float, float]) -> None:
    """Raises ConfigError unless each named parameter lies in its closed interval (low, high). NaN never does."""
    for name, (low, high) in bounds.items():
        value = getattr(plugin, name)
        require(low <= value <= high, f"{type(plugin).__name__}.{name}", value, f"in [{low:g}, {high:g}]")


def require(holds: bool, name: str, value: object, allowed: str) -> None:
    """Raises ConfigError unless the condition holds, in one line like "detector.nms must be in (0, 1], found 2"."""
    if not holds:
        raise ConfigError(f"{name} must be {allowed}, found {value}")


def checked_block(kind: type, name: str, node: Any) -> dict[str, Any]:
    """The keyword arguments that the config's block `name` gives to the dataclass `kind`, its defaults included.

    Raises ConfigError for keys and types that it does not have.
    """
    if not isinstance(node, Mapping):
        raise ConfigError(f"{name} must have keys and values, found {node!r}")
    try:
        content = OmegaConf.to_container(OmegaConf.merge(OmegaConf.structured(kind), OmegaConf.create(dict(node))))
    except OmegaConfBaseException as error:
        first_line = str(error).partition("\n")[0]
        raise ConfigError(f"{name}: {first_line}") from error
    assert isinstance(content, dict)
    return {str(key): value for key, value in content.items()}

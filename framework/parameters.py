"""How plugins check their parameters."""

from __future__ import annotations

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

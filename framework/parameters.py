"""How plugins check their parameters."""

from __future__ import annotations

from framework.errors import ConfigError


def require(holds: bool, name: str, value: object, allowed: str) -> None:
    """Raises ConfigError in one line unless the parameter's bounds hold: "detector.nms must be in (0, 1], found 2"."""
    if not holds:
        raise ConfigError(f"{name} must be {allowed}, found {value}")

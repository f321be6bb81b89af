"""The check that refiners make of their own parameters."""

from __future__ import annotations

from framework.errors import ConfigError
from framework.interfaces import ClusterRefiner


def check_bounds(refiner: ClusterRefiner, name: str, low: float, high: float) -> None:
    """Raises ConfigError unless low <= `refiner.name` <= high. NaN is never within bounds."""
    value = getattr(refiner, name)
    if not low <= value <= high:
        raise ConfigError(f"{type(refiner).__name__}: {name} must be in [{low:g}, {high:g}], found {value}")

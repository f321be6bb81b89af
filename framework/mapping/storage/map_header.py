"""Header of a map file.

Map files are untrusted, so each value is validated.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, TypeVar

from framework.data import LONGEST_CLASS_NAME, MAX_CLASSES
from framework.errors import DataError

LARGEST_COUNT = 2**53  # maximum number of frames and evictions; JSON readers represent all integers up to it exactly

Option = TypeVar("Option", bound=Enum)


@dataclass(frozen=True)
class MapHeader:
    """A JSON object in the header of a map file.

    Each method reads one key. All methods raise DataError for invalid values.
    """

    values: Mapping[str, Any]
    name: str = "header"

    @classmethod
    def of(cls, found: object, name: str = "header") -> MapHeader:
        """Return the header for a JSON object."""
        if not isinstance(found, dict):
            raise DataError(f"{name}: expected a JSON object, got {found!r:.60}")
        return cls(found, name)

    def has(self, key: str) -> bool:
        return key in self.values

    def part(self, key: str) -> MapHeader:
        """Return a nested JSON object."""
        return MapHeader.of(self._value(key), f"{self.name}.{key}")

    def parts(self, key: str) -> Iterator[MapHeader]:
        """Yield the JSON objects of a list."""
        for k, found in enumerate(self.items(key)):
            yield MapHeader.of(found, f"{self.name}.{key}[{k}]")

    def items(self, key: str) -> list[Any]:
        """Return a list of arbitrary values."""
        found = self._value(key)
        if not isinstance(found, list):
            raise self._error(key, "a list", found)
        return found

    def number(self, key: str, bounds: tuple[float, float] = (-math.inf, math.inf)) -> float:
        """Return a finite number within the bounds."""
        found, (low, high) = self._value(key), bounds
        is_number = isinstance(found, int | float) and not isinstance(found, bool) and math.isfinite(found)
        # with a tolerance for the rounding of float32
        if not is_number or not low - 1e-6 * abs(low) <= found <= high + 1e-6 * abs(high):
            raise self._error(key, f"a number in [{low:g}, {high:g}]", found)
        return float(found)

    def whole(self, key: str, low: int = 0, high: int = LARGEST_COUNT) -> int:
        """Return an integer in [low, high]."""
        return whole(f"{self.name}.{key}", self._value(key), low, high)

    def flag(self, key: str) -> bool:
        """Return a Boolean."""
        found = self._value(key)
        if not isinstance(found, bool):
            raise self._error(key, "true or false", found)
        return found

    def option(self, key: str, options: type[Option]) -> Option:
        """Return a member of an enumeration by its name."""
        found = self._value(key)
        if not isinstance(found, str) or found not in options.__members__:
            raise self._error(key, f"one of {', '.join(options.__members__)}", found)
        return options[found]

    def classes(self) -> tuple[str, ...]:
        """Return the names of the classes."""
        found = self.items("classes")
        names = [name for name in found if isinstance(name, str) and len(name) <= LONGEST_CLASS_NAME]
        if len(names) < len(found) or len(found) > MAX_CLASSES:
            expected = f"at most {MAX_CLASSES} names of at most {LONGEST_CLASS_NAME} characters each"
            raise self._error("classes", expected, found)
        return tuple(names)

    def _value(self, key: str) -> Any:
        if key not in self.values:
            raise DataError(f"{self.name}: expected the key {key!r}, got none")
        return self.values[key]

    def _error(self, key: str, expected: str, found: object) -> DataError:
        return DataError(f"{self.name}.{key}: expected {expected}, got {found!r:.60}")


def whole(name: str, found: object, low: int = 0, high: int = LARGEST_COUNT) -> int:
    """Return an integer in [low, high].

    Raises:
        DataError: If the value is not such an integer. The message contains `name`.
    """
    if isinstance(found, bool) or not isinstance(found, int) or not low <= found <= high:
        raise DataError(f"{name}: expected an integer in [{low}, {high}], got {found!r:.60}")
    return found

"""JSON files: read strictly, up to a size and a depth that none of ours comes near."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from framework.errors import DataError, in_one_line
from framework.files.atomic_write import MOST_TEXT, read_bytes, written_whole

DEEPEST = 50  # objects and lists in each other
TOO_DEEP = f"it is not valid JSON for us: lists and objects more than {DEEPEST} deep"
MOST_BITS = 63  # of a whole number: times in ns have 61, and libraries cannot take more


def write_json(path: Path, content: Any) -> None:
    """Writes `content`, whole or not at all; floats with as many digits as it takes to read them back exactly."""
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def read_json(path: Path, most: int = MOST_TEXT) -> Any:
    """What a JSON file of at most so many bytes holds. Raises DataError, naming the file, when it cannot be read."""
    return parse_json(path, read_bytes(path, most))


def parse_json(where: object, content: bytes | str) -> Any:
    """What JSON text says, with or without a byte order mark. `where` it is from begins a DataError's line."""
    try:
        found = json.loads(content, parse_int=_whole, object_pairs_hook=_once)
    except RecursionError as error:
        raise DataError(f"{where} cannot be read: {TOO_DEEP}") from error
    except (ValueError, MemoryError) as error:
        raise DataError(f"{where} cannot be read: it is not valid JSON: {in_one_line(error)}") from error
    if not _is_shallow(found):
        raise DataError(f"{where} cannot be read: {TOO_DEEP}")
    return found


def _whole(digits: str) -> int:
    if len(digits) > MOST_BITS or (value := int(digits)).bit_length() > MOST_BITS:
        raise ValueError(f"{digits[:20]}... is a whole number of {len(digits)} digits, more than {MOST_BITS} bits hold")
    return value


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object: JSON lets a key be there twice, and readers take the last value or the first."""
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = next(key for k, (key, _) in enumerate(pairs) if key in {before for before, _ in pairs[:k]})
        raise ValueError(f"the key {twice!r} is twice in an object")
    return found


def _is_shallow(content: Any) -> bool:
    """Whether what was read is at most DEEPEST deep: what handles it may call itself for each level."""
    level = [content]
    for _ in range(DEEPEST):
        level = [
            below
            for node in level
            if isinstance(node, list | dict)
            for below in (node.values() if isinstance(node, dict) else node)
            if isinstance(below, list | dict)
        ]
        if not level:
            return True
    return False


def _finite(content: Any) -> Any:
    """NaN is not JSON: a figure that is not defined, such as the AP of a class that is not there, is null."""
    if isinstance(content, Mapping):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content

"""JSON files of limited size and depth."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from framework.errors import DataError, errors_of, in_one_line
from framework.files.atomic_write import MAX_TEXT, atomic_write, read_bytes

MAX_DEPTH = 50  # maximum depth of nested objects and lists
TOO_DEEP = f"expected JSON with at most {MAX_DEPTH} nested lists and objects, got deeper nesting"
_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")
MAX_BITS = 63  # maximum size of an integer, bits; libraries have this limit; timestamps in ns have 61 bits


def write_json(path: Path, content: Any) -> None:
    r"""Write an object to a JSON file atomically.

    NaN and infinity are written as null, and bytes of file names that are not UTF-8 as text, such as \udcff.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def read_json(path: Path, most: int = MAX_TEXT) -> Any:
    """Read a JSON file.

    Raises:
        DataError: The file is invalid or larger than `most` bytes.
    """
    return parse_json(path, read_bytes(path, most))


def parse_json(where: object, content: bytes | str) -> Any:
    """Parse JSON.

    Raises:
        DataError: The JSON is invalid. The message contains `where`.
    """
    try:
        with errors_of(where):
            found = json.loads(content, parse_int=_whole, object_pairs_hook=_once)
    except RecursionError as error:
        raise DataError(f"{where}: {TOO_DEEP}") from error
    except (ValueError, MemoryError) as error:
        raise DataError(f"{where}: expected valid JSON, got an error ({in_one_line(error)})") from error
    if not _is_shallow(found):
        raise DataError(f"{where}: {TOO_DEEP}")
    if _SURROGATE.search(content if isinstance(content, bytes) else content.encode(errors="backslashreplace")):
        try:
            json.dumps(found, ensure_ascii=False).encode()
        except UnicodeEncodeError as error:
            character = error.object[error.start]
            raise DataError(f"{where}: expected valid Unicode, got the lone surrogate {character!r}") from error
    return found


def _whole(digits: str) -> int:
    if len(digits) > MAX_BITS or (value := int(digits)).bit_length() > MAX_BITS:
        raise DataError(f"expected integers of at most {MAX_BITS} bits, got {digits[:20]}... of {len(digits)} digits")
    return value


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the pairs as a dictionary, and raise DataError for duplicate keys."""
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:  # JSON does not define the meaning of duplicate keys
            raise DataError(f"expected unique keys, got {key!r} twice")
        found[key] = value
    return found


def _is_shallow(content: Any) -> bool:
    """Return True if the nesting depth is at most MAX_DEPTH."""
    level = [content] if isinstance(content, list | dict) else []
    for _ in range(MAX_DEPTH):
        nodes = [node.values() if isinstance(node, dict) else node for node in level]
        level = [below for node in nodes for below in node if isinstance(below, list | dict)]
        if not level:
            return True
    return False


def _finite(content: Any) -> Any:
    """Return the content with None instead of NaN and infinity, and with valid Unicode, as JSON requires."""
    if isinstance(content, Mapping):
        return {_finite(key): _finite(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_finite(value) for value in content]
    if isinstance(content, str):
        return content.encode(errors="backslashreplace").decode()
    return None if isinstance(content, float) and not math.isfinite(content) else content

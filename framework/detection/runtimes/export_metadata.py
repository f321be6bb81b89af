"""What a network file says about itself, in the texts that Ultralytics' exports carry."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class ExportMetadata:
    """Of a file that says nothing, or says it otherwise, all is empty."""

    names: tuple[str, ...] = ()  # of the classes, in the order of the scores
    image_size: tuple[int, int] = (0, 0)  # (height, width) px that it was exported for, 0 = not said
    author: str = ""

    @classmethod
    def parse(cls, texts: Mapping[str, str]) -> ExportMetadata:
        """From the file's own pairs, whose values are Python's or JSON's literals."""
        return cls(_names(texts.get("names", "")), _size(texts.get("imgsz", "")), texts.get("author", ""))


def _names(text: str) -> tuple[str, ...]:
    """{0: "person", ...}, with numbers or numerals as keys."""
    names = _literal(text)
    if not isinstance(names, dict):
        return ()
    by_number = {int(key): str(name) for key, name in names.items() if str(key).isdecimal()}
    return tuple(by_number[k] for k in range(len(names))) if set(by_number) == set(range(len(names))) else ()


def _size(text: str) -> tuple[int, int]:
    """[height, width], or one number for both."""
    sides = _literal(text)
    height, width = sides if isinstance(sides, list) and len(sides) == 2 else (sides, sides)
    if isinstance(height, int) and isinstance(width, int) and height > 0 and width > 0:
        return height, width
    return 0, 0


def _literal(text: str) -> object:
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return None

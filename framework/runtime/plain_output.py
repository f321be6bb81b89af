"""Output of text from files without control characters.

Names in a run directory can contain escape sequences, which would change the terminal or hide text.
"""

from __future__ import annotations

import logging
import re
import sys
import unicodedata
from collections.abc import Iterable
from typing import Any, TextIO

# carriage return, cursor up, erasing and colors, which progress bars and formatters of log records write to stderr
_OF_PROGRESS = re.compile(r"(\r|\x1b\[(?:A|[0-2]?K|[0-9;]{0,16}m))")


def plain(text: str) -> str:
    r"""Return a text with control characters, invisible characters and invalid Unicode escaped, such as \x1b.

    Line breaks, tabs and spaces of any width are kept.
    """
    if text.isprintable():
        return text
    return "".join(c if _is_plain(c) else c.encode("unicode_escape").decode("ascii") for c in text)


def plain_line(text: str) -> str:
    """Return a text as `plain` does, on one line."""
    return plain(" ".join(text.split()))


def _is_plain(character: str) -> bool:
    return character.isprintable() or character in "\n\t" or unicodedata.category(character) == "Zs"


class PlainStream:
    """A text stream that escapes control characters."""

    def __init__(self, stream: TextIO, keeps_progress: bool = False) -> None:
        self._stream = stream
        self._keeps_progress = keeps_progress  # True if progress bars and colors are kept

    def write(self, text: str) -> int:
        parts = _OF_PROGRESS.split(text) if self._keeps_progress else [text]
        # split() puts the matches at odd positions
        self._stream.write("".join(part if k % 2 else plain(part) for k, part in enumerate(parts)))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class PlainRecord(logging.LogRecord):
    """A log record with an escaped message."""

    def getMessage(self) -> str:
        return plain(super().getMessage())


def escape_log_records() -> None:
    """Escape control characters in the messages of all later log records."""
    logging.setLogRecordFactory(PlainRecord)


def escape_streams() -> None:
    """Escape control characters that are written to stdout and stderr."""
    sys.stdout = PlainStream(sys.stdout)
    sys.stderr = PlainStream(sys.stderr, keeps_progress=True)

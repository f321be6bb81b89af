"""Exceptions for user-correctable errors.

Each message is one line with the file or key, the expected value, the found value, and the fix.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

LONGEST_WORD = 200  # maximum number of characters of an input, such as a name, in a message
LONGEST_MESSAGE = 1000  # maximum number of characters of a message; a list of all options or labels has about 500

_LONG_WORD = re.compile(rf"\S{{{LONGEST_WORD + 1},}}")


class InstanceMapError(Exception):
    """Base class of all known errors. The command line prints one line; `debug=true` adds the traceback.

    For any input, the message is printable and its length is limited.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(printable(message))


class ConfigError(InstanceMapError):
    """An unknown name, or an invalid value of a parameter."""


class DataError(InstanceMapError):
    """Unusable input: a missing, corrupt or inconsistent file, or an array of the wrong shape or type."""


class FrameError(DataError):
    """One unusable frame of a usable sequence. The pipeline counts it in `frames_skipped`."""


class NoPoseError(FrameError):
    """A frame without a required pose, such as in a gap of motion capture. The pipeline skips it."""


class MapFullError(InstanceMapError):
    """The map has reached its maximum number of blocks. The map up to this frame is kept."""


class PartialRunError(InstanceMapError):
    """An early end of a run with partial outputs. `__cause__` is the reason."""


def printable(message: object) -> str:
    """Return a message with unprintable characters escaped, and the middle of long words and texts omitted."""
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(message))
    return _shortened(_LONG_WORD.sub(lambda match: _shortened(match[0], LONGEST_WORD), text), LONGEST_MESSAGE)


def _shortened(text: str, most: int) -> str:
    if len(text) <= most:
        return text
    return f"{text[: most // 2]}...{text[len(text) - most // 4 :]} ({len(text)} characters)"


def in_one_line(message: object) -> str:
    """Return an error message of another library on one line, or the error class if the message is empty."""
    return " ".join(str(message).split()) or type(message).__name__


def first_line(error: BaseException) -> str:
    """Return the first line of an error message, or the error class if the line is empty."""
    return str(error).partition("\n")[0] or type(error).__name__


@contextmanager
def errors_of(where: object) -> Iterator[None]:
    """Prepend a file, or a position in a file, to the message of a DataError."""
    try:
        yield
    except DataError as error:
        raise DataError(f"{where}: {error}") from error


def import_optional(module: str, purpose: str, extra: str) -> Any:
    """Import a module of an optional package. Raises ConfigError that names the extra to install."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        name = module.partition(".")[0]
        raise ConfigError(
            f"{name}: expected an installed package (it {purpose}), got none; run pip install instancemap[{extra}]"
        ) from error

"""Exceptions for user-correctable errors. Each message is one line: expected, found, file or key, fix."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

LONGEST_WORD = 200  # characters of an input, such as a name, that a message repeats
LONGEST_MESSAGE = 1000  # characters; a list of all options or labels has about 500

_LONG_WORD = re.compile(rf"\S{{{LONGEST_WORD + 1},}}")


class InstanceMapError(Exception):
    """Base of every known error. The command line prints it as one line; `debug=true` adds the traceback.

    The message is printable and of limited length, whatever input it repeats.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(printable(message))


class ConfigError(InstanceMapError):
    """An unknown name, or an invalid value of a parameter."""


class DataError(InstanceMapError):
    """Unusable input: a missing, corrupt or inconsistent file, or an array of the wrong form."""


class FrameError(DataError):
    """One unusable frame of a usable sequence: the pipeline counts it in `frames_skipped`."""


class NoPoseError(FrameError):
    """A frame without a pose, as in gaps of motion capture: skipped, and reported at the end."""


class MapFullError(InstanceMapError):
    """The map has reached its block budget; what was mapped so far is kept."""


class PartialRunError(InstanceMapError):
    """A run that ended early and has written its outputs. `__cause__` is the reason."""


def printable(message: object) -> str:
    """Return a message with unprintable characters escaped, and the middle of long words and texts omitted."""
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(message))
    return _shortened(_LONG_WORD.sub(lambda match: _shortened(match[0], LONGEST_WORD), text), LONGEST_MESSAGE)


def _shortened(text: str, most: int) -> str:
    if len(text) <= most:
        return text
    return f"{text[: most // 2]}...{text[len(text) - most // 4 :]} ({len(text)} characters)"


def in_one_line(message: object) -> str:
    """Return the message of another library's error on one line; the error's class if it is empty."""
    return " ".join(str(message).split()) or type(message).__name__


def first_line(error: BaseException) -> str:
    """Return the first line of an error message."""
    return str(error).partition("\n")[0] or type(error).__name__


@contextmanager
def errors_of(where: object) -> Iterator[None]:
    """Prepend the file, or the position in it, to the message of a DataError."""
    try:
        yield
    except DataError as error:
        raise DataError(f"{where}: {error}") from error


def import_optional(module: str, purpose: str, extra: str) -> Any:
    """Import a module of an optional package. Raises ConfigError, naming the extra to install, without it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        name = module.partition(".")[0]
        raise ConfigError(
            f"{name}, which {purpose}: expected an installed package, got none; run pip install instancemap[{extra}]"
        ) from error

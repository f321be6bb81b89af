"""What can go wrong in a way that the user can mend. Each error is one line: expected, found, where, what to do."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

LONGEST_WORD = 200  # characters of what was given, such as a name, that a message repeats
LONGEST_MESSAGE = 1000  # characters; a list of all options or of many labels has some 500

_LONG_WORD = re.compile(rf"\S{{{LONGEST_WORD + 1},}}")


class InstanceMapError(Exception):
    """Base of every known error. `python -m framework` prints it as one line; `debug=true` adds the traceback.

    Its message is what can be printed, and no longer than a person reads, whatever a file or a name was made of.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(printable(message))


class ConfigError(InstanceMapError):
    """A configuration names something that does not exist or gives a parameter a value that it cannot have."""


class DataError(InstanceMapError):
    """Input that cannot be used: a file is missing, corrupt or inconsistent, or an array has the wrong form."""


class FrameError(DataError):
    """One frame cannot be used and the rest of its sequence can: the pipeline counts it in `frames_skipped`."""


class NoPoseError(FrameError):
    """No pose is given for this frame, which is normal where motion capture has gaps: skipped, and told in the end."""


class MapFullError(InstanceMapError):
    """The map has reached its block budget; what was mapped so far is kept."""


class PartialRunError(InstanceMapError):
    """A run ended early, and the record of what it had mapped is written. `__cause__` is what ended it."""


def printable(message: object) -> str:
    """A message with what cannot be printed as its code, such as \\n, and with the middle left out of what is long."""
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(message))
    return _shortened(_LONG_WORD.sub(lambda match: _shortened(match[0], LONGEST_WORD), text), LONGEST_MESSAGE)


def _shortened(text: str, most: int) -> str:
    return (
        text if len(text) <= most else f"{text[: most // 2]}...{text[len(text) - most // 4 :]} ({len(text)} characters)"
    )


def in_one_line(said: object) -> str:
    """What a library says of a fault, for a message of ours; the kind of the fault where it says nothing."""
    return " ".join(str(said).split()) or type(said).__name__


@contextmanager
def errors_of(where: object) -> Iterator[None]:
    """Put the file, or the place in it, before the message of a DataError that is raised within."""
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
        raise ConfigError(f"{name}, which {purpose}, is not there: pip install instancemap[{extra}]") from error

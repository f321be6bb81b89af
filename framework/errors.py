"""Exceptions for errors that the user can correct.

Each message is one line with the file or key, the expected value, the found value, and the fix.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

LONGEST_WORD = 200  # maximum number of characters of one word of a message, such as a name from the input
LONGEST_REASON = 200  # maximum number of characters of a library's message in ours
LONGEST_MESSAGE = 1000  # maximum number of characters of a message; a list of all options or labels has about 500

_LONG_WORD = re.compile(rf"\S{{{LONGEST_WORD + 1},}}")


class InstanceMapError(Exception):
    """Base class of all errors that the user can correct. Commands print the message on one line.

    The message is printable and has at most about 1000 characters. `debug=true` adds the traceback.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(printable(message))


class ConfigError(InstanceMapError):
    """An unknown name, or an invalid value of a parameter."""


class ParameterError(ConfigError):
    """A parameter of a plugin outside of its interval.

    Args:
        owner: Class of the plugin, or of a part of it.
        name: Name of the parameter.
        problem: Allowed and found values.
    """

    def __init__(self, owner: str, name: str, problem: str) -> None:
        super().__init__(f"{owner}.{name}: {problem}")
        self.owner, self.name, self.problem = owner, name, problem

    def __reduce__(self) -> tuple[type[ParameterError], tuple[str, str, str]]:
        """Return the arguments of the constructor, because processes exchange errors."""
        return type(self), (self.owner, self.name, self.problem)


class DataError(InstanceMapError):
    """Unusable input: a missing, corrupt or inconsistent file, or an array of the wrong shape or type."""


class StorageError(DataError):
    """Storage of a recording that is no longer available, such as an unplugged disk. It ends the recording."""


class FrameError(DataError):
    """An unusable frame of a usable sequence. The pipeline skips the frame and counts it in `frames_skipped`."""


class NoPoseError(FrameError):
    """A frame without a required pose. The pipeline skips the frame."""


class MapFullError(InstanceMapError):
    """The map needs more blocks than the maximum. The map of the earlier frames is kept."""


class PartialRunError(InstanceMapError):
    """A run that ended early and wrote partial outputs. `__cause__` is the error that ended it."""


def printable(message: object) -> str:
    """Return a message with unprintable characters escaped, and with long words and messages shortened."""
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(message))
    return _shortened(_LONG_WORD.sub(lambda match: _shortened(match[0], LONGEST_WORD), text), LONGEST_MESSAGE)


def _shortened(text: str, most: int) -> str:
    if len(text) <= most:
        return text
    return f"{text[: most // 2]}...{text[len(text) - most // 4 :]} ({len(text)} characters)"


def in_one_line(message: object) -> str:
    """Return the message of an exception on one line, or the name of its class if the message is empty."""
    return " ".join(str(message).split()) or type(message).__name__


def reason_of(error: BaseException) -> str:
    """Return the message of a library's exception on one line, shortened, because it can quote a damaged file."""
    return _shortened(in_one_line(error), LONGEST_REASON)


def first_line(error: BaseException) -> str:
    """Return the first line of the message of an exception, or the name of its class if the line is empty."""
    return str(error).partition("\n")[0] or type(error).__name__


@contextmanager
def errors_of(where: object) -> Iterator[None]:
    """Prepend a location to the message of a DataError in the `with` body.

    The location `where` is a key, a file or a position in a file.
    """
    try:
        yield
    except DataError as error:
        raise DataError(f"{where}: {error}") from error


def import_optional(module: str, purpose: str, extra: str) -> Any:
    """Import a module of an optional package, and return it.

    Args:
        module: Full name of the module.
        purpose: Verb phrase for the message, such as "reads ROS bags".
        extra: Extra of InstanceMap that installs the package.

    Raises:
        ConfigError: The package is not installed. The message contains the installation command.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        name = module.partition(".")[0]
        raise ConfigError(
            f"{name}: expected an installed package (it {purpose}), got none; run pip install 'instancemap[{extra}]'"
        ) from error

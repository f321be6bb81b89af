"""YAML files of limited size and depth.

A file is validated before loading, because a few lines of aliases can expand to gigabytes.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from framework.errors import DataError, in_one_line
from framework.files.atomic_write import read_text

LARGEST_FILE = 2**22  # bytes; the config of a run has 3 KB, the config of a sweep 20 KB
MAX_DEPTH = 50  # maximum depth of nested mappings and lists
TOO_DEEP = f"expected at most {MAX_DEPTH} nested mappings and lists, got deeper nesting"
MAX_VALUES = 200_000  # maximum number of keys and values after the expansion of aliases

_EventLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the compiled loader is ten times as fast


def load_yaml(path: Path) -> Any:
    """Load a YAML file as a DictConfig or ListConfig.

    Raises:
        DataError: The file is invalid or exceeds a limit.
    """
    text = read_text(path, LARGEST_FILE)
    with yaml_errors(path):
        check_yaml(path, text)
        try:
            return OmegaConf.create(text)
        except AssertionError as error:  # of OmegaConf, without a message
            raise DataError(f"{path}: expected keys and values, got a single value") from error


@contextmanager
def yaml_errors(path: Path) -> Iterator[None]:
    """Convert YAML errors within a context to DataError."""
    try:
        yield
    except (yaml.YAMLError, OmegaConfBaseException, ValueError, RecursionError, OverflowError) as error:
        raise DataError(f"{path}: expected valid YAML, got an error ({in_one_line(error)})") from error


def _events(where: object, text: str) -> Iterator[Any]:
    """Yield the parser events of a YAML text."""
    try:
        yield from yaml.parse(text, _EventLoader)
    except yaml.YAMLError as error:
        if "maximum nesting depth" in str(error):
            raise DataError(f"{where}: {TOO_DEEP}") from error
        raise


def check_yaml(where: object, text: str) -> None:
    """Check a YAML text without loading it.

    Raises:
        DataError: There are more than MAX_VALUES values or MAX_DEPTH levels, or an alias precedes its anchor.
        YAMLError: The text is not valid YAML.
    """
    counts = [0]  # number of values of each open mapping and list, outermost first
    open_anchors: list[Hashable] = []
    anchors: dict[Hashable, int] = {}
    for event in _events(where, text):
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in anchors:
                expected = f"expected a complete anchor &{event.anchor} before its alias"
                raise DataError(f"{where}: {expected}, got none")
            counts[-1] += anchors[event.anchor]
        elif isinstance(event, yaml.ScalarEvent):
            counts[-1] += 1
            anchors[event.anchor] = 1
        elif isinstance(event, yaml.CollectionStartEvent):
            counts.append(1)
            open_anchors.append(event.anchor)
        elif isinstance(event, yaml.CollectionEndEvent):
            count = counts.pop()
            counts[-1] += count
            anchors[open_anchors.pop()] = count
        if len(counts) > MAX_DEPTH:
            raise DataError(f"{where}: {TOO_DEEP}")
        if counts[-1] > MAX_VALUES:
            raise DataError(
                f"{where}: expected at most {MAX_VALUES} keys and values with aliases expanded, got {counts[-1]}"
            )

"""Classes and confidences of the instances in a map of another system."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from framework.errors import DataError
from framework.files.atomic_write import read_text
from framework.files.json_file import read_json
from framework.runs.external_maps.external_map import UNLABELED
from framework.vocabulary.label_spaces import SPACES, read_class_ids, whole_number

KEY = "label_space"
NYU40 = "nyu40"  # label space of ScanNet predictions
MAX_DIGITS = 10  # maximum number of digits of an id


@dataclass(frozen=True)
class ClassIdNames:
    """The names of class ids."""

    names: Mapping[int, str]  # by class id
    source: str  # for messages

    @classmethod
    def of(cls, label_space: str) -> ClassIdNames:
        """Return the names of a label space or file.

        NYU40, ScanNet20 and ScanNet200 have the ids of ScanNet's benchmarks. The ids of another label space or a text
        file start at 0. A JSON file contains an object with the name of each id, or a list of names from id 0.

        Raises:
            ConfigError: The label space or text file does not exist, or the file is invalid.
            DataError: The JSON file is invalid.
        """
        return cls(read_class_ids(label_space, KEY), label_space)

    @property
    def all(self) -> tuple[str, ...]:
        """The names of all class ids."""
        return tuple(self.names.values())

    def name(self, where: str, class_id: int) -> str:
        """Return the name of a class id. Ids below the first class mean UNLABELED.

        Raises:
            DataError: The id has no name.
        """
        if class_id in self.names:
            return self.names[class_id]
        if class_id < min(self.names):
            return UNLABELED
        raise DataError(
            f"{where}: expected a class id of {self.source} ({min(self.names)} to {max(self.names)}), got {class_id}; "
            f"set another {KEY}"
        )


@dataclass(frozen=True)
class InstanceLabel:
    """The class and the confidence of an instance."""

    name: str | None  # UNLABELED = no class; None = the file contains no classes
    confidence: float | None  # in [0, 1]; None = unknown


def read_entries(path: Path) -> list[tuple[str, dict[str, Any]]]:
    """Read the entries of a JSON or CSV file, one for each instance, with their positions for messages.

    A JSON file contains a list of objects, or an object with an object or a class name for each instance id.

    Raises:
        DataError: The file is missing or invalid.
    """
    if path.suffix.lower() == ".csv":
        try:
            rows = [*csv.DictReader(read_text(path).splitlines())]
        except csv.Error as error:
            raise DataError(f"{path}: expected valid CSV, got an error ({error})") from error
        return [(f"{path}, line {k}", {str(key): value for key, value in row.items()}) for k, row in enumerate(rows, 2)]
    content = read_json(path)
    if isinstance(content, list):
        entries = [(f"{path}, entry {k}", entry) for k, entry in enumerate(content, start=1)]
    elif isinstance(content, dict):
        entries = [
            (f"{path}: instance {key:.{MAX_DIGITS}}", {"id": key, **(one if isinstance(one, dict) else {"class": one})})
            for key, one in content.items()
        ]
    else:
        raise DataError(f"{path}: expected a JSON array or object of instances, got {content!r:.40}")
    for where, entry in entries:
        if not isinstance(entry, dict):
            raise DataError(f"{where}: expected a JSON object, got {entry!r:.40}")
    return entries


def label_of(where: str, entry: Mapping[str, Any], names: ClassIdNames | None) -> InstanceLabel:
    """Return the label in an entry with the keys `class` and `confidence`, which are optional.

    Args:
        where: The position of the entry, for messages.
        entry: The entry. The class is a name, an id, or null = UNLABELED.
        names: The names of the class ids; None = unknown.

    Raises:
        DataError: A value is invalid, or a class id has no name.
    """
    confidence = entry.get("confidence")
    return InstanceLabel(
        None if "class" not in entry else _class_name(where, entry["class"], names),
        None if confidence in (None, "") else checked_confidence(where, confidence),
    )


def read_labels_by_id(path: Path, names: ClassIdNames | None) -> dict[int, InstanceLabel]:
    """Read the label of each instance id from a JSON or CSV file.

    Raises:
        DataError: The file is missing or invalid.
    """
    found: dict[int, InstanceLabel] = {}
    for where, entry in read_entries(path):
        key = whole_number(entry.get("id"))
        if key is None:
            raise DataError(f"{where}: id: expected an integer, got {entry.get('id')!r:.40}")
        if key in found:
            raise DataError(f"{where}: id: expected unique ids, got {key} twice")
        found[key] = label_of(where, entry, names)
    return found


def checked_confidence(where: str, value: Any) -> float:
    """Return a confidence in [0, 1], given as a number or text.

    Raises:
        DataError: The value is invalid.
    """
    try:
        confidence = float("nan") if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        confidence = float("nan")
    if not 0 <= confidence <= 1:
        raise DataError(f"{where}: confidence: expected a number in [0, 1], got {value!r:.40}; rescale the confidences")
    return confidence


def class_of_id(where: str, class_id: int, names: ClassIdNames | None) -> str:
    """Return the name of a class id.

    Raises:
        DataError: The id has no name, or no names are known.
    """
    if names is None:
        spaces = ", ".join(SPACES)
        raise DataError(f"{where}: expected names of the class ids, got none; set {KEY} to {spaces}, or a file")
    return names.name(where, class_id)


def _class_name(where: str, value: Any, names: ClassIdNames | None) -> str:
    class_id = whole_number(value)
    if class_id is not None:
        return class_of_id(f"{where}: class", class_id, names)
    if value is None or value == "":
        return UNLABELED
    if not isinstance(value, str):
        raise DataError(f"{where}: class: expected a name, an id or null, got {value!r:.40}")
    return value

"""Edits of the instances of a map, and the file format for lists of edits.

A file with edits contains a JSON array. Each entry is an object with the name and the arguments of one edit:

    [{"merge": [3, 7]}, {"split": [5, "plane"]}, {"rename": [4, "chair"]}, {"delete": [9]}]

The JSON Schema of the format is edits.schema.json.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, cast

from framework.errors import DataError
from framework.files.json_file import read_json, write_json
from framework.mapping.storage.map_file import LARGEST_ID
from framework.vocabulary.label_spaces import check_class_name


class SplitBy(Enum):
    """Criterion for dividing an instance."""

    PARTS = "parts"  # one instance for each connected part of the mesh
    PLANE = "plane"  # one instance for the vertices on the dominant plane, one for the rest


@dataclass(frozen=True)
class Merge:
    """Merge instances into the first one."""

    ids: tuple[int, ...]  # at least two

    @property
    def entry(self) -> dict[str, list[int | str]]:
        """The edit as an entry of a file."""
        return {"merge": [*self.ids]}


@dataclass(frozen=True)
class Split:
    """Split an instance. The largest part keeps the id."""

    id: int
    by: SplitBy = SplitBy.PARTS

    @property
    def entry(self) -> dict[str, list[int | str]]:
        """The edit as an entry of a file."""
        return {"split": [self.id, self.by.value]}


@dataclass(frozen=True)
class Rename:
    """Set the class of an instance, with probability 1."""

    id: int
    class_name: str  # a class of the map, or a new class

    @property
    def entry(self) -> dict[str, list[int | str]]:
        """The edit as an entry of a file."""
        return {"rename": [self.id, self.class_name]}


@dataclass(frozen=True)
class Delete:
    """Change instances to background."""

    ids: tuple[int, ...]  # at least one

    @property
    def entry(self) -> dict[str, list[int | str]]:
        """The edit as an entry of a file."""
        return {"delete": [*self.ids]}


Edit = Merge | Split | Rename | Delete

FORMS = {
    "merge": "two or more instance ids",
    "split": "an instance id and optionally 'parts' or 'plane'",
    "rename": "an instance id and a class name",
    "delete": "one or more instance ids",
}
"""Arguments of each edit."""


def read_edits(path: Path) -> list[Edit]:
    """Read the edits in a JSON file.

    Raises:
        DataError: The file is missing or invalid.
    """
    content = read_json(path)
    if not isinstance(content, list):
        raise DataError(f"{path}: expected a JSON array of edits, got {content!r:.60}")
    return edits_of(str(path), content)


def write_edits(path: Path, edits: Sequence[Edit]) -> None:
    """Write edits to a JSON file."""
    write_json(path, [edit.entry for edit in edits])


def edits_of(name: str, entries: Sequence[Any]) -> list[Edit]:
    """Return the edits for the entries of a file.

    Args:
        name: The name of the file, for error messages.
        entries: The entries.

    Raises:
        DataError: An entry is invalid, or `entries` is not a sequence.
    """
    if not isinstance(cast(object, entries), Sequence):
        raise DataError(f"{name}: expected a list of edits, got {type(entries).__name__}")
    edits = []
    for number, entry in enumerate(entries, start=1):
        if not isinstance(entry, dict) or len(entry) != 1 or not entry.keys() <= FORMS.keys():
            raise DataError(
                f"{name}, entry {number}: expected a JSON object with one of the keys {', '.join(FORMS)}, got "
                f"{entry!r:.60}"
            )
        [(operation, values)] = entry.items()
        edits.append(edit_of(f"{name}, entry {number}: {operation}", operation, values))
    return edits


def edit_of(where: str, operation: str, values: object) -> Edit:
    """Return the edit with an operation and its arguments.

    Args:
        where: The location of the edit, for error messages.
        operation: A key of FORMS.
        values: The list of arguments.

    Raises:
        DataError: The arguments are invalid.
    """
    error = DataError(f"{where}: expected {FORMS[operation]}, got {values!r:.60}")
    if not isinstance(values, list) or not values or not all(isinstance(value, int | str) for value in values):
        raise error
    with_text = operation in ("split", "rename")
    ids = values[:1] if with_text else values
    for one in ids:
        if isinstance(one, bool) or not isinstance(one, int) or not 1 <= one <= LARGEST_ID:
            raise DataError(f"{where}: expected instance ids in [1, {LARGEST_ID}], got {one!r:.60}")
    if len(set(ids)) < len(ids):
        raise DataError(f"{where}: expected different instance ids, got {values!r:.60}")
    match operation, values[len(ids) :]:
        case "merge", _ if len(ids) > 1:
            return Merge(tuple(ids))
        case "delete", _:
            return Delete(tuple(ids))
        case "split", []:
            return Split(ids[0])
        case "split", ["parts" | "plane" as by]:
            return Split(ids[0], SplitBy(by))
        case "rename", [str(class_name)]:
            check_class_name(where, class_name)
            return Rename(ids[0], class_name)
    raise error

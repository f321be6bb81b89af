"""ScanNet's instances: a mesh cut into segments, objects made of segments, and what the objects' names mean."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Int64
from framework.datasets.calibration.camera_json import read_json_object
from framework.datasets.ground_truth.labeled_mesh import LabeledMesh
from framework.errors import DataError
from framework.files.atomic_write import read_text
from framework.files.ply import read_ply
from framework.vocabulary.label_spaces import MEANINGS

LARGEST_FILE = 2**24  # bytes; the largest room's segments take 5 MB, and JSON takes up to 30 times as much memory
MOST_OBJECT_ID = np.iinfo(np.int32).max - 2  # one is added, and one more id is given to what nobody labelled
LABEL_TABLE = "scannetv2-labels.combined.tsv"
FIRST_LABEL_TABLE = "scannet-labels.combined.tsv"  # of the first release, 2017, whose annotators wrote other names
WRITTEN = (
    "raw_category",
    "category",
)  # columns of what annotators wrote; the first release's table has no raw_category
CLASS = "nyu40class"
UNTOLD = frozenset(  # names under which annotators and NYU40 put what has no class of its own: it may be anything
    {"object", "objects", "unknown", "junk", "furniture", "decoration"}
    | {"otherprop", "otherfurniture", "otherstructure"}
)

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SegGroup:
    """An object."""

    object_id: int  # from 0
    label: str  # what the annotator wrote
    segments: Int64  # (S,) of the mesh


def read_labeled_mesh(mesh: Path, segs: Path, aggregation: Path, nyu40: Mapping[str, str]) -> LabeledMesh:
    """The mesh with its objects as instances, object k being instance k + 1; where objects overlap, the later has it.

    Objects whose name means a class of COCO have its name. Objects of other classes that are known (wall, cabinet,
    ...) are instance 0: whoever finds one of COCO's there is wrong. Objects whose name says no class are instances of
    class None, and so is, as one more instance, all that nobody labelled: whatever is found there is neither right nor
    wrong, as in ScanNet's own benchmark. `nyu40` is what `read_label_table` gives, empty = there is no table. Names are
    the same where only spaces and signs differ: the first release has a trashcan, the second one a trash can.

    Raises DataError, naming the file, when one cannot be read or they do not belong together, and, listing them, when
    names are in no table.
    """
    ply = read_ply(mesh)
    segments = _whole_numbers(f"{segs}: segIndices", _read_list(segs, "segIndices"))
    if len(segments) != len(ply.vertices):
        raise DataError(f"{segs} has {len(segments)} segIndices, but {mesh.name} {len(ply.vertices)} vertices")
    present, segment_of_vertex = np.unique(segments, return_inverse=True)
    groups = read_aggregation(aggregation)
    spelling = Spelling.of(nyu40)
    if nyu40:
        _check_names(aggregation, groups, spelling)
    unlabeled = max((group.object_id + 2 for group in groups), default=1)
    instance_of_segment = np.full(len(present), unlabeled, np.int32)
    class_names: dict[int, str | None] = {}
    unknown: set[str] = set()
    for group in groups:
        instance = group.object_id + 1
        name = _known_name(spelling(group.label), nyu40)
        if not name:
            unknown.add(group.label)
            class_names[instance] = None
        elif MEANINGS[name] is None:
            instance = 0
        else:
            class_names[instance] = MEANINGS[name]
        instance_of_segment[_positions(aggregation, group, present)] = instance
    if unlabeled in instance_of_segment:
        class_names[unlabeled] = None
    if unknown:
        log.info("%s: not evaluated, as their class is not known: %s", mesh.parent.name, ", ".join(sorted(unknown)))
    return LabeledMesh(ply.vertices, ply.triangles, instance_of_segment[segment_of_vertex], class_names)


def read_aggregation(path: Path) -> tuple[SegGroup, ...]:
    """The objects of a scene, in the file's order. Raises DataError, naming the file and the object."""
    groups = _read_list(path, "segGroups")
    found = tuple(_group(f"{path}: segGroups[{k}]", group) for k, group in enumerate(groups))
    labels: dict[int, str] = {}
    for group in found:  # scene0217_00 has all of its objects twice
        if labels.setdefault(group.object_id, group.label) != group.label:
            raise DataError(
                f"{path}: object {group.object_id} is {labels[group.object_id]!r:.60} and {group.label!r:.60}"
            )
    return found


def read_label_table(path: Path) -> Mapping[str, str]:
    """What an annotator may have written -> its class among NYU40's, "" = none; of the table of either release.

    Raises DataError, naming file and line.
    """
    header, *rows = read_text(path, LARGEST_FILE).rstrip("\r\n").split("\n")
    columns = header.rstrip("\r").split("\t")
    written = next((name for name in WRITTEN if name in columns), "")
    if not written or CLASS not in columns:
        raise DataError(f"{path}, line 1: expected columns {' or '.join(WRITTEN)} and {CLASS}, separated by tabs")
    raw, nyu40 = columns.index(written), columns.index(CLASS)
    table: dict[str, str] = {}
    for n, row in enumerate(rows, start=2):
        words = row.rstrip("\r").split("\t")
        if len(words) <= max(raw, nyu40):
            raise DataError(f"{path}, line {n}: expected {len(columns)} columns, found {len(words)}")
        table[_spelled(words[raw])] = _spelled(words[nyu40])
    return table


@dataclass(frozen=True)
class Spelling:
    """How names are spelled where their meaning stands."""

    names: frozenset[str]  # that mean something
    by_letters: Mapping[str, str]  # their letters and digits alone -> the name

    @classmethod
    def of(cls, nyu40: Mapping[str, str]) -> Spelling:
        """Of MEANINGS, UNTOLD and a label table."""
        names = {**nyu40, **MEANINGS, **dict.fromkeys(UNTOLD)}
        return cls(frozenset(names), {_letters(name): name for name in names})

    def __call__(self, label: str) -> str:
        """The name that an annotator meant; what was written where no name is like it."""
        own = _spelled(label)
        return own if own in self.names else self.by_letters.get(_letters(own), own)


def _letters(name: str) -> str:
    return re.sub(r"[\W_]", "", name)


def _check_names(path: Path, groups: Sequence[SegGroup], spelling: Spelling) -> None:
    """Raises DataError, listing them, where annotators wrote what no table has."""
    unknown = sorted({group.label for group in groups if spelling(group.label) not in spelling.names})
    if unknown:
        raise DataError(
            f"{path}: {', '.join(f'{label!r:.60}' for label in unknown)}: in no label table; add a line to"
            f" {LABEL_TABLE}, or put {FIRST_LABEL_TABLE} beside it, which has the names of ScanNet's first release"
        )


def _known_name(own: str, nyu40: Mapping[str, str]) -> str:
    """The name by which MEANINGS knows what an annotator wrote; "" when that says no class.

    Its own name goes before NYU40's, which has one class for microwaves, keyboards and bottles.
    """
    names = (own, nyu40.get(own, ""))
    return next((name for name in names if name in MEANINGS and name not in UNTOLD), "")


def _spelled(label: str) -> str:
    return label.strip().lower()


def _positions(path: Path, group: SegGroup, present: Int64) -> Int64:
    """Where the object's segments are in the sorted ids (S,) of all that the mesh has."""
    absent = group.segments[~np.isin(group.segments, present)]
    if len(absent):
        raise DataError(f"{path}: object {group.object_id} has segment {absent[0]}, which no vertex is in")
    return np.searchsorted(present, group.segments)


def _group(where: str, group: Any) -> SegGroup:
    if not isinstance(group, dict):
        raise DataError(f"{where} must be an object, found {type(group).__name__}")
    object_id, label, segments = (group.get(key) for key in ("objectId", "label", "segments"))
    if type(object_id) is not int or not 0 <= object_id <= MOST_OBJECT_ID:
        raise DataError(f"{where}: objectId must be a whole number from 0 to {MOST_OBJECT_ID}")
    if not isinstance(label, str) or not isinstance(segments, list):
        raise DataError(f"{where}: expected a label and a list of segments")
    return SegGroup(object_id, label, _whole_numbers(f"{where}: segments", segments))


def _read_list(path: Path, key: str) -> Sequence[Any]:
    found = read_json_object(path, LARGEST_FILE).get(key)
    if not isinstance(found, list):
        raise DataError(f"{path}: expected a list {key!r}, found {type(found).__name__}")
    return found


def _whole_numbers(where: str, values: Sequence[Any]) -> Int64:
    wrong = [value for value in values if type(value) is not int]
    if wrong:
        raise DataError(f"{where}: expected whole numbers, found {type(wrong[0]).__name__}")
    return np.array(values, np.int64)

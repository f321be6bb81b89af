"""Reader of ScanNet annotations."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import AnnotatedObjects, Int64
from framework.datasets.calibration.camera_json import read_json_object
from framework.datasets.ground_truth.labeled_mesh import LabeledMesh
from framework.errors import DataError
from framework.files.atomic_write import read_text
from framework.files.number_lines import SHOWN
from framework.files.ply import read_ply
from framework.vocabulary.label_spaces import MEANINGS, SPACES

LARGEST_FILE = 2**24  # bytes; segments of the largest room take 5 MB; parsed JSON takes up to 30 times the memory
MAX_OBJECT_ID = np.iinfo(np.int32).max - 2  # instance id = object id + 1; one more id is used for unlabeled vertices
LABEL_TABLE = "scannetv2-labels.combined.tsv"
FIRST_LABEL_TABLE = "scannet-labels.combined.tsv"  # of the first release (2017), with other names
NAME_COLUMNS = ("raw_category", "category")  # annotated names; the first release has no raw_category
CLASS_COLUMN = "nyu40class"
ID_COLUMN = "id"
UNNAMED = frozenset(  # names that do not identify a class
    {"object", "objects", "unknown", "junk", "furniture", "decoration"}
    | {"otherprop", "otherfurniture", "otherstructure"}
)

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SegGroup:
    """An annotated object."""

    object_id: int  # from 0
    label: str  # name as written by the annotator
    segments: Int64  # (S,) ids of mesh segments


def read_labeled_mesh(
    mesh: Path,
    segs: Path,
    aggregation: Path,
    nyu40: Mapping[str, str],
    scannet200: Mapping[str, str] | None = None,
) -> LabeledMesh:
    """Read the mesh and its annotated objects.

    The instance id of an object is its object id + 1. If objects overlap, the later object takes precedence. Objects of
    a COCO class have the name of this class. Objects of other known classes, such as wall or cabinet, become instance
    0, so that detections there are false positives. Objects of unknown classes have the class None. Unlabeled vertices
    form one more instance of class None, so that detections there are not evaluated, as in the ScanNet benchmark.
    `LabeledMesh.annotated` contains all objects.

    Args:
        mesh: The mesh, a PLY file.
        segs: The JSON file with the segment of each vertex.
        aggregation: The JSON file with the segments of each object.
        nyu40: The NYU40 class of each name from `read_label_table`; empty = no table. Spaces and punctuation in names
            are ignored.
        scannet200: The ScanNet200 class of each name from `read_scannet200_names`; None = unknown.

    Raises:
        DataError: A file is invalid, the files are inconsistent, or a name is not in the table.
    """
    ply = read_ply(mesh)
    segments = _whole_numbers(f"{segs}: segIndices", _read_list(segs, "segIndices"))
    if len(segments) != len(ply.vertices):
        expected = f"expected {len(ply.vertices)} ids, one for each vertex of {mesh.name}"
        raise DataError(f"{segs}: segIndices: {expected}, got {len(segments)}")
    present, segment_of_vertex = np.unique(segments, return_inverse=True)
    groups = read_aggregation(aggregation)
    spellings = _spellings(nyu40)
    strange = sorted({group.label for group in groups if _spelled(group.label, spellings) not in spellings})
    if nyu40 and strange:
        raise DataError(
            f"{aggregation}: expected labels from {LABEL_TABLE}, got "
            f"{', '.join(f'{label!r:.60}' for label in strange)}; add a line for each of them, or put "
            f"{FIRST_LABEL_TABLE} next to this table for annotations of ScanNet's first release"
        )
    unlabeled = max((group.object_id + 2 for group in groups), default=1)
    instance_of_segment, object_of_segment = np.full((2, len(present)), unlabeled, np.int32)
    class_names: dict[int, str | None] = {}
    own_names: dict[int, str | None] = {}
    unknown: set[str] = set()
    for group in groups:
        absent = group.segments[~np.isin(group.segments, present)]
        if len(absent):
            expected = f"expected segments of {segs.name}"
            raise DataError(f"{aggregation}: object {group.object_id}: {expected}, got segment {absent[0]}")
        instance = group.object_id + 1
        own = own_names[instance] = _spelled(group.label, spellings)
        # the annotated name is preferred: NYU40 has a single class for microwaves, keyboards and bottles
        names = [name for name in (own, nyu40.get(own, "")) if name in MEANINGS and name not in UNNAMED]
        if not names:
            unknown.add(group.label)
            class_names[instance] = None
        elif MEANINGS[names[0]] is None:
            instance = 0
        else:
            class_names[instance] = MEANINGS[names[0]]
        places = np.searchsorted(present, group.segments)
        instance_of_segment[places], object_of_segment[places] = instance, group.object_id + 1
    if unlabeled in instance_of_segment:
        class_names[unlabeled] = own_names[unlabeled] = None
    if unknown:
        log.info("%s: objects of unknown class are not evaluated: %s", mesh.parent.name, ", ".join(sorted(unknown)))
    annotated = AnnotatedObjects(
        object_of_segment[segment_of_vertex],
        own_names,
        _names_in_spaces(own_names, nyu40, scannet200 or {}),
    )
    return LabeledMesh(
        ply.vertices, ply.triangles, instance_of_segment[segment_of_vertex], class_names, annotated=annotated
    )


def _names_in_spaces(
    own_names: Mapping[int, str | None], nyu40: Mapping[str, str], scannet200: Mapping[str, str]
) -> Mapping[str, Mapping[int, str]]:
    """Return the names of objects by label space and instance id. Label spaces without a table are missing."""
    found = {
        space: {key: table[name] for key, name in own_names.items() if name is not None and table.get(name)}
        for space, table in (("nyu40", nyu40), ("scannet200", scannet200))
        if table
    }
    # ScanNet20 is a part of NYU40. Class-agnostic evaluation requires only the walls and floors.
    return found | {space: found["nyu40"] for space in ("scannet20", "agnostic") if "nyu40" in found}


def read_aggregation(path: Path) -> tuple[SegGroup, ...]:
    """Read the annotated objects of a scene.

    Raises:
        DataError: The file is invalid, or an object has two labels.
    """
    groups = _read_list(path, "segGroups")
    found = tuple(_group(f"{path}: segGroups[{k}]", group) for k, group in enumerate(groups))
    labels: dict[int, str] = {}
    for group in found:  # scene0217_00 contains every object twice
        before = labels.setdefault(group.object_id, group.label)
        if before != group.label:
            expected = f"object {group.object_id}: expected one label"
            raise DataError(f"{path}: {expected}, got {before!r:.60} and {group.label!r:.60}")
    return found


def read_label_table(path: Path) -> Mapping[str, str]:
    """Read the NYU40 class of each object name in a label table.

    Names and classes are in lower case. An empty string means no class.

    Raises:
        DataError: A column is missing, or a line is too short.
    """
    return {row[0]: row[1] for row in _read_columns(path, ())}


def read_scannet200_names(path: Path) -> Mapping[str, str]:
    """Return the ScanNet200 class of each object name in a label table.

    As in ScanNet200, names with the id of a class belong to this class. In a table without ids, only names that equal a
    class are included.

    Raises:
        DataError: A column is missing, or a line is too short.
    """
    classes = frozenset(SPACES["scannet200"])
    rows = _read_columns(path, (ID_COLUMN,))
    class_of_id = {row[2]: row[0] for row in rows if row[0] in classes and row[2]}
    found = {row[0]: row[0] if row[0] in classes else class_of_id.get(row[2]) for row in rows}
    return {name: one for name, one in found.items() if one is not None}


def _read_columns(path: Path, optional: Sequence[str]) -> list[tuple[str, ...]]:
    """Read the name and the NYU40 class in each row of a label table, in lower case, and the optional columns.

    The values of missing optional columns are empty strings.
    """
    header, *rows = read_text(path, LARGEST_FILE).rstrip("\r\n").split("\n")
    columns = header.rstrip("\r").split("\t")
    written = next((name for name in NAME_COLUMNS if name in columns), "")
    if not written or CLASS_COLUMN not in columns:
        expected = f"expected columns {' or '.join(NAME_COLUMNS)} and {CLASS_COLUMN}, separated by tabs"
        raise DataError(f"{path}, line 1: {expected}, got {header[:SHOWN]!r}")
    places = [columns.index(name) if name in columns else None for name in (written, CLASS_COLUMN, *optional)]
    least = max(place for place in places if place is not None)
    table = []
    for n, row in enumerate(rows, start=2):
        words = row.rstrip("\r").split("\t")
        if len(words) <= least:
            raise DataError(f"{path}, line {n}: expected {len(columns)} columns, got {len(words)}")
        table.append(tuple("" if place is None else words[place].strip().lower() for place in places))
    return table


def _spellings(nyu40: Mapping[str, str]) -> dict[str, str]:
    """Return the known names by spelling: as written, and reduced to letters and digits."""
    names = {**nyu40, **MEANINGS, **dict.fromkeys(UNNAMED)}
    return {_letters(name): name for name in names} | {name: name for name in names}


def _spelled(label: str, spellings: Mapping[str, str]) -> str:
    """Return the known name of a label, or the label itself if it is unknown."""
    own = label.strip().lower()
    return spellings.get(own) or spellings.get(_letters(own), own)


def _letters(name: str) -> str:
    return re.sub(r"[\W_]", "", name)


def _group(where: str, group: Any) -> SegGroup:
    if not isinstance(group, dict):
        raise DataError(f"{where}: expected a JSON object, got {type(group).__name__}")
    object_id, label, segments = (group.get(key) for key in ("objectId", "label", "segments"))
    if type(object_id) is not int or not 0 <= object_id <= MAX_OBJECT_ID:
        raise DataError(f"{where}: objectId: expected an integer from 0 to {MAX_OBJECT_ID}, got {object_id!r:.60}")
    if not isinstance(label, str) or not isinstance(segments, list):
        found = f"{type(label).__name__} and {type(segments).__name__}"
        raise DataError(f"{where}: expected a label (text) and segments (list), got {found}")
    return SegGroup(object_id, label, _whole_numbers(f"{where}: segments", segments))


def _read_list(path: Path, key: str) -> Sequence[Any]:
    found = read_json_object(path, LARGEST_FILE).get(key)
    if not isinstance(found, list):
        raise DataError(f"{path}: expected a list {key!r}, got {'none' if found is None else type(found).__name__}")
    return found


def _whole_numbers(where: str, values: Sequence[Any]) -> Int64:
    wrong = [value for value in values if type(value) is not int]
    if wrong:
        raise DataError(f"{where}: expected integers, got {wrong[0]!r:.60}")
    return np.array(values, np.int64)

"""Label spaces, and the class names of detectors.

By default, datasets and detectors use COCO names. `label_spaces.yaml` maps the names of other label spaces to COCO
names. A detector with classes outside of these label spaces keeps its own names.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from enum import Enum
from pathlib import Path

import numpy as np
import yaml

from framework.data import Bool, Float32, Int32
from framework.errors import ConfigError, DataError
from framework.files.atomic_write import read_text
from framework.files.json_file import read_json
from framework.files.search_paths import expanded

MAX_DIGITS = 10  # maximum number of digits of a class id
LARGEST_FILE = 2**20  # bytes, maximum size of a list of labels
LONGEST_CLASS_NAME = 100  # characters
_OTHER_NAMES = "other_names"  # section for spellings outside of all spaces

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the compiled loader is ten times as fast, but optional
_SECTIONS: dict[str, dict[str, str | None]] = yaml.load(Path(__file__).with_suffix(".yaml").read_text("utf-8"), _LOADER)
"""COCO name by section and name; None = no object class of COCO."""

SPACES: Mapping[str, tuple[str, ...]] = {k: tuple(names) for k, names in _SECTIONS.items() if k != _OTHER_NAMES}
"""Names of each label space, in the label order of detectors trained on the space."""

COCO = SPACES["coco"]  # 80 classes
AGNOSTIC = "agnostic"  # label space with the single class OBJECT
OBJECT = "object"
OWN_CLASSES = "own classes"  # classes outside of all label spaces
NO_CLASS = "n/a"  # name of an unused id, in any space
_UNUSED_NAMES = ("n/a", "???", "background", "__background__")  # of networks' label files, any case
_UNUSED_IDS = (0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83)  # planned classes without annotations
_COCO_IDS = [k for k in range(91) if k not in _UNUSED_IDS]
COCO_BY_ID = tuple(COCO[_COCO_IDS.index(k)] if k in _COCO_IDS else NO_CLASS for k in range(91))
"""COCO classes by id in the annotation files, 0 to 90, as in DETR and RF-DETR; unused ids are NO_CLASS."""

SCENENN_TO_COCO = {name: coco for name, coco in _SECTIONS["scenenn"].items() if coco is not None}
"""Nine SceneNN classes with their COCO names. This choice is ours, because the paper does not list its nine classes."""

_SCANNET200_IDS = (
    "1-11 13-19 21-24 26-29 31-36 38-42 44-52 54-59 62-80 82 84 86-90 93 95-107 110 112 115-116 118 120-122 125 128 "
    "130-132 134 136 138-141 145 148 154-157 159 161 163 165-166 168-170 177 180 185 188 191 193 195 202 208 213-214 "
    "221 229-230 232-233 242 250 261 264 276 283 286 300 304 312 323 325 331 342 356 370 392 395 399 408 417 488 540 "
    "562 570 572 581 609 748 776 1156 1163-1176 1178-1191"
)
_RANGES = [[int(end) for end in part.split("-")] for part in _SCANNET200_IDS.split()]
BENCHMARK_IDS: Mapping[str, tuple[int, ...]] = {
    "nyu40": tuple(range(1, 41)),
    "scannet20": tuple(SPACES["nyu40"].index(name) + 1 for name in SPACES["scannet20"]),
    "scannet200": tuple(k for ends in _RANGES for k in range(ends[0], ends[-1] + 1)),
}
"""Class ids of label spaces in the files of ScanNet's benchmarks. In other label spaces, ids are indices."""

MEANINGS: Mapping[str, str | None] = {name: coco for names in _SECTIONS.values() for name, coco in names.items()}
"""COCO names by lower-case name in any space; None = no object class of COCO."""

_NUMBERED = re.compile(r"\d+[\s:,]+\S")

log = logging.getLogger(__name__)


class ClassNames(Enum):
    """Class names of a detector."""

    AUTO = "COCO names for the names of known label spaces, otherwise the names of the label space"
    COCO = "COCO names; classes without a COCO name are removed"
    OWN = "the names of the label space"


@dataclass(frozen=True)
class LabelMapping:
    """Mapping from the C labels of a detector to C' class names."""

    classes: tuple[str, ...]  # (C',) distinct class names
    meaning: Int32  # (C,) index of each label in `classes`; -1 = none

    def apply(self, probabilities: Float32) -> tuple[Float32, Bool]:
        """Convert label probabilities to distributions over the class names.

        Probabilities of labels with the same class name are added. Labels without a class name are removed, and the
        result is normalized.

        Args:
            probabilities: The probabilities or nonnegative weights (N, C) of the labels.

        Returns:
            The distributions (N, C') over `classes`, and an array (N,) that is True if the best label has a class name.
            A row without class names is a uniform distribution.
        """
        has_meaning = self.meaning >= 0
        sums = np.zeros((len(probabilities), len(self.classes)))
        np.add.at(sums.T, self.meaning[has_meaning], probabilities.T[has_meaning])
        totals = sums.sum(axis=1, keepdims=True)
        rows = np.divide(sums, totals, out=np.full_like(sums, 1 / len(self.classes)), where=totals > 0)
        known = has_meaning[probabilities.argmax(axis=1)] & (totals[:, 0] > 0)
        return rows.astype(np.float32), known


def read_labels(name_or_path: str, key: str = "detector.label_space") -> tuple[str, ...]:
    """Return the names of a label space, or the lines of a text file with one name per line.

    Args:
        name_or_path: The name of a label space, such as "coco" or "nyu40", or the path of a text file.
        key: The config key or option, for messages.

    Raises:
        ConfigError: The label space or file does not exist, or the file is invalid.
    """
    if name_or_path in SPACES:
        return SPACES[name_or_path]
    if name_or_path == AGNOSTIC:
        return (OBJECT,)
    path = expanded(Path(name_or_path))
    if path.suffix.lower() in (".yaml", ".yml", ".json", ".pbtxt", ".csv"):
        raise ConfigError(
            f"{key}: expected a text file with one name per line, got {path}; write its names to a text file"
        )
    try:
        lines = read_text(path, LARGEST_FILE).rstrip().splitlines()
    except DataError as error:
        raise ConfigError(
            f"{key}: expected one of {', '.join([*SPACES, AGNOSTIC])}, or a text file with one name per line, got "
            f"{name_or_path}"
        ) from error
    names = tuple(line.strip() for line in lines)
    if "" in names:  # skipping an empty line would shift the following names
        raise ConfigError(
            f"{key}: {path}, line {names.index('') + 1}: expected a name, got an empty line; write "
            f"{NO_CLASS} for an unused index"
        )
    if not names:
        raise ConfigError(f"{key}: {path}: expected one name per line, got an empty file")
    if all(map(_NUMBERED.match, names)):
        raise ConfigError(
            f"{key}: {path}: expected names only, got numbers as well, such as {names[0]!r:.40}; remove the numbers, "
            f"and write {NO_CLASS} for an unused number"
        )
    return tuple(NO_CLASS if name.lower() in _UNUSED_NAMES else name for name in names)


def read_class_ids(name_or_path: str, key: str) -> dict[int, str]:
    """Return the name of each class id in a label space or file.

    NYU40, ScanNet20 and ScanNet200 have the ids of ScanNet's benchmarks. The ids of another label space or a text file
    start at 0. A JSON file contains an object with the name of each id, or a list of names from id 0.

    Args:
        name_or_path: The name of a label space, or the path of a text or JSON file.
        key: The config key or option, for messages.

    Raises:
        ConfigError: The label space or text file does not exist, or the file is invalid.
        DataError: The JSON file is invalid.
    """
    if Path(name_or_path).suffix.lower() != ".json":
        labels = read_labels(name_or_path, key)
        return dict(zip(BENCHMARK_IDS.get(name_or_path, range(len(labels))), labels, strict=True))
    path = expanded(Path(name_or_path))
    content = read_json(path)
    if isinstance(content, list):
        content = {str(k): name for k, name in enumerate(content)}
    if not isinstance(content, dict) or not content:
        raise DataError(f"{path}: expected a JSON object or array of names, got {content!r:.40}")
    found = {}
    for text, name in content.items():
        class_id = whole_number(text)
        if class_id is None or not isinstance(name, str) or not name:
            raise DataError(f"{path}: expected a name for each class id, got {text!r:.40}: {name!r:.40}")
        found[class_id] = name
    return found


def whole_number(value: object) -> int | None:
    """Return an integer that is given as a number or text, or None for another value."""
    if isinstance(value, str):
        digits = value.strip().removeprefix("-")
        return int(value) if digits.isascii() and digits.isdigit() and len(digits) <= MAX_DIGITS else None
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def to_class_names(labels: Sequence[str], class_names: ClassNames, key: str = "detector.label_space") -> LabelMapping:
    """Map the labels of a detector to class names.

    Args:
        labels: The labels.
        class_names: The kind of class names.
        key: The config key of the labels, for messages.

    Raises:
        ConfigError: No label is an object class, or the class names are COCO and a label is unknown.
    """
    if not keeps_names(labels, class_names):
        return to_coco(labels, key)
    if class_names is ClassNames.AUTO and (reason := reason_for_names(labels)):
        log.info("%s: %s", key, reason)
    names = [label.strip() for label in labels]
    classes = tuple(dict.fromkeys(name for name in names if name.lower() != NO_CLASS))
    if not classes:
        raise ConfigError(f"{key}: expected at least one class, got none in {len(labels)} labels")
    index = {name: k for k, name in enumerate(classes)}
    return LabelMapping(classes, np.array([index.get(name, -1) for name in names], np.int32))


def label_space_of(classes: Sequence[str]) -> str:
    """Return the name of the label space of a map.

    It is the first label space that contains all classes, or OWN_CLASSES for classes of no label space. It is AGNOSTIC
    for the single class OBJECT, and "none" for a map without classes.
    """
    if not classes:
        return "none"
    if tuple(classes) == (OBJECT,):
        return AGNOSTIC
    return next((space for space, names in SPACES.items() if set(classes) <= set(names)), OWN_CLASSES)


def keeps_names(labels: Sequence[str], class_names: ClassNames) -> bool:
    """Return True if classes have the names of their label space, False if they have COCO names."""
    if class_names is ClassNames.AUTO:
        return bool(_unknown(labels)) or not any(map(coco_name, labels))
    return class_names is ClassNames.OWN


def reason_for_names(labels: Sequence[str]) -> str:
    """Return the reason why AUTO keeps the names of labels, "" if all are in known label spaces."""
    unknown = _unknown(labels)
    if not unknown:
        return ""
    listed = ", ".join(map(with_similar, dict.fromkeys(unknown)))
    return f"all names are kept, because {len(unknown)} of {len(labels)} are in no known label space: {listed}"


def check_class_name(where: str, name: str) -> None:
    """Raise DataError unless a class name is valid in all outputs.

    Args:
        where: The location of the name, for messages.
        name: The name.
    """
    if name != name.strip() or not 0 < len(name) <= LONGEST_CLASS_NAME or not name.isprintable():
        raise DataError(
            f"{where}: expected a class name of 1 to {LONGEST_CLASS_NAME} characters without outer spaces and control "
            f"characters, got {name!r:.120}"
        )


def with_similar(name: str, others: Sequence[str] = ()) -> str:
    """Return a quoted name, followed by a similar name among others and all known names, if any is similar."""
    close = get_close_matches(label_key(name), [*others, *MEANINGS], n=1, cutoff=0.75)
    return f"{name!r} (similar to {close[0]!r})" if close and close[0] != name else repr(name)


def label_key(label: str) -> str:
    """Return a label without case, outer spaces and synonyms after a comma."""
    return label.partition(",")[0].strip().lower()


def coco_name(label: str) -> str | None:
    """Return the COCO name of a label in any known label space, or None without one."""
    return MEANINGS.get(label_key(label))


def _unknown(labels: Sequence[str]) -> list[str]:
    return [label for label in labels if label_key(label) not in MEANINGS]


def to_coco(labels: Sequence[str], key: str = "detector.label_space") -> LabelMapping:
    """Map labels to COCO names.

    Case and text after a comma are ignored, so that "Sofa, couch, lounge" is "sofa".

    Args:
        labels: The labels.
        key: The config key, for messages.

    Raises:
        ConfigError: Labels are unknown, or no label is a COCO class.
    """
    if unknown := _unknown(labels):
        raise ConfigError(
            f"{key}: expected names of a label space, got unknown labels ({len(unknown)} of {len(labels)}): "
            f"{', '.join(map(repr, unknown))}; set detector.class_names=OWN to keep all names"
        )
    meanings = list(map(coco_name, labels))
    classes = tuple(name for name in COCO if name in meanings)
    if not classes:
        raise ConfigError(f"{key}: expected at least one object class of COCO, got none in {len(labels)} labels")
    index = {name: k for k, name in enumerate(classes)}
    meaning = [-1 if name is None else index[name] for name in meanings]
    return LabelMapping(classes, np.array(meaning, np.int32))

"""The names of classes. Two label spaces meet by name, so every dataset and detector speaks COCO's names.

`label_spaces.yaml`, beside this file, is the one place that says what a name of another space means.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from framework.data import Bool, Float32, Int32
from framework.errors import ConfigError, DataError
from framework.files.atomic_write import read_text
from framework.files.search_paths import expanded

LARGEST_FILE = 2**20  # bytes of a list of labels
_OTHER_NAMES = "other_names"  # the file's section of spellings that belong to no space


def _read_meanings() -> dict[str, dict[str, str | None]]:
    """Section -> name -> the COCO name that it means, None = no object class that COCO knows."""
    path = Path(__file__).with_suffix(".yaml")
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the compiled one is ten times as fast, and not everywhere
    sections: dict[str, dict[str, str | None]] = yaml.load(path.read_text("utf-8"), loader)
    return sections


_SECTIONS = _read_meanings()

SPACES: Mapping[str, tuple[str, ...]] = {
    space: tuple(names) for space, names in _SECTIONS.items() if space != _OTHER_NAMES
}
"""The label spaces: the names of each, in the order of the detectors trained on it."""

COCO = SPACES["coco"]
"""The 80 classes of COCO, in the order of the detectors trained on it."""

NO_CLASS = "n/a"
"""The name of a number that has no class, in any space."""

_UNUSED_IDS = (0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83)  # 91 classes were planned from 1 on, 80 were annotated
_COCO_IDS = [k for k in range(91) if k not in _UNUSED_IDS]
COCO_BY_ID = tuple(COCO[_COCO_IDS.index(k)] if k in _COCO_IDS else NO_CLASS for k in range(91))
"""COCO's classes by the ids of its annotation files, 0 to 90, as DETR and RF-DETR count them; gaps are NO_CLASS."""

SCENENN_TO_COCO = {name: coco for name, coco in _SECTIONS["scenenn"].items() if coco is not None}
"""The nine classes that the paper evaluates on SceneNN, and what COCO calls them."""

MEANINGS: Mapping[str, str | None] = {name: coco for names in _SECTIONS.values() for name, coco in names.items()}
"""What any name of any space means, in lower case: a COCO name, None = no object class that COCO knows."""


@dataclass(frozen=True)
class LabelMapping:
    """What the labels of a detector mean among COCO's names."""

    classes: tuple[str, ...]  # the C' COCO names that a label means, in COCO's order
    meaning: Int32  # (C,) for each label its index in `classes`, -1 = not an object class that COCO knows

    def apply(self, probabilities: Float32) -> tuple[Float32, Bool]:
        """Rows over the C labels become distributions over `classes`.

        probabilities (N, C), not negative. Labels that mean the same add up; what labels without a meaning had is
        dropped and the rest renormalised. Returns the rows (N, C') float32, each with sum 1, and known (N,): whether
        the row's best label means a class. A row that gives no class anything comes back uniform, and is not known.
        """
        has_meaning = self.meaning >= 0
        sums = np.zeros((len(probabilities), len(self.classes)))
        np.add.at(sums.T, self.meaning[has_meaning], probabilities.T[has_meaning])
        totals = sums.sum(axis=1, keepdims=True)
        rows = np.divide(sums, totals, out=np.full_like(sums, 1 / len(self.classes)), where=totals > 0)
        known = has_meaning[probabilities.argmax(axis=1)] & (totals[:, 0] > 0)
        return rows.astype(np.float32), known


def read_labels(name_or_path: str) -> tuple[str, ...]:
    """The names of a label space ("coco", "nyu40", ...), or those of a text file with one name a line.

    Raises ConfigError when it is neither.
    """
    if name_or_path in SPACES:
        return SPACES[name_or_path]
    path = expanded(Path(name_or_path))
    try:
        lines = read_text(path, LARGEST_FILE).rstrip().splitlines()
    except DataError as error:
        raise ConfigError(
            f"labels must be one of {', '.join(SPACES)}, or a text file with one name a line, found {name_or_path}"
        ) from error
    names = tuple(line.strip() for line in lines)
    if not all(names):  # skipping it would shift the names behind it
        empty = names.index("") + 1 if names else 1
        raise ConfigError(f"labels: {path}, line {empty}: expected a name, found nothing")
    if not names:
        raise ConfigError(f"labels: {path} is empty; expected one name a line")
    return names


def to_coco(labels: Sequence[str]) -> LabelMapping:
    """What `labels` mean among COCO's names, as `label_spaces.yaml` has it.

    Case, spaces around a name and what follows a comma do not matter: "Sofa, couch, lounge" is "sofa". Raises
    ConfigError, naming all labels that the file does not have; also when none means an object class.
    """
    keys = [label.partition(",")[0].strip().lower() for label in labels]
    unknown = [label for label, key in zip(labels, keys, strict=True) if key not in MEANINGS]
    if unknown:
        raise ConfigError(
            f"{len(unknown)} of {len(labels)} labels are in no label space: {', '.join(map(repr, unknown))};"
            f" framework/vocabulary/{Path(__file__).stem}.yaml says what a name means: add them there"
        )
    meanings = [MEANINGS[key] for key in keys]
    classes = tuple(name for name in COCO if name in meanings)
    if not classes:
        raise ConfigError(f"none of the {len(labels)} labels means an object class of COCO")
    index = {name: k for k, name in enumerate(classes)}
    meaning = [-1 if name is None else index[name] for name in meanings]
    return LabelMapping(classes, np.array(meaning, np.int32))

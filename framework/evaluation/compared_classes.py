"""Label space of an evaluation: the classes in which a map is compared with the ground truth.

The names of the map and of the ground truth are converted to the classes of the label space. A name is converted by the
first rule that applies:

1. The config key `evaluation.names` contains the name.
2. The label space contains the name. Case is ignored.
3. The label space has a class with the same COCO name, such as sofa for couch. Of several, the first is used.

Objects with other names are ignored: they are neither correct nor wrong. Walls and floors are background, as in the
instance benchmark of ScanNet.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from framework.data import Int32, SceneTruth
from framework.errors import ConfigError
from framework.evaluation.instances import MAX_DISTANCE, PredictedInstances, transfer_labels
from framework.vocabulary.label_spaces import AGNOSTIC, OBJECT, coco_name, label_key, read_labels

BACKGROUND = ("wall", "floor")
OF_DATASET = (None, "coco")  # label spaces with the class names of the dataset
OUTSIDE = ""  # class name of an object that is ignored
KEY = "evaluation.label_space"
MOST_LISTED = 12  # maximum number of names in a list of ignored objects


@dataclass(frozen=True)
class Compared:
    """A map and its ground truth in one label space."""

    predictions: PredictedInstances  # ignored objects have the class OUTSIDE
    truth: SceneTruth  # ignored objects have the class None
    true_classes: Int32  # (V,) class of each ground-truth point with background, index in the label space; -1 = ignored
    ignored_predictions: Mapping[str, int]  # number of ignored objects by name
    ignored_truths: Mapping[str, int]

    def predicted_ids(self) -> Int32:
        """Return the predicted instance of each ground-truth point (V,), 0 = none within MAX_DISTANCE."""
        found = self.predictions
        return transfer_labels(found.points_world, found.instance_ids, self.truth.points_world, MAX_DISTANCE)


@dataclass(frozen=True)
class ComparedClasses:
    """The label space of an evaluation."""

    label_space: str | None = None  # coco, nyu40, scannet20, ..., agnostic, or a text file; None = names of both sides
    classes: tuple[str, ...] = ()  # all classes of the label space; () if `label_space` is None
    names: Mapping[str, str | None] = field(default_factory=dict)  # class by name; None = ignored

    def __post_init__(self) -> None:
        unknown = sorted({name for name in self.names.values() if name is not None} - set(self.classes))
        if unknown and self.label_space is not None:
            raise ConfigError(
                f"evaluation.names: expected classes of {self.label_space}, got {', '.join(map(repr, unknown))}; "
                "correct the names"
            )

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> ComparedClasses:
        """Return the label space of the block `evaluation` in a resolved config; a missing block = defaults.

        Raises:
            ConfigError: The label space is unknown, or a name is invalid.
        """
        block = config.get("evaluation") or {}
        names = block.get("names") or {}
        if not isinstance(names, Mapping):
            raise ConfigError(f"evaluation.names: expected the class of each name, got {names!r:.60}")
        for name, chosen in names.items():
            if not isinstance(name, str) or not (chosen is None or isinstance(chosen, str)):
                raise ConfigError(f"evaluation.names: expected a class or null for each name, got {name!r}: {chosen!r}")
        space = block.get("label_space")
        return cls(None, (), names) if space is None else cls(str(space), classes_of_space(str(space)), names)

    @property
    def names_text(self) -> str | None:
        """`names` as JSON, or None without names."""
        return json.dumps(dict(self.names), ensure_ascii=False) if self.names else None

    @property
    def object_classes(self) -> tuple[str, ...]:
        """The classes of objects, which are all classes except BACKGROUND."""
        return tuple(name for name in self.classes if name not in BACKGROUND)

    def class_of(self, name: str) -> str | None:
        """Return the class of a name, or None if objects with this name are ignored."""
        if name in self.names:
            return self.names[name]
        if self.label_space is None:
            return name
        if self.label_space == AGNOSTIC:
            return OBJECT
        if label_key(name) in self._by_key:
            return self._by_key[label_key(name)]
        return self._by_coco_name.get(coco_name(name))

    @cached_property
    def _by_key(self) -> dict[str, str]:
        return {label_key(name): name for name in reversed(self.classes)}

    @cached_property
    def _by_coco_name(self) -> dict[str | None, str]:
        return {coco: name for name in reversed(self.classes) if (coco := coco_name(name)) is not None}

    def compare(self, predictions: PredictedInstances, truth: SceneTruth) -> Compared:
        """Convert the classes of a map and of its ground truth."""
        found = [self.class_of(name) for name in predictions.class_names]
        converted = replace(predictions, class_names=tuple(OUTSIDE if name is None else name for name in found))
        ignored = Counter(name for name, one in zip(predictions.class_names, found, strict=True) if one is None)
        ids, names = self._annotation(truth)
        classes = {key: name and self.class_of(name) for key, name in names.items()}
        background = {key for key, name in names.items() if self.label_space is not None and name in BACKGROUND}
        objects = {key: one for key, one in classes.items() if key not in background}
        known = self.object_classes or None
        if truth.classes is not None and (truth.annotated is None or self.label_space in OF_DATASET):
            known = tuple(dict.fromkeys(one for name in truth.classes if (one := self.class_of(name)) is not None))
        in_space = replace(
            truth,
            instance_ids=np.where(np.isin(ids, list(background)), 0, ids).astype(np.int32),
            class_names=objects,
            classes=known,
        )
        ignored_truths = Counter(name for key, one in objects.items() if one is None and (name := names[key]))
        return Compared(converted, in_space, indices(ids, classes, self.classes), ignored, ignored_truths)

    def _annotation(self, truth: SceneTruth) -> tuple[Int32, Mapping[int, str | None]]:
        """Return the instance ids (V,) of the ground truth, and the name of each instance."""
        if truth.annotated is None or self.label_space in OF_DATASET:
            return truth.instance_ids, truth.class_names
        # the names of the annotation, because COCO has no class for most objects
        own_names = truth.annotated.own_names
        of_space = truth.annotated.names.get(str(self.label_space), own_names)
        return truth.annotated.instance_ids, {key: of_space.get(key) for key in own_names}


def classes_of_space(label_space: str) -> tuple[str, ...]:
    """Return the classes of a label space, a text file or AGNOSTIC.

    Raises:
        ConfigError: The label space or file does not exist.
    """
    return (OBJECT,) if label_space == AGNOSTIC else read_labels(label_space, KEY, also=(AGNOSTIC,))


def indices(ids: Int32, names: Mapping[int, str | None], classes: Sequence[str]) -> Int32:
    """Return the index of the class name of each instance id (V,), -1 = no class.

    Args:
        ids: The instance ids (V,).
        names: The class name of each instance.
        classes: The classes.
    """
    place = {name: k for k, name in enumerate(classes)}
    present, inverse = np.unique(ids, return_inverse=True)
    of_id = [place.get(names.get(key) or OUTSIDE, -1) for key in present.tolist()]
    return np.array(of_id, np.int32)[inverse]


def listed(counts: Mapping[str, int]) -> str:
    """Return names with their numbers of objects as text, most frequent first: laptop (3), cup (1)."""
    ordered: Iterable[tuple[str, int]] = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    names = [f"{name} ({count})" for name, count in ordered]
    rest = f" and {len(names) - MOST_LISTED} more" if len(names) > MOST_LISTED else ""
    return ", ".join(names[:MOST_LISTED]) + rest

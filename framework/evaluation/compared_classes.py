"""Label space of an evaluation: the classes in which a map is compared with the ground truth.

The names of the map and of the ground truth are converted to the classes of the label space. A name is converted by the
first rule that applies:

1. The config key `evaluation.names` contains the name.
2. The label space contains the name. Other spellings in upper and lower case are also accepted.
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

from framework.data import AnnotatedObjects, Int32, SceneTruth
from framework.errors import ConfigError
from framework.evaluation.instances import MAX_DISTANCE, PredictedInstances, transfer_labels
from framework.vocabulary.label_spaces import AGNOSTIC, NO_CLASS, OBJECT, SPACES, coco_name, label_key, read_class_ids

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

    label_space: str | None = None  # coco, nyu40, scannet20, ..., agnostic, or a file; None = names are not converted
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
        if not isinstance(block, Mapping):
            raise ConfigError(f"evaluation: expected label_space, names and doubled_instances, got {block!r:.60}")
        names = block.get("names") or {}
        if not isinstance(names, Mapping):
            raise ConfigError(f"evaluation.names: expected the class of each name, got {names!r:.60}")
        for name, chosen in names.items():
            if not isinstance(name, str) or not (chosen is None or (isinstance(chosen, str) and chosen.strip())):
                raise ConfigError(f"evaluation.names: expected a class or null for each name, got {name!r}: {chosen!r}")
        space = block.get("label_space")
        return cls(None, (), names) if space is None else cls(str(space), classes_of_space(str(space)), names)

    @property
    def names_text(self) -> str | None:
        """`names` as JSON, or None without names."""
        return json.dumps(dict(self.names), ensure_ascii=False) if self.names else None

    @property
    def file_text(self) -> str | None:
        """`classes` as JSON if they are from a file, otherwise None."""
        is_file = self.label_space not in (None, AGNOSTIC, *SPACES)
        return json.dumps(self.classes, ensure_ascii=False) if is_file else None

    @property
    def object_classes(self) -> tuple[str, ...]:
        """The classes of objects, which are all classes except BACKGROUND."""
        return tuple(name for name in self.classes if label_key(name) not in BACKGROUND)

    def class_of(self, name: str) -> str | None:
        """Return the class of a name, or None if objects with this name are ignored."""
        if name in self.names:
            return self.names[name]
        if self.label_space is None or name in self.classes:
            return name
        if self.label_space == AGNOSTIC:
            return None if label_key(name) in BACKGROUND else OBJECT
        return self._by_key.get(label_key(name)) or self._by_coco_name.get(coco_name(name))

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
        objects = self._true_objects(truth)
        background = [key for key, one in objects.items() if one.is_background]
        classes = {key: one.class_name for key, one in objects.items()}
        annotated = self._annotation(truth)
        ids = truth.instance_ids if annotated is None else annotated.instance_ids
        in_space = replace(
            truth,
            instance_ids=np.where(np.isin(ids, background), 0, ids).astype(np.int32),
            class_names={key: name for key, name in classes.items() if key not in background},
            classes=self._known_classes(truth),
        )
        ignored_truths = Counter(
            one.own_name for one in objects.values() if one.own_name and not one.class_name and not one.is_background
        )
        return Compared(converted, in_space, indices(ids, classes, self.classes), ignored, ignored_truths)

    def _annotation(self, truth: SceneTruth) -> AnnotatedObjects | None:
        """Return the annotation if its names are used, because COCO has no class for most of its objects."""
        return None if self.label_space in OF_DATASET else truth.annotated

    def _true_objects(self, truth: SceneTruth) -> Mapping[int, _TrueObject]:
        """Return the ground-truth objects by id."""
        annotated = self._annotation(truth)
        if annotated is None:
            return {key: self._true_object(name, name) for key, name in truth.class_names.items()}
        of_space = annotated.names.get(str(self.label_space), annotated.own_names)
        return {key: self._true_object(own, of_space.get(key)) for key, own in annotated.own_names.items()}

    def _true_object(self, own_name: str | None, name: str | None) -> _TrueObject:
        """Return an object with its name in the annotation and its name in the label space, if it has one."""
        if own_name is not None and own_name in self.names:
            name = own_name
        class_name = None if name is None else self.class_of(name)
        shown = name if class_name is None else class_name
        is_background = self.label_space is not None and shown is not None and label_key(shown) in BACKGROUND
        return _TrueObject(own_name, class_name, is_background)

    def _known_classes(self, truth: SceneTruth) -> tuple[str, ...] | None:
        """Return the annotated classes in the label space; None = unknown."""
        if truth.classes is None or self._annotation(truth) is not None:
            return self.object_classes or None
        return tuple(dict.fromkeys(one for name in truth.classes if (one := self.class_of(name)) is not None))


@dataclass(frozen=True)
class _TrueObject:
    """A ground-truth object in a label space."""

    own_name: str | None  # name in the annotation; None = unnamed
    class_name: str | None  # None = ignored
    is_background: bool


def classes_of_space(label_space: str) -> tuple[str, ...]:
    """Return the classes of a label space, a text or JSON file, or AGNOSTIC.

    Raises:
        ConfigError: The label space or file does not exist.
        DataError: The JSON file is invalid.
    """
    names = read_class_ids(label_space, KEY).values()
    return tuple(dict.fromkeys(name for name in names if label_key(name) != NO_CLASS))


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

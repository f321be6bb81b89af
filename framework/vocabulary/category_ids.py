"""Numberings of classes in the outputs of networks and in files of detections."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from enum import Enum

from framework.errors import ConfigError, DataError
from framework.vocabulary.label_spaces import BENCHMARK_IDS, COCO, COCO_BY_ID, NO_CLASS, SPACES, coco_name

KEY = "detector.category_ids"

log = logging.getLogger(__name__)


class CategoryIds(Enum):
    """Numbering of classes."""

    AUTO = "recognized from the ids"
    COCO_91 = "ids of COCO's annotation files: 1 to 90, with gaps"
    SCANNET = "ids of ScanNet's benchmark files, for scannet20 and scannet200"
    FROM_ONE = "indices of the labels, from 1"
    FROM_ZERO = "indices of the labels, from 0"

    def of(self, labels: Sequence[str]) -> list[int]:
        """Return the id of each label. AUTO has no ids.

        Raises:
            ConfigError: The labels do not match this numbering.
        """
        if self is CategoryIds.FROM_ZERO:
            return list(range(len(labels)))
        if self is CategoryIds.FROM_ONE:
            return list(range(1, len(labels) + 1))
        if self is CategoryIds.SCANNET and (ids := _scannet_ids(labels)):
            return list(ids)
        if self is not CategoryIds.COCO_91 or not are_coco(labels):
            raise ConfigError(
                f"{KEY}: expected FROM_ONE or FROM_ZERO for this label_space, got {self.name}; "
                f"set {KEY}=FROM_ONE or {KEY}=FROM_ZERO"
            )
        return [k for k, name in enumerate(COCO_BY_ID) if name != NO_CLASS]

    def names(self, labels: Sequence[str]) -> dict[int, str]:
        """Return the label of each used id.

        Raises:
            ConfigError: The labels do not match this numbering.
        """
        return {k: name for k, name in zip(self.of(labels), labels, strict=True) if name != NO_CLASS}


def are_coco(labels: Sequence[str]) -> bool:
    """Return True if labels are COCO's 80 classes in their order, also under other names such as "sofa"."""
    return len(labels) == len(COCO) and tuple(map(coco_name, labels)) == COCO


def _scannet_ids(labels: Sequence[str]) -> tuple[int, ...]:
    """Return the ids of labels in ScanNet's benchmark files, an empty tuple for other label spaces."""
    return next((BENCHMARK_IDS[k] for k in ("scannet20", "scannet200") if SPACES[k] == tuple(labels)), ())


def possible_numberings(labels: Sequence[str]) -> list[CategoryIds]:
    """Return the numberings that these labels may have, COCO's own first."""
    if labels[0] == NO_CLASS:  # the background, or the unused id 0 of COCO
        return [CategoryIds.FROM_ZERO]
    contiguous = [CategoryIds.FROM_ONE, CategoryIds.FROM_ZERO]
    if _scannet_ids(labels):
        return [CategoryIds.SCANNET, *contiguous]
    return [CategoryIds.COCO_91, *contiguous] if are_coco(labels) else contiguous


def recognize(
    where: str, ids: Sequence[int], labels: Sequence[str], named: Iterable[tuple[int, str]] = ()
) -> CategoryIds:
    """Return the numbering of class ids, and log an example.

    Ids that all numberings have are read as COCO's if the labels are COCO's, and a warning is logged.

    Args:
        where: The file, for messages.
        ids: The ids.
        labels: The class names.
        named: Ids with known names.

    Raises:
        DataError: No numbering has all of the ids.
        ConfigError: Several numberings have all of the ids.
    """
    candidates = [(one, one.names(labels)) for one in possible_numberings(labels)]
    pairs = set(named)
    matching = [(one, names) for one, names in candidates if all(names.get(k) == name for k, name in pairs)]
    fitting = [(one, names) for one, names in matching if all(k in names for k in ids)]
    if not fitting:
        raise DataError(
            f"{where}: category_id: expected the ids of {len(labels)} labels, got {min(ids)} to {max(ids)}; set "
            f"detector.label_space to the label space of the file, and {KEY} to its numbering"
        )
    example = next((k for k in ids if len({names[k] for _, names in fitting}) > 1), ids[0])
    (numbering, names), *others = fitting
    others = [(one, other) for one, other in others if any(other[k] != names[k] for k in ids)]
    alternatives = " or ".join(f"{other[example]!r} by {one.name}" for one, other in others)
    fixes = " or ".join(f"{KEY}={one.name}" for one, _ in others)
    if others and numbering is not CategoryIds.COCO_91:
        raise ConfigError(
            f"{KEY}: expected a numbering, got {where} with ids {min(ids)} to {max(ids)}, where {example} is "
            f"{names[example]!r} by {numbering.name} or {alternatives}; set {KEY}={numbering.name} or {fixes}"
        )
    if others:
        log.warning(
            "%s: class ids read as %s, so %d is %r, but it could be %s; set %s if the ids are not those of COCO's "
            "annotation files, or %s=%s to confirm",
            where, numbering.name, example, names[example], alternatives, fixes, KEY, numbering.name,
        )  # fmt: skip
    else:
        log.info("%s: class ids read as %s, so %d is %r", where, numbering.name, example, names[example])
    return numbering


def label_ids(ids: CategoryIds, labels: Sequence[str], published: CategoryIds | None) -> list[int]:
    """Return the number of each class in the label output of a network, and log an example.

    Args:
        ids: The numbering.
        labels: The class names.
        published: The numbering of published networks of this layout; None = unknown. AUTO uses it. For labels other
            than COCO's, COCO_91 is replaced by FROM_ONE, or by FROM_ZERO if the first label is unused.

    Raises:
        ConfigError: The numbering is AUTO and unknown, or does not match the labels.
    """
    numbering = ids
    if ids is CategoryIds.AUTO:
        if published is None:
            choices = [one.name for one in possible_numberings(labels)]
            raise ConfigError(
                f"{KEY}: expected the numbering of the network's labels ({', '.join(choices)}), got AUTO for a layout "
                f"without a known numbering; set {' or '.join(f'{KEY}={choice}' for choice in choices)}"
            )
        numbering = published
        if published is CategoryIds.COCO_91:
            numbering = possible_numberings(labels)[0]
    numbers = numbering.of(labels)
    example = _example(labels)
    others = " or ".join(f"{KEY}={one.name}" for one in possible_numberings(labels) if one is not numbering)
    log.info(
        "%s: labels of the network read as %s, so %d is %r%s",
        KEY, numbering.name, numbers[example], labels[example],
        f"; set {others} if the network counts otherwise" if others else "",
    )  # fmt: skip
    return numbers


def column_ids(ids: CategoryIds, labels: Sequence[str], columns: int) -> list[int]:
    """Return the column of each class in a table with C class columns, and log an example.

    Args:
        ids: The numbering of the columns.
        labels: The class names.
        columns: The number of class columns C.

    Raises:
        DataError: The table has another number of columns.
        ConfigError: The numbering is AUTO, and the table has one more column than classes.
    """
    count, is_coco = len(labels), are_coco(labels)
    numbering = ids
    if ids is CategoryIds.AUTO:
        if is_coco and columns in (len(COCO_BY_ID) - 1, len(COCO_BY_ID)):
            numbering = CategoryIds.COCO_91
        elif columns == count:
            numbering = CategoryIds.FROM_ZERO
        elif columns == count + 1:
            raise ConfigError(
                f"{KEY}: expected the numbering of {columns} class columns for {count} labels, got AUTO; set "
                f"{KEY}=FROM_ONE (first column unused) or {KEY}=FROM_ZERO (last column unused)"
            )
    shift = int(numbering is CategoryIds.COCO_91 and columns == len(COCO_BY_ID) - 1)  # no column for the id 0
    wanted = [k - shift for k in numbering.of(labels)] if numbering is not CategoryIds.AUTO else []
    if not wanted or max(wanted) >= columns:
        coco = f", or {len(COCO_BY_ID)}" if is_coco else ""
        others = f", or {KEY} to another value than {ids.name}" if ids is not CategoryIds.AUTO else ""
        raise DataError(
            f"detector.label_space: expected {count} or {count + 1}{coco} class columns, got {columns}; set "
            f"detector.label_space to the classes of the network{others}"
        )
    example = _example(labels)
    log.info("%s: class columns read as %s, so column %d is %r", KEY, numbering.name, wanted[example], labels[example])
    return wanted


def _example(labels: Sequence[str]) -> int:
    """Return the index of the label in log lines."""
    return labels.index("chair") if "chair" in labels else next((k for k, n in enumerate(labels) if n != NO_CLASS), 0)

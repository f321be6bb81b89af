"""The nine classes of SceneNN under COCO's names, each with a maker of random pieces."""

from __future__ import annotations

from collections.abc import Callable

from framework.synthetic import fixtures, seating, tables
from framework.synthetic.piece import Furniture, Rng

LABELED: dict[str, Callable[[Rng], Furniture]] = {
    "bed": seating.bed,
    "chair": seating.chair,
    "couch": seating.couch,
    "dining table": tables.dining_table,
    "book": tables.book,
    "refrigerator": fixtures.refrigerator,
    "tv": fixtures.tv,
    "toilet": fixtures.toilet,
    "backpack": fixtures.backpack,
}
"""A maker for each of the nine classes."""

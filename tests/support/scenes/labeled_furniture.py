"""The nine classes of SceneNN by COCO name, each with a function that makes random furniture."""

from __future__ import annotations

from collections.abc import Callable

from framework.synthetic.furniture import fixtures, seating, tabletops
from framework.synthetic.furniture.piece import Furniture, Rng

LABELED: dict[str, Callable[[Rng], Furniture]] = {
    "bed": seating.bed,
    "chair": seating.chair,
    "couch": seating.couch,
    "dining table": tabletops.dining_table,
    "book": tabletops.book,
    "refrigerator": fixtures.refrigerator,
    "tv": fixtures.tv,
    "toilet": fixtures.toilet,
    "backpack": fixtures.backpack,
}

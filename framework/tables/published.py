"""What others have published, as `published.yaml` beside this file has it: numbers with their source."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from framework.errors import ConfigError

FILE = Path(__file__).with_suffix(".yaml")
DATASET = "scenenn"  # what the numbers were measured on
MADE_UP = "synthetic"  # begins the release of rooms that `python -m framework synthesize` writes in its format
NOT_KNOWN = "not known"  # what tables print for what nobody has looked up

Key = tuple[str, ...]  # ("fps",), ("011",) or ("011", "instances.ap50.bed"): what a number stands for in its table


@dataclass(frozen=True)
class PublishedRow:
    """A system's numbers, as somebody has printed them."""

    system: str
    source: str
    remark: str  # how the numbers were come by, and what they are not
    poses: str
    annotation: str  # the release
    decimals: int  # of the values, in our unit
    values: Mapping[Key, float | None] | None  # in our unit; None = nobody has looked it up, or none of all

    def knows(self, keys: Iterable[Key]) -> bool:
        """Whether the number of one of `keys`, or more, is known."""
        return any((self.values or {}).get(key) is not None for key in keys)

    def leaves_open(self, keys: Iterable[Key]) -> bool:
        """Whether the source may have a number of one of `keys`, and nobody has looked it up."""
        return self.values is None or any(key in self.values and self.values[key] is None for key in keys)


@dataclass(frozen=True)
class Published:
    """A section of the file."""

    layout: str  # of the tables that the numbers go below: rows, columns_by or group_by
    sequences: tuple[str, ...]  # of the published table, in its order
    rows: tuple[PublishedRow, ...]


NOTHING_PUBLISHED = Published("rows", (), ())


@cache
def read_published(section: str) -> Published:
    """The numbers of a section. Raises ConfigError when the file does not have it."""
    sections: dict[str, Any] = yaml.safe_load(FILE.read_text("utf-8"))
    if section not in sections:
        raise ConfigError(f"table.published must be null or one of {', '.join(sections)}, found {section}")
    node = sections[section]
    rows = tuple(
        PublishedRow(
            system=row["system"],
            source=row["source"],
            remark=row.get("remark", ""),
            poses=row.get("poses", NOT_KNOWN),
            annotation=row.get("annotation", NOT_KNOWN),
            decimals=node["decimals"],
            values=None if row["values"] is None else dict(_leaves(row["values"], node["scale"])),
        )
        for row in node["rows"]
    )
    return Published(node["layout"], tuple(node["sequences"]), rows)


def _leaves(node: Mapping[str, Any], scale: float, prefix: Key = ()) -> Iterator[tuple[Key, float | None]]:
    for name, value in node.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, scale, (*prefix, name))
        else:
            yield (*prefix, name), None if value is None else value * scale

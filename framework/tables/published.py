"""Published results of other systems, from published.yaml."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from framework.errors import ConfigError

FILE = Path(__file__).with_suffix(".yaml")
DATASET = "scenenn"  # dataset of the published results
SYNTHETIC = "synthetic"  # first word of the annotation release of scenes written by `instancemap synthesize`
NOT_KNOWN = "not known"  # text for values that were not looked up

Key = tuple[str, ...]  # metric, sequence, or both, e.g. ("011", "instances.ap50.bed"); depends on the layout


@dataclass(frozen=True)
class PublishedRow:
    """The published results of one system."""

    system: str  # name of the system
    source: str  # publication
    remark: str  # conditions of the measurement
    poses: str  # source of the poses
    annotation: str  # release of the annotation
    decimals: int  # number of published decimals, in the unit of metrics.json
    values: Mapping[Key, float | None] | None  # in the unit of metrics.json; None = not looked up

    def has_any(self, keys: Iterable[Key]) -> bool:
        """Return True if the value of at least one key is known."""
        return any((self.values or {}).get(key) is not None for key in keys)

    def lacks_any(self, keys: Iterable[Key]) -> bool:
        """Return True if the value of at least one key was not looked up."""
        return self.values is None or any(key in self.values and self.values[key] is None for key in keys)


@dataclass(frozen=True)
class Published:
    """A section of published.yaml."""

    layout: str  # layout of the table: rows, columns_by or group_by
    sequences: tuple[str, ...]  # in the order of the published table
    rows: tuple[PublishedRow, ...]


NOTHING_PUBLISHED = Published("rows", (), ())


@cache
def read_published(section: str) -> Published:
    """Read a section of published.yaml.

    Raises:
        ConfigError: The section does not exist.
    """
    sections: dict[str, Any] = yaml.safe_load(FILE.read_text("utf-8"))
    if section not in sections:
        raise ConfigError(f"table.published: expected null or one of {', '.join(sections)}, got {section}")
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

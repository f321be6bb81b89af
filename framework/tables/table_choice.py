"""The block `table` of an experiment's config, or of a sweep with `+table.KEY=VALUE`."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from framework.config.validation import check_known, check_page_columns, checked_block
from framework.errors import ConfigError
from framework.runs.provenance import leaves
from framework.runs.run_rows import value_of
from framework.runs.stored_runs import Record
from framework.tables.published import read_published

LABEL = re.compile(r"[A-Za-z0-9:._/-]*")  # labels for \ref
PLAIN = (
    *("instances.ap50", "instances.ap50_agnostic", "instances.ap25", "instances.ap", "instances.mean_iou"),
    *("instances.count", "trajectory.ate_rmse_m", "frames_lost", "fps"),
    *(f"stage_ms.{stage}.median" for stage in ("refinement", "association", "update", "integration", "fusion")),
)
"""Default columns of a table without an experiment: keys of metrics.json. Columns without values are omitted."""


@dataclass(frozen=True)
class TableChoice:
    """The block `table` of an experiment.

    Each row is a method and each column a metric. Cells are means over the runs that differ only in `average_over`.
    With `columns_by`, each column is a value of that key, such as a sequence, and the last column is the mean. With
    `group_by`, each value of that key has a group of rows. A KEY is a parameter such as dataset.scene, or a group of
    options such as dataset.
    """

    average_over: list[str] = field(default_factory=lambda: ["seed"])  # KEYs to average over
    columns_by: str | None = None  # KEY with one column per value; None = one column per metric
    group_by: str | None = None  # KEY with one group of rows per value; None = no groups
    # KEYs that define the pairs, out of `average_over`, `columns_by` and `group_by`; [] = pairs of runs
    pair_by: list[str] = field(default_factory=list)
    # values, or lists of values, by KEY; other runs are omitted; {} = all runs
    where: dict[str, Any] = field(default_factory=dict)
    base: str | None = None  # row that the other rows are compared with, or KEY=VALUE; None = the first row
    # keys of metrics.json, at least one; with `columns_by`, exactly one
    columns: list[str] = field(default_factory=list)
    names: dict[str, str] = field(default_factory=dict)  # display names by row
    published: str | None = None  # section of published.yaml, if all runs use the original SceneNN data; None = none
    caption: str = ""  # caption of table.tex, LaTeX; "" = generated from the runs
    label: str = ""  # label of table.tex; "" = tab: and the name of the folder
    # width of table.tex in columns of the page, 1 or 2; None = 1 for tables of up to 5 columns, otherwise 2
    page_columns: int | None = None

    def __post_init__(self) -> None:
        for name in ("average_over", "columns"):
            if not getattr(self, name):
                raise ConfigError(f"table.{name}: expected at least one key, got none")
        if self.columns_by and self.group_by:
            raise ConfigError(
                f"table.columns_by, table.group_by: expected at most one key, got {self.columns_by} and {self.group_by}"
            )
        if self.split_key in self.average_over:
            raise ConfigError(
                f"table.average_over: expected keys other than the key of table.{self.layout}, got {self.split_key}"
            )
        if self.columns_by and len(self.columns) > 1:
            raise ConfigError(
                f"table.columns: expected one metric with table.columns_by, got {len(self.columns)}; set "
                f"table.columns_by=null and table.group_by={self.columns_by} for several metrics"
            )
        for key in self.pair_by:
            if key not in self.averaged:
                raise ConfigError(f"table.pair_by: expected one of {', '.join(self.averaged)}, got {key}")
        if not LABEL.fullmatch(self.label):
            raise ConfigError(
                f"table.label: expected letters, digits, ':', '.', '_', '/' or '-', got {self.label!r}; set "
                "table.label=tab:results, for example"
            )
        check_page_columns("table.page_columns", self.page_columns)
        if self.published and read_published(self.published).layout != self.layout:
            raise ConfigError(
                f"table.published: expected a section for the layout {self.layout}, got {self.published} for the "
                f"layout {read_published(self.published).layout}"
            )

    @property
    def layout(self) -> str:
        """Layout of the table: `columns_by`, `group_by` or `rows`."""
        return "columns_by" if self.columns_by else "group_by" if self.group_by else "rows"

    @property
    def split_key(self) -> str | None:
        """Key of the columns or groups of lines."""
        return self.columns_by or self.group_by

    @property
    def averaged(self) -> list[str]:
        """Keys of the runs of a row: the averaged keys, then the key of the columns or groups."""
        return [*self.average_over, *filter(None, [self.split_key])]

    @property
    def units(self) -> list[str]:
        """Keys of the pairs for comparisons. Runs with equal values of these keys are not independent."""
        return self.pair_by or self.averaged[-1:]

    @property
    def conditions(self) -> dict[str, list[str]]:
        """The values of `where` as text, by dotted key."""
        found = leaves(self.where)
        return {key: [str(one) for one in value] if isinstance(value, list) else [str(value)] for key, value in found}

    @classmethod
    def of(cls, node: Any) -> TableChoice:
        """Return the choice of a config block. Raises ConfigError for unknown keys and wrong types."""
        return cls(**checked_block(cls, "table", node))

    @classmethod
    def of_sweep(cls, node: Any) -> TableChoice:
        """Return the choice of a sweep, with default columns; `node` None = all defaults. Raises ConfigError."""
        if node is not None and not isinstance(node, Mapping):
            return cls.of(node)
        given = dict(node or {})
        columns = PLAIN[:1] if given.get("columns_by") else PLAIN
        return cls.of({"columns": list(columns)} | given)

    @property
    def keys(self) -> list[tuple[str, str]]:
        """The settings with a KEY, as (setting, KEY) pairs."""
        return [(f"table.{name}", key) for name, key in self._keys()]

    def _keys(self) -> Iterator[tuple[str, str]]:
        for name in ("average_over", "columns_by", "group_by", "pair_by"):
            value = getattr(self, name)
            for key in [value] if isinstance(value, str) else value or ():
                yield name, key
        yield from (("where", key) for key in self.conditions)
        parts = (self.base or "").split(", ")
        yield from (("base", key) for key, equals, _ in (part.partition("=") for part in parts) if equals)

    def check_keys(self, known: Collection[str]) -> None:
        """Raise ConfigError for a KEY that is not in `known`."""
        check_known(self.keys, known)

    def check_base(self, rows: Collection[str]) -> None:
        """Raise ConfigError for a base that is not one of the experiment's `rows`, or KEY=VALUE in another sweep."""
        if self.base is None:
            return
        if rows and self.base.split(", ")[0] not in rows:
            raise ConfigError(f"table.base: expected one of {', '.join(rows)}, got {self.base}")
        if not rows and not all("=" in part for part in self.base.split(", ")):
            raise ConfigError(f"table.base: expected KEY=VALUE, such as refiner=identity, got {self.base}")

    def selects(self, record: Record) -> bool:
        """Return True if a run is in the table."""
        return all(value_of(record, key) in values for key, values in self.conditions.items())

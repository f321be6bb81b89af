"""The block `figure` of an experiment's config, or of a sweep with `+figure.KEY=VALUE`."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from framework.config.validation import check_known, check_page_columns, checked_block, require
from framework.errors import ConfigError

OF_RUNS = ("stage_times", "maps")  # kinds that show files of the runs
OF_METRIC = ("bar", "box", "tradeoff", "curve", "progress", "class_heatmap")
KINDS = (*OF_RUNS, *OF_METRIC)
USED_BY: Mapping[str, Collection[str]] = {
    "zoom": ("maps",),
    "metric": OF_METRIC,
    "by": OF_METRIC,
    "color_by": ("bar", "box", "tradeoff"),
    "x": ("tradeoff", "curve"),
    "page_columns": OF_METRIC,
}
"""Kinds with each setting that not all kinds have."""
OVER_FRAMES = "instances.count"  # the only metric of `progress`
FILE_NAME = re.compile(r"[\w-][\w.-]*")


@dataclass(frozen=True)
class FigureChoice:
    """A figure of the runs of an experiment or of another sweep.

    `maps` shows the maps of each sequence next to the ground truth, in one column per row.
    `stage_times` shows the stage times over the frames, averaged over sequences, in one diagram per row.
    `bar` shows the mean of a metric with its runs and a bootstrap interval, `box` its quartiles.
    `tradeoff` shows a metric against the speed, with the Pareto front.
    `curve` shows a metric against a numeric parameter, such as dataset.stop.
    `progress` shows the number of detected objects over the frames.
    `class_heatmap` shows the metric of each class.

    A KEY is a parameter such as dataset.scene, or a group of options such as dataset.
    """

    # kind: maps, stage_times, bar, box, tradeoff, curve, progress or class_heatmap
    kind: str = "maps"
    sequences: str = "dataset.scene"  # config key of the sequence
    names: dict[str, str] = field(default_factory=dict)  # display names of rows, or of values of `by` and `color_by`
    zoom: bool = False  # True = add a close-up of the largest difference between the columns; only for `maps`
    metric: str | None = None  # key of metrics.json; None = instances.ap50, or instances.count for `progress`
    by: str | None = None  # KEY with one bar, box, point, curve or row of cells per value; None = one per row
    color_by: str | None = None  # KEY with one color per value, for `bar`, `box` and `tradeoff`; None = one color
    x: str | None = None  # horizontal axis: numeric KEY for `curve`, metric for `tradeoff`; None = fps for `tradeoff`
    page_columns: int | None = None  # width in columns of the page, 1 or 2; None = 2 for `class_heatmap`, otherwise 1
    file_name: str = "figure"  # name of the PNG and PDF files, without suffix

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ConfigError(f"figure.kind: expected one of {', '.join(KINDS)}, got {self.kind!r}")
        for name, kinds in USED_BY.items():
            value = getattr(self, name)
            if value not in (None, False) and self.kind not in kinds:
                text = str(value).lower() if isinstance(value, bool) else value
                raise ConfigError(
                    f"figure.kind: expected {' or '.join(kinds)} with figure.{name}={text}, got {self.kind}"
                )
        require(self.kind != "curve" or bool(self.x), "figure.x", self.x, "a numeric key such as dataset.stop")
        if self.kind == "progress" and self.metric not in (None, OVER_FRAMES):
            raise ConfigError(
                f"figure.metric: expected {OVER_FRAMES} with figure.kind=progress, got {self.metric}; set "
                "figure.kind=curve figure.x=dataset.stop for runs of several lengths"
            )
        check_page_columns("figure.page_columns", self.page_columns)
        require(bool(FILE_NAME.fullmatch(self.file_name)), "figure.file_name", self.file_name, "a name without folder")

    @classmethod
    def of(cls, node: Any) -> FigureChoice:
        """Return the choice of a config block. Raises ConfigError for unknown keys and wrong types."""
        return cls(**checked_block(cls, "figure", node))

    def called(self, name: str) -> str:
        """Return the display name of a row or value."""
        return self.names.get(name, name)

    @property
    def shown_metric(self) -> str:
        """Key of the metric."""
        return self.metric or (OVER_FRAMES if self.kind == "progress" else "instances.ap50")

    @property
    def x_key(self) -> str:
        """Key of the horizontal axis of `tradeoff` and `curve`."""
        return self.x or "fps"

    @property
    def keys(self) -> list[tuple[str, str]]:
        """The settings with a KEY, as (setting, KEY) pairs."""
        settings = ("by", "color_by", *(["x"] if self.kind == "curve" else []))
        return [(f"figure.{name}", key) for name in settings if (key := getattr(self, name))]

    def check_keys(self, known: Collection[str]) -> None:
        """Raise ConfigError for a KEY that is not in `known`."""
        check_known(self.keys, known)

    @property
    def over(self) -> list[str]:
        """Config keys with different values among the runs of a row."""
        return list(dict.fromkeys(("seed", self.sequences, *(key for _, key in self.keys if key != self.by))))

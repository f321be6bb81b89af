"""The block `figure` of an experiment's config."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from framework.config.validation import checked_block
from framework.errors import ConfigError
from framework.runs.run_rows import RunRow

KINDS = ("stage_times", "maps")


@dataclass(frozen=True)
class FigureChoice:
    """A figure of an experiment's runs.

    `stage_times` shows the stage times over the frames, averaged over sequences, in one diagram per row.
    `maps` shows the maps of each sequence next to the ground truth, in one column per row.
    """

    kind: str = "maps"  # kind of the figure, one of KINDS
    sequences: str = "dataset.scene"  # config key of the sequence
    names: dict[str, str] = field(default_factory=dict)  # display names of rows
    zoom: bool = False  # True = add a close-up of the largest difference between the columns; only for `maps`

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ConfigError(f"figure.kind: expected one of {', '.join(KINDS)}, got {self.kind!r}")
        if self.zoom and self.kind != "maps":
            raise ConfigError(f"figure.kind: expected maps with figure.zoom=true, got {self.kind}")

    @classmethod
    def of(cls, node: Any) -> FigureChoice:
        """Return the choice of a config block. Raises ConfigError for unknown keys and wrong types."""
        return cls(**checked_block(cls, "figure", node))

    def called(self, row: RunRow) -> str:
        """Return the display name of a row."""
        return ", ".join([self.names.get(row.system, row.system), *row.variant])

    @property
    def over(self) -> list[str]:
        """Config keys with different values among the runs of a row."""
        return list(dict.fromkeys(("seed", self.sequences)))

"""What the picture of an experiment shows: the block `figure` of its config."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from framework.config.validation import checked_block
from framework.errors import ConfigError
from framework.runs.run_rows import RunRow

KINDS = ("stage_times", "maps")


@dataclass(frozen=True)
class FigureChoice:
    """A picture of an experiment's runs.

    `stage_times` shows how long the stages took over the frames, averaged over sequences, one diagram for each row.
    `maps` shows the maps of each sequence side by side, a column for each row, and the true instances beside them.
    """

    kind: str = "maps"  # one of KINDS
    sequences: str = "dataset.scene"  # key of the config that tells the sequences apart
    names: dict[str, str] = field(default_factory=dict)  # what rows are called in the picture; others go by their name
    zoom: bool = False  # of `maps`: whether the place where the columns differ most is shown below, larger

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ConfigError(f"figure.kind must be one of {', '.join(KINDS)}, found {self.kind!r}")
        if self.zoom and self.kind != "maps":
            raise ConfigError(f"figure.zoom=true needs figure.kind=maps, found {self.kind}")

    @classmethod
    def of(cls, node: Any) -> FigureChoice:
        """What a config's `figure` describes. Raises ConfigError for keys and types that it does not have."""
        return cls(**checked_block(cls, "figure", node))

    def called(self, row: RunRow) -> str:
        """What a row is called in the picture."""
        return ", ".join([self.names.get(row.system, row.system), *row.variant])

    @property
    def over(self) -> list[str]:
        """The keys in which the runs of one row differ."""
        return list(dict.fromkeys(("seed", self.sequences)))

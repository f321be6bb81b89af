"""A run with fake stages that is logged to an experiment tracker."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

from framework.runs.stored_runs import is_number
from tests.support.forked_commands import FAKE_CONF, completed

FRAMES, LOST = 6, 2  # number of frames, index of the lost frame
FAKES = [f"{stage}=fake" for stage in ("dataset", "detector", "tracker", "refiner", "fuser")]
ROOM = [f"dataset.frames={FRAMES}", f"tracker.lost_from={LOST}", f"tracker.lost_to={LOST + 1}"]


@dataclass(frozen=True)
class TrackedRun:
    """Outputs of a run that an experiment tracker has received."""

    directory: Path

    @property
    def tracking_ms(self) -> list[float]:
        """Return the tracking time of each frame, ms, rounded to 0.001."""
        with (self.directory / "timings.csv").open() as file:
            return [float(row["milliseconds"]) for row in csv.DictReader(file) if row["stage"] == "tracking"]

    @property
    def numbers(self) -> dict[str, float]:
        """Return the numbers in the metrics file, keyed by name with the prefix of logged values."""
        [file] = self.directory.glob("metrics*.json")
        return {f"run/{key}": value for key, value in json.loads(file.read_text()).items() if is_number(value)}

    def check(self, series: Mapping[str, list[tuple[int, float]]], numbers: Mapping[str, float], steps: int) -> None:
        """Check the logged (frame, value) pairs of the first `steps` frames, and the logged metrics."""
        assert [step for step, _ in series["frame/lost"]] == list(range(steps))
        assert [value for _, value in series["frame/lost"]] == [float(step == LOST) for step in range(steps)]
        tracking = [value for _, value in series["frame/stage_ms.tracking"]]
        assert tracking == pytest.approx(self.tracking_ms[:steps], abs=6e-4)
        assert {key: value for key, value in numbers.items() if key in self.numbers} == pytest.approx(self.numbers)


def tracked_run(folder: Path, *overrides: str, returncode: int = 0) -> TrackedRun:
    """Execute the run with a viewer in `folder`/run."""
    arguments = ("--config-dir", str(FAKE_CONF), *FAKES, *ROOM, "hydra.run.dir=run", *overrides)
    done = completed(folder, *arguments)
    assert done.returncode == returncode, done.stderr
    assert "disabled after an error" not in done.stderr, done.stderr
    return TrackedRun(folder / "run")

"""Tests for docs/results/steps.py, compared with manual results."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from framework.errors import DataError
from tests.support.doc_pages import CHECKOUT
from tests.support.stored_experiments import AP50, experiment

pytestmark = pytest.mark.integration

SCRIPT = CHECKOUT / "docs" / "results" / "steps.py"
script = sys.modules["steps_script"] = importlib.util.module_from_spec(
    importlib.util.spec_from_file_location("steps_script", SCRIPT)
)
script.__spec__.loader.exec_module(script)


def lines_of(text: str) -> list[str]:
    return [" ".join(line.split()) for line in text.splitlines()]


def test_steps_differences_match_hand_computed_values(tmp_path: Path) -> None:
    """The seeds of a real scene are averaged. In the synthetic dataset, each seed is a scene."""
    kitchen = {"paper": (0.1, 0.3), "step": (0.4, 0.4), "default": (0.5, 0.7), "without_step": (0.4, 0.6)}
    office = {"paper": (0.4,), "step": (0.4,), "default": (0.6,), "without_step": (0.6,)}
    rooms = {"paper": (0.5, 0.6), "step": (0.5, 0.7), "default": (0.8, 0.9), "without_step": (0.9, 0.9)}
    places = [
        experiment(tmp_path / "kitchen", kitchen),
        experiment(tmp_path / "office", office),
        experiment(tmp_path / "rooms", rooms, dataset="synthetic"),
    ]
    text = script.write_steps(places, [AP50], tmp_path / "out")
    lines = lines_of(text)
    assert "| paper | – | 0.300 | – | 2 | 0.550 | – | 2 |" in lines
    assert "| step | paper | 0.400 | +0.100 [+0.000, +0.200] | 2 | 0.600 | +0.050 [+0.000, +0.100] | 2 |" in lines
    assert "| default | step | 0.600 | +0.200 [+0.200, +0.200] | 2 | 0.850 | +0.250 [+0.200, +0.300] | 2 |" in lines
    assert (
        "| without_step | default | 0.550 | -0.050 [-0.100, +0.000] | 2 | 0.900 | +0.050 [+0.000, +0.100] | 2 |"
        in lines
    )
    assert (tmp_path / "out" / "steps.md").read_text("utf-8") == text
    assert (tmp_path / "out" / "steps.png").stat().st_size > 10_000


def test_steps_rows_without_default_are_compared_with_first_row(tmp_path: Path) -> None:
    place = experiment(tmp_path / "kitchen", {"paper": (0.1,), "flat": (0.4,), "drop": (0.3,)})
    lines = lines_of(script.write_steps([place], [AP50], None))
    assert "| drop | paper | 0.300 | +0.200 | 1 |" in lines


def test_steps_interval_is_confidence_interval_of_mean() -> None:
    values = np.random.default_rng(0).normal(0.3, 1.0, 400)
    low, high = script.Difference(values).interval
    half = 1.96 * values.std() / 20
    assert low == pytest.approx(values.mean() - half, abs=0.1 * half)
    assert high == pytest.approx(values.mean() + half, abs=0.1 * half)


def test_steps_rows_missing_in_one_folder_are_excluded(tmp_path: Path) -> None:
    places = [
        experiment(tmp_path / "kitchen", {"paper": (0.1,), "flat": (0.4,), "drop": (0.3,)}),
        experiment(tmp_path / "office", {"paper": (0.1,), "drop": (0.3,)}),
    ]
    lines = lines_of(script.write_steps(places, [AP50], None))
    assert not any(line.startswith("| flat") for line in lines)
    assert "- Omitted rows, missing in some folders: flat." in lines


def test_steps_folders_without_common_rows_raise(tmp_path: Path) -> None:
    places = [experiment(tmp_path / "a", {"paper": (0.1,)}), experiment(tmp_path / "b", {"flat": (0.1,)})]
    with pytest.raises(DataError, match="expected at least two common rows of all folders, got none"):
        script.write_steps(places, [AP50], None)

"""Tests for the table of several detectors."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from framework.errors import DataError
from framework.evaluation.detection_ap import AveragePrecision, DetectionAp
from framework.evaluation.detection_errors import DetectionErrors
from framework.tables.detection_table import METRICS, detection_metrics, write_detection_table, write_metrics


def job(folder: Path, overrides: list[str], ap: float, classes: int = 2, sequence: str = "room") -> None:
    by_class = {"chair": ap, **({"bed": ap} if classes == 2 else {"bed": math.nan})}
    objects = 0 if math.isnan(ap) else 5 * classes
    masks, boxes = (AveragePrecision(ap * scale, ap, by_class, objects) for scale in (0.5, 0.6))
    folder.mkdir(parents=True)
    metrics = detection_metrics(sequence, 10, 20, DetectionAp(masks, boxes), DetectionErrors())
    write_metrics(folder, overrides, metrics)


def lines(text: str) -> list[str]:
    return [" ".join(line.split()) for line in text.splitlines()]


def test_detection_table_has_line_per_job(tmp_path: Path) -> None:
    job(tmp_path / "1", ["detector=a", "dataset=x", "detector.score_threshold=0.3"], 0.5)
    job(tmp_path / "2", ["detector=b", "dataset=x", "detector.score_threshold=0.3"], 0.8)
    found = lines(write_detection_table(tmp_path, {"detector"}, 100))
    assert "| detector=a | room | 10 | 20 | 10 | 2 | 0.250 | 0.500 | 0.300 | 0.500 | – | – | 0.000 |" in found
    assert "| detector=b | room | 10 | 20 | 10 | 2 | 0.400 | 0.800 | 0.480 | 0.800 | – | – | 0.000 |" in found
    assert not any("comparable" in line or "without result" in line for line in found)
    assert (tmp_path / "table.tex").read_text().count("\\\\") == 3
    assert "detector=b" in (tmp_path / "table.csv").read_text()


def test_detection_table_states_incomparable_rows(tmp_path: Path) -> None:
    job(tmp_path / "1", ["detector=a"], 0.5)
    job(tmp_path / "2", ["detector=b"], 0.8, classes=1)
    job(tmp_path / "3", ["detector=a", "dataset=y"], 0.8, sequence="flat")
    (tmp_path / "4").mkdir()
    found = lines(write_detection_table(tmp_path, {"detector", "dataset"}, 100))
    assert sum("comparable" in line for line in found) == 1
    assert any(line.startswith("- Rows of room with different objects or classes are not comparable") for line in found)
    assert "- Jobs without result: 4." in found


def test_detection_table_without_ground_truth_has_counts_only(tmp_path: Path) -> None:
    job(tmp_path / "1", [], math.nan)
    found = lines(write_detection_table(tmp_path, set(), 100))
    assert "| 1 | room | 10 | 20 | 0 | 0 | – | – | – | – | – | – | 0.000 |" in found
    assert any(line.startswith("- –: the sequence has no ground-truth instances") for line in found)


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"overrides": "x"}'])
def test_detection_table_damaged_metrics_raise(tmp_path: Path, content: str) -> None:
    (tmp_path / "1").mkdir()
    (tmp_path / "1" / METRICS).write_text(content)
    with pytest.raises(DataError, match=METRICS):
        write_detection_table(tmp_path, set(), 100)


def test_detection_table_without_jobs_raises(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected a completed job, got none"):
        write_detection_table(tmp_path, set(), 100)

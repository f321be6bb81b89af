"""Tests for the calibrated probabilities of instances."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from framework.errors import DataError
from framework.mapping.instances.instance_calibration import InstanceCalibration, InstanceFeatures, logit
from framework.mapping.instances.instance_table import InstanceTable
from framework.mapping.instances.viewing import Viewing
from framework.mapping.storage.map_file import plain_table, table_arrays, table_of
from framework.mapping.storage.map_header import MapHeader

EVEN = InstanceFeatures(confidence=0.5, observations=1, score=0.5, outline=0.5, class_probability=0.5)


def test_probabilities_match_manual_result():
    calibration = InstanceCalibration((0.5, 1.0, 4.0), (-1.0, 2.0, 0.0), (0.6, 0.2))
    found = calibration.probabilities(EVEN._replace(confidence=0.8, observations=3, class_probability=0.9))
    assert found.exists == pytest.approx(1 / (1 + math.exp(-(0.5 + math.log(4) + 4 * math.log(3)))))
    assert found.class_probability == pytest.approx(1 / (1 + math.exp(1 - 2 * math.log(9))))
    assert found.expected_iou == pytest.approx(0.7)


def test_probabilities_of_extreme_features_are_finite():
    extreme = InstanceFeatures(confidence=1.0, observations=10**6, score=0.0, outline=0.0, class_probability=1.0)
    found = InstanceCalibration((100.0,) * 3, (100.0,) * 3, (100.0,) * 2).probabilities(extreme)
    assert all(0.0 <= value <= 1.0 for value in found)
    assert (logit(0.0), logit(1.0)) == pytest.approx((math.log(0.01 / 0.99), math.log(0.99 / 0.01)))


def test_calibration_file_round_trip_is_exact(tmp_path: Path):
    path = tmp_path / "net.calibration.json"
    calibration = InstanceCalibration(exists=(0.1, 0.2, 0.3))
    path.write_text(json.dumps(asdict(calibration)))
    assert InstanceCalibration.read(path) == calibration


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"exists": [0.0]}, "calibration.exists: expected 3 numbers"),
        ({"exists": [0.0, 1.0, 1e9]}, "calibration.exists: expected 3 numbers"),
        ({"class_probability": ["a", 1, 2]}, "class_probability: expected a list of numbers"),
        ({"other": [1.0]}, "expected the keys exists, class_probability, expected_iou"),
    ],
)
def test_calibration_file_with_invalid_values_raises(tmp_path: Path, change: dict[str, object], message: str):
    path = tmp_path / "net.calibration.json"
    path.write_text(json.dumps(asdict(InstanceCalibration()) | change))
    with pytest.raises(DataError, match=message):
        InstanceCalibration.read(path)


def observed(frames: int, views: int, logarithmic: bool = True) -> float:
    """Return the discounted class probability after detections with a class probability of 0.6."""
    table = InstanceTable(logarithmic=logarithmic)
    record = table.create(2, 0)
    for frame in range(frames):
        evidence = np.array([0.6, 0.4])
        table.observe(record.id, np.log(evidence) if logarithmic else evidence, 0.8, frame)
        table.see([record.id], frame)
    record.viewing.views = views
    return table.discounted_class_probability(record, record.class_evidence)


def test_class_evidence_of_one_view_counts_once():
    assert observed(frames=1, views=1) == pytest.approx(0.6)
    assert observed(frames=1000, views=1) == pytest.approx(0.6)


def test_class_evidence_of_two_views_counts_twice():
    assert observed(frames=1000, views=2) == pytest.approx(0.36 / (0.36 + 0.16))


def test_class_evidence_of_many_views_counts_each_detection_once():
    assert observed(frames=3, views=50) == pytest.approx(0.6**3 / (0.6**3 + 0.4**3))


def test_class_votes_are_not_discounted():
    assert observed(frames=1000, views=1, logarithmic=False) == pytest.approx(0.6)


def test_map_file_keeps_calibration_and_views():
    table = InstanceTable()
    record = table.create(2, 0)
    table.observe(record.id, np.log(np.array([0.6, 0.4])), 0.8, 0)
    record.viewing = Viewing(3, 2, 1.5, 1, (0.0, 1.0, 2.0), (0.5, 0.0, 0.0))
    table.calibration = InstanceCalibration(exists=(0.1, 0.2, 0.3))
    header = MapHeader.of(json.loads(json.dumps(plain_table(table))))
    again = table_of(header, 2, table_arrays(table, 2))
    assert (again.calibration, again.records[1].viewing) == (table.calibration, record.viewing)
    assert again.probabilities(again.records[1], record.class_evidence) == table.probabilities(
        record, record.class_evidence
    )


def test_map_file_with_invalid_views_raises():
    table = InstanceTable()
    table.create(2, 0)
    plain = plain_table(table)
    plain["instances"][0]["viewing"]["camera"] = [0.0, 1.0]
    with pytest.raises(DataError, match=r"viewing\.camera: expected three numbers, got"):
        table_of(MapHeader.of(json.loads(json.dumps(plain))), 2, table_arrays(table, 2))

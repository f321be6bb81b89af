"""Tests for the files with the calibrations of networks."""

from __future__ import annotations

from pathlib import Path

from framework.detection.calibration_files import LEARNED, calibration_of
from framework.mapping.instances.instance_calibration import InstanceCalibration


def test_calibration_next_to_weights_is_found_first(tmp_path: Path) -> None:
    own = tmp_path / "yolo11n_seg.calibration.json"
    assert calibration_of(tmp_path / "yolo11n_seg.onnx") == LEARNED / own.name
    own.write_text("{}")
    assert calibration_of(tmp_path / "yolo11n_seg.onnx") == own


def test_network_without_calibration_has_none(tmp_path: Path) -> None:
    assert calibration_of(tmp_path / "unknown.onnx") is None


def test_calibrations_of_this_project_are_valid() -> None:
    paths = sorted(LEARNED.glob("*.calibration.json"))
    assert [path.name.partition(".")[0] for path in paths] == ["maskrcnn2go_int8", "yolo11n_seg"]
    assert len({InstanceCalibration.read(path) for path in paths} | {InstanceCalibration()}) == 3

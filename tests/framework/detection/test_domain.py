"""Tests for the warning that a detector was trained on another kind of image."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from framework.api import Mapper
from framework.commands.running.detect import write_detections
from framework.commands.running.show_refinement import detected
from framework.datasets.scenenn.scenenn import MADE_BY, SceneNN
from framework.detection.domain import RENDERED_ROOMS
from framework.detection.stored.cache import CachedDetector
from framework.interfaces import Detector, RGBDSequence
from framework.pipeline import Pipeline
from framework.synthetic.sequence import Synthetic
from tests.support import option_files, registered
from tests.support.scenes.corner_room import CornerRoom, GivenPose, GridFuser, KeepAll, SphereDetector

WARNING_TEXT = "trained on rendered rooms only"


@dataclass
class OfRooms(SphereDetector):
    domain = RENDERED_ROOMS


@dataclass
class RenderedCorner(CornerRoom):
    domain = RENDERED_ROOMS


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


def mapped(detector: Detector, sequence: RGBDSequence) -> None:
    Pipeline(detector, GivenPose(), KeepAll(), GridFuser()).run(sequence)


def test_domain_mismatch_in_run_warns_once_with_fix(caplog: pytest.LogCaptureFixture) -> None:
    mapped(OfRooms(), CornerRoom())
    [line] = warnings(caplog)
    assert WARNING_TEXT in line
    assert "corner_room" in line
    assert line.endswith("use detector=maskrcnn2go")
    assert "\n" not in line


@pytest.mark.parametrize(
    ("detector", "sequence"), [(OfRooms(), RenderedCorner()), (SphereDetector(), CornerRoom())], ids=["rooms", "any"]
)
def test_domain_match_in_run_does_not_warn(
    detector: Detector, sequence: RGBDSequence, caplog: pytest.LogCaptureFixture
) -> None:
    mapped(detector, sequence)
    assert warnings(caplog) == []


def test_domain_mismatch_in_detection_commands_warns(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_detections(tmp_path / "found.json", OfRooms(), CornerRoom())
    assert [WARNING_TEXT in line for line in warnings(caplog)] == [True]
    caplog.clear()
    detected(CornerRoom(), OfRooms(), None)
    assert [WARNING_TEXT in line for line in warnings(caplog)] == [True]
    caplog.clear()
    write_detections(tmp_path / "found.json", OfRooms(), RenderedCorner())
    detected(RenderedCorner(), OfRooms(), 0)
    assert warnings(caplog) == []


@pytest.mark.parametrize(("choice", "lines"), [(["detector=mask_rcnn_rooms"], 1), ([], 0)])
def test_domain_unknown_for_mapper_frames_warns(
    choice: list[str], lines: int, caplog: pytest.LogCaptureFixture
) -> None:
    mapper = Mapper(*choice, "device=cpu", "tracker=ground_truth", "refiner=identity", "fuser.voxel_size=0.04")
    for frame in CornerRoom(frames=2):
        mapper.add(frame)
    assert [WARNING_TEXT in line for line in warnings(caplog)] == [True] * lines


def test_domain_is_set_only_by_rooms_detector(ready: Callable[[str, str], Any], tmp_path: Path) -> None:
    rooms = registered.built("detector", "mask_rcnn_rooms", "device=cpu")
    assert rooms.domain == RENDERED_ROOMS
    assert CachedDetector(rooms, tmp_path).domain == RENDERED_ROOMS
    for name in ("mask_rcnn", "maskrcnn2go", "simulated", "ground_truth"):
        assert ready("detector", name).domain == ""
    assert CachedDetector(SphereDetector(), tmp_path).domain == ""


def test_domain_of_dataset_marks_rendered_images(tmp_path: Path) -> None:
    """Folders of `synthesize` are marked as rendered. Original SceneNN folders are not."""
    assert Synthetic.domain == RENDERED_ROOMS
    option_files.overrides("dataset", "scenenn", tmp_path)
    assert SceneNN(tmp_path).domain == ""
    (tmp_path / MADE_BY).write_text("{}")  # content is tested in tests/framework/synthetic/test_scene_writers.py
    assert SceneNN(tmp_path).domain == RENDERED_ROOMS

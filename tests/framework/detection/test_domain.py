"""A network that knows rendered rooms alone says so, once, wherever it is shown something else."""

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
from framework.detection.domain import RENDERED_ROOMS, domain_of
from framework.detection.stored.cache import CachedDetector
from framework.interfaces import Detector, RGBDSequence
from framework.pipeline import Pipeline
from framework.synthetic.sequence import Synthetic
from tests.support import option_files, registered
from tests.support.scenes.corner_room import CornerRoom, GivenPose, GridFuser, KeepAll, SphereDetector

SAID = "trained on rendered rooms alone"


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


def test_a_run_warns_once_in_one_line_that_says_what_to_use(caplog: pytest.LogCaptureFixture) -> None:
    mapped(OfRooms(), CornerRoom())
    [line] = warnings(caplog)
    assert SAID in line
    assert "corner_room" in line
    assert line.endswith("use detector=maskrcnn2go")
    assert "\n" not in line


@pytest.mark.parametrize(
    ("detector", "sequence"), [(OfRooms(), RenderedCorner()), (SphereDetector(), CornerRoom())], ids=["rooms", "any"]
)
def test_nothing_is_said_where_the_pictures_fit(
    detector: Detector, sequence: RGBDSequence, caplog: pytest.LogCaptureFixture
) -> None:
    mapped(detector, sequence)
    assert warnings(caplog) == []


def test_the_commands_that_only_detect_warn_too(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_detections(tmp_path / "found.json", OfRooms(), CornerRoom())
    assert [SAID in line for line in warnings(caplog)] == [True]
    caplog.clear()
    detected(CornerRoom(), OfRooms(), None)
    assert [SAID in line for line in warnings(caplog)] == [True]
    caplog.clear()
    write_detections(tmp_path / "found.json", OfRooms(), RenderedCorner())
    detected(RenderedCorner(), OfRooms(), 0)
    assert warnings(caplog) == []


@pytest.mark.parametrize(("choice", "lines"), [(["detector=mask_rcnn_rooms"], 1), ([], 0)])
def test_a_mapper_warns_since_it_does_not_know_the_frames(
    choice: list[str], lines: int, caplog: pytest.LogCaptureFixture
) -> None:
    mapper = Mapper(*choice, "device=cpu", "tracker=ground_truth", "refiner=identity", "fuser.voxel_size=0.04")
    for frame in CornerRoom(frames=2):
        mapper.add(frame)
    assert [SAID in line for line in warnings(caplog)] == [True] * lines


def test_the_network_of_the_rooms_is_for_rendered_rooms_and_the_others_are_for_all(
    ready: Callable[[str, str], Any], tmp_path: Path
) -> None:
    rooms = registered.built("detector", "mask_rcnn_rooms", "device=cpu")
    assert domain_of(rooms) == RENDERED_ROOMS
    assert domain_of(CachedDetector(rooms, tmp_path)) == RENDERED_ROOMS
    for name in ("mask_rcnn", "maskrcnn2go", "simulated", "ground_truth"):
        assert domain_of(ready("detector", name)) == ""
    assert domain_of(CachedDetector(SphereDetector(), tmp_path)) == ""


def test_a_dataset_knows_whether_it_was_rendered(tmp_path: Path) -> None:
    """What `synthesize` writes says so; a folder of SceneNN itself does not."""
    assert Synthetic.domain == RENDERED_ROOMS
    option_files.overrides("dataset", "scenenn", tmp_path)
    assert SceneNN(tmp_path).domain == ""
    (tmp_path / MADE_BY).write_text("{}")  # tests/framework/synthetic/test_scene_writers.py: as it is written
    assert SceneNN(tmp_path).domain == RENDERED_ROOMS

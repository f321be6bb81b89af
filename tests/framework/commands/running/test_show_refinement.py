"""Tests for the command `show-refinement`."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from PIL import Image

from framework.commands.running.show_refinement import CANDIDATES, called, detected
from framework.data import Detections, Frame
from framework.errors import ConfigError, DataError, FrameError
from tests.support.forked_commands import FAKE_CONF, completed
from tests.support.scenes.corner_room import CornerRoom, SphereDetector

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[4]


def start(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    fakes = ["--config-dir", str(FAKE_CONF), "detector=fake", "dataset=fake"]
    return completed(directory, "show-refinement", *fakes, *arguments)


def test_show_refinement_draws_one_frame(tmp_path: Path) -> None:
    done = start(tmp_path, "refiner=largest_component", "frame=2", "out=refinement.png")
    assert done.returncode == 0, done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["refinement.png"]
    assert Image.open(tmp_path / "refinement.png").width > 1500
    assert "refinement.png: 2 detections in frame 2 of corner_room" in done.stderr


def test_show_refinement_without_detections_draws_frame(tmp_path: Path) -> None:
    done = start(tmp_path, "refiner=gmm_em", "detector=none", "out=refinement.png")
    assert done.returncode == 0, done.stderr
    assert "no detections to refine" in done.stderr
    assert (tmp_path / "refinement.png").exists()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ([], "out: expected a file name, got none; set out=refinement.png"),
        (["out=absent/refinement.png"], "out: expected an existing parent folder, got none"),
        (["out=refinement.jpg"], "out: expected a name with the suffix .png, got refinement.jpg"),
        (["out=r.png", "frame=6"], "frame: expected a position in [0, 5] among the selected frames of"),
        (["out=r.png", "frame=1", "dataset.unreadable=1"], "frame 1: depth/000001.png is truncated"),
    ],
)
def test_show_refinement_errors_are_one_line(tmp_path: Path, overrides: list[str], message: str) -> None:
    done = start(tmp_path, *overrides)
    assert done.returncode == 1
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert not list(tmp_path.iterdir())


class FoundOnlyIn(SphereDetector):
    """Detector that finds both spheres in one frame and nothing in the other frames."""

    def __init__(self, index: int) -> None:
        super().__init__()
        self.index = index

    def detect(self, frame: Frame) -> Detections:
        found = super().detect(frame)
        return found if frame.index == self.index else Detections.none(frame.camera.shape, self.classes)


def test_show_refinement_default_frame_has_most_detections() -> None:
    position, frame, found = detected(CornerRoom(), FoundOnlyIn(4), None)
    assert (position, frame.index, len(found)) == (4, 4, 2)
    position, _, _ = detected(CornerRoom(), SphereDetector(), None)
    assert position == 0, "expected the first of the frames with equally many detections"
    position, frame, found = detected(CornerRoom(frames=60, start=2, stride=2), FoundOnlyIn(2), None)
    assert (position, frame.index, len(found)) == (0, 2, 2)


def test_show_refinement_skips_unusable_frames() -> None:
    position, _, _ = detected(CornerRoom(unreadable=0), SphereDetector(), None)
    assert position == 1
    with pytest.raises(FrameError, match="truncated"):
        detected(CornerRoom(unreadable=0), SphereDetector(), 0)
    with pytest.raises(DataError, match="expected a usable frame, got none among 1 candidates"):
        detected(CornerRoom(frames=1, unreadable=0), SphereDetector(), None)


@pytest.mark.parametrize("position", [-1, 6, "first", 1.0, True])
def test_show_refinement_invalid_position_raises(position: object) -> None:
    with pytest.raises(ConfigError, match=r"frame: expected a position in \[0, 5\] among the selected frames"):
        detected(CornerRoom(), SphereDetector(), position)


def test_show_refinement_tries_few_frames_of_long_video() -> None:
    class Counted(SphereDetector):
        calls = 0

        def detect(self, frame: Frame) -> Detections:
            Counted.calls += 1
            return super().detect(frame)

    detected(CornerRoom(frames=1000), Counted(), None)
    assert Counted.calls == CANDIDATES


def test_called_returns_refiner_overrides() -> None:
    overrides = ["refiner=chain", "refiner.links.gmm_em=null", "refiner@refiner.links.x=kmeans", "frame=3", "seed=1"]
    assert called("chain", overrides) == "refiner=chain refiner.links.gmm_em=null refiner@refiner.links.x=kmeans"
    added = "+refiner@refiner.links.last=largest_component"
    assert called("chain", [added, "~refiner.links.gmm_em", "seed=1"]) == f"refiner=chain {added} ~refiner.links.gmm_em"
    assert called("gmm_em", []) == "refiner=gmm_em"

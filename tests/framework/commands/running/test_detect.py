"""Tests for the command `detect`."""

from __future__ import annotations

import csv
import json
import re
import shlex
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from framework.commands.running.detect import file_of_job, write_detections
from framework.config.text_values import literal
from framework.data import Frame
from framework.datasets.ground_truth.labeled_mesh import unseen
from framework.errors import ConfigError, DataError
from framework.registry import text_kind
from plugins.detectors.none import NoDetections
from plugins.detectors.precomputed import Precomputed
from tests.support.forked_commands import FAKE_CONF, completed
from tests.support.scenes.corner_room import CornerRoom, SphereDetector

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[4]


def start(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    fakes = ["--config-dir", str(FAKE_CONF), "detector=fake", "dataset=fake"]
    return completed(directory, "detect", *fakes, *arguments)


def test_detect_output_is_read_by_precomputed(tmp_path: Path) -> None:
    done = start(tmp_path, "dataset.unreadable=1", "out=found.json")
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["found.json", "found.labels.txt"]
    assert "frame skipped: frame 1" in done.stderr
    assert "10 detections in 5 frames of corner_room" in done.stderr
    assert "mask AP50 1.00, mask AP 1.00 (mean of 2 classes, 10 ground-truth objects of at least" in done.stderr
    assert "box AP50 1.00, box AP 1.00" in done.stderr
    message = dict(re.findall(r"INFO +(.*?)  +(\S+)$", done.stderr, re.MULTILINE))
    assert (message["found"], message["mask IoU"], message["correct class"], message["false detections per image"]) == (
        *("1.00", "1.00", "1.00", "0.00"),
    )
    how = done.stderr.split("use the file with: ")[1].split()
    path, labels = (argument.split("=")[1] for argument in how[1:])
    detector = Precomputed(Path(path), label_space=labels)
    assert [len(detector.detect(frame)) for frame in CornerRoom()] == [2, 0, 2, 2, 2, 2]


def test_detect_output_is_read_by_pycocotools(tmp_path: Path) -> None:
    from pycocotools.coco import COCO

    path = tmp_path / "found.json"
    write_detections(path, SphereDetector(), CornerRoom())
    truth = COCO()
    truth.dataset = {
        "info": {},
        "images": [{"id": k, "height": 72, "width": 96} for k in range(6)],
        "annotations": [],
        "categories": [{"id": 1, "name": "chair"}, {"id": 2, "name": "couch"}],
    }
    truth.createIndex()
    results = truth.loadRes(str(path))
    assert len(results.anns) == 12
    masks = SphereDetector().detect(CornerRoom()[0]).masks
    assert results.annToMask(results.loadAnns(results.getAnnIds(imgIds=[0]))[1]).sum() == masks[1].sum()


def test_detect_sweep_writes_file_per_job_and_table(tmp_path: Path) -> None:
    detectors = ["dataset=fake", "detector=fake,none,faulty", "out=found.json"]
    done = completed(tmp_path, "detect", "-m", "--config-dir", str(FAKE_CONF), *detectors, "hydra.sweep.dir=sweep")
    assert done.returncode == 1, done.stderr
    jobs = [tmp_path / "sweep" / f"dataset=fake,detector={name}" for name in ("fake", "none")]
    assert [len(json.loads((job / "found.json").read_text())) for job in jobs] == [12, 0]
    assert (jobs[0] / "found.labels.txt").read_text() == "chair\ncouch\n"
    assert [path.name for path in tmp_path.iterdir()] == ["sweep"]
    text = (tmp_path / "sweep" / "table.md").read_text()
    assert text in done.stdout
    lines = [" ".join(line.split()) for line in text.splitlines()]
    exact, empty = " | ".join(["1.000"] * 6), " | ".join(["0.000"] * 5)
    assert f"| detector=fake | corner_room | 6 | 12 | 12 | 2 | {exact} | 0.000 |" in lines
    assert f"| detector=none | corner_room | 6 | 0 | 12 | 2 | {empty} | – | 0.000 |" in lines
    assert "- Jobs without result: dataset=fake,detector=faulty." in lines
    assert "not comparable" not in text
    with (tmp_path / "sweep" / "table.csv").open() as file:
        fake, none = csv.DictReader(file)
    assert fake["overrides"] == "dataset=fake detector=fake out=found.json"
    assert (fake["mask_ap50.couch"], none["correct class"]) == ("1.0", "")
    [how] = [line for line in done.stderr.splitlines() if "use the file with: " in line and "label_space" in line]
    words = literal(shlex.split(how.partition("use the file with: ")[2]), text_kind)
    arguments = OverridesParser.create().parse_overrides(words)
    values = {argument.key_or_group: argument.value() for argument in arguments}
    assert values["detector.path"] == str(jobs[0] / "found.json")
    assert values["detector.label_space"] == str(jobs[0] / "found.labels.txt")


@pytest.mark.parametrize("out", ["sub/found.json", "/tmp/found.json", "../found.json"])
def test_detect_sweep_rejects_file_outside_job_folder(tmp_path: Path, out: str) -> None:
    with pytest.raises(ConfigError, match="out: expected a file name without a folder in a sweep, got "):
        file_of_job(out, tmp_path / "job")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ([], "out: expected a file name, got none; set out=detections.json"),
        (["out=absent/found.json"], "out: expected an existing parent folder, got none"),
        (["out=2024/[a,b]"], "out: expected an existing parent folder, got none"),
    ],
)
def test_detect_errors_are_one_line(tmp_path: Path, overrides: list[str], message: str) -> None:
    done = start(tmp_path, *overrides)
    assert done.returncode == 1
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert not list(tmp_path.iterdir())


def test_detect_failure_keeps_existing_file(tmp_path: Path) -> None:
    (tmp_path / "found.json").write_text("before")
    with pytest.raises(DataError, match="expected ground-truth instances"):
        write_detections(tmp_path / "found.json", SphereDetector(), CornerRoom(truth=False))
    with pytest.raises(DataError, match="expected usable frames, got none among 1"):
        write_detections(tmp_path / "found.json", SphereDetector(broken_at=0), CornerRoom(frames=1))
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("found.json", "before")]


def test_detect_without_detections_writes_valid_file(tmp_path: Path) -> None:
    class Nothing(SphereDetector):
        def detect(self, frame):  # type: ignore[no-untyped-def]
            found = super().detect(frame)
            return type(found).none(frame.camera.shape, self.classes)

    write_detections(tmp_path / "found.json", Nothing(), CornerRoom())
    assert json.loads((tmp_path / "found.json").read_text()) == []


@dataclass
class PartlyTrueRoom(CornerRoom):
    """A room in which frame 2 has no pose and therefore no ground-truth instances."""

    def __getitem__(self, k: int) -> Frame:
        frame = super().__getitem__(k)
        return replace(frame, truth=unseen(self.camera, "frame 2 has no pose")) if frame.index == 2 else frame


def test_detect_accepts_frame_without_rendered_truth(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_detections(tmp_path / "found.json", NoDetections(), PartlyTrueRoom())
    assert "frame skipped in the evaluation: frame 2 has no pose" in caplog.text
    with pytest.raises(DataError, match="expected usable frames, got none among 1"):
        write_detections(tmp_path / "found.json", SphereDetector(), PartlyTrueRoom(start=2, stop=3))

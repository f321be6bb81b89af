"""Tests for the detection cache."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from framework.commands.running.run import run
from framework.data import Detections, Frame, FrameTruth
from framework.datasets.ground_truth.labeled_mesh import LabeledMesh
from framework.detection.stored import cache
from framework.detection.stored.cache import (
    FRAME_FIELDS,
    CachedDetector,
    CacheMode,
    cache_metrics,
    frame_hash,
    identity_of,
    pack,
    unpack,
    with_cache,
)
from framework.detection.stored.fingerprint import fingerprint
from framework.errors import ConfigError, DataError, FrameError
from framework.files.search_paths import CONF
from framework.interfaces import Detector
from framework.rendering.rasterizer import Rasterizer
from framework.vocabulary.label_spaces import COCO
from plugins.detectors.simulated import SimulatedDetector
from tests.support import registered
from tests.support.scenes.corner_room import CAMERA, CLASSES, CornerRoom, SphereDetector

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[4]
FIELDS = ("masks", "boxes", "scores", "class_probabilities")


@dataclass
class Noise(Detector):
    """Detector that returns random masks and counts its calls. The seed is the color image and `strength`."""

    strength: float = 1.0
    broken_at: int = -1

    reads = ("color",)

    def __post_init__(self) -> None:
        self.classes = COCO
        self.asked = 0

    def detect(self, frame: Frame) -> Detections:
        if frame.index == self.broken_at:
            raise FrameError(f"frame {frame.index} is broken")
        self.asked += 1
        return random_detections(int(frame.color.sum()) + int(1000 * self.strength), frame.camera.shape)


def random_detections(seed: int, shape: tuple[int, int], n: int = 7) -> Detections:
    random = np.random.default_rng(seed)
    masks = np.zeros((n, *shape), np.bool_)
    for mask in masks[1:]:  # the first one is empty
        (y1, y2), (x1, x2) = (np.sort(random.integers(0, side + 1, 2)) for side in shape)
        mask[y1:y2, x1:x2] = random.random((y2 - y1, x2 - x1)) < random.random()
    masks[-1, 0, 0] = masks[-1, -1, -1] = True
    rows = random.random((n, len(COCO))).astype(np.float32)
    return Detections(
        masks=masks,
        boxes=random.normal(0, 100, (n, 4)).astype(np.float32),
        scores=np.sort(random.random(n).astype(np.float32))[::-1].copy(),
        class_probabilities=rows / rows.sum(axis=1, keepdims=True),
        classes=COCO,
        exact=bool(seed % 2),
    )


def assert_same(a: Detections, b: Detections) -> None:
    """Check that the arrays are byte-identical and have the same flags."""
    assert (a.classes, a.exact) == (b.classes, b.exact)
    for name in FIELDS:
        x, y = getattr(a, name), getattr(b, name)
        assert (x.dtype, x.shape) == (y.dtype, y.shape)
        assert x.tobytes() == y.tobytes(), name
        assert x.flags.writeable == y.flags.writeable
        assert y.flags.c_contiguous


@pytest.mark.parametrize("seed", range(4))
def test_cache_entry_round_trip_is_bit_exact(seed: int) -> None:
    before = random_detections(seed, (37, 53))
    assert_same(before, unpack(pack(before), COCO))


def test_cache_entry_without_detections_round_trips() -> None:
    before = Detections.none((37, 53), COCO)
    assert_same(before, unpack(pack(before), COCO))


def test_cache_entry_optional_embeddings_round_trip() -> None:
    before = random_detections(1, (37, 53))
    embedded = replace(before, embeddings=np.eye(7, 5, dtype=np.float32), embedding_space="words@1 \N{SNOWMAN}")
    after = unpack(pack(embedded), COCO)
    assert_same(before, after)
    assert (after.embedding_space, after.embeddings is not None) == (embedded.embedding_space, True)
    np.testing.assert_array_equal(after.embeddings, embedded.embeddings)
    assert unpack(pack(before), COCO).embeddings is None
    assert b"embedding" not in pack(before)


def test_cache_second_run_does_not_call_detector(room: CornerRoom, tmp_path: Path) -> None:
    first = CachedDetector(Noise(), tmp_path)
    plain = [Noise().detect(frame) for frame in room]
    for frame, expected in zip(room, plain, strict=True):
        assert_same(expected, first.detect(frame))
    assert cache_metrics(first) == {"detection_cache.hits": 0, "detection_cache.misses": 6}
    second = CachedDetector(Noise(), tmp_path)
    for k in reversed(range(6)):
        assert_same(plain[k], second.detect(room[k]))
    assert isinstance(second.detector, Noise)
    assert second.detector.asked == 0
    assert cache_metrics(second) == {"detection_cache.hits": 6, "detection_cache.misses": 0}
    assert not list(tmp_path.rglob(".*")), "expected no temporary files"


@pytest.mark.parametrize("changed", [Noise(strength=2.0), SphereDetector()], ids=["parameter", "class"])
def test_cache_with_other_detector_misses(room: CornerRoom, tmp_path: Path, changed: Detector) -> None:
    CachedDetector(Noise(), tmp_path).detect(room[0])
    other = CachedDetector(changed, tmp_path)
    other.detect(room[0])
    assert (other.hits, other.misses) == (0, 1)


@dataclass
class Named(Noise):
    """Detector whose fingerprint includes the revision of its weights."""

    revision: str = "main"

    def fingerprint(self) -> str:
        return f"{fingerprint(self)} {self.revision}"


@dataclass
class OldNamed(Noise):
    """Detector for an older interface, in which the base class has a method `fingerprint`."""

    def fingerprint(self) -> str:
        return f"{super().fingerprint()} main"  # type: ignore[misc]


def test_cache_identity_uses_detector_fingerprint(tmp_path: Path) -> None:
    """The fingerprint and the read fields are optional attributes of a detector."""
    assert not {"reads", "fingerprint"} & set(dir(Detector))
    silent = SphereDetector()
    assert identity_of(silent) == fingerprint(silent)
    assert CachedDetector(silent, tmp_path).reads == FRAME_FIELDS
    assert identity_of(Named()) == f"{fingerprint(Named())} main"
    assert CachedDetector(Named(), tmp_path).reads == ("color",)
    with pytest.raises(ConfigError, match=r"OldNamed.* call fingerprint\(\) of framework"):
        CachedDetector(OldNamed(), tmp_path)


def test_cache_with_other_weights_misses(room: CornerRoom, tmp_path: Path) -> None:
    weights = tmp_path / "weights"
    counts = []
    for content in (b"1", b"1", b"2"):
        weights.write_bytes(content)
        detector = CachedDetector(Weighted(weights=weights), tmp_path / "cache")
        detector.detect(room[0])
        counts.append(detector.hits)
    assert counts == [0, 1, 0]


@dataclass
class Weighted(Noise):
    """Detector with a weights file."""

    weights: Path = Path()


def test_frame_hash_covers_fields_read_by_detector(room: CornerRoom) -> None:
    frame = room[0]
    assert frame.truth is not None
    color, depth = frame.color.copy(), frame.depth.copy()
    color[3, 4, 1] ^= 1
    depth[3, 4] += 1e-6
    ids = frame.truth.instance_ids.copy()
    ids[0, 0] += 1
    changed = {
        "index": replace(frame, index=1),
        "timestamp": replace(frame, timestamp=1e-9),
        "color": replace(frame, color=color),
        "depth": replace(frame, depth=depth),
        "camera": replace(frame, camera=replace(CAMERA, fx=90.0001)),
        "T_world_camera": replace(frame, T_world_camera=None),
        "truth": replace(frame, truth=FrameTruth(ids, frame.truth.class_names)),
        "class names of the ground truth": replace(
            frame, truth=FrameTruth(frame.truth.instance_ids, {1: None, 2: "couch"})
        ),
        "no truth": replace(frame, truth=None),
    }
    assert len({frame_hash(other, FRAME_FIELDS) for other in (frame, *changed.values())}) == len(changed) + 1
    for name, other in changed.items():
        assert (frame_hash(other, ("color",)) == frame_hash(frame, ("color",))) == (name != "color")


def mesh(**changes: Any) -> LabeledMesh:
    vertices = np.array([[-1, -1, 2], [1, -1, 2], [0, 1, 2]], np.float32)
    parts = {
        "vertices": vertices,
        "triangles": np.array([[0, 1, 2]], np.int32),
        "instance_ids": np.full(3, 5, np.int32),
        "class_names": {5: "chair"},
    }
    return LabeledMesh(**(parts | changes))


def test_cache_mesh_truth_hit_skips_rendering(
    room: CornerRoom, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame, T = room[0], np.eye(4)
    aside = T.copy()
    aside[0, 3] = 1e-12
    moved = mesh().vertices + np.float32(1e-6)
    truths = [
        mesh().seen_by(CAMERA, T),
        mesh(vertices=moved).seen_by(CAMERA, T),
        mesh(triangles=np.array([[1, 2, 0]], np.int32)).seen_by(CAMERA, T),
        mesh(instance_ids=np.array([5, 5, 0], np.int32)).seen_by(CAMERA, T),
        mesh(class_names={5: "couch"}).seen_by(CAMERA, T),
        mesh().seen_by(replace(CAMERA, fx=50.0), T),
        mesh().seen_by(CAMERA, aside),
    ]
    assert len({frame_hash(replace(frame, truth=truth), ("truth",)) for truth in truths}) == len(truths)

    detector = SimulatedDetector(min_pixels=1)
    labeled = replace(frame, truth=truths[0])
    expected = CachedDetector(detector, tmp_path).detect(labeled)
    assert_same(expected, detector.detect(replace(frame, truth=FrameTruth(truths[0].instance_ids, {5: "chair"}))))
    monkeypatch.setattr(Rasterizer, "draw", lambda *_: pytest.fail("expected a hit without rendering"))
    cached = CachedDetector(detector, tmp_path)
    assert_same(expected, cached.detect(replace(frame, truth=mesh().seen_by(CAMERA, T))))
    assert cached.hits == 1
    Noise().detect(replace(frame, truth=mesh().seen_by(CAMERA, T)))


def test_cache_unknown_read_field_raises(tmp_path: Path) -> None:
    detector = Noise()
    detector.reads = ("colour",)
    with pytest.raises(ConfigError, match=r"Noise\.reads.*colour"):
        CachedDetector(detector, tmp_path)


@pytest.mark.parametrize("name", registered.names("detector"))
def test_detectors_read_only_declared_frame_fields(
    name: str, ready: Callable[..., Detector], room: CornerRoom, tmp_path: Path
) -> None:
    """If a detector read other fields, the cache could return the detections of another frame."""
    detector = ready("detector", name)
    frame = room[1]
    others = {
        "index": 7,
        "timestamp": 9.0,
        "color": np.zeros_like(frame.color),
        "depth": np.full_like(frame.depth, 2.0),
        "camera": replace(CAMERA, fx=50.0),
        "T_world_camera": np.eye(4),
        "truth": None,
    }
    reads = CachedDetector(detector, tmp_path).reads
    unread = replace(frame, **{key: value for key, value in others.items() if key not in reads})
    assert_same(detector.detect(frame), detector.detect(unread))


@pytest.mark.parametrize("damage", ["truncated", "empty", "flipped", "another frame's"])
def test_cache_damaged_entry_is_replaced(
    room: CornerRoom, tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: str
) -> None:
    expected = CachedDetector(Noise(), tmp_path).detect(room[0])
    [entry] = tmp_path.rglob("*.detections")
    data = bytearray(entry.read_bytes())
    data[len(data) // 2] ^= 1
    CachedDetector(Noise(), tmp_path / "other").detect(room[1])
    [other] = (tmp_path / "other").rglob("*.detections")
    entry.write_bytes(
        {
            "truncated": bytes(data[:-9]),
            "empty": b"",
            "flipped": bytes(data),
            "another frame's": other.read_bytes(),
        }[damage]
    )
    detector = CachedDetector(Noise(), tmp_path)
    assert_same(expected, detector.detect(room[0]))
    assert (detector.hits, detector.misses) == (0, 1)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert str(entry) in caplog.text
    assert_same(expected, detector.detect(room[0]))
    assert detector.hits == 1


@pytest.mark.parametrize("make", [os.mkfifo, Path.mkdir, lambda path: path.symlink_to("nothing")])
def test_cache_non_regular_entry_is_ignored_with_warning(
    room: CornerRoom, tmp_path: Path, caplog: pytest.LogCaptureFixture, make: Callable[[Path], None]
) -> None:
    expected = CachedDetector(Noise(), tmp_path).detect(room[0])
    [entry] = tmp_path.rglob("*.detections")
    entry.unlink()
    make(entry)
    assert_same(expected, CachedDetector(Noise(), tmp_path).detect(room[0]))
    assert f"{entry}" in caplog.records[0].message
    assert "detection cache:" in caplog.records[0].message


def test_cache_read_only_writes_nothing(room: CornerRoom, tmp_path: Path) -> None:
    absent = tmp_path / "absent"
    detector = CachedDetector(Noise(), absent, CacheMode.READ_ONLY)
    detector.detect(room[0])
    assert (detector.misses, absent.exists()) == (1, False)
    CachedDetector(Noise(), tmp_path).detect(room[0])
    before = sorted(tmp_path.rglob("*"))
    detector = CachedDetector(Noise(), tmp_path, CacheMode.READ_ONLY)
    for frame in room:
        detector.detect(frame)
    assert (detector.hits, detector.misses) == (1, 5)
    assert sorted(tmp_path.rglob("*")) == before


def test_cache_full_disk_disables_storing_with_warning(
    room: CornerRoom, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, **_: object) -> Any:
        raise DataError(f"{path} could not be written: No space left on device")

    monkeypatch.setattr(cache, "atomic_write", full)
    detector = CachedDetector(Noise(), tmp_path)
    for frame in room:
        detector.detect(frame)
    assert detector.misses == 6
    assert len(caplog.records) == 1
    assert "No space left on device; storing no more detections in this run" in caplog.text


def test_cache_unusable_folder_raises(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"detection_cache_dir: .*choose another folder"):
        CachedDetector(Noise(), tmp_path / "file")


def test_cache_frame_error_is_not_stored(room: CornerRoom, tmp_path: Path) -> None:
    detector = CachedDetector(Noise(broken_at=0), tmp_path)
    for _ in range(2):
        with pytest.raises(FrameError, match="frame 0 is broken"):
            detector.detect(room[0])
    assert cache_metrics(detector) == {"detection_cache.hits": 0, "detection_cache.misses": 0}


FILL = """
import sys, time
from pathlib import Path
from framework.detection.stored.cache import CachedDetector
from tests.support.scenes.corner_room import CornerRoom, SphereDetector

folder = Path(sys.argv[1])
(folder / sys.argv[2]).touch()
while len(list(folder.glob("ready*"))) < 2:
    time.sleep(0.001)
for k in range(9):  # remove some entries so that both processes write again, except in the last round
    detector = CachedDetector(SphereDetector(), folder / "cache")
    for frame in CornerRoom():
        detector.detect(frame)
        if frame.index % 2 and k < 8:
            for entry in list(detector.entries.glob("*.detections"))[:1]:
                entry.unlink(missing_ok=True)
"""


def test_cache_folder_is_shared_by_two_processes(tmp_path: Path) -> None:
    line = [sys.executable, "-c", FILL, str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(CHECKOUT)}
    both = [
        subprocess.Popen([*line, name], env=environment, stderr=subprocess.PIPE, text=True)
        for name in ("ready1", "ready2")
    ]
    for process in both:
        _, output = process.communicate(timeout=120)
        assert process.returncode == 0, output
        assert "damaged" not in output
    detector = CachedDetector(SphereDetector(), tmp_path / "cache")
    for frame in CornerRoom():
        assert_same(SphereDetector().detect(frame), detector.detect(frame))
    assert detector.hits == len(CornerRoom())
    assert not list(tmp_path.rglob(".*"))


# Cache settings in the config


def config(*overrides: str) -> DictConfig:
    stages = ("dataset", "detector", "tracker", "refiner", "fuser")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        composed = compose("config", overrides=list(overrides))
    for stage in stages:
        node = (CHECKOUT / "tests" / "support" / "fake_conf" / stage / "fake.yaml").read_text()
        composed[stage] = DictConfig({"_target_": node.split()[1]})
    return composed


@pytest.mark.parametrize("off", ["off", "false", '"off"'])
def test_cache_off_returns_detector_itself(off: str) -> None:
    detector = Noise()
    assert with_cache(detector, config(f"detection_cache={off}")) is detector
    assert with_cache(detector, config()) is detector
    assert cache_metrics(detector) == {}


@pytest.mark.parametrize("chosen", ["7", "[a]", "''"])
def test_cache_invalid_folder_option_raises(chosen: str) -> None:
    with pytest.raises(
        ConfigError, match=r"detection_cache_dir: expected a path \(in quotes if it looks like a number\)"
    ):
        with_cache(Noise(), config("detection_cache=read_write", f"detection_cache_dir={chosen}"))


def test_cache_unknown_mode_raises() -> None:
    with pytest.raises(ConfigError, match="detection_cache: expected one of off, read_write, read_only, got 'on'"):
        with_cache(Noise(), config("detection_cache=on"))


def test_cache_default_folder_is_user_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    detector = with_cache(Noise(), config("detection_cache=read_write"))
    assert isinstance(detector, CachedDetector)
    assert detector.directory == tmp_path / "instancemap" / "detections"


@pytest.mark.usefixtures("fakes_registered")
@pytest.mark.usefixtures("fakes_registered")
def test_run_with_cache_is_identical_to_run_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    detect = SphereDetector.detect
    monkeypatch.setattr(SphereDetector, "detect", lambda self, frame: asked.append(frame.index) or detect(self, frame))
    monkeypatch.setattr("framework.runs.run_directory.write_overview", lambda path, *_: path.write_bytes(b""))
    counted, records = [], []
    for k, mode in enumerate(("off", "read_write", "read_write", "read_only")):
        asked.clear()
        directory = tmp_path / str(k)
        run(config(f"detection_cache={mode}", f"detection_cache_dir={tmp_path / 'cache'}"), directory, {})
        metrics = json.loads((directory / "metrics.json").read_text())
        counted.append((len(asked), metrics.get("detection_cache.hits"), metrics.get("detection_cache.misses")))
        varying = ("fps", "stage_ms", "peak", "detection_cache")
        figures = {key: value for key, value in metrics.items() if not key.startswith(varying)}
        files = [(directory / name).read_bytes() for name in ("mesh.ply", "instances.json", "trajectory.txt")]
        records.append((figures, files))
    assert counted == [(6, None, None), (6, 0, 6), (0, 6, 0), (0, 6, 0)]
    assert records[1:] == records[:1] * 3
    assert records[0][0]["config_hash"]


def test_cache_seeded_detector_is_keyed_by_frame_index(room: CornerRoom, tmp_path: Path) -> None:
    """The simulated detector is seeded with the frame index, so equal images have different detections."""
    detector = CachedDetector(SimulatedDetector(min_pixels=1), tmp_path)
    frame = room[0]
    for index in (0, 1, 0):
        same_picture = replace(frame, index=index)
        assert_same(SimulatedDetector(min_pixels=1).detect(same_picture), detector.detect(same_picture))
    assert (detector.hits, detector.misses) == (1, 2)
    assert detector.classes == COCO != CLASSES

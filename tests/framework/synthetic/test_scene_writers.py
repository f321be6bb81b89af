"""Tests for scenes that are written by several processes.

The files must be identical to those of one process, and missing files can be written later.
"""

from __future__ import annotations

import json
import os
from functools import partial
from pathlib import Path

import pytest

from framework.datasets.scenenn.scenenn import SceneNN
from framework.detection.domain import RENDERED_ROOMS
from framework.errors import ConfigError, DataError
from framework.synthetic import scene_writers
from framework.synthetic.benchmark import SceneSpec
from framework.synthetic.furniture.groups import toilet_group
from framework.synthetic.scene_writers import FRAMES_AT_ONCE, _choose, _Scene, write_scenes
from framework.synthetic.scenenn_scene import GENERATION, BenchmarkSettings, SceneNNScene, frame_files, trajectory_file

pytestmark = pytest.mark.integration

SPEC = SceneSpec("bathroom", (toilet_group,), {"toilet": 1})
SPECS = {"007": SPEC, "008": SPEC}
RECORDING = BenchmarkSettings(seed=1, frames=FRAMES_AT_ONCE + 2, width=64)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def times(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("benchmark") / "rooms"
    write_scenes(root, SPECS, RECORDING, jobs=2)
    return root


@pytest.mark.acceptance
def test_write_scenes_two_processes_equal_single_process(root: Path, tmp_path: Path) -> None:
    alone = SceneNNScene(tmp_path / "008", SPEC, RECORDING)
    alone.write_walk()
    for index in reversed(range(RECORDING.frames)):
        alone.write_frame(index)
    alone.write_truth()
    written = contents(root / "008")
    assert set(written) == set(contents(tmp_path / "008"))
    assert written == contents(tmp_path / "008")
    assert len(written) == 2 * RECORDING.frames + 4


@pytest.mark.acceptance
def test_write_scenes_same_spec_gives_different_scenes(root: Path) -> None:
    assert trajectory_file(root / "007").read_bytes() != trajectory_file(root / "008").read_bytes()


@pytest.mark.acceptance
def test_write_scenes_rewrites_only_missing_files(root: Path) -> None:
    before, written = times(root), contents(root)
    color_file, _ = frame_files(root / "007", 4)
    for path in (trajectory_file(root / "007"), color_file):
        path.unlink()
    assert _Scene(root / "007", SPEC, RECORDING).missing == 1
    assert _Scene(root / "008", SPEC, RECORDING).missing == 0
    write_scenes(root, SPECS, RECORDING, jobs=1)
    assert contents(root) == written
    after = times(root)
    assert {name for name in after if name.endswith(".png") and after[name] != before[name]} == {
        f"007/{kind}/{kind}00005.png" for kind in ("image", "depth")
    }
    assert all(after[name] == before[name] for name in after if name.startswith("008"))


@pytest.mark.acceptance
def test_write_scenes_writes_common_files(root: Path) -> None:
    assert (root / "release.txt").read_text() == f"synthetic {GENERATION}, seed 1, 10 frames\n"
    assert json.loads((root / "synthesize.json").read_text())["generation"] == GENERATION
    assert SceneNN(root, scene="007").domain == RENDERED_ROOMS
    assert "fx 54.447329\n" in (root / "intrinsic" / "asus.ini").read_text()
    assert not list(root.rglob(".*")), "expected no temporary files"


@pytest.mark.acceptance
@pytest.mark.parametrize(
    "other", [BenchmarkSettings(seed=2, frames=10, width=64), BenchmarkSettings(seed=1, frames=9, width=64)]
)
def test_write_scenes_other_parameters_raise(root: Path, other: BenchmarkSettings) -> None:
    before = times(root)
    with pytest.raises(ConfigError, match=r"expected scenes with the parameters .*; set another folder"):
        write_scenes(root, SPECS, other, jobs=1)
    assert times(root) == before


def test_write_scenes_interrupted_at_start_is_started_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(_: object) -> str:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(json, "dumps", interrupted)
        with pytest.raises(KeyboardInterrupt):
            scene_writers._begin(tmp_path, RECORDING)
    (tmp_path / ".synthetic.4711-0123abcd.partial.json").touch()  # of a killed process
    scene_writers._begin(tmp_path, RECORDING)
    assert (tmp_path / "intrinsic" / "asus.ini").exists()


def test_write_scenes_foreign_folder_raises(tmp_path: Path) -> None:
    (tmp_path / "011.ply").write_text("a scan")
    with pytest.raises(ConfigError, match="expected a new or empty folder"):
        write_scenes(tmp_path, SPECS, RECORDING, jobs=1)
    assert [path.name for path in tmp_path.iterdir()] == ["011.ply"]
    with pytest.raises(ConfigError, match="expected a new or empty folder"):
        write_scenes(tmp_path / "011.ply", SPECS, RECORDING, jobs=1)
    (tmp_path / "synthesize.json").write_text("{")
    with pytest.raises(DataError, match=r"synthesize\.json: expected valid JSON, got a damaged file"):
        write_scenes(tmp_path, SPECS, RECORDING, jobs=1)


def killed(status: int, rng: object) -> None:
    os._exit(status)


def test_write_scenes_killed_process_raises_one_line_error(tmp_path: Path) -> None:
    deadly = SceneSpec("trap", (partial(killed, 9),), {})
    with pytest.raises(DataError, match=r"rooms/666: expected a running writer process.*run the same command again"):
        write_scenes(tmp_path / "rooms", {"666": deadly}, RECORDING, jobs=1)


def test_write_scenes_chooses_current_then_untouched_scene(tmp_path: Path) -> None:
    recording = BenchmarkSettings(frames=3 * FRAMES_AT_ONCE, width=64)
    first, second = (_Scene(tmp_path / name, SPEC, recording) for name in ("007", "008"))
    scenes = [first, second]
    assert _choose(scenes, None) is first
    first.take()
    assert _choose(scenes, first) is first
    assert _choose(scenes, None) is second
    second.take()
    for _ in range(3):
        first.take()
    assert first.ready == 0, "expected no ready files: other processes are writing the remaining ones"
    assert _choose(scenes, first) is second
    first.running = 0
    assert first.ready == 1
    first.take()
    assert first.ready == 0
    first.running = 0
    assert first.ready == 0

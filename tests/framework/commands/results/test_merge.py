"""Tests for the command `merge`, with two parts of a real recording."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from framework.commands.results import merge
from framework.files.tum_trajectory import read_tum
from framework.geometry import pose_distance
from framework.tracking.keyframes import read_keyframes
from tests.support.forked_commands import completed

pytestmark = pytest.mark.integration

KITCHEN = Path(__file__).resolve().parents[5] / "shared" / "data" / "redkitchen"
FIRST, SECOND = (0, 40), (28, 68)  # frames of the desk; 12 are common


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("desk")
    for name, (start, stop) in (("first", FIRST), ("second", SECOND)):
        part = (f"dataset.start={start}", f"dataset.stop={stop}", f"hydra.run.dir={folder / name}")
        done = completed(folder, "dataset=desk", "detector=none", "fuser.voxel_size=0.03", *part)
        assert done.returncode == 0, done.stderr
    return [folder / "first", folder / "second"]


def merged(monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    monkeypatch.setattr(sys, "argv", ["instancemap merge", *map(str, words)])
    merge.main()


def test_merge_aligns_poses_of_common_frames(
    runs: list[Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    merged(monkeypatch, *runs)
    transform, shared, out = capsys.readouterr().out.splitlines()
    assert re.fullmatch(rf"transform of {runs[1]}: \((-?\d\.\d{{3}} ?){{3}}\) m, \d\.\d\d degrees", transform)
    assert shared == "0 instances of both maps merged"
    assert Path(out) == runs[0].parent / "first_merged"
    _, poses = read_tum(Path(out) / "trajectory.txt")
    common = FIRST[1] - SECOND[0]
    pairs = zip(poses[FIRST[1] - common : FIRST[1]], poses[FIRST[1] : FIRST[1] + common], strict=True)
    assert np.median([pose_distance(*pair) for pair in pairs]) < 0.015
    counts = [len(read_keyframes(run / "keyframes.npz")["counts"]) for run in (*runs, Path(out))]
    assert counts[2] == counts[0] + counts[1]


def test_merge_into_existing_run_is_one_line(
    runs: list[Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="1"):
        merged(monkeypatch, *runs, "--out", runs[0])
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {runs[0]}: expected ")


@pytest.mark.acceptance
def test_merged_map_can_be_localized_in(runs: list[Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    merged(monkeypatch, *runs, "--out", tmp_path / "merged")
    words = ("dataset=desk", "detector=none", "fuser.voxel_size=0.03", "dataset.start=50", "dataset.stop=60")
    done = completed(tmp_path, *words, f"localize_in={tmp_path / 'merged'}", f"hydra.run.dir={tmp_path / 'third'}")
    assert done.returncode == 0, done.stderr
    _, poses = read_tum(tmp_path / "third" / "trajectory.txt")
    _, stored = read_tum(tmp_path / "merged" / "trajectory.txt")
    expected = stored[FIRST[1] + 50 - SECOND[0] :][: len(poses)]
    assert np.median([pose_distance(*pair) for pair in zip(poses, expected, strict=True)]) < 0.03


@pytest.mark.acceptance
@pytest.mark.skipif(not KITCHEN.is_dir(), reason="needs the recordings in ../shared")
def test_merge_of_different_rooms_is_refused(
    runs: list[Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("dataset=rgbd_folder", f"dataset.root={KITCHEN}", "dataset.stop=60", "detector=none")
    done = completed(tmp_path, *words, "fuser.voxel_size=0.03", f"hydra.run.dir={tmp_path / 'kitchen'}")
    assert done.returncode == 0, done.stderr
    with pytest.raises(SystemExit, match="1"):
        merged(monkeypatch, runs[0], tmp_path / "kitchen", "--out", tmp_path / "merged")
    [line] = capsys.readouterr().err.splitlines()
    assert line == (
        f"error: {tmp_path / 'kitchen'}: expected an overlap with at least 40 consistent feature matches, got fewer; "
        f"map it again with localize_in={runs[0]}"
    )
    assert not (tmp_path / "merged").exists()

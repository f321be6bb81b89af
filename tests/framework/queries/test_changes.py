"""Tests for changes between two visits of a room. Objects are removed, added or moved."""

from __future__ import annotations

import json
from collections.abc import Mapping
from copy import copy
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from framework.api import Mapper
from framework.commands.results import diff
from framework.data import Bool
from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import DataError
from framework.files.tum_trajectory import write_tum
from framework.interfaces import RGBDSequence
from framework.queries.changes import STAY_PROBABILITY, Kind, Visit, _shared, changes, look_for, probability_gone
from framework.synthetic.renderer import Renderer
from framework.synthetic.room import RoomKind
from framework.synthetic.sequence import Synthetic
from framework.synthetic.surfaces import assemble

pytestmark = pytest.mark.integration

GIVEN = ("tracker=ground_truth", "fuser.voxel_size=0.025")


@cache
def office() -> Synthetic:
    return Synthetic(scene="room1", kind=RoomKind.OFFICE, width=320, height=240)


def visit(sequence: RGBDSequence, *overrides: str) -> Visit:
    mapper = Mapper(*GIVEN, *overrides)
    poses = [mapper.add(frame).T_world_camera for frame in sequence]
    return Visit(mapper.scene, np.array(poses))


def changed_room(
    start: int, without: tuple[int, ...] = (), moved: Mapping[int, tuple[float, float]] | None = None
) -> Synthetic:
    """Return every ninth frame of the office from `start`, without some objects or with objects moved by (x, y), m."""
    room = copy(office())
    shift = moved or {}
    objects = [
        (key, piece.placed(*shift[key]) if key in shift else piece)
        for key, piece in office().room.objects
        if key not in without
    ]
    room._renderer = Renderer(assemble(objects), list(office().room.lamps))
    room._chosen = range(start, office().frames, 9)
    return room


@pytest.fixture(scope="module")
def before() -> Visit:
    return visit(changed_room(0), "detector=ground_truth")


CHAIR, TABLE = 5, 6  # ids of clearly visible objects


def expected(found: list, kind: Kind) -> list[str]:
    return sorted(change.name for change in found if change.kind is kind)


def test_changes_office_contains_expected_objects() -> None:
    names = office().class_names
    assert (names[CHAIR], names[TABLE]) == ("chair", "dining table")


def test_changes_of_unchanged_room_are_empty(before: Visit) -> None:
    found = changes(before, visit(changed_room(1), "detector=ground_truth"))
    assert {change.kind for change in found} <= {Kind.STAYED, Kind.NOT_SEEN}
    assert len(expected(found, Kind.STAYED)) >= 7
    assert all(change.before is not None and change.after is not None for change in found if change.kind is Kind.STAYED)
    assert all(0 <= change.probability <= 1 for change in found)


def test_changes_removed_objects_appear_if_visits_are_swapped(before: Visit) -> None:
    after = visit(changed_room(1, without=(CHAIR, TABLE)), "detector=ground_truth")
    found = changes(before, after)
    assert expected(found, Kind.VANISHED) == ["chair", "dining table"]
    assert expected(found, Kind.APPEARED) == expected(found, Kind.MOVED) == []
    assert all(change.probability > 0.5 for change in found if change.kind is Kind.VANISHED)
    assert [change.kind for change in found[:2]] == [Kind.VANISHED] * 2, "expected vanished objects before the others"
    back = changes(after, before)
    assert expected(back, Kind.APPEARED) == ["chair", "dining table"]
    assert expected(back, Kind.VANISHED) == expected(back, Kind.MOVED) == []


def test_changes_displaced_object_has_moved(before: Visit) -> None:
    found = changes(before, visit(changed_room(1, moved={CHAIR: (-0.9, 0.6)}), "detector=ground_truth"))
    [moved] = [change for change in found if change.kind is Kind.MOVED]
    assert moved.name == "chair"
    assert moved.distance == pytest.approx(np.hypot(0.9, 0.6), abs=0.4), (
        "expected an error of at most 0.4 m: each visit sees other sides of the box"
    )
    assert None not in (moved.before, moved.after)
    assert expected(found, Kind.VANISHED) == expected(found, Kind.APPEARED) == []


def test_moved_object_is_found_if_one_map_has_more_classes() -> None:
    """Renaming an instance (`edit`) can add classes to a map."""
    first, second = _shared(("chair", "couch", "tv"), ("bed", "tv", "chair"))
    assert (first.tolist(), second.tolist()) == ([0, 2], [2, 1])
    found = _shared(("chair",), ("forklift",))
    assert [one.tolist() for one in found] == [[], []]


@pytest.mark.acceptance
def test_changes_with_noisy_detector_are_empty() -> None:
    one, other = (visit(changed_room(k), "detector=simulated", f"seed={k}") for k in (0, 1))
    found = changes(one, other)
    assert not [change for change in found if change.kind in (Kind.VANISHED, Kind.MOVED) and change.probability > 0.3]
    assert len(expected(found, Kind.STAYED)) >= 5


def test_changes_between_halves_of_real_recording_are_empty(shared_data: Path) -> None:
    """The halves are the even and the odd frames of an apartment. The detector is MaskRCNN2Go."""
    halves = [
        visit(RgbdFolder(shared_data / "replica_floor2", start=k, stop=40, stride=2), "fuser.voxel_size=0.04")
        for k in (0, 1)
    ]
    found = changes(*halves)
    assert not [change for change in found if change.kind in (Kind.VANISHED, Kind.MOVED) and change.probability > 0.3]


def bits(there: int, through: int, of: int = 10) -> tuple[Bool, Bool]:
    return np.arange(of) < there, np.arange(of) >= of - through


def test_probability_gone_depends_on_evidence() -> None:
    def gone(there: int, through: int, matched: bool, confidence: float = 0.8) -> float:
        return probability_gone(confidence, *bits(there, through), matched)

    assert gone(0, 2, False) == pytest.approx(1 - STAY_PROBABILITY), (
        "expected the prior probability: too little was visible"
    )
    assert gone(10, 0, True) < 0.01
    assert gone(0, 10, False) > 0.8
    assert gone(0, 10, False) > gone(5, 5, False) > gone(10, 0, False)
    assert gone(8, 2, False) > gone(8, 2, True)
    assert gone(0, 10, False, confidence=0.1) < gone(0, 10, False, confidence=0.9), (
        "expected a lower probability for an uncertain object"
    )


def test_look_for_separates_surface_from_free_space(before: Visit) -> None:
    vertices = before.scene.mesh().vertices[::500]
    there, through = look_for(before, vertices)
    assert there.mean() > 0.8
    camera = before.poses[:, :3, 3].mean(axis=0)
    nearer = (camera + 0.5 * (vertices - camera)).astype(np.float32)  # in free space
    there, through = look_for(before, nearer)
    assert through.mean() > 0.6
    assert there.mean() < 0.1
    outside = (camera + 3 * (vertices - camera)).astype(np.float32)
    assert not np.logical_or(*look_for(before, outside)).any(), "expected no evidence for surfaces behind walls"


def test_changes_visit_without_poses_raises(before: Visit) -> None:
    with pytest.raises(DataError, match="visit: expected at least one pose"):
        Visit(before.scene, np.zeros((0, 4, 4)))


def test_diff_command_lists_changes(
    tmp_path: Path, before: Visit, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    after = visit(changed_room(1, without=(CHAIR,)), "detector=ground_truth")
    for name, seen in (("first", before), ("second", after)):
        place = tmp_path / name
        place.mkdir()
        seen.scene.save(place / "map.npz")
        write_tum(place / "trajectory.txt", np.arange(len(seen.poses)) / 30, seen.poses)
        (place / "metrics.json").write_text('{"pose_source": "ground_truth"}')
    out = tmp_path / "diff.json"
    words = ["instancemap diff", str(tmp_path / "first"), str(tmp_path / "second"), "--out", str(out)]
    monkeypatch.setattr("sys.argv", words)
    diff.main()
    printed = capsys.readouterr()
    assert printed.err == ""
    [first, last] = printed.out.splitlines()
    assert first.startswith("vanished  chair            0.")
    assert "stayed, " in last
    written = json.loads(out.read_text())
    assert written[0]["kind"] == "vanished"
    assert written[0]["after"] is None
    assert len(written) > 5
    (tmp_path / "second" / "metrics.json").unlink()
    assert not diff.in_world(tmp_path / "second", tmp_path / "first")
    (tmp_path / "second" / "config.yaml").write_text(f"localize_in: {tmp_path / 'first'}\n")
    assert diff.in_world(tmp_path / "second", tmp_path / "first")
    monkeypatch.setattr("sys.argv", ["instancemap diff", str(tmp_path), str(tmp_path / "second")])
    with pytest.raises(SystemExit):
        diff.main()
    assert "diff: expected a run directory" in capsys.readouterr().err

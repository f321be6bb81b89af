"""Tests for keyframes, in a textured room with known poses and on real video."""

from __future__ import annotations

import pickle
import threading
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from framework.data import Frame
from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import ConfigError
from framework.geometry import exp_se3, inverse, rotation_angle, transform
from framework.interfaces import SubmapChange
from framework.tracking.features import FeatureExtractor, Features
from framework.tracking.keyframes import Keyframes, VisualWords, similarity
from tests.support.scenes.papered_room import CAMERA, papered_frame

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data"


def pose(x: float, yaw: float = 0.0) -> np.ndarray:
    return exp_se3(np.array([x, 0, 0, 0, yaw, 0]))


def apart(T_a: np.ndarray, T_b: np.ndarray) -> tuple[float, float]:
    T = inverse(T_a) @ T_b
    return float(np.linalg.norm(T[:3, 3])), rotation_angle(T[:3, :3])


@pytest.fixture(scope="module")
def keyframes() -> Keyframes:
    keyframes = Keyframes()
    for yaw in np.linspace(0, 6.2, 20):
        keyframes.add(papered_frame(pose(0, yaw)), pose(0, yaw))
    return keyframes


def has_become_one(keyframes: Keyframes, frame: Frame, T_world_camera: np.ndarray) -> bool:
    before = len(keyframes)
    keyframes.add(frame, T_world_camera)
    return len(keyframes) > before


def blanked(frame: Frame) -> Frame:
    return replace(frame, color=np.zeros_like(frame.color))


def test_keyframe_is_added_only_beyond_minimum_distance() -> None:
    keyframes = Keyframes(min_distance=0.2, min_angle=0.3)
    added = [
        has_become_one(keyframes, papered_frame(T), T)
        for T in (pose(0), pose(0.19), pose(0.21), pose(0.21, 0.2), pose(0, 0.31))
    ]
    assert added == [True, False, True, False, True]
    half_of_each = pose(-0.12, 0.16)
    assert has_become_one(keyframes, papered_frame(half_of_each), half_of_each)


def test_keyframes_skip_feature_extraction_for_near_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    keyframes = Keyframes()
    assert has_become_one(keyframes, papered_frame(pose(0)), pose(0))
    monkeypatch.setattr(FeatureExtractor, "extract", None)
    assert not has_become_one(keyframes, papered_frame(pose(0.05)), pose(0.05))


def test_keyframes_skip_near_frames_after_featureless_frame() -> None:
    keyframes = Keyframes(min_distance=0.2)
    seen = []
    extract = keyframes.extractor.extract
    keyframes.extractor.extract = lambda frame: seen.append(frame) or extract(frame)
    nothing = blanked(papered_frame(pose(0)))
    assert not any(has_become_one(keyframes, nothing, pose(x)) for x in (0, 0.01, 0.04, 0.06, 0.07))
    assert len(seen) == 2, "expected features only at 0 m and 0.06 m"
    without_depth = replace(papered_frame(pose(1)), depth=np.zeros(CAMERA.shape, np.float32))
    assert not has_become_one(keyframes, without_depth, pose(1.0))
    assert has_become_one(keyframes, papered_frame(pose(0.9)), pose(0.9))
    assert len(keyframes) == 1


def slowed(keyframes: Keyframes, seconds: float) -> None:
    """Delay the feature extraction by `seconds` s."""
    extract = keyframes.extractor.extract

    def slow(frame: Frame) -> Features:
        time.sleep(seconds)
        return extract(frame)

    keyframes.extractor.extract = slow


@pytest.mark.parametrize("seconds", [0.0, 0.05])
def test_keyframes_are_independent_of_extraction_time(seconds: float) -> None:
    """The steps of the camera have different sizes, some frames are black, and old keyframes are removed."""
    rng = np.random.default_rng(3)
    at_once, later = (Keyframes(max_keyframes=4, min_distance=0.2) for _ in range(2))
    slowed(later, seconds)
    x = 0.0
    looked_at = 0
    for k in range(120):
        x = np.clip(x + rng.choice([0.01, 0.03, 0.08, 0.25]) * rng.choice([-1, 1]), -1.8, 1.8)
        frame = papered_frame(pose(x))
        frame = blanked(frame) if k // 10 % 2 else frame
        at_once.add(frame, pose(x))
        looked_at += at_once._offered is not None
        at_once._settle()
        later.add(frame, pose(x))
    assert looked_at > 12
    assert len(at_once) == 4
    for name, array in at_once.saved().items():
        np.testing.assert_array_equal(later.saved()[name], array, err_msg=name)


def test_keyframes_add_waits_only_for_relevant_features() -> None:
    keyframes = Keyframes(min_distance=0.2)
    extract, may_end = keyframes.extractor.extract, threading.Event()

    def held(frame: Frame) -> Features:
        assert may_end.wait(60)
        return extract(frame)

    keyframes.extractor.extract = held
    keyframes.add(papered_frame(pose(0)), pose(0))
    keyframes.add(papered_frame(pose(0.04)), pose(0.04))
    assert not may_end.is_set(), "expected add not to wait near the pending keyframe"
    threading.Timer(0.1, may_end.set).start()
    keyframes.add(papered_frame(pose(0.1)), pose(0.1))
    assert may_end.is_set(), "expected add to wait at 0.1 m, where the result depends on the pending features"
    assert len(keyframes) == 1


def test_keyframes_thread_exception_is_raised_once() -> None:
    keyframes = Keyframes(min_distance=0.2)
    found = keyframes.extractor.extract
    keyframes.extractor.extract = lambda frame: {}[frame.index]
    frame = papered_frame(pose(0))
    for ask in (keyframes.saved, lambda: keyframes.nearest(pose(0)), lambda: keyframes.add(frame, pose(0.5))):
        keyframes.add(frame, pose(0))
        with pytest.raises(KeyError):
            ask()
    keyframes.extractor.extract = found
    assert has_become_one(keyframes, frame, pose(0))


def test_keyframes_pickle_includes_pending_keyframe() -> None:
    keyframes = Keyframes()
    keyframes.add(papered_frame(pose(0)), pose(0))
    copied = pickle.loads(pickle.dumps(keyframes))
    assert len(copied) == 1
    assert copied.relocalize(papered_frame(pose(0.1))) is not None
    assert has_become_one(copied, papered_frame(pose(0.5)), pose(0.5))


def test_keyframes_leave_no_threads() -> None:
    keyframes = Keyframes()
    keyframes.add(papered_frame(pose(0)), pose(0))
    assert [thread for thread in threading.enumerate() if thread.name.startswith("keyframe")]
    assert len(keyframes) == 1
    for thread in threading.enumerate():
        if thread.name.startswith("keyframe"):
            thread.join(60)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("keyframe")]


def test_relocalize_finds_camera_at_new_poses(keyframes: Keyframes) -> None:
    for k, yaw in enumerate(np.linspace(0.1, 6, 7)):
        T_world_camera = exp_se3(np.array([0.1 - 0.03 * k, 0.05, 0.1, 0.05, yaw, 0.1]))
        found = keyframes.relocalize(papered_frame(T_world_camera))
        assert found is not None
        distance, angle = apart(found.T_world_camera, T_world_camera)
        assert distance < 0.01
        assert angle < 0.005
        assert found.inliers.sum() >= keyframes.min_inliers


def test_relocalize_is_deterministic(keyframes: Keyframes) -> None:
    frame = papered_frame(pose(0.1, 0.4))
    found = [keyframes.relocalize(frame) for _ in range(2)]
    np.testing.assert_array_equal(found[0].T_world_camera, found[1].T_world_camera)


def test_relocalize_in_unknown_scene_returns_none(keyframes: Keyframes) -> None:
    rng = np.random.default_rng(0)
    frame = papered_frame(pose(0))
    noise = rng.integers(0, 255, (*CAMERA.shape, 3)).astype(np.uint8)
    for color in (np.zeros_like(noise), noise, cv2.GaussianBlur(noise, (0, 0), 3), frame.color[:, ::-1]):
        assert keyframes.relocalize(replace(frame, color=np.ascontiguousarray(color))) is None
    assert keyframes.relocalize(papered_frame(pose(0), paper=1)) is None, "expected no pose in another room"
    twice_as_far = replace(frame, depth=frame.depth * 2)
    assert keyframes.relocalize(twice_as_far) is None, (
        "expected no pose for a photo of the room, which is at another depth"
    )
    assert Keyframes().relocalize(frame) is None


def test_keyframes_move_with_their_submap() -> None:
    """The keyframe that is under construction during the correction belongs to the submap before it."""
    keyframes, fixed = Keyframes(), Keyframes()
    slowed(keyframes, 0.05)
    first, second = pose(0.5, 0.4), pose(-0.7, 1.0)
    for x in (0.0, 0.6):
        for one in (keyframes, fixed):
            one.add(papered_frame(pose(x)), pose(x))
        keyframes.correct(SubmapChange({0: first} if x == 0 else {1: second}, submap=1))
    before, after = fixed.saved(), keyframes.saved()
    np.testing.assert_allclose(after["poses"], [first @ pose(0), second @ pose(0.6)], atol=1e-12)
    np.testing.assert_array_equal(after["descriptors"], before["descriptors"])
    np.testing.assert_array_equal(after["counts"], before["counts"])
    for own, T_new_old in ((slice(before["counts"][0]), first), (slice(before["counts"][0], None), second)):
        expected = transform(T_new_old, before["points_world"][own].astype(np.float64))
        np.testing.assert_allclose(after["points_world"][own], expected, atol=1e-6)
    assert apart(keyframes.nearest(second @ pose(0.6))[0].T_world_camera, second @ pose(0.6)) < (1e-6, 1e-6)


def test_keyframes_of_hidden_submaps_are_not_matched() -> None:
    keyframes = Keyframes()
    frame = papered_frame(pose(0))
    keyframes.add(frame, pose(0))
    keyframes.correct(SubmapChange(hidden=frozenset({0}), submap=1))
    assert keyframes.nearest(pose(0)) == []
    assert keyframes.relocalize(frame) is None
    assert has_become_one(keyframes, frame, pose(0.1)), "expected a new keyframe at the place of the hidden one"
    assert [one.submap for one in keyframes.nearest(pose(0))] == [1]
    keyframes.correct(SubmapChange(shown=frozenset({0}), submap=2))
    assert [one.submap for one in keyframes.nearest(pose(0))] == [0, 1]
    assert len(keyframes.saved()["poses"]) == 2


def test_keyframes_are_bounded_and_keep_distant_frames() -> None:
    keyframes = Keyframes(max_keyframes=5, min_distance=0.01, min_angle=0.01, candidates=5)
    for yaw in (0, 0.48, 0.5, 1.0, 2.0, 2.5, 2.52):
        keyframes.add(papered_frame(pose(0, yaw)), pose(0, yaw))
    assert len(keyframes) == 5
    kept = sorted(apart(keyframe.T_world_camera, pose(0))[1] for keyframe in keyframes.nearest(pose(0)))
    np.testing.assert_allclose(kept, [0, 0.5, 1, 2, 2.52], atol=1e-6)
    assert sum(array.nbytes for array in keyframes.saved().values()) < 5 * 200_000


def test_nearest_keyframes_are_sorted_by_distance(keyframes: Keyframes) -> None:
    angles = [apart(k.T_world_camera, pose(0, 1.0))[1] for k in keyframes.nearest(pose(0, 1.0))]
    assert angles == sorted(angles)
    assert angles[0] < 0.17


def test_visual_words_depend_on_seed() -> None:
    descriptors = np.random.default_rng(0).integers(0, 100, (50, 128)).astype(np.uint8)
    bag = VisualWords(1).bag(descriptors)
    assert (bag**2).sum() == pytest.approx(50)
    np.testing.assert_array_equal(bag, VisualWords(1).bag(descriptors[::-1]))
    assert not np.array_equal(bag, VisualWords(2).bag(descriptors))
    other = VisualWords(1).bag(255 - descriptors)
    np.testing.assert_allclose(similarity(bag, np.stack([bag, other])), [1, 0], atol=1e-6)


@pytest.mark.parametrize("bound", [{"max_keyframes": 0}, {"min_distance": 0.0}, {"min_inliers": 3}, {"max_ratio": 1.2}])
def test_keyframes_parameter_out_of_range_raises(bound: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(bound))):
        Keyframes(**bound)


@pytest.mark.skipif(not SHARED.is_dir(), reason="requires ../shared/data")
def test_relocalize_in_real_video_requires_known_scene() -> None:
    kitchen = RgbdFolder(SHARED / "redkitchen")
    keyframes = Keyframes()
    for k in range(0, 150, 10):
        keyframes.add(kitchen[k], kitchen[k].T_world_camera)
    for k in range(5, 300, 30):
        found = keyframes.relocalize(kitchen[k])
        assert found is not None, f"frame {k}"
        distance, angle = apart(found.T_world_camera, kitchen[k].T_world_camera)
        assert distance < 0.15, f"frame {k}"
        assert angle < 0.08
    elsewhere = [("mit76", range(5)), ("redwood5", range(5)), ("replica_floor2", range(0, 123, 20))]
    for name, chosen in elsewhere:
        sequence = RgbdFolder(SHARED / name)
        assert not [k for k in chosen if keyframes.relocalize(sequence[k]) is not None], name

"""Tests for the masking of people, with small images of a body before a wall."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import Bool, Camera, Detections, Float32, Frame
from framework.errors import ConfigError
from plugins.masking.people import People

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
WALL, BODY = 3.0, 2.0  # m
CLASSES = ("chair", "person")


def frame_of(left: int, index: int = 0, depth: float = BODY, rate: float = 30.0) -> Frame:
    """Return a frame with a body in columns `left` to `left` + 9 and rows 8 to 39."""
    image = np.full(CAMERA.shape, WALL, np.float32)
    image[8:40, left : left + 10] = depth
    return Frame(index, index / rate, np.zeros((*CAMERA.shape, 3), np.uint8), image, CAMERA)


def body_of(frame: Frame) -> Bool:
    return np.asarray(frame.depth < WALL)


def found(*masks: Bool, score: float = 0.9, label: str = "person") -> Detections:
    """Return detections of one class."""
    n = len(masks)
    return Detections(
        masks=np.array(masks, np.bool_).reshape(n, *CAMERA.shape),
        boxes=np.zeros((n, 4), np.float32),
        scores=np.full(n, score, np.float32),
        class_probabilities=np.tile(np.eye(2, dtype=np.float32)[CLASSES.index(label)], (n, 1)),
        classes=CLASSES,
    )


def nothing(detected: bool = False) -> Detections:
    return Detections.none(CAMERA.shape, CLASSES, detected=detected)


def depth_after(people: People, frame: Frame, detections: Detections) -> Float32:
    return people.mask(frame, detections)[0].depth


def test_people_mask_covers_body_and_margin() -> None:
    frame = frame_of(20)
    masked, kept = People(margin=2, completion_distance=0.0).mask(frame, found(body_of(frame)))
    hidden = np.zeros(CAMERA.shape, np.bool_)
    hidden[6:42, 18:32] = True
    np.testing.assert_array_equal(masked.depth, np.where(hidden, 0, frame.depth))
    assert masked.color is frame.color
    assert len(kept) == 0
    assert kept.detected


def test_people_mask_is_completed_at_depth_of_body() -> None:
    frame = frame_of(20)
    partial = body_of(frame)
    partial[:, 28:] = False  # the network misses 2 px, about 7 cm
    assert not depth_after(People(completion_distance=0.2), frame, found(partial))[body_of(frame)].any()
    assert depth_after(People(completion_distance=0.0, margin=0), frame, found(partial))[20, 29] == BODY


def test_people_part_of_larger_surface_is_not_followed() -> None:
    """Networks take parts of a desk for people in blurred images."""
    frame = frame_of(20)
    part = np.zeros(CAMERA.shape, np.bool_)
    part[10:30, 40:50] = True  # on the wall
    people = People(margin=0)
    np.testing.assert_array_equal(depth_after(people, frame, found(part)) == 0, part)
    later = frame_of(20, 1)
    assert people.mask(later, nothing())[0] is later


def test_people_completion_keeps_wall() -> None:
    frame = frame_of(20)
    masked = depth_after(People(completion_distance=0.5, margin=0), frame, found(body_of(frame)))
    np.testing.assert_array_equal(masked[~body_of(frame)], WALL)


def test_people_wall_in_mask_is_masked_but_not_followed() -> None:
    frame, wide = frame_of(20), body_of(frame_of(20))
    wide[8:40, 15:20] = True  # the mask extends to the wall
    people = People(margin=0, completion_distance=0.0)
    assert not depth_after(people, frame, found(wide))[8:40, 15:30].any()
    after = depth_after(people, frame_of(20, 1), nothing())
    np.testing.assert_array_equal(after == 0, body_of(frame))


@pytest.mark.parametrize("step", [-2, 0, 2])
def test_people_body_is_followed_without_detector(step: int) -> None:
    people = People(margin=0, completion_distance=0.0)
    people.mask(frame_of(20), found(body_of(frame_of(20))))
    for k in range(1, 6):
        frame = frame_of(20 + step * k, k)
        np.testing.assert_array_equal(depth_after(people, frame, nothing()) == 0, body_of(frame))


def test_people_body_is_followed_toward_camera() -> None:
    people = People(margin=0, completion_distance=0.0)
    people.mask(frame_of(20), found(body_of(frame_of(20))))
    for k in range(1, 6):
        frame = frame_of(20, k, BODY - 0.06 * k)
        np.testing.assert_array_equal(depth_after(people, frame, nothing()) == 0, body_of(frame))


def test_people_body_missed_by_detector_is_followed() -> None:
    people = People(margin=0)
    for k in range(2):
        people.mask(frame_of(20, k), found(body_of(frame_of(20))))
    assert not depth_after(people, frame_of(21, 2), nothing(detected=True))[body_of(frame_of(21))].any()


def test_people_low_score_on_followed_body_continues_it() -> None:
    people = People(max_missed=0, margin=0, completion_distance=0.0)
    people.mask(frame_of(20), found(body_of(frame_of(20))))
    for k in range(1, 6):
        frame = frame_of(20, k)
        masked, kept = people.mask(frame, found(body_of(frame), score=0.1))
        np.testing.assert_array_equal(masked.depth == 0, body_of(frame))
        assert len(kept) == 0


def test_people_other_class_on_followed_body_is_removed() -> None:
    people = People()
    frame = frame_of(20)
    for _ in range(2):
        people.mask(frame, found(body_of(frame)))
        frame = frame_of(20, frame.index + 1)
    assert len(people.mask(frame, found(body_of(frame), label="chair"))[1]) == 0


def test_people_detection_replaces_last_shape_of_body() -> None:
    """Otherwise, the mask would grow from frame to frame."""
    people = People(margin=0, completion_distance=0.0)
    frame = frame_of(20)
    people.mask(frame, found(body_of(frame)))
    upper = body_of(frame)
    upper[24:] = False
    masked = depth_after(people, frame_of(20, 1), found(upper))
    assert not masked[upper].any()
    assert masked[25:].all()  # readings within 1 px complete the mask


@pytest.mark.parametrize(("detections", "followed"), [(1, 0), (2, 2), (3, 6), (6, 7)])
def test_people_misses_end_following(detections: int, followed: int) -> None:
    """Each detection doubles the number of misses, up to `max_missed`."""
    people = People(max_missed=7)
    for k in range(detections):
        people.mask(frame_of(20, k), found(body_of(frame_of(20))))
    frames = [frame_of(20, k) for k in range(detections, detections + 9)]
    masked = [people.mask(frame, nothing(detected=True))[0] is not frame for frame in frames]
    assert masked == [True] * followed + [False] * (9 - followed)


def test_people_uncovered_wall_is_not_masked() -> None:
    people = People(margin=0, completion_distance=0.0)
    people.mask(frame_of(20), found(body_of(frame_of(20))))
    frame = frame_of(22, 1)
    assert depth_after(people, frame, nothing())[20, 20] == WALL


def test_people_static_object_next_to_body_is_not_followed() -> None:
    def with_cupboard(left: int, index: int) -> Frame:
        frame = frame_of(left, index)
        frame.depth[8:40, 36:] = BODY
        return frame

    people = People(margin=0, completion_distance=0.0)
    first = with_cupboard(20, 0)
    people.mask(first, found(body_of(frame_of(20))))
    masked = depth_after(people, with_cupboard(22, 1), nothing())
    np.testing.assert_array_equal(masked[8:40, 36:], BODY)
    assert not masked[8:40, 22:32].any()


def test_people_faster_than_max_speed_is_not_followed() -> None:
    people = People(max_speed=0.5, margin=0)
    people.mask(frame_of(20), found(body_of(frame_of(20))))
    frame = frame_of(40, 1)
    assert people.mask(frame, nothing())[0] is frame


@pytest.mark.parametrize("time", [0.0, -1.0, 2.0])
def test_people_body_is_forgotten_after_gap_in_time(time: float) -> None:
    people = People()
    people.mask(frame_of(20), found(body_of(frame_of(20))))
    frame = frame_of(20, 1, rate=1 / time if time else np.inf)
    assert people.mask(frame, nothing())[0] is frame


def test_people_low_score_removes_only_detection() -> None:
    frame = frame_of(20)
    masked, kept = People(min_score=0.5).mask(frame, found(body_of(frame), score=0.4))
    assert masked is frame
    assert len(kept) == 0


def test_people_other_class_is_kept() -> None:
    frame = frame_of(20)
    detections = found(body_of(frame), label="chair")
    assert People().mask(frame, detections) == (frame, detections)


def test_people_classes_are_separated_by_commas() -> None:
    frame = frame_of(20)
    assert len(People(classes="dog, chair ,unknown").mask(frame, found(body_of(frame), label="chair"))[1]) == 0


def test_people_mask_without_depth_changes_no_later_frame() -> None:
    people = People()
    frame = frame_of(20)
    people.mask(frame_of(20, depth=0.0), found(body_of(frame)))
    later = frame_of(20, 1)
    assert people.mask(later, nothing())[0] is later


@pytest.mark.parametrize("overrides", [{"classes": " , "}, {"min_score": 1.5}, {"max_missed": 255}, {"margin": -1}])
def test_people_invalid_parameter_raises(overrides: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=next(iter(overrides))):
        People(**overrides)  # type: ignore[arg-type]

"""Tests for the matching of image ids to the frames of a sequence."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from framework.detection.stored.frame_matching import ImageIds, ImageIndex, check_matches
from framework.detection.stored.image_names import ImageId, ImageName, read_image_id
from framework.errors import DataError

PATH = Path("detections.json")


def frames_named(pattern: str, numbers: object) -> dict[int, str]:
    return {k: pattern.format(number) for k, number in enumerate(numbers)}  # type: ignore[call-overload]


GAPS = frames_named("{:06d}.jpg", range(0, 28, 2))  # as `import --stride 2` writes
FROM_ONE = frames_named("{:06d}.jpg", range(1, 15))
PREFIXED = frames_named("frame_{:06d}.png", range(14))
STAMPS = frames_named("1305031102.{:06d}.png", range(175304, 600000, 33000))
CAMERA_0 = frames_named("cam0_{:06d}.jpg", range(0, 28, 2))
NANOSECONDS = frames_named("{}.png", range(1403636579763555584, 1403636580463555584, 50000000))
SCANS = frames_named("scene0000_00_{:05d}.jpg", range(0, 140, 10))
SEVEN_SCENES = frames_named("frame-{:06d}.color.png", range(14))


@pytest.mark.parametrize(
    ("frames", "found", "index"),
    [
        (GAPS, "color/000004.jpg", 2),
        (GAPS, "000004.png", 2),  # a mask of color/000004.jpg
        (GAPS, "4.jpg", 2),
        (GAPS, "000004", 2),
        (GAPS, 4, 4),  # a whole number is a frame index
        (FROM_ONE, "000001.png", 0),
        (FROM_ONE, "/data/scans/room/color/000014.jpg", 13),
        (FROM_ONE, 1, 1),
        (PREFIXED, "frame_000012.jpg", 12),
        (PREFIXED, "000012.png", 12),
        (PREFIXED, "color\\frame_000012.jpg", 12),
        (STAMPS, "rgb/1305031102.208304.png", 1),
        (STAMPS, "1305031102.208304", 1),
        (STAMPS, "000001.png", 1),  # no frame has a number of its own
        (SEVEN_SCENES, "frame-000003.png", 3),
        (SEVEN_SCENES, "chess/seq-01/frame-000003.color.png", 3),
        ({0: "", 1: ""}, "000001.png", 1),  # frames in one file
        (CAMERA_0, "000012.png", 6),  # a number of a file, although its prefix has a digit
        (CAMERA_0, "cam0_12.png", 6),
        (NANOSECONDS, "1403636579813555584.jpg", 1),
        (SCANS, "scene0000_00_00030.png", 3),
        (SCANS, "D:\\scans\\00030.jpg", 3),
        (GAPS, "000004_jpg.rf.0b1f54e2a7.jpg", 2),  # as Roboflow renames images
        (GAPS, "000004.jpg.png", 2),
        (STAMPS, 1305031102.208304, 1),
        (FROM_ONE, 3.0, 3),  # as pandas writes whole numbers
    ],
)
def test_image_index_name_means_file_and_number_means_frame(frames: dict[int, str], found: object, index: int) -> None:
    image = read_image_id(found)
    assert ImageIndex([image], ImageIds.AUTO, PATH).matched(frames) == {index: (image,)}


@pytest.mark.parametrize(
    ("frames", "found"),
    [
        (GAPS, "000003.jpg"),
        (PREFIXED, "depth_000003.png"),
        (STAMPS, "1305031102.9.png"),
        (FROM_ONE, "000000.png"),
        (SEVEN_SCENES, "left.png"),
        (CAMERA_0, "cam1_000012.png"),
        (SCANS, "scene0001_00_00030.png"),
        (GAPS, "3f2b8c1e-9d4a-4c1b-8f3e-0a1b2c3d4e04.png"),
        (STAMPS, "2024-01-05-175304.png"),
        (NANOSECONDS, "1403636579763.png"),
    ],
)
def test_image_index_name_of_no_frame_is_unmatched(frames: dict[int, str], found: str) -> None:
    assert ImageIndex([read_image_id(found)], ImageIds.AUTO, PATH).matched(frames) == {}


@pytest.mark.parametrize(
    ("ids", "frames", "found", "index"),
    [
        (ImageIds.FROM_ONE, GAPS, 1, 0),
        (ImageIds.FROM_ONE, STAMPS, "000013.png", 12),
        (ImageIds.FROM_ZERO, FROM_ONE, "000000.png", 0),
        (ImageIds.FILE_NUMBER, GAPS, 26, 13),
        (ImageIds.FILE_NUMBER, PREFIXED, "mask_000003.png", 3),
    ],
)
def test_image_index_given_meaning_is_used(ids: ImageIds, frames: dict[int, str], found: object, index: int) -> None:
    image = read_image_id(found)
    assert ImageIndex([image], ids, PATH).matched(frames) == {index: (image,)}


def test_image_index_images_of_two_sequences_raise() -> None:
    index = ImageIndex(images("left_12.png", "right_12.png"), ImageIds.AUTO, PATH)
    with pytest.raises(
        DataError, match=r"expected one image of frame 12, got 'left_12' and 'right_12'; split the file"
    ):
        index.of_frame(12, ImageName.of("000012.jpg"))
    assert len(ImageIndex(images(12, "12", "000012.png"), ImageIds.AUTO, PATH).of_frame(12, None)) == 3


def test_check_matches_repeated_file_name_raises() -> None:
    with pytest.raises(DataError, match=r"expected one frame with the image '1', got frames 0 and 1 \(1\.png\)"):
        check_matches(PATH, images("cam0/1.png"), ImageIds.AUTO, {0: "1.jpg", 1: "1.png"}, warns=True)


def images(*found: object) -> list[ImageId]:
    return [read_image_id(one) for one in found]


@pytest.mark.parametrize(
    ("frames", "found", "fix"),
    [
        (PREFIXED, images(*range(1, 15)), "FROM_ONE"),  # as pycocotools numbers images
        (GAPS, images(*range(0, 28, 2)), "FILE_NUMBER"),
        (FROM_ONE, images(*(f"{k:06d}.png" for k in range(14))), "FROM_ZERO"),
        (GAPS, images("000000.png", "000001.png", "000002.png"), "FROM_ZERO"),
        (STAMPS, images(*range(2, 14)), "FROM_ONE"),
    ],
)
def test_check_matches_other_numbering_raises_with_setting(
    frames: dict[int, str], found: list[ImageId], fix: str
) -> None:
    with pytest.raises(DataError, match=rf"image_ids: expected ids .*set .*detector\.image_ids={fix}"):
        check_matches(PATH, found, ImageIds.AUTO, frames, warns=True)


def test_check_matches_unusable_numbering_is_not_suggested() -> None:
    found = images(1403636579763555584, 1403636579813555584)
    with pytest.raises(DataError, match=r"; set detector\.image_ids=FILE_NUMBER$"):
        check_matches(PATH, found, ImageIds.AUTO, NANOSECONDS, warns=True)


@pytest.mark.parametrize("found", [images("kitchen.png"), images("000001.png", "000003.png"), images(99)])
def test_check_matches_other_sequence_raises(found: list[ImageId]) -> None:
    with pytest.raises(DataError, match=r"expected detections of this sequence .*000000\.jpg.*, got detections\.json"):
        check_matches(PATH, found, ImageIds.AUTO, {k: name for k, name in GAPS.items() if k % 3 == 0}, warns=True)


def test_check_matches_given_meaning_is_not_refused(caplog: pytest.LogCaptureFixture) -> None:
    check_matches(PATH, images(*range(1, 15)), ImageIds.FROM_ZERO, PREFIXED, warns=True)
    assert "got 1 of 14 images that match no frame (first: 14)" in caplog.text
    with pytest.raises(DataError, match="expected detections of this sequence"):
        check_matches(PATH, images(14, 15), ImageIds.FROM_ZERO, PREFIXED, warns=True)


def test_check_matches_unmatched_ids_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    check_matches(PATH, images("000002.jpg", "000003.jpg", "x.jpg"), ImageIds.AUTO, GAPS, warns=True)
    [record] = [record for record in caplog.records if record.levelname == "WARNING"]
    assert "got 2 of 3 images that match no frame (first: '000003')" in record.getMessage()


@pytest.mark.parametrize(
    ("frames", "found", "level"),
    [
        (PREFIXED, images(0, 1, 2), "INFO"),
        (PREFIXED, images(1, 2, 3), "WARNING"),  # the first frame has no detections, or ids count from 1
        (PREFIXED, images(5, 6), "INFO"),
        (FROM_ONE, images(2, 3), "WARNING"),  # also numbers of files
        (PREFIXED, images("frame_000001.png"), "INFO"),
    ],
)
def test_check_matches_ambiguous_numbers_warn(
    frames: dict[int, str], found: list[ImageId], level: str, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO):
        check_matches(PATH, found, ImageIds.AUTO, frames, warns=True)
    assert caplog.records[-1].levelname == level
    caplog.clear()
    check_matches(PATH, found, ImageIds.AUTO, frames, warns=False)
    assert not [record for record in caplog.records if record.levelname == "WARNING"]

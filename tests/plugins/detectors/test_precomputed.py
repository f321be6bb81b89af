"""Tests for precomputed detections in files of COCO results and in folders of masks."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pycocotools import mask as coco

from framework.commands.running.detect import write_detections, write_labels
from framework.data import Camera, Detections, Frame
from framework.datasets.rgbd_folder import RgbdFolder
from framework.detection.map_classes import DetectorOfMap
from framework.detection.stored.cache import CachedDetector
from framework.errors import ConfigError, DataError, FrameError
from framework.vocabulary.category_ids import CategoryIds
from framework.vocabulary.label_spaces import COCO
from plugins.detectors.ground_truth import GroundTruthDetector
from plugins.detectors.precomputed import Precomputed
from plugins.detectors.simulated import SimulatedDetector
from tests.support.scenes.corner_room import CornerRoom, SphereDetector

CAMERA = Camera(8, 6, 10.0, 10.0, 3.5, 2.5)
MASK = np.zeros(CAMERA.shape, np.bool_)
MASK[1:4, 2:7] = True  # rows 1 to 3, columns 2 to 6
RUN_LENGTHS = [13, 3, 3, 3, 3, 3, 3, 3, 3, 3, 8]  # run lengths, column by column
PACKED = coco.encode(np.asfortranarray(MASK.view(np.uint8)))["counts"].decode()
CHAIR = COCO.index("chair")


def frame(index: int = 0, camera: Camera = CAMERA) -> Frame:
    shape = camera.shape
    return Frame(index, 0.0, np.zeros((*shape, 3), np.uint8), np.ones(shape, np.float32), camera)


def entry(**changes: Any) -> dict[str, Any]:
    """Return one result of a detection file. A value of None removes a key."""
    segmentation = {"size": [6, 8], "counts": PACKED}
    result = {"image_id": 0, "category_name": "chair", "segmentation": segmentation, "score": 0.6} | changes
    return {key: value for key, value in result.items() if value is not None}


def write(folder: Path, *entries: Any) -> Path:
    path = folder / "results.json"
    path.write_text(json.dumps(list(entries)))
    return path


def detected(folder: Path, *entries: Any, **parameters: Any) -> Detections:
    return Precomputed(write(folder, *entries), **parameters).detect(frame())


@pytest.mark.parametrize(
    "segmentation",
    [
        {"size": [6, 8], "counts": PACKED},
        {"size": [6, 8], "counts": RUN_LENGTHS},
        [[2, 1, 7, 1, 7, 4, 2, 4]],  # pixel borders, relative to the image corner
        [[2, 1, 7, 1, 7, 3, 2, 3], [2, 3, 7, 3, 7, 4, 2, 4]],  # a polygon of two parts
    ],
    ids=["packed", "list", "polygon", "polygons"],
)
def test_precomputed_all_segmentation_formats_are_read(tmp_path: Path, segmentation: Any) -> None:
    found = detected(tmp_path, entry(segmentation=segmentation))
    np.testing.assert_array_equal(found.masks, MASK[None])
    np.testing.assert_array_equal(found.boxes, [[2, 1, 6, 3]])  # without a bbox, the box of the mask is used


@pytest.mark.parametrize("image_id", [12, "000012", "12", "color/000012.png", "frame/000012.color.png"[6:12]])
def test_precomputed_all_image_id_formats_are_read(tmp_path: Path, image_id: Any) -> None:
    detector = Precomputed(write(tmp_path, entry(image_id=image_id)))
    assert [len(detector.detect(frame(k))) for k in (12, 0, 11)] == [1, 0, 0]


def test_precomputed_label_and_score_give_class_distribution(tmp_path: Path) -> None:
    [row] = detected(tmp_path, entry(score=0.6)).class_probabilities
    expected = np.full(80, 0.4 / 79)
    expected[CHAIR] = 0.6
    np.testing.assert_allclose(row, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("spread", "score", "own"), [(0.0, 0.6, 1.0), (0.5, 0.6, 0.8), (1.0, 1.0, 1.0), (1.0, 0, 1 / 80)]
)
def test_precomputed_class_spread_sets_other_probabilities(
    tmp_path: Path, spread: float, score: float, own: float
) -> None:
    """The label must remain the most likely class."""
    [row] = detected(tmp_path, entry(score=score), class_spread=spread).class_probabilities
    assert row[CHAIR] == pytest.approx(own)
    np.testing.assert_allclose(np.delete(row, CHAIR), (1 - own) / 79, rtol=1e-5, atol=1e-9)


def test_precomputed_full_distribution_is_kept_exactly(tmp_path: Path) -> None:
    row = np.random.default_rng(0).random(80).astype(np.float32)
    row /= row.sum()
    as_list = [float(p) for p in row]
    as_names = {name: p for name, p in zip(COCO, as_list, strict=True) if name != "person"} | {"person": as_list[0]}
    found = detected(tmp_path, entry(class_probabilities=as_list), entry(class_probabilities=as_names))
    np.testing.assert_array_equal(found.class_probabilities, [row, row])


def test_precomputed_partial_distribution_is_normalized(tmp_path: Path) -> None:
    found = detected(tmp_path, entry(class_probabilities={"chair": 0.66, "couch": 0.32}))
    expected = np.zeros(80)
    expected[CHAIR], expected[COCO.index("couch")] = 0.66 / 0.98, 0.32 / 0.98
    np.testing.assert_allclose(found.class_probabilities[0], expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("ids", "labels", "category_id", "name"),
    [
        (CategoryIds.COCO_91, "coco", 1, "person"),
        (CategoryIds.COCO_91, "coco", 62, "chair"),  # like in instances_val2017.json
        (CategoryIds.COCO_91, "coco", 90, "toothbrush"),
        (CategoryIds.FROM_ONE, "coco", 57, "chair"),
        (CategoryIds.FROM_ZERO, "coco", 56, "chair"),
        (CategoryIds.FROM_ONE, "nyu40", 5, "chair"),
        (CategoryIds.SCANNET, "scannet20", 33, "toilet"),
    ],
)
def test_precomputed_category_id_maps_to_label(
    tmp_path: Path, ids: CategoryIds, labels: str, category_id: int, name: str
) -> None:
    numbered = entry(category_name=None, category_id=category_id)
    found = detected(tmp_path, numbered, category_ids=ids, label_space=labels)
    assert found.classes[int(found.class_probabilities[0].argmax())] == name


def test_precomputed_foreign_labels_map_to_coco_or_are_dropped(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Detections of a wall are dropped and logged, because a wall is not an object."""
    entries = [entry(category_name="sofa", score=0.9), entry(category_name="wall", score=0.8)]
    with caplog.at_level(logging.INFO):
        found = detected(tmp_path, *entries, label_space="nyu40")
    assert [found.classes[k] for k in found.class_probabilities.argmax(axis=1)] == ["couch"]
    assert found.class_probabilities.max() == pytest.approx(0.9)
    assert "1 of 2 detections dropped because their classes have no COCO name: wall" in caplog.text


def test_precomputed_sorts_and_filters_detections_by_score(tmp_path: Path) -> None:
    entries = [entry(score=s, bbox=[k, 0, 1, 1]) for k, s in enumerate((0.2, 0.9, 0.05, 0.9))]
    found = detected(tmp_path, *entries, score_threshold=0.1)
    np.testing.assert_array_equal(found.scores, np.array([0.9, 0.9, 0.2], np.float32))
    np.testing.assert_array_equal(found.boxes[:, 0], [1, 3, 0])
    np.testing.assert_array_equal(found.boxes[:, 2] - found.boxes[:, 0], 1)


# Output of the command `detect`


@pytest.mark.parametrize(
    "detector",
    [SimulatedDetector(min_pixels=1, false_positives=3.0), GroundTruthDetector(min_pixels=1), SphereDetector()],
    ids=lambda detector: type(detector).__name__,
)
def test_precomputed_detection_file_round_trip_is_exact(tmp_path: Path, detector: Any) -> None:
    path, room = tmp_path / "results.json", CornerRoom()
    expected = [detector.detect(one) for one in room]
    assert write_detections(path, detector, room)["detections"] == sum(map(len, expected)) > 6
    labels = "coco" if detector.classes == COCO else str(write_labels(path, detector.classes))
    again = Precomputed(path, label_space=labels)
    assert again.classes == detector.classes
    for one, before in zip(room, expected, strict=True):
        after = again.detect(one)
        for name in ("masks", "boxes", "scores", "class_probabilities"):
            x, y = getattr(before, name), getattr(after, name)
            assert (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes()), name
        assert before.exact == after.exact or not len(before)


# Folders of masks


def write_folder(folder: Path, ids: np.ndarray | None = None, listed: Any = None, name: str = "000003") -> Path:
    """Write masks of a chair (7), a tv in the corner (300) and an instance that is not listed (9)."""
    image = np.where(MASK, 7, 0).astype(np.uint16)
    image[0, 0], image[5, 7] = 300, 9
    cv2.imwrite(str(folder / f"{name}.png"), image if ids is None else ids)
    detections = [{"id": 300, "class": "tv", "score": 0.5}, {"id": 7, "class": "chair", "score": 0.75}]
    (folder / f"{name}.json").write_text(json.dumps(detections if listed is None else listed))
    return folder


def test_precomputed_byte_order_mark_is_ignored(tmp_path: Path) -> None:
    path = write_folder(tmp_path) / "000003.json"
    path.write_text(path.read_text(), encoding="utf-8-sig")
    assert len(Precomputed(tmp_path).detect(frame(3))) == 2


def test_precomputed_mask_folder_is_read(tmp_path: Path) -> None:
    found = Precomputed(write_folder(tmp_path)).detect(frame(3))
    corner = np.zeros_like(MASK)
    corner[0, 0] = True
    np.testing.assert_array_equal(found.masks, [MASK, corner])
    np.testing.assert_array_equal(found.boxes, [[2, 1, 6, 3], [0, 0, 0, 0]])
    np.testing.assert_array_equal(found.scores, np.array([0.75, 0.5], np.float32))
    assert [COCO[k] for k in found.class_probabilities.argmax(axis=1)] == ["chair", "tv"]


@pytest.mark.parametrize(
    ("listed", "message"),
    [
        ([{"id": 0, "class": "tv", "score": 0.5}], r"id: expected an integer in \[1, 65535\], got 0"),
        (
            [{"id": 7, "class": "chairlift", "score": 0.5}],
            r"label: expected one of the 80 names in detector\.label_space, got .*'chairlift'",
        ),
        ([{"id": 7, "class": "tv"}], r"score: expected a number in \[0, 1\]"),
        ({"id": 7}, "expected a list of"),
        (
            [{"id": 7, "class": "tv", "score": 0.5}, {"id": 7, "class": "bed", "score": 1}],
            "entry 1: id: expected unique ids, got 7 twice",
        ),
    ],
)
def test_precomputed_invalid_mask_folder_entry_raises(tmp_path: Path, listed: Any, message: str) -> None:
    with pytest.raises(DataError, match=message) as raised:
        Precomputed(write_folder(tmp_path, listed=listed))
    assert "000003.json" in str(raised.value)


def test_precomputed_mask_folder_of_8_bits_is_read(tmp_path: Path) -> None:
    found = Precomputed(write_folder(tmp_path, np.where(MASK, np.uint8(7), np.uint8(0)))).detect(frame(3))
    np.testing.assert_array_equal(found.masks[0], MASK)


@pytest.mark.parametrize(
    ("category_id", "name"),
    [("62", "chair"), (62.0, "chair"), ("1", "person")],  # as text or by pandas
)
def test_precomputed_category_id_of_other_type_is_read(tmp_path: Path, category_id: Any, name: str) -> None:
    found = detected(tmp_path, entry(category_name=None, category_id=category_id))
    assert found.classes[int(found.class_probabilities[0].argmax())] == name


def test_precomputed_mask_folder_with_unpaired_file_raises(tmp_path: Path) -> None:
    (write_folder(tmp_path) / "000003.json").rename(tmp_path / "000004.json")
    with pytest.raises(DataError, match=r"000003\.json: expected a readable file"):
        Precomputed(tmp_path)
    (tmp_path / "000003.png").rename(tmp_path / "000005.png")
    (tmp_path / "000005.json").write_text("[]")
    with pytest.raises(DataError, match=r"000004\.json: expected an image 000004\.png"):
        Precomputed(tmp_path)


def test_precomputed_mask_folder_with_duplicate_frame_raises(tmp_path: Path) -> None:
    write_folder(write_folder(tmp_path), name="3")
    with pytest.raises(DataError, match=r"3\.png: expected one image of frame .*, got 000003\.png as well"):
        Precomputed(tmp_path)


@pytest.mark.parametrize(
    ("ids", "error"), [(np.zeros((6, 9), np.uint16), DataError), (np.zeros((6, 8, 3), np.uint8), FrameError)]
)
def test_precomputed_mask_image_with_wrong_size_or_type_raises(
    tmp_path: Path, ids: np.ndarray, error: type[DataError]
) -> None:
    with pytest.raises(error, match=r"000003\.(png|json).*(size, 8x6 px, got 9x6 px|uint8)"):
        Precomputed(write_folder(tmp_path, ids)).detect(frame(3))


# Rejected files


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"image_id": ""}, "image_id: expected a frame number, or a file name such as 000012.png, got"),
        ({"image_id": -1}, "image_id"),
        ({"image_id": True}, "image_id"),
        ({"image_id": 0.5}, "image_id: expected a frame number, or a file name such as 000012.png, got"),
        ({"category_name": "chiar"}, "label: expected one of the 80 names in detector.label_space, got"),
        ({"category_name": None}, "category_id: expected category_id or category_name, got neither; add one of them"),
        ({"score": 1.5}, "score: expected a number in [0, 1], got 1.5"),
        ({"score": None}, "score"),
        (
            {"segmentation": None},
            "segmentation: expected run lengths with size [height, width], or a list of polygons, got None",
        ),
        ({"segmentation": {"size": [6, 8], "counts": "\u00e9"}}, "packed string"),
        ({"segmentation": {"size": [6, 8], "counts": PACKED[:-1]}}, "run lengths: expected 8x6 = 48 px, got 40 px"),
        ({"segmentation": {"size": [6, 9], "counts": PACKED}}, "run lengths: expected 9x6 = 54 px, got 48 px"),
        ({"segmentation": {"size": [6], "counts": PACKED}}, "size"),
        ({"segmentation": {"size": [6, 8], "counts": [3, 4]}}, "run lengths: expected"),
        ({"segmentation": [[1, 2, 3, 4]]}, "at least 3 points, got [1, 2, 3, 4]"),
        ({"segmentation": []}, "segmentation: expected at least one polygon, got an empty list"),
        ({"bbox": [1, 2, 3]}, "bbox: expected [x, y, width, height] px, at most"),
        ({"class_probabilities": [0.5, 0.5]}, "class_probabilities: expected 80 values, one for each label, got 2"),
        ({"class_probabilities": {"chair": 0.5}}, "class_probabilities: expected a sum of 1, got 0.5"),
        ({"class_probabilities": {"chair": 1.5, "couch": -0.5}}, "expected numbers of at least 0"),
        ({"class_probabilities": {"sofa": 1.0}}, "'sofa'"),
    ],
)
def test_precomputed_invalid_entry_raises_one_line_error(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError) as raised:
        Precomputed(write(tmp_path, entry(), entry(**changes)))
    assert message in str(raised.value)
    assert f"{tmp_path}/results.json, entry 1: " in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[{]", "expected valid JSON"),
        ('{"annotations": []}', "expected a list of results in COCO's format, or an object with lists of images, ann"),
        ('{"images": [], "annotations": [], "categories": []}', "expected at least one detection"),
        ('{"images": [], "annotations": [{"image_id": 3}], "categories": []}', "annotation 0: expected ids of images"),
        ('{"images": [], "annotations": [{"image_id": []}], "categories": []}', "annotation 0: expected ids of images"),
        (
            '{"images": [{"id": [1]}], "annotations": [], "categories": []}',
            "image 0: expected a numeric or string id",
        ),
        ("[]", "expected at least one detection"),
        ("[3]", "entry 0"),
    ],
)
def test_precomputed_invalid_or_missing_result_file_raises(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "results.json").write_text(content)
    with pytest.raises(DataError, match=message):
        Precomputed(tmp_path / "results.json")
    with pytest.raises(DataError, match=r"absent\.json: expected a readable file"):
        Precomputed(tmp_path / "absent.json")


def test_precomputed_result_file_with_two_sequences_raises(tmp_path: Path) -> None:
    path = write(tmp_path, entry(image_id="kitchen/000002.png"), entry(image_id="hall/000002.png"))
    with pytest.raises(
        DataError,
        match=r"entry 1: hall/000002\.png: expected one image 000002, got another image in kitchen/",
    ):
        Precomputed(path)


def test_precomputed_mask_with_wrong_frame_size_raises(tmp_path: Path) -> None:
    detector = Precomputed(write(tmp_path, entry()))
    with pytest.raises(DataError, match=r"entry 0: frame 0: mask: expected the frame's size, 16x12 px, got 8x6 px"):
        detector.detect(frame(camera=CAMERA.scaled(2)))
    detector = Precomputed(write(tmp_path, entry(segmentation=[[0, 0, 12, 0, 12, 6]])))
    with pytest.raises(
        DataError, match="entry 0: frame 0: polygon: expected points in the image of 8x6 px, got a point 4 px outside"
    ):
        detector.detect(frame())


def test_precomputed_result_file_of_other_sequence_raises(tmp_path: Path) -> None:
    path = write(tmp_path, entry(image_id=2), entry(image_id=5))
    strange = Precomputed(path)
    for index in (0, 1, 3, 4):
        assert len(strange.detect(frame(index))) == 0
    with pytest.raises(
        DataError,
        match=r"got .* frames 2 to 5 and none for the frames requested so far, up to 6",
    ):
        strange.detect(frame(6))
    fitting = Precomputed(path)
    assert [len(fitting.detect(frame(k))) for k in (2, 6, 900)] == [1, 0, 0]


def test_precomputed_possible_sequence_mismatch_warns_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    detector = Precomputed(write(tmp_path, entry(image_id=5000)))
    for index in range(100):
        detector.detect(frame(index))
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "none for the first 30 frames" in caplog.text


def test_precomputed_coco_91_ids_with_other_label_space_raise(tmp_path: Path) -> None:
    path = write(tmp_path, entry(category_name=None, category_id=1))
    with pytest.raises(ConfigError, match="FROM_ONE or FROM_ZERO"):
        Precomputed(path, label_space="nyu40", category_ids=CategoryIds.COCO_91)


def test_precomputed_invalid_parameter_raises(tmp_path: Path) -> None:
    for wrong in ({"class_spread": 1.5}, {"score_threshold": -0.1}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            Precomputed(write(tmp_path, entry()), **wrong)


def test_precomputed_unusable_or_duplicate_label_raises(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected detections of known classes, got none in 1 detections"):
        Precomputed(write(tmp_path, entry(category_name="wall")), label_space="nyu40")
    (tmp_path / "labels.txt").write_text("chair\nchair\n")
    with pytest.raises(ConfigError, match=r"detector\.label_space: expected unique names, got 'chair' twice"):
        Precomputed(write(tmp_path, entry()), label_space=str(tmp_path / "labels.txt"))


# File names


@pytest.mark.parametrize(
    ("image_name", "image_id"),
    [
        ("000004.jpg", "color/000004.jpg"),
        ("frame_000012.jpg", "frame_000012.png"),
        ("000012.png", "color\\000012.png"),
        ("1305031102.175304.png", "rgb/1305031102.175304.png"),
        ("frame-000007.color.png", "seq-01/frame-000007.color.png"),
    ],
)
def test_precomputed_file_name_belongs_to_frame_with_this_file(tmp_path: Path, image_name: str, image_id: str) -> None:
    detector = Precomputed(write(tmp_path, entry(image_id=image_id)))
    assert len(detector.detect(replace(frame(2), image_name=image_name))) == 1
    assert len(detector.detect(replace(frame(4), image_name="000099.png"))) == 0


def test_precomputed_mask_named_like_color_image_is_read(tmp_path: Path) -> None:
    detector = Precomputed(write_folder(tmp_path, name="frame_000003"))
    assert len(detector.detect(replace(frame(1), image_name="frame_000003.jpg"))) == 2


@pytest.mark.parametrize("numbers", [range(0, 8, 2), range(1, 5), range(4), range(7, 11), (3, 4, 9, 12)])
@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("masks", [False, True])
def test_precomputed_numbered_folder_finds_its_masks(
    tmp_path: Path, numbers: Sequence[int], stride: int, masks: bool
) -> None:
    """Frame k has k + 1 detections, named by the file of its color image."""
    root, stored = tmp_path / "room", tmp_path / "stored"
    for folder in (root / "color", root / "depth", stored):
        folder.mkdir(parents=True)
    camera = {"width": 8, "height": 6, "fx": 10.0, "fy": 10.0, "cx": 3.5, "cy": 2.5, "depth_scale": 1000.0}
    (root / "camera.json").write_text(json.dumps(camera))
    entries = []
    for k, number in enumerate(numbers):
        cv2.imwrite(str(root / "color" / f"{number:06d}.png"), np.zeros((6, 8, 3), np.uint8))
        cv2.imwrite(str(root / "depth" / f"{number:06d}.png"), np.full((6, 8), 1000, np.uint16))
        entries += [entry(image_id=f"color/{number:06d}.jpg")] * (k + 1)
        listed = [{"id": one + 1, "class": "chair", "score": 0.5} for one in range(k + 1)]
        write_folder(stored, np.arange(1, 49, dtype=np.uint16).reshape(6, 8), listed, f"{number:06d}")
    sequence = RgbdFolder(root, stride=stride)
    detector = Precomputed(stored if masks else write(tmp_path, *entries))
    detector.check_sequence(sequence)
    assert [len(detector.detect(one)) for one in sequence] == [one.index + 1 for one in sequence]


@pytest.mark.parametrize(
    "wrapped",
    [
        lambda detector, folder: CachedDetector(detector, folder),
        lambda detector, folder: DetectorOfMap(detector, (*COCO, "forklift")),
    ],
    ids=["cached", "of_map"],
)
def test_precomputed_in_other_detector_checks_sequence(tmp_path: Path, wrapped: Any) -> None:
    detector = Precomputed(write(tmp_path, entry(image_id="color/000007.jpg")))
    with pytest.raises(DataError, match="expected detections of this sequence"):
        wrapped(detector, tmp_path / "cache").check_sequence(NamedRoom())


class NamedRoom(CornerRoom):
    """A room whose frames have numbered files with gaps."""

    def image_names(self) -> dict[int, str]:
        return {k: f"{2 * k:06d}.jpg" for k in range(len(self))}


def test_precomputed_detections_of_other_files_raise(tmp_path: Path) -> None:
    detector = Precomputed(write(tmp_path, entry(image_id="color/000007.jpg")))
    with pytest.raises(DataError, match=r"expected detections of this sequence .*000000\.jpg.*first: '000007'"):
        detector.check_sequence(NamedRoom())
    detector = Precomputed(write(tmp_path, entry(image_id=len(NamedRoom()))))
    with pytest.raises(DataError, match=r"set detector\.image_ids=FROM_ONE"):
        detector.check_sequence(NamedRoom())


def test_precomputed_file_names_without_numbers_need_named_frames(tmp_path: Path) -> None:
    detector = Precomputed(write(tmp_path, entry(image_id="left.png")))
    with pytest.raises(DataError, match=r"expected frame numbers .*first: 'left'.*frame 0 has no file"):
        detector.detect(frame())


def test_precomputed_file_name_precedes_image_id(tmp_path: Path) -> None:
    detector = Precomputed(write(tmp_path, entry(image_id=0, file_name="000006.jpg")))  # as Ultralytics writes
    detector.check_sequence(NamedRoom())
    assert len(detector.detect(replace(frame(3), image_name="000006.jpg"))) == 1
    assert len(detector.detect(replace(frame(0), image_name="000000.jpg"))) == 0


def dataset(image: dict[str, Any], category: str, **changes: Any) -> dict[str, Any]:
    """Return a COCO dataset with one annotation of the image 17 and the category 3."""
    segmentation = [[2, 1, 7, 1, 7, 4, 2, 4]]
    annotation = {"id": 1, "image_id": 17, "category_id": 3, "segmentation": segmentation, "iscrowd": 0, "area": 15}
    return {
        "images": [{"id": 9, "file_name": "000000.jpg"}, {"id": 17, **image}],
        "annotations": [annotation | changes],
        "categories": [{"id": 0, "name": "things"}, {"id": 3, "name": category, "supercategory": "things"}],
    }


@pytest.mark.parametrize(
    ("image", "category", "changes", "score"),
    [
        ({"file_name": "000006.jpg"}, "chair", {}, 1.0),
        ({"file_name": "C:\\scans\\color\\000006.png"}, "chair", {"score": 0.5}, 0.5),
        ({"file_name": "000006_jpg.rf.a1b2c3.jpg"}, "Chair", {}, 1.0),  # Roboflow
        ({"file_name": "x.jpg", "extra": {"name": "000006.jpg"}}, "chair", {}, 1.0),
        ({"file_name": "6.png"}, "chair", {"segmentation": {"size": [6, 8], "counts": RUN_LENGTHS}}, 1.0),
    ],
    ids=["file", "windows", "roboflow", "roboflow_extra", "crowd"],
)
def test_precomputed_coco_dataset_is_read(
    tmp_path: Path, image: dict[str, Any], category: str, changes: dict[str, Any], score: float
) -> None:
    (tmp_path / "dataset.json").write_text(json.dumps(dataset(image, category, **changes)))
    detector = Precomputed(tmp_path / "dataset.json")
    detector.check_sequence(NamedRoom())
    found = detector.detect(replace(frame(3), image_name="000006.jpg"))
    assert (len(found), float(found.scores[0])) == (1, score)
    np.testing.assert_array_equal(found.masks[0], MASK)
    assert COCO[found.class_probabilities[0].argmax()] == "chair"


@pytest.mark.parametrize(
    ("written", "name"),
    [("sofa", "couch"), ("tvmonitor", "tv"), ("Dining Table", "dining table"), ("potted_plant", "potted plant")],
)
def test_precomputed_other_name_of_class_is_read(tmp_path: Path, written: str, name: str) -> None:
    found = detected(tmp_path, entry(category_name=written))
    assert found.classes[int(found.class_probabilities[0].argmax())] == name


# Own classes


def test_precomputed_label_file_with_unused_ids_is_read(tmp_path: Path) -> None:
    (tmp_path / "labels.txt").write_text("\n".join(["__background__", "forklift", "N/A", "pallet"]))
    entries = [entry(category_name=None, category_id=3), entry(category_name="forklift", score=0.5)]
    found = detected(tmp_path, *entries, label_space=str(tmp_path / "labels.txt"))
    assert found.classes == ("forklift", "pallet")
    assert [found.classes[k] for k in found.class_probabilities.argmax(axis=1)] == ["pallet", "forklift"]


@pytest.mark.parametrize(
    ("labels", "found", "parameters", "name"),
    [
        (("forklift", "pallet"), {"category_id": 1}, {"category_ids": CategoryIds.FROM_ONE}, "forklift"),
        (("forklift", "pallet"), {"category_id": 2}, {}, "pallet"),
        (("forklift", "pallet"), {"category_id": 0}, {}, "forklift"),
        (("forklift", "pallet", "chair"), {"category_name": "pallet"}, {}, "pallet"),
        (("forklift", "pallet", "chair"), {"category_id": 3}, {}, "chair"),
    ],
)
def test_precomputed_own_classes_keep_their_names(
    tmp_path: Path, labels: tuple[str, ...], found: dict[str, Any], parameters: dict[str, Any], name: str
) -> None:
    (tmp_path / "labels.txt").write_text("\n".join(labels))
    one = entry(**{"category_name": None, **found})
    detected_one = detected(tmp_path, one, label_space=str(tmp_path / "labels.txt"), **parameters)
    assert detected_one.classes[int(detected_one.class_probabilities[0].argmax())] == name


def test_precomputed_ambiguous_own_ids_raise(tmp_path: Path) -> None:
    (tmp_path / "labels.txt").write_text("forklift\npallet")
    with pytest.raises(ConfigError, match=r"1 is 'forklift' by FROM_ONE or 'pallet' by FROM_ZERO; set detector\.cat"):
        detected(tmp_path, entry(category_name=None, category_id=1), label_space=str(tmp_path / "labels.txt"))


def test_precomputed_mask_folder_keeps_own_classes(tmp_path: Path) -> None:
    (tmp_path / "labels.txt").write_text("forklift\npallet")
    folder = tmp_path / "masks"
    folder.mkdir()
    write_folder(folder, listed=[{"id": 7, "class": "forklift", "score": 0.9}])
    found = Precomputed(folder, label_space=str(tmp_path / "labels.txt")).detect(frame(3))
    assert found.classes == ("forklift", "pallet")
    assert found.class_probabilities[0].argmax() == 0

"""Tests for the included network, on rooms that were not used for training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from framework.data import Camera, Frame
from framework.detection.mask_rcnn.network_file import describe_network
from framework.evaluation.detection_ap import detection_ap
from framework.training.augmentation import MIN_PIXELS
from framework.training.room_pictures import RoomPictures, render_rooms
from framework.vocabulary.label_spaces import SCENENN_TO_COCO
from plugins.detectors.mask_rcnn import MaskRCNNDetector
from tests.support import registered

pytestmark = pytest.mark.integration

ROOMS = 2_000_000  # seed of rooms that are neither training nor held-out rooms
MAX_BYTES = 20 << 20


@pytest.fixture(scope="module")
def detector() -> MaskRCNNDetector:
    detector = registered.built("detector", "mask_rcnn_rooms", "device=cpu")
    assert isinstance(detector, MaskRCNNDetector)
    return detector


def test_bundled_network_is_small_and_has_model_card(detector: MaskRCNNDetector) -> None:
    assert Path(detector.weights).stat().st_size < MAX_BYTES
    assert set(detector.classes) == set(SCENENN_TO_COCO.values())
    card = describe_network(Path(detector.weights)).card
    assert {"data", "steps", "seed", "mask_ap50", "limits"} <= set(card)
    assert isinstance(card["mask_ap50"], float)
    assert card["mask_ap50"] >= 0.5, "expected a mean AP50 of at least 0.5 over the nine classes on held-out rooms"


@pytest.mark.acceptance
def test_bundled_network_detects_objects_in_unseen_rooms(detector: MaskRCNNDetector, tmp_path: Path) -> None:
    """The bound is low, because there are few images. The complete results are in the model card."""
    render_rooms(tmp_path, ROOMS, 2, 10, 1)
    pictures = RoomPictures(tmp_path, ROOMS, 2, 10)
    found = []
    for k in range(len(pictures)):
        example = pictures[k]
        height, width = example.color.shape[:2]
        camera = Camera(width, height, width, width, (width - 1) / 2, (height - 1) / 2)
        frame = Frame(k, float(k), example.color, np.zeros((height, width), np.float32), camera)
        found.append((example.masks, example.class_names, detector.detect(frame)))
    precision = detection_ap(found, detector.classes, MIN_PIXELS).masks
    assert precision.objects >= 30
    assert precision.ap50 >= 0.4

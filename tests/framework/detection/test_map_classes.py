"""Tests for detections with the classes of a stored map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from framework.detection.map_classes import with_classes_of_map
from framework.detection.stored.cache import identity_of
from framework.errors import ConfigError
from tests.support.scenes.corner_room import CLASSES, CornerRoom, SphereDetector


def test_new_classes_of_map_have_probability_zero() -> None:
    detector, frame = SphereDetector(), CornerRoom()[0]
    wide = with_classes_of_map(detector, ("forklift", *reversed(CLASSES)))
    plain, found = detector.detect(frame), wide.detect(frame)
    assert found.classes == wide.classes == ("forklift", "couch", "chair")
    np.testing.assert_array_equal(found.class_probabilities[:, [2, 1]], plain.class_probabilities)
    assert not found.class_probabilities[:, 0].any()
    np.testing.assert_array_equal(found.masks, plain.masks)


@pytest.mark.parametrize("classes", [(), CLASSES])
def test_detector_of_map_without_new_classes_is_unchanged(classes: tuple[str, ...]) -> None:
    detector = SphereDetector()
    assert with_classes_of_map(detector, classes) is detector


def test_detector_of_map_keeps_calibration(tmp_path: Path) -> None:
    detector = SphereDetector()
    detector.calibration = tmp_path / "net.calibration.json"
    assert with_classes_of_map(detector, (*CLASSES, "forklift")).calibration == detector.calibration


def test_map_without_class_of_detector_is_error() -> None:
    with pytest.raises(ConfigError, match=r"expected the 2 classes of the stored map, got other classes \('couch'\)"):
        with_classes_of_map(SphereDetector(), ("chair", "forklift"))


def test_fingerprint_includes_detector_and_classes() -> None:
    wide, other = (with_classes_of_map(SphereDetector(), (*CLASSES, name)) for name in ("forklift", "pallet"))
    assert identity_of(SphereDetector()) in identity_of(wide) != identity_of(other)

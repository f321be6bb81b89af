"""Tests for the demo."""

from __future__ import annotations

import pytest

from framework.config.composition import composed
from framework.files.search_paths import PROJECT_ROOT
from framework.interfaces import RGBDSequence
from framework.registry import build
from instancemap import Mapper

pytestmark = pytest.mark.integration

DESK = PROJECT_ROOT / "data" / "desk"


def test_desk_data_is_small_and_has_attribution() -> None:
    assert sum(path.stat().st_size for path in DESK.rglob("*") if path.is_file()) < 12e6
    card = (DESK / "README.md").read_text()
    assert all(word in card for word in ("Sturm", "Attribution 4.0", "JPEG", "corrected"))


def test_desk_is_tracked_and_objects_are_detected() -> None:
    """Only the first 24 frames are mapped."""
    config = composed("dataset=desk")
    assert config.detector._target_ == "plugins.detectors.maskrcnn2go.MaskRCNN2Go"
    sequence = build(RGBDSequence, composed("dataset=desk", "dataset.stop=24").dataset)
    mapper = Mapper("fuser.voxel_size=0.02")
    assert not any(mapper.add(sequence[k]).lost for k in range(len(sequence)))
    classes = mapper.scene.classes
    found = {classes[int(one.class_probabilities.argmax())] for one in mapper.instances().values()}
    assert {"tv", "keyboard"} <= found

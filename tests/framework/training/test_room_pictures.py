"""Tests for the training images of one rendered room."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from framework.training import room_pictures
from framework.training.room_pictures import RoomPictures, pictures, render_room, room_folder
from framework.vocabulary.label_spaces import SCENENN_TO_COCO

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def seen() -> list[tuple[np.ndarray, np.ndarray, dict[int, str]]]:
    return list(pictures(2, 3))


def test_room_pictures_show_known_classes_in_varied_colors(seen: list) -> None:
    for color, ids, names in seen:
        assert color.shape == (*ids.shape, 3)
        assert set(names.values()) <= set(SCENENN_TO_COCO.values())
        assert np.isin(ids, list(names)).sum() >= room_pictures.MIN_PIXELS
    assert not np.array_equal(seen[0][0], seen[1][0])


def test_room_pictures_round_trip_keeps_masks_and_classes(seen: list, tmp_path: Path) -> None:
    render_room(tmp_path, 3, 2)
    assert [path.name for path in tmp_path.iterdir()] == ["room_000002_3"], "expected no temporary folder"
    stored = RoomPictures(tmp_path, 2, 1, 3)
    assert len(stored) == 3
    for k, (color, ids, names) in enumerate(seen):
        example = stored[k]
        assert cv2.PSNR(example.color, color) > 25
        visible = [i for i in np.unique(ids).tolist() if i in names]
        assert np.array_equal(example.masks, ids == np.array(visible).reshape(-1, 1, 1))
        assert example.class_names == tuple(names[i] for i in visible)


def test_render_rooms_keeps_existing_rooms(tmp_path: Path) -> None:
    kept = room_folder(tmp_path, 0, 3)
    kept.mkdir()
    room_pictures.render_rooms(tmp_path, 0, 1, 3, 1)
    assert list(kept.iterdir()) == []


def test_render_rooms_renders_other_number_of_images(tmp_path: Path) -> None:
    room_folder(tmp_path, 0, 3).mkdir()
    room_pictures.render_rooms(tmp_path, 0, 1, 1, 1)
    assert len(RoomPictures(tmp_path, 0, 1, 1)) == 1

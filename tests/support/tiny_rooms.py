"""Images that a tiny network can learn in seconds, with red chairs and blue beds on gray."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from framework.training.room_pictures import room_folder

PICTURES = 6


def write_room(folder: Path, number: int) -> None:
    """Write a room like render_room(), with images of 64x48 px."""
    room = room_folder(folder, number, PICTURES)
    room.mkdir(parents=True)
    rng = np.random.default_rng(number)
    for k in range(PICTURES):
        color, ids = np.full((48, 64, 3), 128, np.uint8), np.zeros((48, 64), np.uint16)
        for i, bgr in ((1, (0, 0, 255)), (2, (255, 0, 0))):
            u, v = 32 * (i - 1) + int(rng.integers(2, 10)), int(rng.integers(2, 20))
            color[v : v + 24, u : u + 18], ids[v : v + 24, u : u + 18] = bgr, i
        cv2.imwrite(str(room / f"{k:06d}.jpg"), color)
        cv2.imwrite(str(room / f"{k:06d}.png"), ids)
    (room / "classes.json").write_text(json.dumps({"1": "chair", "2": "bed"}))

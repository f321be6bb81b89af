"""Masks of screens and textbooks by color, in place of a network."""

import json
from pathlib import Path

import cv2
import numpy as np

from instancemap import open_dataset

COLORS = {  # range of hue, saturation and value, and the minimum area in px
    "screen": ((0, 0, 4), (180, 255, 40), 3000),
    "textbook": ((98, 90, 80), (125, 255, 255), 1000),
}
folder = Path("masks")
folder.mkdir(exist_ok=True)
Path("names.txt").write_text("\n".join(COLORS) + "\n")
for frame in open_dataset("desk"):
    hsv = cv2.cvtColor(frame.color, cv2.COLOR_RGB2HSV)
    ids, detections = np.zeros(frame.depth.shape, np.uint16), []
    for name, (low, high, min_area) in COLORS.items():
        count, regions, stats, _ = cv2.connectedComponentsWithStats(cv2.inRange(hsv, low, high))
        for k in range(1, count):
            if stats[k, cv2.CC_STAT_AREA] >= min_area:
                detections.append({"id": len(detections) + 1, "class": name, "score": 0.8})
                ids[regions == k] = len(detections)
    cv2.imwrite(str(folder / f"{frame.index:06d}.png"), ids)
    (folder / f"{frame.index:06d}.json").write_text(json.dumps(detections))

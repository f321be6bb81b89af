"""The pair of files that ROS's map_server reads: map.pgm and map.yaml (wiki.ros.org/map_server, nav2_map_server)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from framework.data import UInt8
from framework.exporting.occupancy import Plan
from framework.files.atomic_write import written_whole

OCCUPIED, FREE, UNKNOWN = 0, 254, 205  # levels of grey, as map_saver writes them
OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196  # of (255 - level) / 255: 205 is just above the second one


def write_ros_map(directory: Path, found: Plan) -> list[Path]:
    """Writes both files. The map's frame is the room's: z up, the floor at 0, the same x and y as in all exports."""
    image, yaml = directory / "map.pgm", directory / "map.yaml"
    with written_whole(image) as temporary:
        Image.fromarray(levels(found)).save(temporary)
    x, y = found.origin.tolist()
    lines = [
        f"image: {image.name}",
        "mode: trinary",
        f"resolution: {found.resolution:g}",
        f"origin: [{x:.6g}, {y:.6g}, 0.0]",
        "negate: 0",
        f"occupied_thresh: {OCCUPIED_THRESHOLD}",
        f"free_thresh: {FREE_THRESHOLD}",
    ]
    with written_whole(yaml) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
    return [image, yaml]


def levels(found: Plan) -> UInt8:
    """(H, W) the picture: its first row has the highest y."""
    grey = np.where(found.occupied, OCCUPIED, np.where(found.free, FREE, UNKNOWN)).astype(np.uint8)
    return np.ascontiguousarray(grey[::-1])

"""Copy an RGB-D folder frame by frame at a given rate, like a camera.

Usage: `python -m tests.benchmarks.feeder SOURCE TARGET FRAMES HZ`. The frames of the source are played forward and
backward, and each file is written atomically. TARGET/feeder.csv contains the index of each frame and its Unix time in
seconds.
"""

from __future__ import annotations

import shutil
import sys
import time
from pathlib import Path

from framework.datasets.frames.numbered_images import numbered_images


def feed(source: Path, target: Path, frames: int, hz: float) -> None:
    """Write camera.json, then `frames` frames at `hz` Hz, and finally the file `end`."""
    color = list(numbered_images(source / "color", (".jpg", ".png")).values())
    depth = list(numbered_images(source / "depth", (".png",)).values())
    there = []
    for folder in ("color", "depth"):
        (target / folder).mkdir()
    shutil.copyfile(source / "camera.json", target / "camera.json")
    began = time.monotonic()
    for number in range(frames):
        k = number % (2 * len(color) - 2)
        k = min(k, 2 * len(color) - 2 - k)
        temporary = []
        for path in (color[k], depth[k]):
            temporary.append(target / path.parent.name / f".{number:06d}{path.suffix}")
            shutil.copyfile(path, temporary[-1])
        time.sleep(max(0.0, began + number / hz - time.monotonic()))
        for path in temporary:
            path.rename(path.with_name(path.name[1:]))
        there.append(time.time())
    (target / "end").touch()
    (target / "feeder.csv").write_text("".join(f"{number},{when:.6f}\n" for number, when in enumerate(there)))


if __name__ == "__main__":
    feed(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4]))

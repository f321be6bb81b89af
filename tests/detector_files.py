"""Small stand-ins for the files that only a user has, so that the contracts run on the detectors that need them."""

from __future__ import annotations

from pathlib import Path

from framework.commands.detect import write_detections, write_labels
from tests.scenes.corner_room import CornerRoom, SphereDetector
from tests.tiny_mask_rcnn import tiny_network_file


def overrides(name: str, folder: Path) -> list[str]:
    """What to set so that detector=`name` works on the corner room; files are made in `folder`."""
    if name == "mask_rcnn":
        return [f"detector.weights={tiny_network_file(folder)}"]
    if name != "precomputed":
        return []
    path = folder / "detections.json"
    write_detections(path, SphereDetector(), CornerRoom())
    return [f"detector.path={path}", f"detector.labels={write_labels(path, SphereDetector().classes)}"]

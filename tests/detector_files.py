"""Small stand-ins for the files that only a user has, so that the contracts run on the detectors that need them."""

from __future__ import annotations

from pathlib import Path

from tests.tiny_mask_rcnn import tiny_network_file


def overrides(name: str, folder: Path) -> list[str]:
    """What to set so that detector=`name` works on the corner room; files are made in `folder`."""
    if name != "mask_rcnn":
        return []
    return [f"detector.weights={tiny_network_file(folder)}"]

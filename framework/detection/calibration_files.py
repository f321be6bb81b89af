"""Files with the calibrations of networks."""

from __future__ import annotations

from pathlib import Path

from framework.files.search_paths import PROJECT_ROOT, candidates

SUFFIX = ".calibration.json"
LEARNED = PROJECT_ROOT / "plugins" / "detectors"  # folder of the calibrations of this project


def calibration_of(weights: Path) -> Path | None:
    """Return the file with the calibration of a network, or None for a network without one.

    The file is named after the weights, such as yolo11n_seg.calibration.json for yolo11n_seg.onnx. It is searched next
    to the weights, then in LEARNED.
    """
    name = f"{weights.stem}{SUFFIX}"
    places = [*(found.with_name(name) for found in candidates(weights)), LEARNED / name]
    return next((path for path in places if path.is_file()), None)

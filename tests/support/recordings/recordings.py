"""Functions that the tests of several readers share."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from framework.errors import FrameError
from framework.interfaces import RGBDSequence
from framework.pipeline import Pipeline
from framework.runtime.run_log import RunResult
from plugins.detectors.none import NoDetections
from plugins.trackers.ground_truth import GroundTruth
from tests.support import registered
from tests.support.scenes.corner_room import GridFuser, KeepAll


def write_color(path: Path, rgb: tuple[int, int, int], shape: tuple[int, int] = (480, 640)) -> None:
    """Write an image of one color."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((*shape, 3), rgb[::-1], np.uint8))


def write_depth(path: Path, value: int | np.ndarray, shape: tuple[int, int] = (480, 640)) -> None:
    """Write a uint16 image of one value or of the given ones."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.broadcast_to(value, shape).astype(np.uint16))


def mapped(sequence: RGBDSequence) -> tuple[RunResult, np.ndarray]:
    """Run all frames with true poses; return the result and the mapped points (P, 3) in the world."""
    fuser = GridFuser()
    result = Pipeline(NoDetections(), GroundTruth(), KeepAll(), fuser, prefetch=0).run(sequence)
    return result, fuser.scene.mesh().vertices


def opened(option: str, *overrides: str) -> RGBDSequence:
    """Open the recording like `python -m framework dataset=OPTION ...`."""
    sequence: RGBDSequence = registered.built("dataset", option, *overrides)
    return sequence


def fault_of(sequence: RGBDSequence, bad: int) -> str:
    """Return the error of frame `bad`; the other frames must be readable."""
    for k in range(len(sequence)):
        if k != bad:
            sequence[k]
    try:
        sequence[bad]
    except FrameError as error:
        assert "\n" not in str(error)
        return str(error)
    raise AssertionError(f"frame {bad} has no fault")

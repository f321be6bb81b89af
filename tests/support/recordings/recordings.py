"""Functions for the tests of dataset readers."""

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
    """Write a uint16 image. `value` is a constant or an array (H, W)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.broadcast_to(value, shape).astype(np.uint16))


def mapped(sequence: RGBDSequence) -> tuple[RunResult, np.ndarray]:
    """Map all frames with ground-truth poses. Return the result and the points (P, 3), m, in the world frame."""
    fuser = GridFuser()
    result = Pipeline(NoDetections(), GroundTruth(), KeepAll(), fuser, prefetch=0).run(sequence)
    return result, fuser.scene.mesh().vertices


def opened(option: str, *overrides: str) -> RGBDSequence:
    """Open the recording like `python -m framework dataset=OPTION ...`."""
    sequence: RGBDSequence = registered.built("dataset", option, *overrides)
    return sequence


def fault_of(sequence: RGBDSequence, bad: int) -> str:
    """Return the error of frame `bad` after checking that the other frames are readable."""
    for k in range(len(sequence)):
        if k != bad:
            sequence[k]
    try:
        sequence[bad]
    except FrameError as error:
        assert "\n" not in str(error)
        return str(error)
    raise AssertionError(f"frame {bad}: expected a FrameError, got none")

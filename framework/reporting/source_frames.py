"""The frames of a recording that a report looks at: their pictures, how sharp they are, and where they were taken."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from framework.data import Camera, Float64, UInt8
from framework.reporting.run_source import RunSource

LARGEST = 640  # px, the width of the pictures that are kept
BLURRED = 0.3  # the least clarity: a blurred picture of an object is better than one from far away


@dataclass(frozen=True)
class Footage:
    """What was read, by the number of the pose in the trajectory; frames that cannot be read are not in it."""

    camera: Camera  # of the pictures
    images: Mapping[int, UInt8]  # (H, W, 3) RGB
    frames: Mapping[int, int]  # their numbers in the video
    true_positions: Mapping[int, Float64]  # (3,) m, of those whose true pose is known
    clarity: Mapping[int, float]  # in [BLURRED, 1], 1 = as sharp as half of them, or sharper

    @classmethod
    def of(cls, recording: RunSource, chosen: Sequence[int], camera: Camera) -> Footage:
        """Reads the frames of the chosen poses."""
        small = camera.scaled(min(1.0, LARGEST / camera.width))
        images, frames, positions, sharpness = {}, {}, {}, {}
        for k in chosen:
            frame = recording.frame(k)
            if frame is None:
                continue
            image = cv2.resize(frame.color, (small.width, small.height), interpolation=cv2.INTER_AREA)
            images[k], frames[k] = np.asarray(image), frame.index
            sharpness[k] = float(cv2.Laplacian(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.CV_32F).var())
            if frame.T_world_camera is not None:
                positions[k] = frame.T_world_camera[:3, 3]
        usual = max(float(np.median(list(sharpness.values()))), 1e-9) if sharpness else 1.0
        clarity = {k: min(max(value / usual, BLURRED), 1.0) for k, value in sharpness.items()}
        return cls(small, images, frames, positions, clarity)

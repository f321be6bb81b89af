"""The videos of the benchmarks with their detections, in memory, so that reading and detection are not timed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from framework.data import Detections, Frame
from framework.datasets.rgbd_folder import RgbdFolder
from framework.interfaces import Detector
from framework.synthetic.sequence import Synthetic
from plugins.detectors.maskrcnn2go import MaskRCNN2Go
from plugins.detectors.simulated import SimulatedDetector


@dataclass(frozen=True)
class Recording:
    name: str
    frames: Sequence[Frame]
    detections: Sequence[Detections]


def red_kitchen(shared: Path, frames: int) -> Recording:
    """Return the first `frames` frames of a real Kinect video, with the masks of a real detector."""
    sequence = RgbdFolder(shared / "data" / "redkitchen", stop=frames)
    return _recorded("redkitchen", sequence, MaskRCNN2Go())


def furnished_room(frames: int) -> Recording:
    """Return `frames` frames of a synthetic room, with noisy Kinect depth and masks with simulated detector errors."""
    return _recorded("synthetic room", Synthetic(frames=240, stop=frames), SimulatedDetector())


def _recorded(name: str, sequence: RgbdFolder | Synthetic, detector: Detector) -> Recording:
    frames = list(sequence)
    return Recording(name, frames, [detector.detect(frame) for frame in frames])

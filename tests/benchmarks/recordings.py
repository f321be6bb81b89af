"""The videos of the benchmarks and their detections, kept in memory.

Reading files and detection are therefore not part of the measured times.
"""

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
    """Return the first `frames` frames of a Kinect video of a real kitchen, with masks of a real detector."""
    sequence = RgbdFolder(shared / "data" / "redkitchen", stop=frames)
    return _recorded("redkitchen", sequence, MaskRCNN2Go())


def furnished_room(frames: int) -> Recording:
    """Return `frames` frames of a synthetic room with Kinect noise and simulated detection errors."""
    return _recorded("synthetic room", Synthetic(frames=240, stop=frames), SimulatedDetector())


def _recorded(name: str, sequence: RgbdFolder | Synthetic, detector: Detector) -> Recording:
    frames = list(sequence)
    return Recording(name, frames, [detector.detect(frame) for frame in frames])

"""The videos that the benchmarks run on, with their detections, held in memory: reading and detecting is not timed."""

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
    """A real Kinect video with a real detector's masks."""
    sequence = RgbdFolder(shared / "data" / "redkitchen", stop=frames)
    return _recorded("redkitchen", sequence, MaskRCNN2Go())


def furnished_room(frames: int) -> Recording:
    """A synthetic room with a Kinect's noise, whose depth is dense, and masks as faulty as a real detector's."""
    return _recorded("synthetic room", Synthetic(frames=240, stop=frames), SimulatedDetector())


def _recorded(name: str, sequence: RgbdFolder | Synthetic, detector: Detector) -> Recording:
    frames = list(sequence)
    return Recording(name, frames, [detector.detect(frame) for frame in frames])

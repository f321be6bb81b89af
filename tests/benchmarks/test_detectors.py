"""Milliseconds and memory of the detectors on one 640x480 image: `python -m pytest tests/benchmarks -k detectors`."""

import resource
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from framework.data import Camera, Frame, FrameTruth
from plugins.detectors.ground_truth import GroundTruthDetector
from plugins.detectors.maskrcnn2go import MaskRCNN2Go
from plugins.detectors.none import NoDetections
from plugins.detectors.simulated import SimulatedDetector

SHARED = Path(__file__).resolve().parents[3] / "shared"
CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
THREADS = 2


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    yield
    torch.set_num_threads(before)


def labelled_frame():
    """Twelve rectangles of 100x100 px, each a chair."""
    ids = np.zeros((480, 640), np.int32)
    for k in range(12):
        v, u = 20 + 150 * (k // 4), 20 + 150 * (k % 4)
        ids[v : v + 100, u : u + 100] = k + 1
    truth = FrameTruth(ids, dict.fromkeys(range(1, 13), "chair"))
    return Frame(0, 0.0, np.zeros((480, 640, 3), np.uint8), np.ones((480, 640), np.float32), CAMERA, truth=truth)


@pytest.mark.parametrize("index", [0, 150, 290])
def test_maskrcnn2go(benchmark, threads, index):
    path = SHARED / "data" / "redkitchen" / "color" / f"{index:06d}.jpg"
    if not path.exists() or not (SHARED / "weights" / "maskrcnn2go_int8").is_dir():
        pytest.skip(f"{path} or the weights are absent")
    color = cv2.imread(str(path))[..., ::-1].copy()
    frame = Frame(index, 0.0, color, np.ones((480, 640), np.float32), CAMERA)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    detector = MaskRCNN2Go(device="cpu")
    detections = benchmark.pedantic(detector.detect, (frame,), warmup_rounds=3, rounds=20)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    benchmark.extra_info.update(threads=THREADS, detections=len(detections), peak_rss_growth_mib=round(grown / 1024))


@pytest.mark.parametrize(
    "detector", [NoDetections(), GroundTruthDetector(), SimulatedDetector()], ids=lambda d: type(d).__name__
)
def test_label_detectors(benchmark, detector):
    benchmark.pedantic(detector.detect, (labelled_frame(),), warmup_rounds=2, rounds=20)

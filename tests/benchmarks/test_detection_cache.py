"""Cost and savings of the detection cache at 640x480.

Run with `python -m pytest tests/benchmarks -k detection_cache`.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from framework.data import Camera, Detections, Frame, FrameTruth
from framework.datasets.rgbd_folder import RgbdFolder
from framework.detection.masks.binary_masks import tight_boxes
from framework.detection.stored.cache import FRAME_FIELDS, CachedDetector, frame_hash, pack, unpack
from framework.vocabulary.label_spaces import COCO
from plugins.detectors.maskrcnn2go import MaskRCNN2Go

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
FRAMES = 12
OBJECTS = 20


def noise() -> Frame:
    random = np.random.default_rng(0)
    color = random.integers(0, 256, (480, 640, 3), np.uint8)
    truth = FrameTruth(random.integers(0, 9, (480, 640), np.int32), dict.fromkeys(range(1, 9), "chair"))
    return Frame(0, 0.0, color, random.random((480, 640), np.float32), CAMERA, truth=truth)


def ellipses() -> Detections:
    """Return detections with elliptical masks. The axes are 60 to 260 px long."""
    random = np.random.default_rng(0)
    v, u = np.ogrid[:480, :640]
    half, center = random.uniform(30, 130, (OBJECTS, 2)), random.uniform(0, (640, 480), (OBJECTS, 2))
    masks = np.stack([np.hypot((u - x) / a, (v - y) / b) < 1 for (a, b), (x, y) in zip(half, center, strict=True)])
    rows = random.dirichlet(np.ones(80), OBJECTS).astype(np.float32)
    return Detections(masks, tight_boxes(masks), np.linspace(1, 0, OBJECTS, dtype=np.float32), rows, COCO)


@pytest.mark.parametrize("reads", [("color",), FRAME_FIELDS], ids=["color", "all_fields"])
def test_detection_cache_frame_hash_speed(benchmark: BenchmarkFixture, reads: tuple[str, ...]) -> None:
    benchmark(frame_hash, noise(), reads)


def test_detection_cache_pack_speed(benchmark: BenchmarkFixture) -> None:
    benchmark.extra_info["bytes"] = len(benchmark(pack, ellipses()))


def test_detection_cache_unpack_speed(benchmark: BenchmarkFixture) -> None:
    benchmark(unpack, pack(ellipses()), COCO)


def test_detection_cache_second_run_skips_detection(benchmark: BenchmarkFixture, shared: Path, tmp_path: Path) -> None:
    data = shared / "data" / "redkitchen"
    if not data.is_dir():
        pytest.skip(f"{data} does not exist")
    frames = list(RgbdFolder(data, stop=FRAMES))
    detector = MaskRCNN2Go(device="cpu")
    detector.detect(frames[0])  # warm-up
    first = CachedDetector(detector, tmp_path)
    started = time.perf_counter()
    for frame in frames:
        first.detect(frame)
    took = time.perf_counter() - started
    second = CachedDetector(detector, tmp_path)
    benchmark.pedantic(lambda: [second.detect(frame) for frame in frames], rounds=5, warmup_rounds=1)
    assert second.misses == 0
    share = benchmark.stats.stats.median / took
    benchmark.extra_info.update(first_run_ms_a_frame=round(1e3 * took / FRAMES, 1), second_run_share=round(share, 4))
    print(f"\nfirst run: {1e3 * took / FRAMES:.1f} ms per frame; second run: {100 * share:.1f} % of this time")

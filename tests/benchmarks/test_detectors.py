"""Time and memory of every available detector at 640x480.

Run with `python -m pytest tests/benchmarks -k detectors`. Each detector runs in a separate process, so that the peak
memory of each can be measured. Networks without local weights get random weights. Their times are representative, and
they return MASKS objects per image.
"""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture

from framework.data import Frame
from framework.detection.mask_rcnn.network import Architecture, MaskRCNN
from framework.detection.mask_rcnn.network_file import save_network
from framework.detection.mask_rcnn.resnet import ResNetShape
from framework.errors import ConfigError, DataError
from framework.synthetic.sequence import Synthetic
from framework.vocabulary.label_spaces import COCO
from tests.benchmarks.comparison import Table
from tests.support import registered

THREADS = 2
FRAMES = 8
ROUNDS = 3  # number of passes over the frames
WARM_UP = 2  # number of images before the timing starts
LONGEST = 20.0  # s, maximum time per detector; a slower detector is stopped
MASKS = 20  # number of detections that random networks return per image


def random_mask_rcnn(backbone: str, folder: Path) -> list[str]:
    """Return the overrides for the published architecture with weights that select the first class for all objects."""
    torch.manual_seed(0)
    network = MaskRCNN(Architecture(COCO, ResNetShape(backbone)))
    with torch.no_grad():
        network.roi_heads.box_predictor.cls_score.bias[1] += 100
        network.roi_heads.mask_predictor.mask_fcn_logits.bias += 100
    save_network(network, folder / "network.safetensors", {"data": "none: the weights are random"})
    return [f"detector.weights={folder / 'network.safetensors'}", f"detector.max_detections={MASKS}"]


def random_transformer(
    model: str, parameters: dict[str, Any], preprocessing: dict[str, Any], folder: Path
) -> list[str]:
    """Return the overrides for a `transformers` model with COCO classes."""
    transformers = pytest.importorskip("transformers")
    torch.manual_seed(0)
    model_class = getattr(transformers, model)
    config = model_class.config_class(**parameters, id2label=dict(enumerate(COCO)), num_labels=len(COCO))
    model_class(config).save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps({**preprocessing, "image_processor_type": "Other"}))
    return [f"detector.model={folder}", "detector.score_threshold=0", f"detector.max_detections={MASKS}"]


SWIN_TINY = {
    "model_type": "swin", "depths": [2, 2, 6, 2], "num_heads": [3, 6, 12, 24], "window_size": 7,
    "out_features": ["stage1", "stage2", "stage3", "stage4"],
}  # fmt: skip
MASK2FORMER = partial(
    random_transformer, "Mask2FormerForUniversalSegmentation", {"backbone_config": SWIN_TINY},
    {"size": {"shortest_edge": 800, "longest_edge": 1333}, "size_divisor": 32},
)  # fmt: skip


def rf_detr_seg(side: int, windows: int) -> Callable[[Path], list[str]]:
    """Return a function that writes an RF-DETR-Seg network, either Nano (312 px) or Small (384 px, two windows)."""
    backbone = {
        "model_type": "rf_detr_dinov2", "hidden_size": 384, "num_attention_heads": 6, "image_size": side,
        "patch_size": 12, "num_windows": windows, "out_features": ["stage3", "stage6", "stage9", "stage12"],
    }  # fmt: skip
    parameters = {"backbone_config": backbone, "decoder_layers": 4, "num_queries": 100, "decoder_n_points": 2}
    preprocessing = {"size": {"height": side, "width": side}}
    return partial(random_transformer, "RfDetrForInstanceSegmentation", parameters, preprocessing)


RANDOM: dict[str, tuple[str, Callable[[Path], list[str]]]] = {
    "mask_rcnn, ResNet-50": ("mask_rcnn", partial(random_mask_rcnn, "resnet50")),
    "mask_rcnn, ResNet-101": ("mask_rcnn", partial(random_mask_rcnn, "resnet101")),
    "transformers_segmentation, Mask2Former Swin-T": ("transformers_segmentation", MASK2FORMER),
    "rf_detr_seg, Nano": ("rf_detr_seg", rf_detr_seg(312, 1)),
    "rf_detr_seg, Small": ("rf_detr_seg", rf_detr_seg(384, 2)),
}


@dataclass(frozen=True)
class Measured:
    """Results of one detector."""

    seconds: list[float]  # s, per image
    detections: float  # mean number per image
    mib: float  # increase of the peak memory of the process, MiB
    fault: str = ""  # reason why the detector cannot run; "" if it ran


def measure(name: str, overrides: list[str], frames: list[Frame]) -> Measured:
    """Run the detector `name` on the frames and return the results."""
    torch.set_num_threads(THREADS)
    Path("/proc/self/clear_refs").write_text("5")  # a new process inherits the peak of its parent
    before = peak_kib()
    try:
        detector = registered.built("detector", name, f"threads={THREADS}", *overrides)
    except (ConfigError, DataError) as absent:
        return Measured([], 0.0, 0.0, str(absent))
    for frame in frames[:WARM_UP]:
        detector.detect(frame)
    seconds: list[float] = []
    found: list[int] = []
    for frame in frames * ROUNDS:
        began = time.perf_counter()
        found.append(len(detector.detect(frame)))
        seconds.append(time.perf_counter() - began)
        if sum(seconds) > LONGEST:
            break
    return Measured(seconds, float(np.mean(found)), (peak_kib() - before) / 1024)


def peak_kib() -> int:
    """Return the peak memory of this process on Linux, KiB."""
    [line] = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")]
    return int(line.split()[1])


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    """Return frames of the synthetic room. They have ground truth, which some detectors need."""
    return list(Synthetic(frames=240, stride=240 // FRAMES))


@pytest.fixture(scope="module")
def table(tables: list[Table]) -> Table:
    table = Table(
        "Detectors, synthetic room at 640x480",
        ["detector", "ms", "images per second", "peak memory, MiB", "detections"],
        notes=[
            f"Medians over {FRAMES * ROUNDS} images, or over those of {LONGEST:.0f} s; {THREADS} threads.",
            "Memory: increase of the process. Named networks have random weights.",
        ],
    )
    tables.append(table)
    return table


@pytest.mark.parametrize("name", [*registered.names("detector"), *RANDOM])
def test_detectors_report_time_and_memory(
    benchmark: BenchmarkFixture, table: Table, frames: list[Frame], tmp_path: Path, name: str
) -> None:
    option, made = RANDOM.get(name, (name, None))
    overrides = made(tmp_path) if made else []
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        measured: Measured = benchmark.pedantic(process.submit(measure, option, overrides, frames).result, rounds=1)
    if measured.fault:
        pytest.skip(measured.fault)
    median = float(np.median(measured.seconds))
    row = [name, f"{1e3 * median:.1f}", f"{1 / median:.1f}", f"{measured.mib:.0f}", f"{measured.detections:.1f}"]
    table.rows.append(row)
    benchmark.extra_info.update(ms=1e3 * median, peak_rss_growth_mib=measured.mib, detections=measured.detections)

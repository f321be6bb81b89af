"""Detectors and SLAM on CUDA, compared with the CPU.

`python -m pytest tests/benchmarks -k cuda` prints the tables. The results are in docs/results/cuda.md. The tests assert
no times.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture

from framework.data import Detections, Float64, Frame
from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import ConfigError, DataError
from framework.registry import assemble
from framework.synthetic.sequence import Synthetic
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from plugins.trackers.voxel_hashing_icp import VoxelHashingIcp
from tests.benchmarks.comparison import NOTHING, Table, ms, times
from tests.benchmarks.open3d_slam import Open3DSlam
from tests.benchmarks.recordings import red_kitchen
from tests.benchmarks.slam_loop import RENDERING, SlamLoop, seconds
from tests.benchmarks.test_detectors import RANDOM
from tests.support import registered

DEVICE = "cuda"
IMAGES, WARM_UP = 40, 10  # number of timed and of warm-up images per detector and device
LONGEST = 6.0  # s, maximum time per detector and device; the warm-up takes at most a quarter of it
MATCH = 0.5  # minimum mask IoU of two detections of one object
VOXEL_SIZE = 0.01  # m
TURN, FIRST, LAST = 10, 20, 80  # frames between two changes of the system; frames in [FIRST, LAST) are evaluated
WEIGHTS = {"onnx_segmentation": "yolo11n_seg/yolo11n_seg.onnx", "onnx_boxes": "yolox_nano/yolox_nano.onnx"}
NAMES = ["maskrcnn2go", "mask_rcnn_rooms", *WEIGHTS, *RANDOM]

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="requires CUDA")


@dataclass(frozen=True)
class Agreement:
    """Agreement of the detections of one detector on two devices, over all images."""

    found: tuple[int, int]  # number of detections on the reference device and on the other device
    overlaps: list[float]  # mask IoU of each match
    score_differences: list[float]  # absolute score difference of each match
    same_class: float  # fraction of the matches with equal classes

    @classmethod
    def of(cls, reference: Sequence[Detections], other: Sequence[Detections]) -> Agreement:
        """Match the detections of both devices greedily by mask IoU, in the order of the reference scores."""
        overlaps, differences, same = [], [], []
        for a, b in zip(reference, other, strict=True):
            flat_a, flat_b = (d.masks.reshape(len(d), -1).astype(np.float32) for d in (a, b))
            shared = flat_a @ flat_b.T
            iou = shared / np.maximum(flat_a.sum(1)[:, None] + flat_b.sum(1) - shared, 1)
            for i in range(len(a)):
                if len(b) and iou[i].max() >= MATCH:
                    j = int(iou[i].argmax())
                    overlaps.append(float(iou[i, j]))
                    differences.append(abs(float(a.scores[i] - b.scores[j])))
                    same.append(a.class_probabilities[i].argmax() == b.class_probabilities[j].argmax())
                    iou[:, j] = 0
        return cls((sum(map(len, reference)), sum(map(len, other))), overlaps, differences, float(np.mean(same or [0])))

    def cells(self) -> list[str]:
        if not self.overlaps:
            return [f"{self.found[0]}, {self.found[1]}", "0", *[NOTHING] * 4]
        return [
            f"{self.found[0]}, {self.found[1]}", f"{len(self.overlaps)}", f"{100 * self.same_class:.1f}",
            f"{np.median(self.overlaps):.4f}", f"{np.quantile(self.overlaps, 0.05):.4f}",
            f"{np.median(self.score_differences):.5f}, {max(self.score_differences):.5f}",
        ]  # fmt: skip


@pytest.fixture(scope="module")
def images(shared: Path) -> Callable[[str], list[Frame]]:
    """Return the images for a detector. The network trained on rendered rooms gets rendered rooms."""
    kitchen = list(RgbdFolder(shared / "data" / "redkitchen", stop=5 * IMAGES, stride=5))
    rooms = list(Synthetic(frames=240, stride=240 // IMAGES))
    return lambda name: rooms if name == "mask_rcnn_rooms" else kitchen


@pytest.fixture(scope="module")
def tables_of_detectors(tables: list[Table]) -> tuple[Table, Table]:
    columns = ["detector", "device", "ms, median", "ms, 95 %", "images", "times as fast as CPU, float32"]
    speed = Table("Detectors on CUDA, ms per image of 640x480", columns)
    columns = ["detector", "device", "found: CPU, this", "matched", "same class, %", "mask IoU, median", "5 %",
               "score difference: median, largest"]  # fmt: skip
    agreement = Table("Agreement with the CPU in float32", columns)
    tables += [speed, agreement]
    return speed, agreement


def settings(option: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the name and the overrides of each combination of device and precision, float32 on the CPU first."""
    parameters = registered.composed("detector", option).detector
    integers = ["detector.int8=false"] * ("int8" in parameters)
    yield "CPU, float32", ["device=cpu", *integers]
    if integers:
        yield "CPU, int8", ["device=cpu"]
    for half in (False, True) if "half_precision" in parameters else (None,):
        precision = [] if half is None else [f"detector.half_precision={half}"]
        yield f"CUDA, {'float16' if half else 'float32'}", [f"device={DEVICE}", *precision]


def run(detector: Any, frames: Sequence[Frame]) -> tuple[list[float], list[Detections]]:
    """Return the time, s, and the detections of each image.

    The detections are copied to the CPU, which waits for CUDA.
    """
    began = time.perf_counter()
    for frame in frames[:WARM_UP]:
        detector.detect(frame)
        if time.perf_counter() - began > LONGEST / 4:
            break
    spent: list[float] = []
    found: list[Detections] = []
    for frame in frames:
        duration, detections = seconds(detector.detect, frame)
        spent.append(duration)
        found.append(detections)
        if sum(spent) > LONGEST:
            break
    return spent, found


@pytest.mark.parametrize("name", NAMES)
def test_cuda_detector_reports_speed_and_agreement(
    benchmark: BenchmarkFixture, images: Callable[[str], list[Frame]], tables_of_detectors: tuple[Table, Table],
    shared: Path, tmp_path: Path, name: str,
) -> None:  # fmt: skip
    option, made = RANDOM.get(name, (name, None))
    overrides = made(tmp_path) if made else []
    if name in WEIGHTS:
        overrides = [f"detector.weights={shared / 'weights' / WEIGHTS[name]}"]

    def measure() -> dict[str, tuple[list[float], list[Detections]]]:
        built = partial(registered.built, "detector", option, *overrides)
        return {setting: run(built(*chosen), images(name)) for setting, chosen in settings(option)}

    try:
        measured = benchmark.pedantic(measure, rounds=1)
    except (ConfigError, DataError) as absent:
        pytest.skip(str(absent))
    speed, agreement = tables_of_detectors
    reference, expected = measured["CPU, float32"]
    for setting, (spent, found) in measured.items():
        median = float(np.median(spent))
        benchmark.extra_info[f"{setting}, ms"] = 1e3 * median
        faster = times(float(np.median(reference)), median)
        speed.rows.append([name, setting, ms(median), ms(float(np.quantile(spent, 0.95))), f"{len(spent)}", faster])
        n = min(len(expected), len(found))
        if setting != "CPU, float32":
            agreement.rows.append([name, setting, *Agreement.of(expected[:n], found[:n]).cells()])


def test_cuda_slam_speed(benchmark: BenchmarkFixture, shared: Path, tables: list[Table]) -> None:
    """Our loop runs on the CPU, and Open3D runs on both devices. They alternate on the same frames."""
    kitchen = red_kitchen(shared, LAST)
    ours = SlamLoop(VoxelHashingIcp(), assemble(BayesianTsdf, voxel_size=VOXEL_SIZE))
    theirs = {device: Open3DSlam(kitchen.frames[0], VOXEL_SIZE, device=device) for device in ("CPU:0", "CUDA:0")}
    spent: dict[str, list[list[float]]] = {name: [] for name in ("ours", *theirs)}  # s, by step

    def measure() -> None:
        for start in range(0, LAST, TURN):
            for k in range(start, start + TURN):
                ours(kitchen.frames[k], kitchen.detections[k])
                full, _ = seconds(ours.render_all, kitchen.frames[k])
                track, fuse, render = (ours.seconds[step] for step in ("track", "fuse", RENDERING))
                spent["ours"].append([track + fuse, 0.0, track, fuse, render, full])
            for name, slam in theirs.items():
                for k in range(start, start + TURN):
                    spent[name].append(steps(slam, kitchen.frames[k]))

    benchmark.pedantic(measure, rounds=1)
    medians: dict[str, Float64] = {name: np.median(rows[FIRST:], axis=0) for name, rows in spent.items()}
    rows = ["whole loop", "copy the images", "track", "integrate", "render for tracking", "render full image"]
    table = Table(
        f"Loop compared with Open3D {o3d.__version__}, redkitchen, 1 cm voxels, median ms per frame",
        ["step", "ours, CPU", *(f"Open3D, {name}" for name in theirs)],
        [[row, *(ms(of_steps[k]) for of_steps in medians.values())] for k, row in enumerate(rows)],
        [f"Frames {FIRST} to {LAST - 1}. Ours has labels and renders during tracking. Image copies are excluded."],
    )
    tables.append(table)


def steps(slam: Open3DSlam, frame: Frame) -> list[float]:
    """Return the times, s, of the whole loop of Open3D and of each step."""
    calls = [partial(slam.load, frame), slam.track, slam.integrate, slam.render, slam.render_all]
    load, track, integrate, render, full = (seconds(synchronized, call)[0] for call in calls)
    return [track + integrate + render, load, track, integrate, render, full]


def synchronized(call: Callable[[], Any]) -> None:
    call()
    o3d.core.cuda.synchronize()

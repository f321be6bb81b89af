"""Test of a research workflow: own plugins, an experiment over datasets and detectors, table, figure and bundle."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from instancemap import load_runs
from tests.support import option_files
from tests.support.fresh_environment import CHECKOUT, OFFLINE, PIP, build_wheels, create_environment, run_in
from tests.support.latex import log_of_paper, requires_pdflatex
from tests.support.table_text import grids

pytestmark = pytest.mark.acceptance

PROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "my-methods"
version = "0.1"

[project.entry-points."instancemap.configs"]
my_methods = "my_methods.conf"

[tool.hatch.build.targets.wheel]
packages = ["my_methods"]
"""
PLUGINS = '''
"""A detector by color, and a refiner by depth."""

from dataclasses import dataclass

import cv2
import numpy as np
from instancemap import ClusterRefiner, Detections, Detector, Frame, PointClusters, keep_points


@dataclass
class ColorBlobs(Detector):
    """Detection of connected regions of saturated color."""

    min_area: int = 200  # minimum area of a region, px

    def __post_init__(self) -> None:
        self.classes = ("chair", "couch")

    def detect(self, frame: Frame) -> Detections:
        saturation = cv2.cvtColor(frame.color, cv2.COLOR_RGB2HSV)[..., 1]
        count, regions, stats, _ = cv2.connectedComponentsWithStats((saturation > 80).astype(np.uint8))
        kept = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= self.min_area]
        if not kept:
            return Detections.none(frame.camera.shape, self.classes)
        x, y, width, height = stats[kept, :4].T.astype(np.float32)
        return Detections(
            masks=regions == np.array(kept)[:, None, None],
            boxes=np.stack([x, y, x + width - 1, y + height - 1], axis=1),
            scores=np.full(len(kept), 0.6, np.float32),
            class_probabilities=np.tile(np.float32([0.6, 0.4]), (len(kept), 1)),
            classes=self.classes,
        )


@dataclass
class NearestPoints(ClusterRefiner):
    """Selection of the points of each cluster that are nearer than a quantile of their depths."""

    quantile: float = 0.5  # quantile of the depths, in [0, 1]

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        u, v = clusters.pixels.T
        depth = frame.depth[v, u]
        kept = np.ones(len(depth), np.bool_)
        for k in range(len(clusters)):
            own = clusters.cluster == k
            if own.any():
                kept[own] = depth[own] <= np.quantile(depth[own], self.quantile)
        return keep_points(clusters, kept)
'''
EXPERIMENT = """
# @package _global_
# Effect of the refiner nearest_points.
defaults:
  - /parts/experiment
  - _self_

rows:
  identity: [refiner=identity]
  mine: [refiner=nearest_points]

table:
  average_over: [seed, dataset, detector]
  pair_by: [dataset, detector]
  columns: [instances.count, instances.ap50, stage_ms.refinement.median]

figure:
  kind: maps
  sequences: dataset
"""
DATASETS, DETECTORS, ROWS = ("desk", "my_recording", "my_room"), ("maskrcnn2go", "color_blobs"), ("identity", "mine")
CHOSEN = (
    "experiment=week",
    f"dataset={','.join(DATASETS)}",
    f"detector={','.join(DETECTORS)}",
    *("dataset.stop=3", "tracker=ground_truth", "fuser.voxel_size=0.03", "fuser.min_observations=1"),
)


def write_package(folder: Path, recording: Path) -> None:
    """Write the source folder of a package with two plugins, two datasets and an experiment."""
    files = {
        "pyproject.toml": PROJECT,
        "my_methods/__init__.py": PLUGINS,
        "my_methods/conf/detector/color_blobs.yaml": "_target_: my_methods.ColorBlobs\nmin_area: 200 # px\n",
        "my_methods/conf/refiner/nearest_points.yaml": "_target_: my_methods.NearestPoints\nquantile: 0.5\n",
        "my_methods/conf/dataset/my_recording.yaml": f"defaults: [rgbd_folder, _self_]\nroot: {recording}\n",
        "my_methods/conf/dataset/my_room.yaml": "defaults: [synthetic, _self_]\nwidth: 160\nheight: 120\nframes: 3\n",
        "my_methods/conf/experiment/week.yaml": EXPERIMENT.lstrip(),
    }
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)


def command(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command of InstanceMap in `folder`, with the package installed there."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(CHECKOUT), str(folder / "installed")])}
    line = [sys.executable, "-m", "framework", *words]
    return subprocess.run(line, cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the installed package and the outputs of its experiment."""
    folder = tmp_path_factory.mktemp("week")
    (folder / "recording").mkdir()
    option_files.overrides("dataset", "rgbd_folder", folder / "recording")
    write_package(folder / "my-methods", folder / "recording")
    wheels = build_wheels(folder / "package", [folder / "my-methods"])
    subprocess.run([*PIP, "install", *OFFLINE, "--target", str(folder / "installed"), *wheels], check=True, timeout=120)
    done = command(folder, *CHOSEN)
    assert done.returncode == 0, done.stderr[-4000:]
    return folder


def test_workflow_data_frame_has_run_of_each_combination(folder: Path) -> None:
    runs = load_runs(folder / "outputs" / "week")
    combinations = runs[["dataset", "detector", "row"]].itertuples(index=False, name=None)
    assert sorted(combinations) == sorted((d, n, row) for d in DATASETS for n in DETECTORS for row in ROWS)
    assert (runs["frames"] == 3).all()
    mine = runs["row"] == "mine"
    assert runs["code.refiner"][mine].str.startswith("my_methods 0.1 ").all()
    assert runs["code.refiner"][~mine].str.startswith("plugins.refiners.identity ").all()


def test_workflow_table_has_paired_differences(folder: Path) -> None:
    text = (folder / "outputs" / "week" / "table.md").read_text()
    means, differences, statistics = grids(text)
    assert [line.split(" | ")[:2] for line in means[2:]] == [["| identity", "6"], ["| mine", "6"]]
    assert differences[0] == "| minus identity | pairs | instances | AP50 | refinement (ms) |"
    [line] = differences[2:]
    assert line.startswith("| mine | 6 | ")
    assert any(line.startswith("| refinement (ms) | mine | 6 | ") for line in statistics)
    assert "- Differences are paired by dataset, detector: mean ± standard error over dataset, detector" in text
    assert f"- Command line: {' '.join(CHOSEN[1:])}." in text
    assert "Missing" not in text
    assert "Incomplete" not in text


def test_workflow_writes_figure(folder: Path) -> None:
    outputs = folder / "outputs" / "week"
    assert (outputs / "figure.png").stat().st_size > 10_000
    assert (outputs / "figure.pdf").read_bytes().startswith(b"%PDF")


@requires_pdflatex
def test_workflow_table_compiles_in_latex(folder: Path, tmp_path: Path) -> None:
    table = (folder / "outputs" / "week" / "table.tex").read_text()
    log = log_of_paper(tmp_path, table, "tab:week", "tab:week-differences")
    assert "Overfull" not in log
    assert "undefined" not in log


def test_workflow_bundle_is_reproduced_in_new_environment(folder: Path, tmp_path: Path) -> None:
    """The new environment has InstanceMap, but not the package with the plugins."""
    done = command(folder, "bundle", "outputs/week", "--out", str(tmp_path / "week.zip"))
    assert done.returncode == 0, done.stderr
    assert "week.zip: 12 runs, " in done.stdout
    create_environment(tmp_path)
    absent = "import importlib.util as util; print(util.find_spec('my_methods'))"
    assert run_in(tmp_path, "python", "-c", absent) == "None\n"
    message = run_in(tmp_path, "instancemap", "reproduce", "week.zip", "--trust-code")
    compared = [line for line in message.splitlines() if ": changed: " not in line]
    assert len(compared) == 12
    assert all(line.endswith(": byte-identical") for line in compared), message

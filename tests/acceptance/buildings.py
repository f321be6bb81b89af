"""Maps of synthetic buildings: drift, doubled instances and doubled surfaces, with and without loop closures."""

from __future__ import annotations

import functools
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from framework.api import load_map
from framework.data import Float64
from framework.datasets.ground_truth.scene_truth import LabeledDepth
from framework.evaluation.doubled_instances import doubled_instances, observed_labels
from framework.evaluation.trajectory import align
from framework.files.tum_trajectory import read_tum
from framework.geometry import transform
from framework.synthetic.buildings.building_sequence import SyntheticBuilding
from framework.synthetic.walk import FRAME_RATE
from tests.acceptance.changing_scenes import distances
from tests.acceptance.runner import CHECKOUT

MIN_CONFIDENCE = 0.5  # minimum confidence of a counted instance
VIEW_STEP = 5  # frames between two views that determine the true instances
APART = 0.05  # m, minimum distance of a vertex of a doubled surface from the true surface


@dataclass(frozen=True)
class BuildingRun:
    """Results of a run."""

    ate: float  # m
    frames_lost: int
    ap50: float
    mean_iou: float
    doubled: frozenset[int]  # true instances that the map contains more than once
    distance: float  # m, median distance of the vertices from the true surface
    apart: float  # fraction of the vertices that are at least APART from the true surface

    @classmethod
    def of(cls, building: Mapping[str, int], directory: Path, *overrides: str) -> BuildingRun:
        """Map a building, and print the results.

        Args:
            building: Parameters of the dataset.
            directory: The run directory.
            overrides: Other overrides of the run.
        """
        chosen = [f"dataset.{name}={value}" for name, value in building.items()] + [*overrides]
        mapped(directory, *chosen)
        found = cls.read(directory, SyntheticBuilding(**building))
        print(" ".join(chosen), found, flush=True)
        return found

    @classmethod
    def read(cls, run: Path, sequence: SyntheticBuilding) -> BuildingRun:
        """Return the results of a run directory."""
        metrics = json.loads((run / "metrics.json").read_text())
        timestamps, poses = read_tum(run / "trajectory.txt")
        indices = np.rint(timestamps * FRAME_RATE).astype(int)
        scene = load_map(run / "map.npz").scene
        mesh = scene.mesh()
        true_ids = observed_labels(mesh.vertices, _views(sequence, indices, poses))
        likely = {k for k, instance in scene.instances().items() if instance.confidence >= MIN_CONFIDENCE}
        T_true_map = align(poses, np.array([sequence.tour.pose(k) for k in indices]))
        surfaces = sequence.building.surfaces
        apart = distances(
            np.asarray(transform(T_true_map, mesh.vertices), np.float32), surfaces.vertices, surfaces.triangles
        )
        return cls(
            metrics["trajectory.ate_rmse_m"],
            metrics["frames_lost"],
            metrics["instances.ap50"],
            metrics["instances.mean_iou"],
            frozenset(doubled_instances(true_ids, mesh.instance_ids, likely)),
            float(np.median(apart)),
            float((apart > APART).mean()),
        )


def _views(sequence: SyntheticBuilding, indices: Float64, poses: Float64) -> Iterator[LabeledDepth]:
    """Yield every VIEW_STEP-th frame with its estimated pose."""
    for index, T_world_camera in zip(indices[::VIEW_STEP], poses[::VIEW_STEP], strict=True):
        frame = sequence[int(index)]
        assert frame.truth is not None
        yield LabeledDepth(frame.depth, frame.truth.instance_ids, frame.camera, T_world_camera)


def mapped(directory: Path, *overrides: str) -> Path:
    """Map a building into a run directory, and return the directory."""
    chosen = ["dataset=synthetic_building", "fuser.voxel_size=0.02", "detector=ground_truth", *overrides]
    command = [sys.executable, "-m", "framework", *chosen, f"hydra.run.dir={directory}"]
    subprocess.run(command, cwd=CHECKOUT, check=True)
    return directory


class Comparison(NamedTuple):
    """Runs of one building that differ in their poses."""

    drifted: BuildingRun  # without a back end
    corrected: BuildingRun
    oracle: BuildingRun  # mapped again with the corrected poses and depth
    given: BuildingRun  # with the true poses


@functools.cache
def compared(seed: int, rooms: int = 5, frames: int = 1200) -> Comparison:
    """Map a building with and without a back end, again with the corrected poses, and with the true poses."""
    building = {"rooms": rooms, "frames": frames, "seed": seed}
    with tempfile.TemporaryDirectory() as directory:
        runs = {name: Path(directory, name) for name in Comparison._fields}
        corrected = runs["corrected"]
        again = (f"tracker.path={corrected / 'trajectory.txt'}", f"depth_distortion_from={corrected}")
        return Comparison(
            drifted=BuildingRun.of(building, runs["drifted"], "backend=none"),
            corrected=BuildingRun.of(building, runs["corrected"], "backend=pose_graph"),
            oracle=BuildingRun.of(building, runs["oracle"], "tracker=trajectory_file", *again),
            given=BuildingRun.of(building, runs["given"], "tracker=ground_truth"),
        )


def five_rooms() -> list[Comparison]:
    """Return the comparisons of three buildings of five rooms."""
    return [compared(seed) for seed in range(3)]


def second_round() -> float:
    """Return the size of the map after two rounds through a building, divided by its size after one round."""
    frames = SyntheticBuilding(rooms=5).tour.frames
    sizes = []
    with tempfile.TemporaryDirectory() as directory:
        for rounds in (1, 2):
            chosen = ("dataset.rooms=5", f"dataset.frames={rounds * frames}", "backend=pose_graph")
            run = mapped(Path(directory, f"{rounds}"), *chosen)
            sizes.append(json.loads((run / "metrics.json").read_text())["map.bytes"])
    return float(sizes[1] / sizes[0])


def files_that_depend_on_threads() -> list[str]:
    """Return the result files of a building with loops that differ between one and two threads."""
    names = ("map.npz", "trajectory.txt", "trajectory_tracked.txt", "instances.json", "mesh.ply")
    with tempfile.TemporaryDirectory() as directory:
        chosen = ("dataset.rooms=5", "dataset.frames=1200", "backend=pose_graph")
        one, two = (mapped(Path(directory, f"{k}"), *chosen, f"threads={k}") for k in (1, 2))
        return [name for name in names if (one / name).read_bytes() != (two / name).read_bytes()]


if __name__ == "__main__":
    five_rooms()
    compared(0, rooms=8, frames=3000)

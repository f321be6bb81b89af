"""Maps of synthetic buildings: drift, doubled instances and doubled surfaces."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

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
from tests.acceptance.changing_scenes import LIKELY, distances
from tests.acceptance.runner import CHECKOUT

VIEW_STEP = 5  # frames between two views that determine the true instances
APART = 0.05  # m, minimum distance of a vertex of a doubled surface from the true surface
FIVE_ROOMS = {"rooms": 5, "frames": 1200}
EIGHT_ROOMS = {"rooms": 8, "frames": 3000}


@dataclass(frozen=True)
class BuildingRun:
    """Results of a run."""

    ate: float  # m
    frames_lost: int
    ap50: float
    doubled: frozenset[int]  # true instances that the map contains more than once
    distance: float  # m, median distance of the vertices from the true surface
    apart: float  # fraction of the vertices that are at least APART from the true surface

    @classmethod
    def of(cls, building: dict[str, int], *overrides: str) -> BuildingRun:
        """Map a building, and print the results.

        Args:
            building: Parameters of the dataset.
            overrides: Other overrides of the run.
        """
        with tempfile.TemporaryDirectory() as directory:
            run = Path(directory, "run")
            chosen = [f"dataset.{name}={value}" for name, value in building.items()]
            chosen = ["dataset=synthetic_building", "fuser.voxel_size=0.02", *chosen, *overrides]
            subprocess.run(
                [sys.executable, "-m", "framework", *chosen, f"hydra.run.dir={run}"], cwd=CHECKOUT, check=True
            )
            found = cls.read(run, SyntheticBuilding(**building))  # type: ignore[arg-type]
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
        likely = {k for k, instance in scene.instances().items() if instance.confidence >= LIKELY}
        T_true_map = align(poses, np.array([sequence.tour.pose(k) for k in indices]))
        surfaces = sequence.building.surfaces
        apart = distances(
            np.asarray(transform(T_true_map, mesh.vertices), np.float32), surfaces.vertices, surfaces.triangles
        )
        return cls(
            metrics["trajectory.ate_rmse_m"],
            metrics["frames_lost"],
            metrics["instances.ap50"],
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


def main() -> None:
    for seed in range(3):
        for tracker in ("voxel_hashing_icp", "ground_truth"):
            BuildingRun.of(FIVE_ROOMS | {"seed": seed}, f"tracker={tracker}", "detector=ground_truth")


if __name__ == "__main__":
    main()

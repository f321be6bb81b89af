"""Self-calibration of depth on real Kinect video, compared with references that do not use depth."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from framework.data import Float64
from framework.files.tum_trajectory import read_tum
from tests.acceptance.runner import CHECKOUT

SHARED = CHECKOUT.parent / "shared" / "data"
KITCHEN = ("dataset=rgbd_folder", f"dataset.root={SHARED / 'redkitchen'}")
RPY = (
    "dataset=tum_rgbd", f"dataset.root={SHARED / 'tum_fr1_rpy_a'}", "dataset.scene=rgbd_dataset_freiburg1_rpy",
)  # fmt: skip
STEP = 5  # step between the images that are reconstructed
BACK_ENDS = ("none", "pose_graph")


class CalibrationEffect(NamedTuple):
    """Errors of a trajectory without and with the back end, m."""

    without: float
    with_back_end: float

    @property
    def ratio(self) -> float:
        return self.with_back_end / self.without


@cache
def of_freiburg1() -> CalibrationEffect:
    """Return the ATE against motion capture."""
    return CalibrationEffect(
        *(json.loads((run / "metrics.json").read_text())["trajectory.ate_rmse_m"] for run in _runs(*RPY))
    )


@cache
def of_kitchen() -> CalibrationEffect:
    """Return the distance from the positions that structure from motion finds in the color images.

    The reference of the data set is KinectFusion, which contains the distortion of depth.
    """
    indices, positions = reconstructed(SHARED / "redkitchen" / "color")
    return CalibrationEffect(
        *(distance(read_tum(run / "trajectory.txt")[1][indices, :3, 3], positions) for run in _runs(*KITCHEN))
    )


def _runs(*dataset: str) -> Iterator[Path]:
    """Yield the run directories without and with the back end."""
    with tempfile.TemporaryDirectory() as directory:
        for name in BACK_ENDS:
            run = Path(directory, name)
            command = [
                sys.executable,
                "-m",
                "framework",
                *dataset,
                "detector=none",
                f"backend={name}",
                f"hydra.run.dir={run}",
            ]
            subprocess.run(command, cwd=CHECKOUT, check=True)
            yield run


def reconstructed(images: Path) -> tuple[list[int], Float64]:
    """Return the numbers of every STEP-th image of a folder and their positions (N, 3), without scale."""
    with tempfile.TemporaryDirectory() as directory:
        chosen, database = Path(directory, "images"), Path(directory, "database.db")
        chosen.mkdir()
        paths = sorted(images.iterdir())
        numbers = {path.name: k for k, path in enumerate(paths) if k % STEP == 0}
        for name in numbers:
            (chosen / name).symlink_to(images / name)
        pycolmap.set_random_seed(0)
        pycolmap.extract_features(database, chosen, camera_mode=pycolmap.CameraMode.SINGLE)
        pycolmap.match_exhaustive(database)
        models = pycolmap.incremental_mapping(database, chosen, directory)
        found = max(models.values(), key=lambda model: model.num_reg_images()).images.values()
        return [numbers[one.name] for one in found], np.array([one.projection_center() for one in found])


def distance(positions: Float64, reference: Float64) -> float:
    """Return the RMS distance of positions (N, 3), m, from reference positions (N, 3) of any scale and pose."""
    centered, other = positions - positions.mean(axis=0), reference - reference.mean(axis=0)
    U, S, Vt = np.linalg.svd(centered.T @ other)
    signs = np.array([1, 1, np.sign(np.linalg.det(U @ Vt))])
    scale = (S * signs).sum() / (other**2).sum()
    fitted = scale * other @ (U * signs @ Vt).T
    return float(np.sqrt(((centered - fitted) ** 2).sum(axis=1).mean()))


if __name__ == "__main__":
    with contextlib.redirect_stderr(sys.stdout):
        for name, effect in (("freiburg1_rpy", of_freiburg1()), ("redkitchen", of_kitchen())):
            print(
                f"{name}: {1e3 * effect.without:.1f} mm without, {1e3 * effect.with_back_end:.1f} mm with the back end"
            )

"""Test that both forms of the annotation of redkitchen give the same accuracy."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from framework.commands.results.evaluate import evaluate_runs
from framework.evaluation.instances import Transfer
from instancemap import run

pytestmark = pytest.mark.acceptance

REDKITCHEN = Path(__file__).resolve().parents[5] / "shared" / "data" / "redkitchen"


def ap50_in(directory: Path) -> float:
    return float(json.loads((directory / "metrics.json").read_text())["instances.ap50"])


@pytest.mark.parametrize("tracker", ["ground_truth", "voxel_hashing_icp"])
def test_instance_images_and_labeled_mesh_give_same_ap50(tmp_path: Path, tracker: str) -> None:
    if not REDKITCHEN.is_dir():
        pytest.skip(f"{REDKITCHEN} does not exist")
    directory = run(tmp_path / "run", f"dataset.root={REDKITCHEN}", dataset="rgbd_folder", tracker=tracker)
    of_images = ap50_in(directory)
    mesh = str(REDKITCHEN / "annotation" / "mesh.ply")
    assert evaluate_runs([directory], Transfer.TO_TRUTH, write=True, ground_truth=mesh) == 0
    assert of_images > 0.5
    assert ap50_in(directory) == pytest.approx(of_images, abs=0.05)

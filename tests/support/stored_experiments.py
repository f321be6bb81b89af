"""Stored runs of an experiment with given metrics."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from omegaconf import OmegaConf

from framework.runs.provenance import config_hash

AP50, IOU = "instances.ap50", "instances.mean_iou"
Figures = Mapping[str, Sequence[float | None]]  # values by row, one for each seed; None = undefined


def experiment(root: Path, figures: Figures, iou: float = 0.5, scenes: Sequence[str] = (), dataset: str = "d") -> Path:
    """Write run directories of `dataset` below `root`. With `scenes`, each value is of one scene with seed 0."""
    root.mkdir(parents=True)
    rows = {row: [f"refiner={row}"] for row in figures}
    over = ["seed", "dataset.scene"] if scenes else ["seed"]
    table = {"average_over": over, "columns": [AP50]}
    (root / "multirun.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create({"table": table, "rows": rows})))
    for row, values in figures.items():
        for k, value in enumerate(values):
            run(root, row, 0 if scenes else k, value, iou, scenes[k] if scenes else "", dataset)
    return root


def run(
    root: Path, row: str, seed: int, value: float | None, iou: float = 0.5, scene: str = "", dataset: str = "d"
) -> None:
    """Write the directory of one run."""
    directory = root / f"row={row},seed={seed},{scene}"
    directory.mkdir()
    config = {"row": row, "seed": seed, "dataset": {"scene": scene}, "refiner": {"kind": row}}
    (directory / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(config)))
    metrics = {
        **{
            AP50: value,
            "instances.ap": value,
            IOU: iou,
            "pose_source": "ground_truth",
            "choice.dataset": dataset,
            "choice.detector": "seen",
        },
        **{"config_hash": config_hash(config), "git_commit": "1234567890", "git_dirty": False},
    }
    (directory / "metrics.json").write_text(json.dumps(metrics))

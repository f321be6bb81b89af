"""Run directories with given metrics, for figures, and checks of the pages."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from framework.figures.experiment_figure import DRAWN
from framework.figures.figure_page import Page
from framework.figures.figure_runs import Pictured
from framework.runs.provenance import config_hash

AP50 = "instances.ap50"
FRAMES = 20


def sweep(root: Path, rows: Sequence[str] = (), task: Sequence[str] = ()) -> Path:
    """Write the config of a sweep with these rows of an experiment and overrides on the command line."""
    root.mkdir(parents=True)
    config: dict[str, Any] = {"hydra": {"overrides": {"task": list(task)}}}
    if rows:
        config["rows"] = {row: [f"refiner={row}"] for row in rows}
    (root / "multirun.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(config)))
    return root


def run(root: Path, metrics: Mapping[str, Any], seed: int = 0, **config: Any) -> Path:
    """Write a run directory; `config` contains `row` and other keys, `refiner` and `detector` are options."""
    directory = root / f"run{len(list(root.iterdir()))}"
    directory.mkdir()
    choices = {group: config.pop(group) for group in ("refiner", "detector") if group in config}
    if "row" in config:
        choices.setdefault("refiner", config["row"])
    config = {"seed": seed, "dataset": {"scene": "office"}} | config
    (directory / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(config)))
    stored = {
        **{"choice.dataset": "synthetic", "frames": FRAMES, "config_hash": config_hash(config)},
        **{"git_commit": "1234567890", "git_dirty": False, "environment.cpus": 2, "environment.processor": "Z80"},
        **{f"choice.{group}": option for group, option in choices.items()},
    }
    (directory / "metrics.json").write_text(json.dumps(stored | dict(metrics)))
    return directory


def list_detections(directory: Path, first_frames: Sequence[int], frames: int = FRAMES) -> None:
    """Write objects with these frames of their first detections, and the times of `frames` frames."""
    box = {"center": [0, 0, 0], "extent": [1, 1, 1], "rotation": np.eye(3).tolist()}
    common = {"class": "chair", "confidence": 0.9, "class_probabilities": {"chair": 1.0}, "observations": 5}
    common |= {"last_frame": 19, "centroid": [0, 0, 0], "obb": box, "vertices": 3}
    entries = [{"id": k, "first_frame": frame, **common} for k, frame in enumerate(first_frames, start=1)]
    (directory / "instances.json").write_text(json.dumps(entries))
    times = [f"{frame},integration,10" for frame in range(frames)]
    (directory / "timings.csv").write_text("\n".join(["frame,stage,milliseconds", *times]) + "\n")


def page(root: Path, *overrides: str) -> Page:
    """Return the page of the figure with these settings."""
    pictured = Pictured.below(root, overrides)
    return DRAWN[pictured.choice.kind](pictured)


def texts(drawn: Page) -> list[str]:
    """Return all texts of a page without line breaks, including those of diagrams."""
    found = [*drawn.figure.texts, *(text for axes in drawn.figure.axes for text in axes.texts)]
    return [" ".join(text.get_text().split()) for text in found]


def check_layout(drawn: Page) -> None:
    """Check that all texts are inside the page and do not overlap."""
    drawn.figure.draw_without_rendering()
    found = list(drawn.figure.texts)
    for axes in drawn.figure.axes:
        found += [*axes.texts, axes.xaxis.label, axes.yaxis.label]
        for axis, limits in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            found += [
                tick.label1 if tick.label1.get_visible() else tick.label2
                for tick in axis.get_major_ticks()
                if min(limits) <= tick.get_loc() <= max(limits)
            ]
    boxes = [(text.get_text(), text.get_window_extent()) for text in found if text.get_text()]
    for text, box in boxes:
        assert box.x0 >= 0, text
        assert box.y0 >= 0, text
        assert box.x1 <= drawn.figure.bbox.width, text
        assert box.y1 <= drawn.figure.bbox.height, text
    for (one, first), (other, second) in combinations(boxes, 2):
        assert not first.overlaps(second), f"{one!r} overlaps {other!r}"

"""Draw the corrections of depth of runs: python docs/results/depth_corrections.py PICTURE NAME=RUN ..."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from framework.pose_graph.depth_distortion_file import read_depth_distortion

DEPTH = 2.0  # m


def main(picture: str, *named: str) -> None:
    """Draw the correction of each run, in mm at a depth of 2 m."""
    figure, axes = plt.subplots(1, len(named), figsize=(3.3 * len(named), 2.9), squeeze=False, layout="constrained")
    for axis, (name, run) in zip(axes[0], (one.split("=", 1) for one in named), strict=True):
        distortion = read_depth_distortion(Path(run) / "depth_distortion.json")
        assert distortion is not None, f"{run}: expected a run with corrected depth"
        shown = 1e3 * DEPTH**2 * distortion.corrections
        limit = np.abs(shown).max()
        drawn = axis.imshow(shown, cmap="RdBu_r", vmin=-limit, vmax=limit)
        axis.set(title=name, xticks=[], yticks=[])
        figure.colorbar(drawn, ax=axis, orientation="horizontal", label="correction at 2 m, mm", shrink=0.9)
    figure.savefig(picture, dpi=100)


if __name__ == "__main__":
    main(*sys.argv[1:])

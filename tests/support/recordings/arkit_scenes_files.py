"""Writer of scans in the layout of ARKitScenes.

Source: DATA.md, raw/README.md and threedod/benchmark_scripts/utils/tenFpsDataLoader.py in apple/ARKitScenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from tests.support.recordings.phone_exports import PhoneFrame, write_png

VIDEO = "41069021"


def write_arkit_scenes(folder: Path, frames: Sequence[PhoneFrame], confident: bool = True) -> None:
    folder.mkdir(parents=True)
    (folder / "lowres_wide_intrinsics").mkdir()
    lines = []
    for frame in frames:
        name = f"{VIDEO}_{frame.timestamp:.3f}"
        write_png(folder / f"lowres_wide/{name}.png", frame.color[..., ::-1])
        write_png(folder / f"lowres_depth/{name}.png", frame.depth_mm)
        if confident:
            write_png(folder / f"confidence/{name}.png", frame.confidence)
        c = frame.camera
        (folder / f"lowres_wide_intrinsics/{name}.pincam").write_text(
            f"{c.width} {c.height} {c.fx:g} {c.fy:g} {c.cx:g} {c.cy:g}"
        )
        R, t = frame.T_world_camera[:3, :3], frame.T_world_camera[:3, 3]
        rotation, _ = cv2.Rodrigues(R.T)
        values = [*rotation.ravel(), *(-R.T @ t)]
        lines.append(f"{frame.timestamp:.8f} " + " ".join(f"{value:.17g}" for value in np.ravel(values)))
    (folder / "lowres_wide.traj").write_text("\n".join(lines) + "\n")

"""Write an animation of a growing map. The animation begins with the complete map.

Usage: `python docs/growing_map.py OUT.webp [key=value ...]`, with the overrides of a run.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from framework.api import begin
from framework.config.composition import composed
from framework.data import LIKELY, Int32
from framework.interfaces import RGBDSequence
from framework.registry import build
from framework.rendering.lit_view import LitView
from framework.rendering.palette import instance_colors
from framework.rendering.surface import Surface
from framework.rendering.viewpoint import best_view
from framework.runtime.process_settings import Settings
from framework.runtime.run_log import Journal

FRAME_INTERVAL = 2  # frames between two images
WIDTH, HEIGHT = 600, 500  # px, size of each of the two views
MILLISECONDS, LAST = 100, 2500  # ms, display times of an image and of the complete map


def only(instance_ids: Int32, shown: list[int]) -> Int32:
    """Return the instance ids; ids not in `shown` become 0."""
    return np.where(np.isin(instance_ids, shown), instance_ids, 0).astype(np.int32)


def main() -> None:
    """Run `python docs/growing_map.py`."""
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    out, config = Path(sys.argv[1]), composed(*sys.argv[2:])
    Settings.of(config).apply()
    sequence, pipeline = build(RGBDSequence, config.dataset), begin(config)
    scene, journal = pipeline.fuser.scene, Journal(pipeline.fuser.scene, len(sequence), pipeline.tracker.pose_source)
    poses, maps = [], []
    for k in tqdm(range(len(sequence)), unit="frame"):
        frame = sequence[k]
        pose = pipeline.map_frame(frame, pipeline.detector.detect(frame), journal)
        if not pose.lost:
            poses.append(pose.T_world_camera)
        if k % FRAME_INTERVAL == FRAME_INTERVAL - 1 or k == len(sequence) - 1:
            likely = [key for key, found in scene.instances().items() if found.probabilities[0] >= LIKELY]
            maps.append((scene.mesh(), likely))

    if not poses:
        sys.exit("dataset: expected at least one tracked frame, got none; choose another sequence or tracker")
    path = np.array(poses)
    last, likely = maps[-1]
    surface = Surface.seen_from(last.vertices, last.triangles, path)
    camera, T_world_camera = best_view(surface, only(last.instance_ids, likely), path, WIDTH, HEIGHT)
    centroids = {}
    for mesh, likely in maps:  # colors depend on the last position of each instance
        for key in likely:
            centroids[key] = mesh.vertices[mesh.instance_ids == key].mean(axis=0)
    colors = dict(
        zip(centroids, instance_colors(np.array(list(centroids.values()), np.float64).reshape(-1, 3)), strict=True)
    )
    pictures = []
    for mesh, likely in maps:
        view = LitView(Surface.seen_from(mesh.vertices, mesh.triangles, path), camera, T_world_camera)
        panels = view.in_colors(mesh.colors), view.in_instances(mesh.colors, only(mesh.instance_ids, likely), colors)
        pictures.append(Image.fromarray(np.concatenate(panels, axis=1)))
    durations = [LAST] + [MILLISECONDS] * (len(pictures) - 1)
    pictures[-1].save(out, save_all=True, append_images=pictures[:-1], duration=durations, loop=0, quality=70, method=6)
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()

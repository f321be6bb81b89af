"""Maps a video with `instancemap.Mapper` and writes a moving picture of the map as it grows.

python examples/growing_map.py OUT.webp [key=value ...]     the keys of a run, dataset=desk among them
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from framework.configs import composed
from framework.interfaces import RGBDSequence
from framework.registry import build
from framework.rendering.lit_view import LitView
from framework.rendering.palette import instance_colors
from framework.rendering.surface import Surface
from framework.rendering.viewpoint import best_view
from instancemap import Mapper

EVERY = 3  # frames between two pictures
WIDTH, HEIGHT = 480, 400  # px of each of the two views
LIKELY = 0.3  # confidence of the instances that are coloured
MILLISECONDS, LAST = 120, 2500  # that a picture stays, and the last one


def main() -> None:
    out, overrides = Path(sys.argv[1]), sys.argv[2:]
    sequence = build(RGBDSequence, composed(*overrides).dataset)
    mapper = Mapper(*(override for override in overrides if not override.startswith("dataset")))
    poses, maps = [], []
    for k in range(len(sequence)):
        pose = mapper.add(sequence[k])
        if not pose.lost:
            poses.append(pose.T_world_camera)
        if k % EVERY == EVERY - 1 or k == len(sequence) - 1:
            likely = [key for key, found in mapper.instances().items() if found.confidence >= LIKELY]
            maps.append((mapper.scene.mesh(), likely))
        print(f"\rframe {k + 1} of {len(sequence)}", end="", file=sys.stderr)

    last, likely = maps[-1]
    path = np.array(poses)
    ids = np.where(np.isin(last.instance_ids, likely), last.instance_ids, 0).astype(np.int32)
    camera, T_world_camera = best_view(Surface.seen_from(last.vertices, last.triangles, path), ids, path, WIDTH, HEIGHT)
    keys = sorted({key for _, likely in maps for key in likely})
    centroids = {}
    for mesh, _ in maps:
        centroids |= {
            key: mesh.vertices[mesh.instance_ids == key].mean(axis=0)
            for key in keys
            if (mesh.instance_ids == key).any()
        }
    colors = dict(
        zip(centroids, instance_colors(np.array(list(centroids.values()), np.float64).reshape(-1, 3)), strict=True)
    )

    pictures = []
    for mesh, likely in maps:
        view = LitView(Surface.seen_from(mesh.vertices, mesh.triangles, path), camera, T_world_camera)
        shown = {key: colors[key] for key in likely if key in colors}
        pictures.append(
            Image.fromarray(
                np.concatenate(
                    [view.in_colors(mesh.colors), view.in_instances(mesh.colors, mesh.instance_ids, shown)], axis=1
                )
            )
        )
    stays = [MILLISECONDS] * (len(pictures) - 1) + [LAST]
    pictures[0].save(out, save_all=True, append_images=pictures[1:], duration=stays, loop=0, quality=70, method=6)
    print(f"\n{out}: {out.stat().st_size / 1e6:.1f} MB", file=sys.stderr)


if __name__ == "__main__":
    main()

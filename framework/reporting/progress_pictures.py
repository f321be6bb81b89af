"""The map as it had come into sight at some frames, as pictures."""

from __future__ import annotations

from dataclasses import dataclass

from PIL import Image

from framework.rendering.lit_view import LitView
from framework.rendering.surface import Surface
from framework.reporting.map_scene import MapScene, colors_by_id, likely_ids
from framework.reporting.pictures import webp_url

PARTS = 4  # pictures, equally many frames apart; the last one shows the whole map
SCALE = 0.5  # of the first view's size
QUALITY = 80


@dataclass(frozen=True)
class GrowthPicture:
    """What of the final map had been seen until a frame."""

    url: str  # data:
    frame: int
    share: float  # of the surface, in [0, 1]


def growth_pictures(scene: MapScene) -> list[GrowthPicture]:
    """The instances at some frames, from where the map is looked at first; none for fewer poses than pictures."""
    steps = len(scene.sightings.chosen)
    if steps < PARTS:
        return []
    numbers = scene.contents.tracked_frames or tuple(range(len(scene.contents.poses)))
    camera, T_world_camera = scene.view
    color_of = colors_by_id(scene.contents.objects)
    colors = {place: color_of[key] for place, key in enumerate(likely_ids(scene.contents), start=1)}
    labels, growth = scene.likely_labels, scene.sightings.growth
    found = []
    for part in range(1, PARTS + 1):
        last = part * steps // PARTS - 1
        seen = scene.sightings.first_seen <= (last if part < PARTS else steps)
        triangles = scene.surface.triangles[seen[scene.surface.triangles].all(axis=1)]
        view = LitView(Surface(scene.surface.vertices, triangles), camera.scaled(SCALE), T_world_camera)
        image = Image.fromarray(view.in_instances(scene.mesh.colors, labels, colors))
        found.append(
            GrowthPicture(webp_url(image, QUALITY), numbers[scene.sightings.chosen[last]], float(growth[last]))
        )
    return found

"""Maps for the viewer of a report.

A map is decimated, and has object colors and an initial view.
"""

from __future__ import annotations

import base64
import gzip
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from PIL import Image

from framework.data import LIKELY, Camera, Float64, InstanceMesh, Int32, UInt8
from framework.exporting.decimation import with_finer_objects
from framework.rendering.lit_view import LitView
from framework.rendering.palette import class_colors, object_colors
from framework.rendering.surface import Surface
from framework.rendering.viewpoint import FIELD_OF_VIEW_RAD, best_view, upward
from framework.reporting.pictures import webp_url
from framework.reporting.run_contents import RunContents
from framework.reporting.run_source import Footage
from framework.reporting.scene_glb import MAX_BYTES, MAX_TRIANGLES, light_enough, scene_glb
from framework.reporting.visibility import Sightings, sightings, spread_out
from framework.runs.instances_file import StoredInstance

VIEW_WIDTH, VIEW_HEIGHT = 960, 640  # px, size of the initial view; the viewer uses only its aspect ratio
PATH_POINTS = 400  # maximum number of points of the camera path
PROGRESS_PICTURES = 4  # number of mapping progress images, at equal intervals; the last image shows the whole map
PROGRESS_SCALE = 0.5  # size of mapping progress images, relative to the initial view
PROGRESS_QUALITY = 80  # WebP quality of mapping progress images, 0 to 100


@dataclass(frozen=True)
class ProgressPicture:
    """An image of the part of the final map that was visible up to a frame."""

    url: str  # `data:` URL
    frame: int  # frame number
    fraction: float  # fraction of the visible surface that was seen up to this frame, in [0, 1]


@dataclass(frozen=True)
class MapScene:
    """The map of one run in the viewer of the report."""

    contents: RunContents
    mesh: InstanceMesh  # decimated; the front sides of its triangles face the cameras
    surface: Surface  # surface of `mesh`
    sightings: Sightings
    up: Float64  # (3,) up direction in the world frame, a unit vector

    @classmethod
    def of(cls, contents: RunContents, footage: Footage, fraction: float = 1.0) -> MapScene | None:
        """Return the map of a run, or None for an empty map.

        The map is decimated to a fraction of MAX_TRIANGLES and MAX_BYTES.

        Args:
            contents: Outputs of the run.
            footage: Images of the sequence; may be empty.
            fraction: Fraction of the size limits, in (0, 1].
        """
        if contents.mesh is None or not len(contents.viewpoints):
            return None
        mesh = replace(contents.mesh, instance_ids=contents.instance_ids(contents.mesh))
        mesh = with_finer_objects(mesh, int(fraction * MAX_TRIANGLES))
        mesh = light_enough(mesh, int(fraction * MAX_BYTES))
        if not len(mesh.triangles):
            return None
        surface = Surface.seen_from(mesh.vertices, mesh.triangles, contents.viewpoints)
        mesh = replace(mesh, triangles=surface.triangles)
        up = contents.up if contents.up is not None else upward(contents.viewpoints, surface)
        seen = sightings(mesh, mesh.instance_ids, contents.viewpoints, footage.camera, footage.clarity)
        return cls(contents, mesh, surface, seen, up)

    def glb(self) -> str:
        """Return the map as a base64-encoded, gzip-compressed GLB file. The result is deterministic."""
        steps = max(1, len(self.sightings.chosen))
        names = {one.id: one.class_name for one in self.contents.objects}
        content = scene_glb(self.mesh, (self.sightings.first_seen / steps).astype(np.float32), names, self.up)
        return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode()

    @property
    def likely_labels(self) -> Int32:
        """Index (V,) of the object of each vertex in `likely_ids`, starting at 1, or 0 for no likely object."""
        likely = np.array([0, *likely_ids(self.contents)])
        indices = np.minimum(np.searchsorted(likely, self.mesh.instance_ids), len(likely) - 1)
        return np.where(likely[indices] == self.mesh.instance_ids, indices, 0).astype(np.int32)

    @cached_property
    def view(self) -> tuple[Camera, Float64]:
        """Camera and camera pose (4, 4) of the initial view."""
        return best_view(self.surface, self.likely_labels, self.contents.viewpoints, VIEW_WIDTH, VIEW_HEIGHT)

    def data(self) -> dict[str, Any]:
        """Return the data for viewer.js that the GLB file does not contain, as JSON values."""
        poses = self.contents.poses
        _, T_world_camera = self.view
        eye, forward = T_world_camera[:3, 3], T_world_camera[:3, 2]
        distance = float(np.median((self.mesh.vertices - eye) @ forward))
        numbers = self.contents.frame_numbers
        objects = self.contents.objects
        colors, of_class = colors_by_id(objects), class_colors([(one.class_name, one.confidence) for one in objects])
        return {
            "up": _rounded(self.up),
            "eye": _rounded(eye),
            "target": _rounded(eye + max(distance, 0.1) * forward),
            "fov": float(np.rad2deg(FIELD_OF_VIEW_RAD)),
            "path": [_rounded(poses[k][:3, 3]) for k in spread_out(len(poses), PATH_POINTS)],
            "frames": [numbers[k] for k in self.sightings.chosen] if len(poses) else [],
            "objects": [
                {
                    "id": one.id,
                    "class": one.class_name,
                    "confidence": one.confidence,
                    "exists": one.existence,
                    "color": hex_color(colors[one.id]),
                    "classColor": hex_color(of_class[one.class_name]),
                }
                for one in objects
            ],
        }

    def progress_pictures(self) -> list[ProgressPicture]:
        """Return images of the mapping progress from the initial view.

        Each image shows the surface that was visible up to its frame. Runs with fewer than PROGRESS_PICTURES poses have
        no images.
        """
        steps = len(self.sightings.chosen)
        if steps < PROGRESS_PICTURES:
            return []
        camera, T_world_camera = self.view
        color_of = colors_by_id(self.contents.objects)
        colors = {index: color_of[key] for index, key in enumerate(likely_ids(self.contents), start=1)}
        labels, growth, triangles = self.likely_labels, self.sightings.growth, self.surface.triangles
        pictures = []
        for part in range(1, PROGRESS_PICTURES + 1):
            last = part * steps // PROGRESS_PICTURES - 1
            seen = self.sightings.first_seen <= (last if part < PROGRESS_PICTURES else steps)
            surface = Surface(self.surface.vertices, triangles[seen[triangles].all(axis=1)])
            view = LitView(surface, camera.scaled(PROGRESS_SCALE), T_world_camera)
            image = Image.fromarray(view.in_instances(self.mesh.colors, labels, colors))
            frame = self.contents.frame_numbers[self.sightings.chosen[last]]
            pictures.append(ProgressPicture(webp_url(image, PROGRESS_QUALITY), frame, float(growth[last])))
        return pictures


def likely_ids(contents: RunContents) -> list[int]:
    """Return the ids of the objects that probably exist, in ascending order."""
    return [one.id for one in contents.objects if one.existence >= LIKELY]


def colors_by_id(objects: tuple[StoredInstance, ...]) -> dict[int, UInt8]:
    """Return the RGB color (3,) of each object by id. Objects without vertices are gray."""
    positions = {one.id: one.centroid for one in objects if one.centroid is not None}
    colors = object_colors(positions, {one.id for one in objects if one.existence >= LIKELY})
    return {one.id: colors.get(one.id, np.array((150, 150, 150), np.uint8)) for one in objects}


def hex_color(color: UInt8) -> str:
    """Return an RGB color (3,) as `#rrggbb`."""
    return "#" + bytes(color.tolist()).hex()


def _rounded(point: Float64) -> list[float]:
    return [round(float(value), 4) for value in point]

"""A run's map as it is shown: light, with colours for its objects and a place to look at it from."""

from __future__ import annotations

import base64
import gzip
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from framework.data import Camera, Float64, InstanceMesh, Int32, UInt8
from framework.exporting.decimation import with_finer_objects
from framework.rendering.palette import class_colors, object_colors
from framework.rendering.surface import Surface
from framework.rendering.viewpoint import FIELD_OF_VIEW_RAD, best_view, upward
from framework.reporting.run_contents import RunContents
from framework.reporting.scene_glb import MOST_BYTES, MOST_TRIANGLES, light_enough, scene_glb
from framework.reporting.source_frames import Footage
from framework.reporting.visibility import Sightings, sightings, spread_out
from framework.runs.instances_file import StoredInstance
from framework.runs.run_directory import LIKELY

VIEW_WIDTH, VIEW_HEIGHT = 960, 640  # px, whose proportions the first view is chosen for
PATH_POINTS = 400  # of the camera's way


@dataclass(frozen=True)
class MapScene:
    """What the viewer shows of one run."""

    contents: RunContents
    mesh: InstanceMesh  # light, wound so that it shows its front to where the camera was
    surface: Surface  # the same
    sightings: Sightings
    up: Float64  # (3,)

    @classmethod
    def of(cls, contents: RunContents, footage: Footage, share: float = 1.0) -> MapScene | None:
        """None where nothing was mapped. `share` of the triangles and bytes that a file may have is for this one."""
        if contents.mesh is None or not len(contents.poses):
            return None
        mesh = replace(contents.mesh, instance_ids=contents.instance_ids(contents.mesh))
        mesh = with_finer_objects(mesh, int(share * MOST_TRIANGLES))
        mesh = light_enough(mesh, int(share * MOST_BYTES))
        if not len(mesh.triangles):
            return None
        surface = Surface.seen_from(mesh.vertices, mesh.triangles, contents.poses)
        mesh = replace(mesh, triangles=surface.triangles)
        up = contents.up if contents.up is not None else upward(contents.poses, surface)
        seen = sightings(mesh, mesh.instance_ids, contents.poses, footage.camera, footage.clarity)
        return cls(contents, mesh, surface, seen, up)

    def glb(self) -> str:
        """The map as GLB, compressed by gzip, in base64: the same for the same record."""
        steps = max(1, len(self.sightings.chosen))
        names = {one.id: one.class_name for one in self.contents.objects}
        content = scene_glb(self.mesh, (self.sightings.first_seen / steps).astype(np.float32), names, self.up)
        return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode()

    @property
    def likely_labels(self) -> Int32:
        """(V,) 1 + the place among the likely objects of the one that a vertex is of, 0 = of none."""
        likely = np.array([0, *likely_ids(self.contents)])
        places = np.minimum(np.searchsorted(likely, self.mesh.instance_ids), len(likely) - 1)
        return np.where(likely[places] == self.mesh.instance_ids, places, 0).astype(np.int32)

    @cached_property
    def view(self) -> tuple[Camera, Float64]:
        """From where the map is looked at first: a camera and its T_world_camera."""
        return best_view(self.surface, self.likely_labels, self.contents.poses, VIEW_WIDTH, VIEW_HEIGHT)

    def data(self) -> dict[str, Any]:
        """What the viewer's script needs beside the GLB."""
        poses = self.contents.poses
        _, T_world_camera = self.view
        eye, forward = T_world_camera[:3, 3], T_world_camera[:3, 2]
        distance = float(np.median((self.mesh.vertices - eye) @ forward))
        numbers = self.contents.tracked_frames or tuple(range(len(poses)))
        objects = self.contents.objects
        colors, of_class = colors_by_id(objects), class_colors([(one.class_name, one.confidence) for one in objects])
        return {
            "up": _rounded(self.up),
            "eye": _rounded(eye),
            "target": _rounded(eye + max(distance, 0.1) * forward),
            "fov": float(np.rad2deg(FIELD_OF_VIEW_RAD)),
            "path": [_rounded(poses[k][:3, 3]) for k in spread_out(len(poses), PATH_POINTS)],
            "frames": [numbers[k] for k in self.sightings.chosen],
            "objects": [
                {
                    "id": one.id,
                    "class": one.class_name,
                    "confidence": one.confidence,
                    "color": hex_color(colors[one.id]),
                    "classColor": hex_color(of_class[one.class_name]),
                }
                for one in objects
            ],
        }


def likely_ids(contents: RunContents) -> list[int]:
    """The objects that are in a run's overview.png."""
    return [one.id for one in contents.objects if one.confidence >= LIKELY]


def colors_by_id(objects: tuple[StoredInstance, ...]) -> dict[int, UInt8]:
    """RGB (3,) by id; grey for what has no place."""
    places = {one.id: one.centroid for one in objects if one.centroid is not None}
    colors = object_colors(places, {one.id for one in objects if one.confidence >= LIKELY})
    return {one.id: colors.get(one.id, np.array((150, 150, 150), np.uint8)) for one in objects}


def hex_color(color: UInt8) -> str:
    """#rrggbb."""
    return "#" + bytes(color.tolist()).hex()


def _rounded(point: Float64) -> list[float]:
    return [round(float(value), 4) for value in point]

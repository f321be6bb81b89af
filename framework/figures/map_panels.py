"""Maps of one scene next to the ground truth: from one viewpoint, with one color per object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from framework.data import Camera, Float64, Int32, SceneTruth, UInt8
from framework.rendering.camera_path import ProjectedPath
from framework.rendering.lit_view import LitView
from framework.rendering.object_colors import ObjectColors, relabeled
from framework.rendering.surface import FrontSides, Surface
from framework.rendering.viewpoint import best_view, fitted
from framework.runs.stored_map import StoredMap

ZOOM = 2.5  # magnification of the window with the most differing pixels
FRAMING_SCALE = 0.1  # scale of the image rendered to determine the framing of a view


@dataclass(frozen=True)
class Panel:
    """An image of one map."""

    image: UInt8  # (H, W, 3) RGB
    objects: Int32  # (H, W) object of each pixel, 0 = none
    names: Mapping[int, str]  # class name by object
    path: ProjectedPath | None = None  # camera path; None = not drawn


@dataclass(frozen=True)
class Window:
    """A part of an image; coordinates in px from the upper left corner of the image."""

    left: int
    top: int
    width: int
    height: int

    def seen_by(self, camera: Camera) -> Camera:
        """Return the camera for the window, enlarged to the image size of `camera`."""
        scale = camera.width / self.width
        return replace(
            camera,
            fx=camera.fx * scale,
            fy=camera.fy * scale,
            cx=(camera.cx + 0.5 - self.left) * scale - 0.5,
            cy=(camera.cy + 0.5 - self.top) * scale - 0.5,
        )


@dataclass(frozen=True)
class PanelLine:
    """Panels of one scene: its maps and its ground truth."""

    maps: Sequence[Panel | None]  # by column; None = no map
    truth: Panel | None  # None = no ground truth
    true_count: int  # number of ground-truth instances of known class
    window: Window | None = None  # window of the enlarged panels; None = no enlarged panels
    zoomed: Sequence[Panel | None] = ()  # enlarged window of the maps and of the ground truth


def panel_line(
    maps: Sequence[StoredMap | None], truth: SceneTruth | None, size: tuple[int, int], zoom: bool
) -> PanelLine:
    """Return the panels of one scene's maps. The last map determines the viewpoint and the ground-truth surface.

    Args:
        maps: Map of each column, None = no map; at least one map is required.
        truth: Ground truth; None = the last map is used as the reference.
        size: Width and height of a panel, px.
        zoom: True = also draw the window with the most pixels that differ between the maps.
    """
    last = [one for one in maps if one is not None][-1]
    reference = truth or SceneTruth(last.mesh.vertices, last.ids, last.class_names)
    colors = ObjectColors(reference)
    columns = [None if one is None else _Column.of(one, reference, colors) for one in maps]
    true_column = _Column.of_truth(last, reference, colors)
    camera, T_world_camera = best_view(true_column.surface, true_column.objects, last.poses, *size)
    with_path = len({len(one.poses) for one in maps if one is not None}) > 1
    if with_path:
        camera, T_world_camera = _with_path(true_column, camera, T_world_camera)
    panels = [one.panel(camera, T_world_camera, colors, with_path) if one else None for one in columns]
    true_panel = true_column.panel(camera, T_world_camera, colors, with_path=False)
    line = PanelLine(
        maps=panels,
        truth=true_panel if truth is not None else None,
        true_count=len(set(true_column.objects.tolist()) & set(colors.name_of)),
    )
    window = _most_different([panel.objects for panel in panels if panel], colors) if zoom else None
    if window is None:
        return line
    camera = window.seen_by(camera)
    columns.append(true_column if truth is not None else None)
    zoomed = [one.panel(camera, T_world_camera, colors, with_path=False) if one else None for one in columns]
    return replace(line, window=window, zoomed=zoomed)


@dataclass(frozen=True)
class _Column:
    """A surface with labeled objects."""

    surface: Surface
    colors: UInt8  # (V, 3) RGB
    objects: Int32  # (V,) object of each vertex, 0 = none
    names: Mapping[int, str]  # class name by object
    poses: Float64  # (F, 4, 4) T_world_camera

    @classmethod
    def of(cls, stored: StoredMap, truth: SceneTruth, colors: ObjectColors) -> _Column:
        object_of = colors.objects(stored.ids, stored.true_ids(truth))
        names = {object_of[key]: name for key, name in stored.class_names.items() if key in object_of}
        return cls(_surface(stored), stored.mesh.colors, relabeled(stored.ids, object_of), names, stored.poses)

    @classmethod
    def of_truth(cls, stored: StoredMap, truth: SceneTruth, colors: ObjectColors) -> _Column:
        """Return the ground-truth instances on the surface of a map."""
        objects = relabeled(stored.true_ids(truth), colors.true_objects)
        return cls(_surface(stored), stored.mesh.colors, objects, colors.name_of, stored.poses)

    def panel(self, camera: Camera, T_world_camera: Float64, colors: ObjectColors, with_path: bool) -> Panel:
        view = LitView(self.surface, camera, T_world_camera)
        image = view.in_instances(self.colors, self.objects, colors.color_of)
        path = ProjectedPath.of(self.poses, camera, T_world_camera, view.hits) if with_path else None
        return Panel(image, view.hits.nearest(self.objects), self.names, path)


def _with_path(column: _Column, camera: Camera, T_world_camera: Float64) -> tuple[Camera, Float64]:
    """Return the camera and pose of a view, moved back until it contains the camera path of the column."""
    R_world_camera = T_world_camera[:3, :3]
    hits = FrontSides(column.surface, T_world_camera[:3, 3]).seen_by(camera.scaled(FRAMING_SCALE), R_world_camera)
    path = column.poses[:, :3, 3].astype(np.float32)
    # as many path points as surface points, so that `fitted` does not remove the path as outliers
    path = path[np.linspace(0, len(path) - 1, int(hits.seen.sum())).astype(int)]
    return fitted(R_world_camera, np.concatenate([hits.points_world[hits.seen], path]), camera.width, camera.height)


def _surface(stored: StoredMap) -> Surface:
    return Surface.seen_from(stored.mesh.vertices, stored.mesh.triangles, stored.poses)


def _most_different(images: Sequence[Int32], colors: ObjectColors) -> Window | None:
    """Return the window with the most pixels that differ between object images (H, W); None if the images are equal.

    A pixel counts if at least one image shows a ground-truth object.
    """
    stack = np.stack(images)
    true = np.isin(stack, list(colors.name_of)).any(axis=0)
    differing = (stack != stack[0]).any(axis=0) & true
    if not differing.any():
        return None
    height, width = differing.shape
    h, w = round(height / ZOOM), round(width / ZOOM)
    total = cv2.integral(differing.astype(np.uint8))
    inside = total[h:, w:] - total[:-h, w:] - total[h:, :-w] + total[:-h, :-w]
    top, left = np.unravel_index(int(inside.argmax()), inside.shape)
    return Window(int(left), int(top), w, h)

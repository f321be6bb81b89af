"""Maps of one scene beside its truth: from one point of view, and with one colour for each object."""

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

ZOOM = 2.5  # how much larger the place is shown in which the columns differ most

FRAMING_SCALE = 0.1  # of the small picture whose points a view is framed for


@dataclass(frozen=True)
class Name:
    """What an object is called, and where in the picture there is most room for it."""

    text: str
    u: float  # px
    v: float  # px
    room: float  # px, from there to the object's border


@dataclass(frozen=True)
class Panel:
    """A picture of one map."""

    image: UInt8  # (H, W, 3) RGB
    names: Sequence[Name]  # the largest first
    path: ProjectedPath | None = None  # None = it says nothing that the other columns do not


@dataclass(frozen=True)
class Window:
    """A part of a picture, in px from its upper left corner."""

    left: int
    top: int
    width: int
    height: int

    def seen_by(self, camera: Camera) -> Camera:
        """The camera whose whole image is what `camera` sees in the window, in as many pixels."""
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
    """The maps of one scene."""

    maps: Sequence[Panel | None]  # one for each column; None = there is no map
    truth: Panel | None  # None = nobody labelled the scene
    true_count: int  # instances of known class in the truth's picture
    window: Window | None = None  # what the panels below show larger
    zoomed: Sequence[Panel | None] = ()  # of the maps, and of the truth as the last one


def panel_line(
    maps: Sequence[StoredMap | None], truth: SceneTruth | None, size: tuple[int, int], zoom: bool
) -> PanelLine:
    """Draws the maps of one scene; the last one that there is chooses the point of view and shows the truth.

    Args:
        maps: one or more of them not None.
        truth: None = unknown; then the objects are those of that last map.
        size: width and height of a panel, px.
        zoom: whether the place where the maps differ most is drawn larger, too.
    """
    last = [one for one in maps if one is not None][-1]
    reference = truth or SceneTruth(last.mesh.vertices, last.ids, last.class_names)
    colors = ObjectColors(reference)
    columns = [None if one is None else _Column.of(one, reference, colors) for one in maps]
    true_column = _Column.of_truth(last, reference, colors)
    camera, T_world_camera = best_view(true_column.surface, true_column.objects, last.poses, *size)
    lengths = {len(one.poses) for one in maps if one is not None}
    with_path = len(lengths) > 1
    if with_path:
        camera, T_world_camera = _with_path(true_column, camera, T_world_camera)
    views = [None if column is None else column.seen_from(camera, T_world_camera) for column in columns]
    true_view = true_column.seen_from(camera, T_world_camera)
    line = PanelLine(
        maps=[None if view is None else view.panel(colors, with_path) for view in views],
        truth=true_view.panel(colors, with_path=False) if truth is not None else None,
        true_count=len(set(true_column.objects.tolist()) & set(colors.name_of)),
    )
    window = _most_different([view.objects for view in views if view], colors) if zoom else None
    if window is None:
        return line
    camera = window.seen_by(camera)
    larger = [
        None if column is None else column.seen_from(camera, T_world_camera).panel(colors, with_path=False)
        for column in (*columns, true_column if truth is not None else None)
    ]
    return replace(line, window=window, zoomed=larger)


@dataclass(frozen=True)
class _Column:
    """A surface with objects on it."""

    surface: Surface
    colors: UInt8  # (V, 3) RGB
    objects: Int32  # (V,) 0 = none
    names: Mapping[int, str]  # by object
    poses: Float64  # (F, 4, 4)

    @classmethod
    def of(cls, stored: StoredMap, truth: SceneTruth, colors: ObjectColors) -> _Column:
        object_of = colors.objects(stored.ids, stored.true_ids(truth))
        names = {object_of[key]: name for key, name in stored.class_names.items() if key in object_of}
        return cls(_surface(stored), stored.mesh.colors, relabeled(stored.ids, object_of), names, stored.poses)

    @classmethod
    def of_truth(cls, stored: StoredMap, truth: SceneTruth, colors: ObjectColors) -> _Column:
        """The true instances on a map's surface: as much of them as it can have."""
        objects = relabeled(stored.true_ids(truth), colors.true_objects)
        return cls(_surface(stored), stored.mesh.colors, objects, colors.name_of, stored.poses)

    def seen_from(self, camera: Camera, T_world_camera: Float64) -> _View:
        lit = LitView(self.surface, camera, T_world_camera)
        path = ProjectedPath.of(self.poses, camera, T_world_camera, lit.hits)
        return _View(self, lit, lit.hits.nearest(self.objects), path)


@dataclass(frozen=True)
class _View:
    column: _Column
    lit: LitView
    objects: Int32  # (H, W)
    path: ProjectedPath

    def panel(self, colors: ObjectColors, with_path: bool) -> Panel:
        image = self.lit.in_instances(self.column.colors, self.column.objects, colors.color_of)
        return Panel(image, _names(self.objects, self.column.names), self.path if with_path else None)


def _with_path(column: _Column, camera: Camera, T_world_camera: Float64) -> tuple[Camera, Float64]:
    """The same view from so far that the path of the column's cameras is in it, too."""
    R_world_camera = T_world_camera[:3, :3]
    hits = FrontSides(column.surface, T_world_camera[:3, 3]).seen_by(camera.scaled(FRAMING_SCALE), R_world_camera)
    path = column.poses[:, :3, 3].astype(np.float32)
    # as many points as the surface has, so that a short path is no stray point at the border
    path = path[np.linspace(0, len(path) - 1, int(hits.seen.sum())).astype(int)]
    return fitted(R_world_camera, np.concatenate([hits.points_world[hits.seen], path]), camera.width, camera.height)


def _surface(stored: StoredMap) -> Surface:
    return Surface.seen_from(stored.mesh.vertices, stored.mesh.triangles, stored.poses)


def _names(objects: Int32, names: Mapping[int, str]) -> list[Name]:
    """The names of the objects in a picture (H, W), each at the middle of its object's widest part."""
    found = []
    sizes = np.bincount(objects.ravel(), minlength=max(names, default=0) + 1)
    for key in sorted(names, key=lambda key: -sizes[key]):
        if not sizes[key]:
            break
        v, u = np.nonzero(objects == key)
        left, top = u.min(), v.min()
        part = np.pad(objects[top : v.max() + 1, left : u.max() + 1] == key, 1)
        depth = cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, 3)
        y, x = np.unravel_index(int(depth.argmax()), depth.shape)
        found.append(Name(names[key], float(left + x - 1), float(top + y - 1), float(depth[y, x])))
    return found


def _most_different(images: Sequence[Int32], colors: ObjectColors) -> Window | None:
    """Where pictures (H, W) of objects differ in most pixels; None where they are the same.

    A difference counts where one of them shows an object of the truth: what only a map has can be anywhere.
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

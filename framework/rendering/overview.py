"""Overview image of a map: its own colors and instance colors, side by side."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from framework.data import Float64, InstanceMesh, Int32, UInt8
from framework.files.atomic_write import atomic_write
from framework.rendering.camera_path import ProjectedPath
from framework.rendering.labels import draw_labels, place_labels, text_size
from framework.rendering.lit_view import LitView
from framework.rendering.palette import FAINT_INK, INK, PAPER, instance_colors
from framework.rendering.surface import Surface
from framework.rendering.viewpoint import best_view, surrounding_poses
from framework.runtime.plain_output import plain_line

PANEL_WIDTH, PANEL_HEIGHT = 960, 760  # px, size of each of the two images
TITLE_HEIGHT = 56  # px, height of the title bar
LEGEND_ROW = 30  # px, height of a row of the legend
LEGEND_COLUMNS, LEGEND_ROWS = 9, 4
PNG_LEVEL = 3  # zlib level; the default of 6 is much slower for a 3% smaller file
LABEL_PX, LEGEND_PX, TITLE_PX = 17, 17, 22  # font sizes


@dataclass(frozen=True)
class InstanceState:
    """The instances of a mesh before or after a change."""

    title: str
    ids: Int32  # (V,) instance of each vertex, 0 = none
    names: Mapping[int, str]  # label of each instance in `ids`


def write_overview(
    path: Path,
    mesh: InstanceMesh,
    instances: Mapping[int, tuple[str, float]],
    poses: Float64,
    title: str,
    up: Float64 | None = None,
) -> None:
    """Write the overview image of a map as a PNG file.

    Args:
        path: The output file.
        mesh: The mesh of the map.
        instances: The class name and confidence of each instance by id. All other ids are background.
        poses: The camera poses (F, 4, 4) of the mapped frames; F = 0 for a map without a trajectory.
        title: The title above the images.
        up: The up direction (3,) of a map without a trajectory; None = the z axis.
    """
    image = overview(mesh, instances, poses, title, up)
    with atomic_write(path) as temporary:
        Image.fromarray(image).save(temporary, compress_level=PNG_LEVEL)


def overview(
    mesh: InstanceMesh,
    instances: Mapping[int, tuple[str, float]],
    poses: Float64,
    title: str,
    up: Float64 | None = None,
) -> UInt8:
    """Return the overview image (H, W, 3), RGB.

    See `write_overview` for the arguments.
    """
    ids = np.where(np.isin(mesh.instance_ids, list(instances)), mesh.instance_ids, 0).astype(np.int32)
    shown = [key for key in sorted(instances) if (ids == key).any()]
    centroids = np.array([mesh.vertices[ids == key].mean(axis=0) for key in shown], np.float64).reshape(-1, 3)
    colors = dict(zip(shown, instance_colors(centroids), strict=True))
    if len(mesh.triangles):
        views = poses if len(poses) else surrounding_poses(mesh.vertices, up)
        panels = _panels(mesh, ids, {key: instances[key][0] for key in shown}, colors, views, poses)
    else:
        note = f"point cloud without triangles: {len(mesh.vertices)} points" if len(mesh.vertices) else "empty map"
        panels = _text_panel(note, PANEL_HEIGHT, PANEL_WIDTH, FAINT_INK, "mm")
    legend = _legend([(colors[key], *instances[key]) for key in shown])
    return np.concatenate([_text_panel(title, TITLE_HEIGHT, 24, INK, "lm"), panels, legend])


def write_comparison(path: Path, mesh: InstanceMesh, states: Sequence[InstanceState], poses: Float64) -> None:
    """Write an image of the instances of a mesh in different states, side by side, as a PNG file.

    Instances with the same id have the same color.

    Args:
        path: The output file.
        mesh: The mesh of the map, with triangles.
        states: The states of the instances.
        poses: The camera poses (F, 4, 4) of the mapped frames.
    """
    centroids: dict[int, Float64] = {}
    for state in states:
        for key in state.names:
            centroids.setdefault(key, mesh.vertices[state.ids == key].mean(axis=0, dtype=np.float64))
    places = np.array([*centroids.values()], np.float64).reshape(-1, 3)
    colors = dict(zip(centroids, instance_colors(places), strict=True))
    surface = Surface.seen_from(mesh.vertices, mesh.triangles, poses)
    view = LitView(surface, *best_view(surface, states[0].ids, poses, PANEL_WIDTH, PANEL_HEIGHT))
    columns = []
    for state in states:
        title = _text_panel(state.title, TITLE_HEIGHT, 24, INK, "lm", PANEL_WIDTH)
        columns.append(np.concatenate([title, _instance_panel(view, mesh, state.ids, state.names, colors)]))
    with atomic_write(path) as temporary:
        Image.fromarray(np.concatenate(columns, axis=1)).save(temporary, "PNG", compress_level=PNG_LEVEL)


def _panels(
    mesh: InstanceMesh,
    ids: Int32,
    names: Mapping[int, str],
    colors: Mapping[int, UInt8],
    views: Float64,
    path: Float64,
) -> UInt8:
    """Return both images. `views` (N, 4, 4) are poses with a view of the map, `path` (F, 4, 4) are drawn."""
    surface = Surface.seen_from(mesh.vertices, mesh.triangles, views)
    camera, T_world_camera = best_view(surface, ids, views, PANEL_WIDTH, PANEL_HEIGHT)
    view = LitView(surface, camera, T_world_camera)
    left = Image.fromarray(view.in_colors(mesh.colors))
    projected = ProjectedPath.of(path, camera, T_world_camera, view.hits) if len(path) else None
    if projected is not None:
        projected.draw(left)
    return np.concatenate([np.asarray(left), _instance_panel(view, mesh, ids, names, colors, projected)], axis=1)


def _instance_panel(
    view: LitView,
    mesh: InstanceMesh,
    ids: Int32,
    names: Mapping[int, str],
    colors: Mapping[int, UInt8],
    path: ProjectedPath | None = None,
) -> UInt8:
    """Return the image of a view in instance colors, with names and optionally the camera path."""
    image = Image.fromarray(view.in_instances(mesh.colors, ids, colors))
    if path is not None:
        path.draw(image)
    font = _font(LABEL_PX)
    draw_labels(image, place_labels(view.hits.nearest(ids), names, lambda text: text_size(text, font)), font)
    return np.asarray(image)


def _text_panel(
    text: str, height: int, x: int, ink: tuple[int, int, int], anchor: str, width: int = 2 * PANEL_WIDTH
) -> UInt8:
    image = Image.new("RGB", (width, height), PAPER)
    ImageDraw.Draw(image).text((x, height / 2), plain_line(text), ink, _font(TITLE_PX), anchor=anchor)
    return np.asarray(image)


def _legend(entries: Iterable[tuple[UInt8, str, float]]) -> UInt8:
    """Return the image of the legend, with the color, name and confidence of each object."""
    ranked = sorted(entries, key=lambda entry: -entry[2])
    rows = min(LEGEND_ROWS, -(-len(ranked) // LEGEND_COLUMNS))
    image = Image.new("RGB", (2 * PANEL_WIDTH, LEGEND_ROW * rows + 20), PAPER)
    canvas, font = ImageDraw.Draw(image), _font(LEGEND_PX)
    places = LEGEND_ROWS * LEGEND_COLUMNS
    shown = ranked if len(ranked) <= places else ranked[: places - 1]
    step = (2 * PANEL_WIDTH - 48) / LEGEND_COLUMNS
    for k, (color, text, confidence) in enumerate(shown):
        name = plain_line(text)
        x, y = 24 + step * (k % LEGEND_COLUMNS), 10 + LEGEND_ROW * (k // LEGEND_COLUMNS) + LEGEND_ROW / 2
        canvas.rounded_rectangle((x, y - 8, x + 16, y + 8), 4, fill=tuple(color.tolist()))
        canvas.text((x + 24, y), name, INK, font, anchor="lm")
        right = x + 24 + canvas.textlength(f"{name} ", font)
        canvas.text((right, y), f"{confidence:.2f}", FAINT_INK, font, anchor="lm")
    if len(shown) < len(ranked):
        x, y = 24 + step * (LEGEND_COLUMNS - 1), 10 + LEGEND_ROW * (LEGEND_ROWS - 0.5)
        canvas.text((x, y), f"and {len(ranked) - len(shown)} more", FAINT_INK, font, anchor="lm")
    return np.asarray(image)


def _font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(str(Path(mpl.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)

"""overview.png: the map in its colours and its instances, side by side, from one well-chosen point of view."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from framework.atomic_files import written_whole
from framework.data import Bool, Camera, Float32, Float64, InstanceMesh, Int32, UInt8
from framework.geometry import inverse, project, transform
from framework.reports.palette import instance_colors
from framework.reports.surface import FrontSides, Hits, Surface
from framework.reports.viewpoint import best_view

PANEL_WIDTH, PANEL_HEIGHT = 960, 760  # px
SUPERSAMPLING = 2  # rays per pixel in either direction
TITLE_HEIGHT = 56  # px
LEGEND_ROW = 30  # px
LEGEND_COLUMNS, LEGEND_ROWS = 9, 4
NOTHING = (229, 232, 236)  # where nothing was mapped: a shade off the paper, as mapped things may be white
PAPER, INK, FAINT_INK = (250, 250, 248), (32, 36, 42), (120, 126, 134)
PATH_START, PATH_END = (40, 110, 220), (235, 90, 40)
LABEL_PX, LEGEND_PX, TITLE_PX = 17, 17, 22
LABEL_MOVES_PIXELS = 1500  # the name of an object that shows less stays on it or is left out
LABEL_MIN_PIXELS = 250  # an object that shows less gets no name in the picture, only in the legend


def write_overview(
    path: Path, mesh: InstanceMesh, instances: Mapping[int, tuple[str, float]], poses: Float64, title: str
) -> None:
    """Draws the map to a PNG.

    Args:
        instances: class name and confidence by instance id; ids that are not in it are drawn as background.
        poses: (F, 4, 4) T_world_camera of the frames that were mapped.
        title: the line above the pictures.
    """
    image = overview(mesh, instances, poses, title)
    with written_whole(path) as temporary:
        Image.fromarray(image).save(temporary)


def overview(mesh: InstanceMesh, instances: Mapping[int, tuple[str, float]], poses: Float64, title: str) -> UInt8:
    """The picture (H, W, 3) RGB."""
    ids = np.where(np.isin(mesh.instance_ids, list(instances)), mesh.instance_ids, 0).astype(np.int32)
    shown = [key for key in sorted(instances) if (ids == key).any()]
    centroids = np.array([mesh.vertices[ids == key].mean(axis=0) for key in shown], np.float64).reshape(-1, 3)
    colors = dict(zip(shown, instance_colors(centroids), strict=True))
    if len(mesh.triangles) and len(poses):
        panels = _panels(mesh, ids, {key: instances[key][0] for key in shown}, colors, poses)
    else:
        panels = _centered("nothing was mapped", 2 * PANEL_WIDTH, PANEL_HEIGHT)
    legend = _legend([(colors[key], *instances[key]) for key in shown])
    return np.concatenate([_title(title), panels, legend])


def _panels(
    mesh: InstanceMesh, ids: Int32, names: Mapping[int, str], colors: Mapping[int, UInt8], poses: Float64
) -> UInt8:
    surface = Surface.seen_from(mesh.vertices, mesh.triangles, poses)
    camera, T_world_camera = best_view(surface, ids, poses, PANEL_WIDTH, PANEL_HEIGHT)
    sides = FrontSides(surface, T_world_camera[:3, 3])
    fine = sides.seen_by(camera.scaled(SUPERSAMPLING), T_world_camera[:3, :3])
    coarse = fine.every(SUPERSAMPLING)
    normals = _normals_seen(fine, surface.vertex_normals(), T_world_camera)
    openness = sides.openness(coarse, normals[::SUPERSAMPLING, ::SUPERSAMPLING])
    light = _lighting(normals, T_world_camera) * cv2.resize(openness, fine.depth.shape[::-1])

    color = fine.interpolated(mesh.colors.astype(np.float32))
    instance_image = fine.nearest(ids)
    palette = np.zeros((max([0, *colors]) + 1, 3), np.float32)
    for key, rgb in colors.items():
        palette[key] = rgb
    gray = color.mean(axis=2, keepdims=True)
    background = 0.22 * gray + 178.0  # pale, so that the instances stand out
    painted = palette[instance_image] * (0.84 + 0.16 * gray / 140.0)  # some texture shows through
    labeled = np.where(instance_image[..., None] > 0, painted, background)
    labeled[_borders(instance_image)] *= 0.45

    route = _Route.of(poses, camera, T_world_camera, coarse)
    left = Image.fromarray(_developed(color * 1.08, light, fine))
    right = Image.fromarray(_developed(labeled, light, fine))
    route.draw(left)
    route.draw(right)
    _draw_names(right, coarse.nearest(ids), names)
    return np.concatenate([np.asarray(left), np.asarray(right)], axis=1)


def _normals_seen(hits: Hits, vertex_normals: Float32, T_world_camera: Float64) -> Float32:
    """(H, W, 3) smooth normals, turned towards the camera."""
    normals = hits.interpolated(vertex_normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
    towards = T_world_camera[:3, 3].astype(np.float32) - hits.points_world
    away = (normals * towards).sum(axis=2, keepdims=True) < 0
    return np.asarray(np.where(away, -normals, normals), np.float32)


def _lighting(normals: Float32, T_world_camera: Float64) -> Float32:
    """(H, W) brightness: a soft lamp over the viewer's left shoulder."""
    lamp = T_world_camera[:3, :3] @ np.array([-0.45, -0.75, -0.6])
    lamp /= np.linalg.norm(lamp)
    return np.asarray(0.70 + 0.34 * np.clip(normals @ lamp.astype(np.float32), 0, 1), np.float32)


def _borders(ids: Int32) -> Bool:
    """(H, W) where an instance meets another one or the background."""
    edge = np.zeros(ids.shape, np.bool_)
    across, down = ids[:, 1:] != ids[:, :-1], ids[1:] != ids[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge


def _developed(color: Float32, light: Float32, hits: Hits) -> UInt8:
    """The lit picture on paper, (H, W, 3), scaled down to the panel."""
    lit = np.where(hits.seen[..., None], np.clip(color * light[..., None], 0, 255), np.array(NOTHING, np.float32))
    panel = cv2.resize(lit.astype(np.float32), (PANEL_WIDTH, PANEL_HEIGHT), interpolation=cv2.INTER_AREA)
    return np.asarray(panel, np.uint8)


@dataclass(frozen=True)
class _Route:
    """The way of the camera, as seen in the picture."""

    pixels: Float64  # (F, 2) u v
    hidden: Bool  # (F,) behind the surface

    @classmethod
    def of(cls, poses: Float64, camera: Camera, T_world_camera: Float64, hits: Hits) -> _Route:
        positions = poses[:, :3, 3]
        points = transform(inverse(T_world_camera), positions)
        points = points[points[:, 2] > 0.05]
        pixels = project(camera, points)
        u, v = np.rint(pixels).astype(int).T
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        depth = np.zeros(len(points))
        depth[inside] = hits.depth[v[inside], u[inside]]
        return cls(np.asarray(pixels, np.float64), (depth > 0) & (depth < points[:, 2]))

    def draw(self, image: Image.Image) -> None:
        """Blue at its beginning, orange at its end; thin where something stands before it."""
        canvas = ImageDraw.Draw(image)
        share = np.linspace(0, 1, max(2, len(self.pixels)))[:, None]
        shades = np.rint((1 - share) * np.array(PATH_START) + share * np.array(PATH_END)).astype(int)
        points = [tuple(pixel) for pixel in self.pixels.tolist()]
        for k in range(len(points) - 1):  # segments of a line, not pixels
            canvas.line((points[k], points[k + 1]), tuple(shades[k].tolist()), width=1 if self.hidden[k] else 3)
        for (u, v), color in zip(points[:1] + points[-1:], (PATH_START, PATH_END), strict=False):
            canvas.ellipse((u - 6, v - 6, u + 6, v + 6), fill=color, outline=PAPER, width=2)


def _draw_names(image: Image.Image, ids: Int32, names: Mapping[int, str]) -> None:
    """Writes each object's name where it shows, the large ones first; a name moves aside for those already there."""
    canvas, font = ImageDraw.Draw(image), _font(LABEL_PX)
    pixels = np.bincount(ids.ravel(), minlength=max([0, *names]) + 1)
    taken: list[tuple[float, float, float, float]] = []
    for key in sorted(names, key=lambda key: -pixels[key]):
        if pixels[key] < LABEL_MIN_PIXELS:
            break
        v, u = np.argwhere(ids == key).mean(axis=0)
        left, top, right, bottom = canvas.textbbox((u, v), names[key], font, anchor="mm")
        for shift in (0, -18, 18) if pixels[key] > LABEL_MOVES_PIXELS else (0,):
            box = (left - 2, top + shift - 1, right + 2, bottom + shift + 1)
            if not any(_overlap(box, other) for other in taken):
                taken.append(box)
                canvas.text((u, v + shift), names[key], INK, font, anchor="mm", stroke_width=3, stroke_fill=PAPER)
                break


def _overlap(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _title(text: str) -> UInt8:
    image = Image.new("RGB", (2 * PANEL_WIDTH, TITLE_HEIGHT), PAPER)
    canvas, font = ImageDraw.Draw(image), _font(TITLE_PX)
    canvas.text((24, TITLE_HEIGHT / 2), text, INK, font, anchor="lm")
    return np.asarray(image)


def _legend(entries: Iterable[tuple[UInt8, str, float]]) -> UInt8:
    """What the colours mean, the most confident first."""
    ranked = sorted(entries, key=lambda entry: -entry[2])
    rows = min(LEGEND_ROWS, -(-len(ranked) // LEGEND_COLUMNS))
    image = Image.new("RGB", (2 * PANEL_WIDTH, LEGEND_ROW * rows + 20), PAPER)
    canvas, font = ImageDraw.Draw(image), _font(LEGEND_PX)
    places = LEGEND_ROWS * LEGEND_COLUMNS
    told = ranked if len(ranked) <= places else ranked[: places - 1]
    step = (2 * PANEL_WIDTH - 48) / LEGEND_COLUMNS
    for k, (color, name, confidence) in enumerate(told):
        x, y = 24 + step * (k % LEGEND_COLUMNS), 10 + LEGEND_ROW * (k // LEGEND_COLUMNS) + LEGEND_ROW / 2
        canvas.rounded_rectangle((x, y - 8, x + 16, y + 8), 4, fill=tuple(color.tolist()))
        canvas.text((x + 24, y), name, INK, font, anchor="lm")
        canvas.text(
            (x + 24 + canvas.textlength(f"{name} ", font), y), f"{confidence:.2f}", FAINT_INK, font, anchor="lm"
        )
    if len(told) < len(ranked):
        x, y = 24 + step * (LEGEND_COLUMNS - 1), 10 + LEGEND_ROW * (LEGEND_ROWS - 0.5)
        canvas.text((x, y), f"and {len(ranked) - len(told)} more", FAINT_INK, font, anchor="lm")
    return np.asarray(image)


def _centered(text: str, width: int, height: int) -> UInt8:
    image = Image.new("RGB", (width, height), PAPER)
    ImageDraw.Draw(image).text((width / 2, height / 2), text, FAINT_INK, _font(TITLE_PX), anchor="mm")
    return np.asarray(image)


def _font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(str(Path(mpl.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)

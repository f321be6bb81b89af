"""Ray-cast view of a map: depth, normals, vertices, RGB and object indices (panels of Figure 2 in the paper)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from framework.data import Array, Float64, Int32, UInt8, View
from framework.figures.figure_page import FAINT_INK, INK, PAGE_MM, PNG_DPI, SMALL_PT, TEXT_PT, Page, draw_names
from framework.files.atomic_write import atomic_write
from framework.geometry import back_project, transform
from framework.rendering.palette import object_colors

COLUMNS, ROWS = 3, 2
GAP_MM, LEFT_MM, HEAD_MM, CAPTION_MM = 2.0, 1.5, 4.0, 4.0
BAR_MM, BAR_SPACE_MM = 1.6, 9.0  # widths of the colorbar and of the space for colorbar and labels
DEPTH_COLORS = "viridis"
WITHOUT_OBJECT = (226, 226, 224)  # RGB of the surface without a listed object


def write_raycast(path: Path, view: View, names: Mapping[int, str], centers: Mapping[int, Float64], note: str) -> None:
    """Write the five panels of a ray-cast view as a PNG.

    Args:
        path: PNG file.
        view: Ray-cast view.
        names: Class name of each object, by id; pixels of all other ids are gray.
        centers: Center (3,), m, of each object, by id; it determines the color of the object.
        note: Note at the bottom of the page.
    """
    page = raycast_page(view, names, centers, note)
    with atomic_write(path) as temporary:
        page.figure.savefig(temporary, dpi=PNG_DPI)


def raycast_page(view: View, names: Mapping[int, str], centers: Mapping[int, Float64], note: str) -> Page:
    """Return the page of `write_raycast`."""
    width = (PAGE_MM - 2 * LEFT_MM - BAR_SPACE_MM - GAP_MM * (COLUMNS - 1)) / COLUMNS
    height = width * view.depth.shape[0] / view.depth.shape[1]
    row_height = HEAD_MM + height + CAPTION_MM
    page = Page(PAGE_MM, ROWS * row_height, note)
    mapped = view.depth > 0
    v, u = np.indices(view.depth.shape, np.int32)
    points = back_project(view.camera, np.stack([u.ravel(), v.ravel()], axis=1), view.depth.ravel())
    positions = np.asarray(transform(view.T_world_camera, points), np.float64).reshape(*view.depth.shape, 3)
    low, high = (positions[mapped].min(axis=0), positions[mapped].max(axis=0)) if mapped.any() else np.zeros((2, 3))
    ids = np.where(np.isin(view.instance_ids, list(names)), view.instance_ids, 0).astype(np.int32)
    extent = " x ".join(f"{size:.1f}" for size in high - low)
    panels: list[tuple[str, str, Array]] = [
        ("depth", f"{mapped.mean():.0%} of the pixels are mapped", np.where(mapped, view.depth, np.nan)),
        ("normals", "red: right, green: up, blue: toward the camera", normal_colors(view)),
        ("vertices", f"red: x, green: y, blue: z ({extent} m)", position_colors(positions, low, high)),
        ("RGB", "", view.color),
        ("object indices", f"{len(set(ids.ravel().tolist()) - {0})} objects", index_colors(ids, centers)),
    ]
    for k, (name, caption, image) in enumerate(panels):
        row, column = divmod(k, COLUMNS)
        left = LEFT_MM + column * (width + GAP_MM) + (BAR_SPACE_MM if column > 0 else 0)
        bottom = (ROWS - 1 - row) * row_height + CAPTION_MM
        axes = page.axes(left, bottom, width, height)
        page.text(left, bottom + height + 1, name, fontsize=TEXT_PT, color=INK, weight="bold")
        page.text(left, bottom - 1, caption, va="top", fontsize=SMALL_PT, color=FAINT_INK)
        if image.ndim == 2:
            drawn = axes.imshow(image, cmap=DEPTH_COLORS, interpolation="nearest", aspect="auto")
            if mapped.any():
                bar = page.figure.colorbar(drawn, cax=page.axes(left + width + 1, bottom, BAR_MM, height))
                bar.ax.tick_params(labelsize=SMALL_PT, width=0.3, length=1.5)
                bar.ax.set_title("m", fontsize=SMALL_PT, color=INK, pad=2)
                bar.outline.set_linewidth(0.3)
            continue
        axes.imshow(np.where(mapped[..., None], image, 255), interpolation="nearest", aspect="auto")
    draw_names(axes, ids, {key: f"{key} {name}" for key, name in names.items()}, SMALL_PT, width)
    return page


def normal_colors(view: View) -> UInt8:
    """Return RGB colors (H, W, 3) of the normals in the camera frame, with reversed y and z axes."""
    normals = view.normals_world @ view.T_world_camera[:3, :3] * (1, -1, -1)
    return np.asarray(np.rint(np.clip(127.5 + 127.5 * normals, 0, 255)), np.uint8)


def position_colors(positions: Float64, low: Float64, high: Float64) -> UInt8:
    """Return RGB colors (H, W, 3) of positions (H, W, 3), m, from black at `low` (3,) to white at `high` (3,)."""
    scaled = (positions - low) / np.maximum(high - low, 1e-9)
    return np.asarray(np.rint(255 * np.clip(scaled, 0, 1)), np.uint8)


def index_colors(ids: Int32, centers: Mapping[int, Float64]) -> UInt8:
    """Return RGB colors (H, W, 3) of object indices (H, W), 0 = none. `centers` maps each index to a point (3,), m."""
    image = np.empty((*ids.shape, 3), np.uint8)
    image[...] = WITHOUT_OBJECT
    for key, color in object_colors(centers, set(centers)).items():
        image[ids == key] = color
    return image

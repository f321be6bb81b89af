"""Tests for the panels of a ray-cast view."""

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from framework.data import Camera, View
from framework.figures.figure_page import Page
from framework.figures.raycast_figure import (
    WITHOUT_OBJECT,
    index_colors,
    normal_colors,
    position_colors,
    raycast_page,
    write_raycast,
)
from tests.support.scenes.analytic_scene import pose

CAMERA = Camera(80, 60, 60.0, 60.0, 39.5, 29.5)
NAMES = {3: "chair", 12: "cup"}
CENTERS = {3: np.zeros(3), 12: np.ones(3)}


def wall(depth: float = 2.0) -> View:
    """Return the view of a wall `depth` m from a rotated camera.

    The left edge is unmapped, and id 99 is not in the list of objects.
    """
    T = pose(0.5, -0.2, 0.1, (0.0, 0.3, 0.0))
    depths = np.full(CAMERA.shape, depth, np.float32)
    depths[:, :8] = 0
    normals = np.zeros((*CAMERA.shape, 3), np.float32)
    normals[depths > 0] = T[:3, :3] @ (0, 0, -1)
    ids = np.zeros(CAMERA.shape, np.int32)
    ids[10:40, 10:40], ids[10:40, 50:75], ids[45:55, 20:60] = 3, 12, 99
    color = np.full((*CAMERA.shape, 3), 90, np.uint8)
    return View(CAMERA, T, depths, normals, color, ids, np.full(CAMERA.shape, -1, np.int32))


def titles(page: Page) -> list[str]:
    return [text.get_text() for text in page.figure.texts]


def test_raycast_page_labels_five_panels() -> None:
    page = raycast_page(wall(), NAMES, CENTERS, "kitchen, frame 7")
    assert {"depth", "normals", "vertices", "RGB", "object indices", "kitchen, frame 7"} <= set(titles(page))
    assert {"90% of the pixels are mapped", "2 objects"} <= set(titles(page))
    assert len(page.figure.axes) == 5 + 1, "expected five panels and a colorbar"
    names = {text.get_text() for axes in page.figure.axes for text in axes.texts}
    assert names == {"3 chair", "12 cup"}


def test_raycast_page_colorbar_is_in_meters() -> None:
    view = wall()
    view.depth[:30] = np.where(view.depth[:30] > 0, 1.0, 0)
    [bar] = [axes for axes in raycast_page(view, NAMES, CENTERS, "").figure.axes if axes.get_title() == "m"]
    assert bar.get_ylim() == (1.0, 2.0), "expected a range without unmapped pixels"


def test_raycast_page_texts_fit_on_page() -> None:
    page = raycast_page(wall(1e3), NAMES, CENTERS, "a long note " * 30)
    renderer = FigureCanvasAgg(page.figure).get_renderer()
    width, height = page.figure.bbox.size
    for text in page.figure.texts:
        box = text.get_window_extent(renderer)
        assert box.x0 >= 0
        assert box.x1 <= width, text.get_text()
        assert box.y0 >= 0
        assert box.y1 <= height


def test_raycast_colors_match_geometry() -> None:
    view = wall()
    mapped = view.depth > 0
    assert np.abs(normal_colors(view)[mapped].astype(int) - (128, 128, 255)).max() <= 1, (
        "expected normals that point toward the camera"
    )
    positions = np.stack([view.depth, -view.depth, 0 * view.depth], axis=-1).astype(np.float64)
    colors = position_colors(positions, np.array([0.0, -2.0, 0.0]), np.array([4.0, 2.0, 0.0]))
    assert (colors[mapped] == (128, 0, 0)).all()
    indices = index_colors(view.instance_ids, CENTERS)
    assert {tuple(color) for color in indices[view.instance_ids == 99].tolist()} == {WITHOUT_OBJECT}
    assert not np.array_equal(indices[20, 20], indices[20, 60])


def test_raycast_unmapped_pixels_are_white(tmp_path: Path) -> None:
    write_raycast(tmp_path / "view.png", wall(), NAMES, CENTERS, "")
    write_raycast(tmp_path / "again.png", wall(), NAMES, CENTERS, "")
    assert (tmp_path / "view.png").read_bytes() == (tmp_path / "again.png").read_bytes()
    for axes in raycast_page(wall(), NAMES, CENTERS, "").figure.axes[2:]:
        for image in axes.images:
            assert (np.asarray(image.get_array())[:, :8] == 255).all()
    assert matplotlib.image.imread(tmp_path / "view.png").shape[1] > 1200


@pytest.mark.parametrize("mapped", [False, True])
def test_raycast_page_without_objects_is_drawn(mapped: bool) -> None:
    view = wall()
    view.depth[...] = 2.0 if mapped else 0
    assert "0 objects" in titles(raycast_page(view, {}, {}, ""))

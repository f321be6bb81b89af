"""Tests for map panels. An object must have the same color and position in all panels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from framework.data import Camera, SceneTruth
from framework.figures.map_panels import Panel, PanelLine, Window, panel_line
from framework.geometry import project
from framework.rendering.labels import _widest_part
from framework.runs.stored_map import StoredMap
from framework.runs.stored_runs import Record
from tests.support.scenes.boxes_room import BoxesRoom, furnished, walk

SIZE = (160, 120)


def stored(ids: Mapping[int, int]) -> StoredMap:
    """Return the map of the room with new ids for 0 (room), 1 (red box) and 2 (blue box)."""
    mesh = furnished()
    labels = np.array([ids.get(k, 0) for k in range(3)], np.int32)[mesh.instance_ids]
    names = {key: f"thing {key}" for key in ids.values() if key}
    return StoredMap(replace(mesh, instance_ids=labels), labels, names, walk(), Record(Path(), {}, {}, 0.0))


def hue(color: np.ndarray) -> np.ndarray:
    """Return the hue of an RGB color as a unit vector (3,). The hue does not depend on the lighting."""
    direction = color - color.min()
    return direction / np.linalg.norm(direction)


@pytest.fixture(scope="module")
def truth() -> SceneTruth:
    return BoxesRoom().scene_truth()


@pytest.fixture(scope="module")
def line(truth: SceneTruth) -> PanelLine:
    """Return a line of panels in which one map is missing, one has swapped ids, and one lacks a box.

    All trajectories have the same length. In this case, no paths are drawn.
    """
    return panel_line([stored({1: 7, 2: 3}), None, stored({1: 5}), stored({1: 2, 2: 1})], truth, SIZE, zoom=True)


def test_panel_line_uses_same_object_color_in_all_columns(line: PanelLine) -> None:
    assert line.truth is not None
    assert line.true_count == 2
    saturation = np.ptp(line.truth.image.astype(int), axis=2)
    red, blue = (place_of(line.truth, text) for text in ("chair", "couch"))
    assert saturation[red] > 60 < saturation[blue]
    first, missing, second, third = line.maps
    assert missing is None
    for panel in (first, third):
        assert panel is not None
        for place in (red, blue):
            np.testing.assert_allclose(panel.image[place], line.truth.image[place], atol=2)
    assert second is not None
    np.testing.assert_allclose(second.image[red], line.truth.image[red], atol=2)
    assert np.ptp(second.image[blue].astype(int)) < 12, "expected missed objects in the background color"
    assert (np.abs(hue(line.truth.image[red].astype(float)) - hue(line.truth.image[blue].astype(float)))).max() > 0.3


def place_of(panel: Panel, text: str) -> tuple[int, int]:
    [key] = [key for key, name in panel.names.items() if name == text]
    u, v, _ = _widest_part(panel.objects == key)
    return round(v), round(u)


def shown(panel: Panel) -> set[str]:
    return {panel.names[key] for key in np.unique(panel.objects).tolist() if key in panel.names}


def test_zoom_window_contains_object_missing_in_some_maps(line: PanelLine) -> None:
    window = line.window
    assert window is not None
    assert (window.width, window.height) == (64, 48)
    assert line.truth is not None
    v, u = place_of(line.truth, "couch")
    assert window.left <= u < window.left + window.width
    assert window.top <= v < window.top + window.height
    assert [panel is None for panel in line.zoomed] == [False, True, False, False, False]
    larger = line.zoomed[-1]
    assert larger is not None
    # the same point is 2.5 times as far from the corner of the window
    at = round((v + 0.5 - window.top) * 2.5 - 0.5), round((u + 0.5 - window.left) * 2.5 - 0.5)
    np.testing.assert_allclose(larger.image[at], line.truth.image[v, u], atol=12)
    assert shown(larger) >= {"couch"}


def test_panel_line_of_equal_maps_has_no_window_or_paths(truth: SceneTruth) -> None:
    line = panel_line([stored({1: 7, 2: 3}), stored({1: 1, 2: 2})], truth, SIZE, zoom=True)
    assert (line.window, line.zoomed) == (None, ())
    assert [panel.path for panel in line.maps if panel] == [None, None]


def test_zoom_window_ignores_false_objects(truth: SceneTruth) -> None:
    line = panel_line([stored({0: 9, 1: 7}), stored({1: 1, 2: 2})], truth, SIZE, zoom=True)
    assert line.truth is not None
    assert line.window is not None
    v, u = place_of(line.truth, "couch")
    assert 0 < u - line.window.left < line.window.width
    assert 0 < v - line.window.top < line.window.height


def test_panel_paths_are_clipped_to_image(truth: SceneTruth) -> None:
    poses = walk()
    poses[10:, 2, 3] = 9  # far above the room
    maps = [stored({1: 7}), stored({1: 1, 2: 2})]
    line = panel_line([replace(maps[0], poses=poses[:8]), replace(maps[1], poses=poses)], truth, SIZE, zoom=False)
    first, second = (panel.path for panel in line.maps if panel)
    assert first is not None
    assert second is not None
    assert (len(first.pixels), len(second.pixels)) == (8, 20)
    np.testing.assert_array_equal(first.pixels, second.pixels[:8])
    assert (second.pixels >= 0).all()
    assert (second.pixels <= np.array(SIZE) - 1).all()
    assert line.truth is not None
    assert line.truth.path is None


def test_panel_line_without_truth_uses_last_map_as_reference() -> None:
    line = panel_line([stored({1: 7, 2: 3}), stored({1: 2, 2: 1})], None, SIZE, zoom=False)
    assert line.truth is None
    first, last = line.maps
    assert first is not None
    assert last is not None
    np.testing.assert_array_equal(first.image, last.image)
    assert shown(last) == {"thing 1", "thing 2"}


def test_zoom_window_camera_projects_window_area() -> None:
    camera, window = Camera(160, 120, 150.0, 140.0, 80.0, 59.0), Window(32, 24, 64, 48)
    larger = window.seen_by(camera)
    points = np.array([[0.1, -0.2, 2.0], [-0.4, 0.3, 1.5]])
    corner = np.array([window.left, window.top]) - 0.5
    expected = (project(camera, points) - corner) * 2.5 - 0.5
    np.testing.assert_allclose(project(larger, points), expected, atol=1e-9)
    assert larger.shape == camera.shape

"""Tests for the refinement figure on synthetic frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from framework.data import Camera, Frame, FrameTruth, PointClusters, Pose
from framework.evaluation.refined_points import Refinement
from framework.figures import side_view
from framework.figures.cluster_marks import DROPPED, ClusterMarks
from framework.figures.refinement_figure import (
    DPI,
    WIDTH_IN,
    draw_image,
    refinement_figure,
    tinted,
    write_refinement,
)
from framework.figures.side_view import SideView, draw_side
from framework.geometry import exp_se3
from framework.refinement.lifting import lift
from framework.refinement.refine import keep_points
from tests.support.scenes.corner_room import CornerRoom, SphereDetector

Masks = list[np.ndarray]


def two_walls(height: int = 48, width: int = 64) -> Frame:
    """Return a gray frame. The left half is 2 m away, and the right half is 3 m away."""
    depth = np.full((height, width), 2.0, np.float32)
    depth[:, width // 2 :] = 3.0
    camera = Camera(width, height, 60.0, 60.0, (width - 1) / 2, (height - 1) / 2)
    return Frame(0, 0.0, np.full((height, width, 3), 120, np.uint8), depth, camera)


def clusters_of(frame: Frame, masks: Masks) -> PointClusters:
    places = [np.argwhere(mask)[:, ::-1] for mask in masks]
    pixels = np.concatenate([np.zeros((0, 2), np.int64), *places]).astype(np.int32)
    n = len(masks)
    return PointClusters(
        points_world=np.zeros((len(pixels), 3), np.float32),
        pixels=pixels,
        cluster=np.repeat(np.arange(n), [len(place) for place in places]).astype(np.int32),
        class_probabilities=np.ones((n, 1), np.float32),
        scores=np.full(n, 0.5, np.float32),
        classes=("chair",),
    )


def box(frame: Frame, top: int, bottom: int, left: int, right: int) -> np.ndarray:
    mask = np.zeros(frame.depth.shape, np.bool_)
    mask[top:bottom, left:right] = True
    return mask


def refined(frame: Frame, before: Masks, after: Masks) -> Refinement:
    return Refinement(frame, clusters_of(frame, before), clusters_of(frame, after), 1.5)


def pixels(figure: Figure) -> np.ndarray:
    """Return the drawn figure as an RGB image (H, W, 3)."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].astype(int)


def picture(refinement: Refinement, title: str, refiner: str) -> np.ndarray:
    return pixels(refinement_figure(refinement, title, refiner))


def test_cluster_marks_owner_is_smallest_cluster() -> None:
    frame = two_walls()
    large, small = box(frame, 5, 40, 5, 40), box(frame, 10, 20, 10, 20)
    for masks, at in (([large, small], 1), ([small, large], 0)):
        owner = ClusterMarks.before(refined(frame, masks, masks)).owner
        np.testing.assert_array_equal(owner[small], at)
        np.testing.assert_array_equal(owner[large & ~small], 1 - at)
        np.testing.assert_array_equal(owner[~large], -1)


def test_cluster_marks_separate_dropped_and_added_pixels() -> None:
    frame = two_walls()
    a, b = box(frame, 0, 10, 0, 20), box(frame, 0, 10, 15, 30)
    grown = box(frame, 0, 14, 0, 15)
    marks = ClusterMarks.after(refined(frame, [a, b], [grown, b]))
    assert not marks.dropped.any(), "expected no dropped points: columns 15 to 19 were already in the second cluster"
    np.testing.assert_array_equal(marks.added, box(frame, 10, 14, 0, 15))
    marks = ClusterMarks.after(refined(frame, [a, b], [box(frame, 0, 10, 0, 5), b]))
    np.testing.assert_array_equal(marks.dropped, box(frame, 0, 10, 5, 15))
    assert not marks.added.any()


def test_cluster_marks_unassigned_points_are_dropped() -> None:
    frame = two_walls()
    change = refined(frame, [box(frame, 0, 10, 0, 20)], [box(frame, 0, 10, 0, 20)])
    loose = np.where(change.after.pixels[:, 0] < 8, -1, change.after.cluster).astype(np.int32)
    marks = ClusterMarks.after(replace(change, after=replace(change.after, cluster=loose)))
    np.testing.assert_array_equal(marks.dropped, box(frame, 0, 10, 0, 8))
    assert not marks.added.any()


def test_cluster_marks_keep_colors_and_add_colors_for_parts() -> None:
    frame = two_walls()
    a, b = box(frame, 0, 10, 0, 20), box(frame, 20, 30, 0, 20)
    change = refined(frame, [a, b], [box(frame, 0, 10, 0, 5), box(frame, 0, 10, 5, 20), b])
    before, after = ClusterMarks.before(change).colors, ClusterMarks.after(change).colors
    np.testing.assert_array_equal(after[[1, 2]], before)
    assert (np.abs(after[0].astype(int) - before).max(axis=1) > 60).all()
    many = ClusterMarks.before(refined(frame, [a] * 100, [a] * 100)).colors.astype(int)
    assert many.shape == (100, 3)
    apart = np.abs(many - np.array(DROPPED)).sum(axis=1)
    assert apart.min() > 100, "expected cluster colors that differ from the mark of dropped points"


def test_refinement_image_is_tinted_and_hatched() -> None:
    frame = two_walls()
    change = refined(frame, [box(frame, 16, 40, 16, 48)], [box(frame, 16, 40, 16, 32)])
    before, after = ClusterMarks.before(change), ClusterMarks.after(change)
    left, right = tinted(frame, before).astype(int), tinted(frame, after).astype(int)
    kept, other = np.s_[17:39, 17:31], np.s_[4:10, 50:60]
    np.testing.assert_array_equal(left[kept], right[kept])
    assert np.ptp(left[other].reshape(-1, 3).mean(axis=0)) < 1, "expected unmarked pixels to stay gray"
    hue = left[kept].reshape(-1, 3).mean(axis=0) - left[kept].mean()
    color = before.colors[0] - before.colors[0].mean()
    assert hue @ color > 0.98 * np.linalg.norm(hue) * np.linalg.norm(color)
    hatched = []
    for marks in (before, after):
        figure = Figure((6.4, 4.8), dpi=100)
        draw_image(figure.add_axes((0, 0, 1, 1)), frame, marks, 6.4)
        lost = pixels(figure)[300:380, 340:460]
        hatched.append(((lost[..., 0] > 150) & (lost[..., 1] < 110)).mean())
    assert hatched[0] == 0
    assert 0.1 < hatched[1] < 0.6, "expected stripes"


def test_side_view_shows_depth_distances() -> None:
    frame = two_walls()
    mask = box(frame, 16, 32, 24, 40)  # the mask bleeds from the near wall to the far wall
    change = refined(frame, [mask], [mask & (frame.depth < 2.5)])
    after = ClusterMarks.after(change)
    side = SideView.of(frame, ClusterMarks.before(change), after, 1.7)
    assert side is not None
    at = {column: side.points[(side.rows == 24) & (side.columns == column)][0] for column in (31, 32)}
    moved = at[32] - at[31]  # m, distance of the two points along x; their depths differ by 1 m
    angle, sign = side_view.AZIMUTH_RAD, np.sign(side.forward)
    x = 0.5 / 60 * 3 + 0.5 / 60 * 2
    assert moved[0] == pytest.approx(sign * np.sin(angle) + x * np.cos(angle), abs=0.01)
    axes = Figure().add_subplot()
    draw_side(axes, frame, after, side, 4.6)
    clusters = axes.collections[-1]
    red = (np.abs(clusters.get_facecolors()[:, :3] - np.array(DROPPED) / 255) < 1e-6).all(axis=1)
    u = np.asarray(clusters.get_offsets())[:, 0]
    assert red.sum() == (~red).sum() == 16 * 8
    assert np.median(u[red]) - np.median(u[~red]) == pytest.approx(sign * np.sin(angle), rel=0.25)
    low, high = axes.get_xlim()
    assert ((u > low) & (u < high)).all()


@pytest.mark.parametrize("tilt", [-0.8, -0.5, -0.2, 0.0])
def test_side_view_up_direction_is_floor_normal(tilt: float) -> None:
    room = CornerRoom()[0]
    camera, T = room.camera, exp_se3(np.array([0, 0, 0, tilt, 0, 0.1]))
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1) @ T[:3, :3].T
    depth = np.where(rays[..., 1] > 0.02, 1.4 / np.maximum(rays[..., 1], 0.02), 0).astype(np.float32)
    depth[depth > 8] = 0
    up = side_view._up(replace(room, depth=depth))
    np.testing.assert_allclose(up, T[:3, :3].T @ [0, -1, 0], atol=0.02)
    axes = side_view._turned(up, side_view.AZIMUTH_RAD)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-9)
    assert np.linalg.det(axes) == pytest.approx(1)
    assert axes[:, 2] @ up == pytest.approx(-np.sin(side_view.ELEVATION_RAD))
    assert axes[:, 0] @ up == pytest.approx(0, abs=1e-9)


def test_refinement_figure_of_room_is_deterministic() -> None:
    frame = CornerRoom()[0]
    before = lift(SphereDetector().detect(frame), frame, Pose(np.eye(4)))
    after = keep_points(before, before.pixels[:, 0] % 3 > 0)
    image = picture(Refinement(frame, before, after, 1.0), "a room", "refiner=thirds")
    assert image.shape[1:] == (round(WIDTH_IN * DPI), 3)
    again = picture(Refinement(frame, before, after, 1.0), "a room", "refiner=thirds")
    np.testing.assert_array_equal(image, again)


def odd_frames() -> dict[str, Frame]:
    plain = two_walls()
    camera = Camera(1, 1, 1.0, 1.0, 0.0, 0.0)
    return {
        "portrait": two_walls(90, 30),
        "wide": two_walls(6, 200),
        "one pixel": Frame(0, 0.0, np.zeros((1, 1, 3), np.uint8), np.ones((1, 1), np.float32), camera),
        "no reading": replace(plain, depth=np.zeros_like(plain.depth)),
        "one reading": replace(plain, depth=np.where(box(plain, 9, 10, 9, 10), plain.depth, 0)),
        "truth": replace(plain, truth=FrameTruth(np.ones(plain.depth.shape, np.int32), {1: None})),
    }


@pytest.mark.parametrize("name", odd_frames())
def test_refinement_figure_of_unusual_frames_is_drawn(name: str) -> None:
    frame = odd_frames()[name]
    held = frame.depth > 0
    some = held & (np.indices(held.shape)[1] % 8 < 5)
    image = picture(refined(frame, [held] * 3, [some, held, held & False]), "title " * 60, "refiner=x " * 60)
    assert image.shape[1] == round(WIDTH_IN * DPI)


@pytest.mark.parametrize("after", [0, 1, 2])
@pytest.mark.parametrize("before", [0, 1])
def test_refinement_figure_accepts_changed_cluster_counts(before: int, after: int) -> None:
    frame = two_walls()
    image = picture(refined(frame, [box(frame, 5, 9, 0, 30)] * before, [box(frame, 7, 9, 0, 30)] * after), "", "")
    assert image.shape[1] == round(WIDTH_IN * DPI)


def test_refinement_figure_height_is_limited_for_many_clusters() -> None:
    frame = two_walls()
    stripes = [box(frame, k, k + 1, 4, 20) for k in range(30)]
    few = picture(refined(frame, stripes[:24], stripes[:24]), "all", "refiner=identity")
    many = picture(refined(frame, stripes, [*stripes, *stripes[:3]]), "all", "refiner=split")
    assert many.shape == few.shape, "expected a limited number of table rows"


def test_write_refinement_creates_complete_image(tmp_path: Path) -> None:
    frame = two_walls()
    mask = box(frame, 10, 30, 10, 50)
    write_refinement(tmp_path / "refinement.png", refined(frame, [mask], [mask]), "title", "refiner=identity")
    assert [path.name for path in tmp_path.iterdir()] == ["refinement.png"]
    assert Image.open(tmp_path / "refinement.png").width == round(WIDTH_IN * DPI)

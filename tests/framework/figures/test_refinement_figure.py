"""The picture of a refinement: what is marked where, on frames that are known exactly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from framework.data import Camera, Frame, FrameTruth, PointClusters, Pose
from framework.evaluation.refined_points import Refinement
from framework.figures import drawing, side_view
from framework.figures.cluster_image import _free_place, image_panel
from framework.figures.cluster_marks import ClusterMarks
from framework.figures.refinement_figure import refinement_picture, write_refinement
from framework.figures.side_view import SideView, side_panel
from framework.geometry import exp_se3
from framework.refinement.lifting import lift
from framework.refinement.selection import keep_points
from tests.support.scenes.corner_room import CornerRoom, SphereDetector

Masks = list[np.ndarray]


def two_walls(height: int = 48, width: int = 64) -> Frame:
    """The left half of the picture is 2 m away, the right half 3 m; all gray."""
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


def test_a_pixel_shows_the_smallest_cluster_over_it() -> None:
    frame = two_walls()
    large, small = box(frame, 5, 40, 5, 40), box(frame, 10, 20, 10, 20)
    for masks, at in (([large, small], 1), ([small, large], 0)):
        owner = ClusterMarks.before(refined(frame, masks, masks)).owner
        np.testing.assert_array_equal(owner[small], at)
        np.testing.assert_array_equal(owner[large & ~small], 1 - at)
        np.testing.assert_array_equal(owner[~large], -1)


def test_dropped_is_what_no_cluster_holds_and_added_what_its_own_did_not() -> None:
    frame = two_walls()
    a, b = box(frame, 0, 10, 0, 20), box(frame, 0, 10, 15, 30)
    grown = box(frame, 0, 14, 0, 15)
    marks = ClusterMarks.after(refined(frame, [a, b], [grown, b]))
    assert not marks.dropped.any(), "columns 15 to 19 went to the second cluster, which had them already"
    np.testing.assert_array_equal(marks.added, box(frame, 10, 14, 0, 15))
    marks = ClusterMarks.after(refined(frame, [a, b], [box(frame, 0, 10, 0, 5), b]))
    np.testing.assert_array_equal(marks.dropped, box(frame, 0, 10, 5, 15))
    assert not marks.added.any()


def test_points_of_no_cluster_are_dropped() -> None:
    frame = two_walls()
    change = refined(frame, [box(frame, 0, 10, 0, 20)], [box(frame, 0, 10, 0, 20)])
    loose = np.where(change.after.pixels[:, 0] < 8, -1, change.after.cluster).astype(np.int32)
    marks = ClusterMarks.after(replace(change, after=replace(change.after, cluster=loose)))
    np.testing.assert_array_equal(marks.dropped, box(frame, 0, 10, 0, 8))
    assert not marks.added.any()


def test_colors_stay_and_further_parts_get_their_own() -> None:
    frame = two_walls()
    a, b = box(frame, 0, 10, 0, 20), box(frame, 20, 30, 0, 20)
    change = refined(frame, [a, b], [box(frame, 0, 10, 0, 5), box(frame, 0, 10, 5, 20), b])
    before, after = ClusterMarks.before(change).colors, ClusterMarks.after(change).colors
    np.testing.assert_array_equal(after[[1, 2]], before)
    assert (np.abs(after[0].astype(int) - before).max(axis=1) > 60).all()
    many = ClusterMarks.before(refined(frame, [a] * 100, [a] * 100)).colors.astype(int)
    assert many.shape == (100, 3)
    apart = np.abs(many - np.array(drawing.DROPPED)).sum(axis=1)
    assert apart.min() > 100, "nothing looks like what was dropped"


def test_the_image_is_tinted_and_hatched_where_it_should_be() -> None:
    frame = two_walls()
    change = refined(frame, [box(frame, 16, 40, 16, 48)], [box(frame, 16, 40, 16, 32)])
    before, after = ClusterMarks.before(change), ClusterMarks.after(change)
    left, right = image_panel(frame, before).astype(int), image_panel(frame, after).astype(int)
    scale = left.shape[0] / 48
    kept = np.s_[round(30 * scale) : round(38 * scale), round(18 * scale) : round(30 * scale)]
    lost = np.s_[round(30 * scale) : round(38 * scale), round(34 * scale) : round(46 * scale)]
    beside = np.s_[round(4 * scale) : round(10 * scale), round(50 * scale) : round(60 * scale)]
    np.testing.assert_array_equal(left[kept], right[kept])
    assert np.ptp(left[beside].reshape(-1, 3).mean(axis=0)) < 1, "gray stays gray"
    hue = left[kept].reshape(-1, 3).mean(axis=0) - left[kept].mean()
    color = before.colors[0] - before.colors[0].mean()
    assert hue @ color > 0.98 * np.linalg.norm(hue) * np.linalg.norm(color)
    red = (right[lost][..., 0] > 150) & (right[lost][..., 1] < 90)
    assert 0.35 < red.mean() < 0.65, "stripes"
    assert not ((left[lost][..., 0] > 150) & (left[lost][..., 1] < 90)).any()


def test_tags_never_overlap() -> None:
    taken: list[tuple[float, float, float, float]] = []
    for _ in range(200):
        place = _free_place((50.0, 40.0), (60.0, 20.0), (300, 200), taken)
        if place is None:
            break
        assert place[0] >= 0 and place[1] >= 0 and place[2] <= 300 and place[3] <= 200  # noqa: PT018
        for other in taken:
            assert place[0] >= other[2] or other[0] >= place[2] or place[1] >= other[3] or other[1] >= place[3]
        taken.append(place)
    assert 4 <= len(taken) < 200


def test_from_the_side_distances_in_depth_show() -> None:
    frame = two_walls()
    mask = box(frame, 16, 32, 24, 40)  # bleeds from the near wall to the far one
    change = refined(frame, [mask], [mask & (frame.depth < 2.5)])
    side = SideView.of(frame, ClusterMarks.before(change), ClusterMarks.after(change))
    assert side is not None
    rows, columns = side.places
    at = {column: side.pixels[(rows == 24) & (columns == column)][0] for column in (31, 32)}
    moved = (at[32] - at[31]) / side.scale  # the two readings are 1 m apart in depth, and 3/60 + 0.5/60 in x
    angle, sign = side_view.AZIMUTH_RAD, np.sign(side.forward[0])
    x = 0.5 / 60 * 3 + 0.5 / 60 * 2
    assert moved[0] == pytest.approx(sign * np.sin(angle) + x * np.cos(angle), abs=0.01)
    panel = side_panel(frame, ClusterMarks.after(change), side).astype(int)
    red = (panel[..., 0] > 120) & (panel[..., 1] < 70) & (panel[..., 2] < 90)
    colored = np.ptp(panel, axis=2) > 60
    u_red, u_kept = np.nonzero(red)[1], np.nonzero(colored & ~red)[1]
    assert len(u_red) > 20
    assert len(u_kept) > 20
    expected = sign * np.sin(angle) * side.scale / drawing.SUPERSAMPLING
    assert np.median(u_red) - np.median(u_kept) == pytest.approx(expected, rel=0.25)


@pytest.mark.parametrize("tilt", [-0.8, -0.5, -0.2, 0.0])
def test_the_floor_says_what_is_up(tilt: float) -> None:
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


def test_the_picture_of_a_room() -> None:
    frame = CornerRoom()[0]
    before = lift(SphereDetector().detect(frame), frame, Pose(np.eye(4)))
    after = keep_points(before, before.pixels[:, 0] % 3 > 0)
    image = refinement_picture(Refinement(frame, before, after, 1.0), "a room", "refiner=thirds")
    assert image.dtype == np.uint8
    assert image.shape[1:] == (drawing.WIDTH, 3)
    again = refinement_picture(Refinement(frame, before, after, 1.0), "a room", "refiner=thirds")
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
def test_whatever_the_frame_there_is_a_picture(name: str) -> None:
    frame = odd_frames()[name]
    held = frame.depth > 0
    some = held & (np.indices(held.shape)[1] % 8 < 5)
    image = refinement_picture(refined(frame, [held] * 3, [some, held, held & False]), "title " * 60, "refiner=x " * 60)
    assert image.shape[1] == drawing.WIDTH


@pytest.mark.parametrize("after", [0, 1, 2])
@pytest.mark.parametrize("before", [0, 1])
def test_clusters_may_be_none_come_and_go(before: int, after: int) -> None:
    frame = two_walls()
    image = refinement_picture(
        refined(frame, [box(frame, 5, 9, 0, 30)] * before, [box(frame, 7, 9, 0, 30)] * after), "", ""
    )
    assert image.shape[1] == drawing.WIDTH


def test_many_clusters_and_parts_fit_on_the_picture() -> None:
    frame = two_walls()
    stripes = [box(frame, k, k + 1, 4, 20) for k in range(30)]
    few = refinement_picture(refined(frame, stripes[:24], stripes[:24]), "all", "refiner=identity")
    many = refinement_picture(refined(frame, stripes, [*stripes, *stripes[:3]]), "all", "refiner=split")
    assert many.shape == few.shape, "the table has an end"


def test_it_is_written_whole(tmp_path: Path) -> None:
    frame = two_walls()
    mask = box(frame, 10, 30, 10, 50)
    write_refinement(tmp_path / "refinement.png", refined(frame, [mask], [mask]), "title", "refiner=identity")
    assert [path.name for path in tmp_path.iterdir()] == ["refinement.png"]
    assert Image.open(tmp_path / "refinement.png").width == drawing.WIDTH

"""Tests for fuser=bayesian_tsdf."""

import dataclasses

import numpy as np
import pytest

from framework.data import Frame
from framework.errors import ConfigError, MapFullError
from framework.registry import assemble
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from tests.support.scenes.analytic_scene import room, walk
from tests.support.thread_counts import by_one_thread_and_two
from tests.support.true_masks import fuse_masks, masks_of


def new_fuser(**parameters: object) -> BayesianTsdf:
    return assemble(BayesianTsdf, voxel_size=0.02, max_depth=4.0, **parameters)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [room().frame(T, k) for k, T in enumerate(walk(10))]


def test_bayesian_tsdf_full_map_error_keeps_content(frames: list[Frame]) -> None:
    fuser = new_fuser(max_blocks=300)
    with pytest.raises(MapFullError, match="300 blocks"):
        fuse_masks(fuser, frames[0], [], [])
    assert fuser.scene.statistics.voxels == 300 * 512
    fuser.scene.mesh()


def test_bayesian_tsdf_invalid_parameter_raises() -> None:
    for wrong in (
        {"max_weight": 256.0},
        {"class_floor": 0.0},
        {"absence_likelihood": float("nan")},
        {"occlusion_area_ratio": 1.5},
    ):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            assemble(BayesianTsdf, **wrong)


def test_bayesian_tsdf_map_does_not_depend_on_thread_count(frames: list[Frame]) -> None:
    def mapped() -> list[bytes]:
        fuser = new_fuser()
        for frame in frames:
            fuse_masks(fuser, frame, masks_of(frame), [0.9, 0.5, 0.4])
        grid, labels = fuser.scene.volume.voxels.grid, fuser.scene.labels
        b, r = fuser.scene.volume.voxels.block_count, labels.row_count
        of_grid = [a[:b].tobytes() for a in (grid.block_coords, grid.tsdf, grid.weight, grid.color, grid.label_row)]
        return of_grid + [a[:r].tobytes() for a in labels.evidence]

    by_one, by_two = by_one_thread_and_two(mapped)
    assert by_one == by_two


def test_bayesian_tsdf_only_created_instances_allocate_rows(frames: list[Frame]) -> None:
    fuser = new_fuser()
    first, second, _ = masks_of(frames[0])
    fuse_masks(fuser, frames[0], [second], [0.1])
    assert fuser.scene.labels.row_count == 0
    fuse_masks(fuser, frames[0], [first], [0.9])
    alone = fuser.scene.labels.row_count
    assert alone > 0
    fuse_masks(fuser, frames[0], [first, second], [0.9, 0.1])
    assert fuser.scene.labels.row_count == alone


@pytest.mark.parametrize(("on_top", "of_the_book"), [(0.25, True), (0.0, False)])
def test_bayesian_tsdf_small_object_keeps_voxels_by_area_ratio(
    frames: list[Frame], on_top: float, of_the_book: bool
) -> None:
    """The book is detected in every other frame. The mask of the couch always covers the book."""
    fuser = new_fuser(occlusion_area_ratio=on_top)
    couch = masks_of(frames[0])[0]
    v, u = np.nonzero(couch)
    rows, columns = np.ogrid[: couch.shape[0], : couch.shape[1]]
    side = np.sqrt(len(u)) / 4
    book = couch & (np.abs(rows - np.median(v)) < side / 2) & (np.abs(columns - np.median(u)) < side / 2)
    fuse_masks(fuser, frames[0], [couch & ~book, book], [0.9, 0.4])  # creates the instances that later masks match
    for k in range(1, 9):
        frame = dataclasses.replace(frames[0], index=k)
        fuse_masks(fuser, frame, [couch, book] if k % 2 else [couch], [0.6, 0.5][: 1 + k % 2])
    frame = frames[0]
    assert frame.T_world_camera is not None
    seen = fuser.scene.instances_seen(frame, frame.T_world_camera, 1)
    assert (np.median(seen[book]) == 2) == of_the_book
    assert (seen[book] == 2).any() == of_the_book

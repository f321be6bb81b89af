"""An instance keeps its colour, and near ones differ."""

from __future__ import annotations

import numpy as np

from framework.live_view.instance_colors import InstanceColors
from framework.rendering.palette import instance_colors
from tests.framework.live_view.test_seen_instances import room_mesh


def test_those_that_come_later_change_no_colour() -> None:
    centroids = {key: np.random.default_rng(key).uniform(0, 2, 3) for key in (3, 5, 9, 12)}
    colors = InstanceColors()
    colors.add({key: centroids[key] for key in (5, 3)})
    first = {key: colors[key].tolist() for key in (3, 5)}
    colors.add({**centroids, 3: np.array([50.0, 0, 0])})  # 3 has moved
    assert {key: colors[key].tolist() for key in (3, 5)} == first
    assert len({tuple(colors[key].tolist()) for key in centroids}) == 4
    assert [colors[key].tolist() for key in (3, 5)] == instance_colors(np.array([centroids[3], centroids[5]])).tolist()


def test_a_mesh_is_painted_where_instances_are() -> None:
    mesh, colors = room_mesh(), InstanceColors()
    colors.add({1: np.zeros(3), 2: np.ones(3)})
    painted = colors.painted(mesh)
    np.testing.assert_array_equal(painted[mesh.instance_ids == 0], mesh.colors[mesh.instance_ids == 0])
    for key in (1, 2):
        of = mesh.instance_ids == key
        gray = mesh.colors[of].mean(axis=1, keepdims=True)
        np.testing.assert_allclose(painted[of], 0.4 * gray + 0.6 * colors[key], atol=1.01)

"""Tests for the confirmation of instances."""

import numpy as np
import pytest

from framework.mapping.instances.instance_list import MIN_VERTICES, Confirmation
from framework.mapping.instances.instance_table import InstanceTable


def test_confirmation_requires_observations_and_confidence() -> None:
    table = InstanceTable()
    for scores in ([0.9, 0.9], [0.9, 0.9, 0.9], [0.1, 0.1, 0.1], [0.5, 0.5, 0.5]):
        record = table.create(1, 0)
        for frame, score in enumerate(scores):
            table.observe(record.id, np.zeros(1), score, frame)
    for frame in range(6):  # visible in 6 frames, detected in 3
        table.see([4], frame)
    assert Confirmation(3, 0.26, 0).counts(table).tolist() == [False, False, True, False, False]
    assert Confirmation(3, 0.25, 0).counts(table).tolist() == [False, False, True, False, True]
    assert Confirmation(1, 0, 0).counts(InstanceTable()).tolist() == [False]


@pytest.mark.parametrize(
    ("min_area", "voxel_size", "vertices"),
    [
        (0.003, 0.01, 30),
        (0.003, float(np.float32(0.01)), 30),  # the grid stores float32
        (0.075, 0.05, 30),
        (0.003, 0.05, MIN_VERTICES),  # the area has 1.2 vertices
        (0.0, 0.01, MIN_VERTICES),
    ],
)
def test_confirmation_area_converts_to_vertex_count(min_area: float, voxel_size: float, vertices: int) -> None:
    confirmation = Confirmation(1, 0, min_area)
    assert confirmation.min_vertices(voxel_size) == vertices
    ids = np.repeat(np.int32([0, 2, 5]), [1, vertices, vertices - 1])
    assert set(ids[confirmation.too_small(ids, voxel_size)]) == {0, 5}
    assert confirmation.too_small(np.zeros(0, np.int32), voxel_size).shape == (0,)

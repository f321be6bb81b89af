"""Contract tests of a refiner, and tests of DepthMedian."""

from __future__ import annotations

import numpy as np
import pytest
from instancemap import ConfigError
from instancemap.testing import OptionContract, RefinerContract, bleeding_clusters, exact_clusters, frame_at

from instancemap_depth_median.depth_median import DepthMedian


class TestDepthMedian(OptionContract, RefinerContract):
    option = "depth_median"


def test_depth_median_drops_background_of_bleeding_mask() -> None:
    frame = frame_at(1)
    refined = DepthMedian().refine(bleeding_clusters(frame), frame)
    ids = frame.truth.instance_ids[refined.pixels[:, 1], refined.pixels[:, 0]]
    bleeding = bleeding_clusters(frame)
    before = frame.truth.instance_ids[bleeding.pixels[:, 1], bleeding.pixels[:, 0]]
    assert (ids == 0).sum() < 0.5 * (before == 0).sum()
    assert (ids > 0).sum() > 0.99 * (before > 0).sum()


def test_depth_median_drops_only_distant_point() -> None:
    frame = frame_at(1)
    clusters = exact_clusters(frame)
    farthest = frame.depth[clusters.pixels[:, 1], clusters.pixels[:, 0]].argmax()
    frame.depth[tuple(clusters.pixels[farthest, ::-1])] += 1
    refined = DepthMedian(reach=0.5).refine(clusters, frame)
    np.testing.assert_array_equal(refined.pixels, np.delete(clusters.pixels, farthest, axis=0))


def test_depth_median_invalid_parameter_raises() -> None:
    with pytest.raises(ConfigError, match=r"DepthMedian.reach: expected at least 0, got -1"):
        DepthMedian(reach=-1)

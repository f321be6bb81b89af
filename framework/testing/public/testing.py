"""Contract tests for plugin authors, importable as `instancemap.testing`.

    from instancemap.testing import OptionContract, RefinerContract

    class TestMyRefiner(OptionContract, RefinerContract):
        option = "my_refiner"

pytest finds the tests in the class. They run on short synthetic videos with exact ground truth.
"""

import pytest

pytest.register_assert_rewrite("framework.testing")  # shows the values of failed assertions

from framework.testing.contracts import (
    BackEndContract,
    DetectorContract,
    FuserContract,
    MaskingContract,
    OptionContract,
    RefinerContract,
    SequenceContract,
    TrackerContract,
)
from framework.testing.corner_room import (
    CAMERA,
    CLASSES,
    RoomMap,
    bleeding_clusters,
    exact_clusters,
    frame_at,
    pose_at,
    spheres_in,
)
from framework.testing.viewer import (
    FRAMES,
    LOST,
    SKIPPED,
    STAGE_MS,
    ViewerContract,
    WatchedMap,
    frame_with_found,
    show_run,
)

__all__ = [
    "CAMERA",
    "CLASSES",
    "FRAMES",
    "LOST",
    "SKIPPED",
    "STAGE_MS",
    "BackEndContract",
    "DetectorContract",
    "FuserContract",
    "MaskingContract",
    "OptionContract",
    "RefinerContract",
    "RoomMap",
    "SequenceContract",
    "TrackerContract",
    "ViewerContract",
    "WatchedMap",
    "bleeding_clusters",
    "exact_clusters",
    "frame_at",
    "frame_with_found",
    "pose_at",
    "show_run",
    "spheres_in",
]

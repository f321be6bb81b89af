"""Tests for the data classes and their validation."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from framework.data import (
    Box,
    Camera,
    DeferredTruth,
    Detections,
    Frame,
    FrameTruth,
    Instance,
    InstanceMesh,
    PointClusters,
    Pose,
    SceneTruth,
)
from framework.errors import DataError
from framework.geometry import exp_se3

CAMERA = Camera(4, 3, 5.0, 5.0, 1.5, 1.0)


def frame(**changes: Any) -> Frame:
    parts = {
        "index": 7,
        "timestamp": 0.5,
        "color": np.zeros((3, 4, 3), np.uint8),
        "depth": np.ones((3, 4), np.float32),
        "camera": CAMERA,
        "T_world_camera": np.eye(4),
    }
    return Frame(**(parts | changes))


@pytest.mark.parametrize("index", [1.5, "a", -5, None, True])
def test_frame_invalid_index_raises(index: object) -> None:
    with pytest.raises(DataError, match=r"Frame\.index: expected an integer of at least 0 and below 2\^53, got"):
        frame(index=index)


def test_camera_and_frame_accept_numpy_scalars() -> None:
    camera = Camera(np.int64(4), np.int32(3), np.float32(5), np.float64(5), np.int64(1), 1)  # type: ignore[arg-type]
    assert frame(index=np.int64(3), timestamp=np.float32(1), camera=camera).index == 3


def test_frame_up_other_than_unit_vector_raises() -> None:
    np.testing.assert_array_equal(frame(up=np.array([0.6, -0.8, 0.0])).up, [0.6, -0.8, 0.0])
    for wrong, message in (
        ([0.0, -9.81, 0.0], "expected a unit vector, got a vector of length 9.81"),
        ([0.0, -1.0], r"shape \(3\)"),
        ([0.0, np.nan, 0.0], "expected finite values"),
    ):
        with pytest.raises(DataError, match=f"frame 7: up.*{message}"):
            frame(up=np.array(wrong))


@pytest.mark.parametrize("camera", [None, (4, 3, 5.0, 5.0, 1.5, 1.0)])
def test_frame_invalid_camera_type_raises(camera: object) -> None:
    with pytest.raises(DataError, match="frame 7: camera: expected a Camera, got"):
        frame(camera=camera)


@pytest.mark.parametrize(("name", "value"), [("width", "160"), ("height", 3.0), ("fx", None), ("cy", True)])
def test_camera_non_numeric_value_raises(name: str, value: object) -> None:
    with pytest.raises(DataError, match=rf"Camera\.{name}: expected an? (integer )?number of px, got"):
        replace(CAMERA, **{name: value})


def test_frame_copies_only_read_only_images() -> None:
    """For read-only arrays, Numba would compile the kernels again."""
    depth = np.ones((3, 4), np.float32)
    assert frame(depth=depth).depth is depth
    depth.flags.writeable = False
    assert frame(depth=depth).depth.flags.writeable


def detections(**changes: Any) -> Detections:
    parts = {
        "masks": np.zeros((2, 3, 4), np.bool_),
        "boxes": np.zeros((2, 4), np.float32),
        "scores": np.array([0.9, 0.2], np.float32),
        "class_probabilities": np.array([[0.7, 0.3], [0.5, 0.5]], np.float32),
        "classes": ("chair", "couch"),
    }
    return Detections(**(parts | changes))


def clusters(**changes: Any) -> PointClusters:
    parts = {
        "points_world": np.zeros((3, 3), np.float32),
        "pixels": np.zeros((3, 2), np.int32),
        "cluster": np.array([0, -1, 1], np.int32),
        "class_probabilities": np.array([[0.7, 0.3], [0.5, 0.5]], np.float32),
        "scores": np.array([0.9, 0.2], np.float32),
        "classes": ("chair", "couch"),
    }
    return PointClusters(**(parts | changes))


def mesh(**changes: Any) -> InstanceMesh:
    parts = {
        "vertices": np.zeros((3, 3), np.float32),
        "triangles": np.array([[0, 1, 2]], np.int32),
        "colors": np.zeros((3, 3), np.uint8),
        "instance_ids": np.zeros(3, np.int32),
        "class_ids": np.full(3, -1, np.int32),
        "classes": (),
    }
    return InstanceMesh(**(parts | changes))


def with_nan(shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
    array = np.ones(shape, dtype)
    array.flat[0] = np.nan
    return array


def test_camera_unusual_numbers_are_converted_or_rejected() -> None:
    assert type(Camera(4, 3, Fraction(4), 4, 2, 2).fx) is float
    with pytest.raises(DataError, match="got an integer beyond double precision"):
        Camera(4, 3, 10**400, 4, 2, 2)
    for factor in (0, -1, float("nan"), float("inf"), "2"):
        with pytest.raises(DataError, match=r"Camera\.scaled: factor: expected a positive number"):
            Camera(4, 3, 4, 4, 2, 2).scaled(factor)  # type: ignore[arg-type]


def test_data_objects_accept_valid_values() -> None:
    assert len(detections()) == len(clusters()) == 2
    assert len(Detections.none((3, 4), ("chair",))) == 0
    frame()
    mesh()
    Pose(exp_se3(np.arange(6.0)))
    SceneTruth(np.zeros((2, 3), np.float32), np.zeros(2, np.int32))


@pytest.mark.parametrize(
    ("make", "changes", "message"),
    [
        (frame, {"color": np.zeros((3, 5, 3), np.uint8)}, r"frame 7: color: expected shape \(3, 4, 3\)"),
        (frame, {"color": np.zeros((3, 4, 3), np.float32)}, "color: expected an array of uint8, got float32"),
        (frame, {"depth": np.ones((4, 3), np.float32)}, r"depth: expected shape \(3, 4\), got \(4, 3\)"),
        (frame, {"depth": np.ones((3, 4))}, "depth: expected an array of float32, got float64"),
        (frame, {"depth": with_nan((3, 4))}, "depth: expected finite values, got NaN or infinity"),
        (frame, {"depth": -np.ones((3, 4), np.float32)}, r"depth: expected values of at least 0 m, got -1\.0 m"),
        (
            frame,
            {"depth": np.ma.masked_less(np.ones((3, 4), np.float32), 2)},
            "depth: expected an array without a mask, got a masked array",
        ),
        (frame, {"timestamp": float("nan")}, r"frame 7: timestamp: expected a number of seconds in \[.*, got nan"),
        (frame, {"timestamp": "5"}, r"timestamp: expected a number of seconds in \[-1e\+19, 1e\+19\], got '5'"),
        (detections, {"scores": None}, "Detections.scores: expected an array of float32, got NoneType"),
        (clusters, {"points_world": None}, "points_world: expected an array of float32, got NoneType"),
        (
            frame,
            {"index": 2**53},
            r"Frame\.index: expected an integer of at least 0 and below 2\^53, got 9007199254740992",
        ),
        (frame, {"timestamp": 1e300}, r"timestamp: expected a number of seconds in \[.*, got 1e\+300"),
        (frame, {"timestamp": 10**400}, r"timestamp: expected a number of seconds in \[.*, got 1000"),
        (frame, {"timestamp": True}, r"timestamp: expected a number of seconds in \[.*, got True"),
        (frame, {"timestamp": np.timedelta64(5, "s")}, r"timestamp: expected a number of seconds in \[.*timedelta64"),
        (
            frame,
            {"timestamp": np.datetime64("2020-01-01")},
            r"timestamp: expected a number of seconds in \[.*datetime64",
        ),
        (frame, {"depth_timestamp": 1e200}, r"depth_timestamp: expected a number of seconds in \["),
        (
            frame,
            {"depth": np.matrix(np.ones((3, 4), np.float32))},
            r"depth: expected an array, got a matrix; .*asarray\(depth",
        ),
        (frame, {"T_world_camera": np.matrix(np.eye(4))}, "T_world_camera: expected an array, got a matrix"),
        (frame, {"depth": np.ones((3, 4), ">f4")}, "depth: expected an array of float32, got >f4"),
        (frame, {"depth": np.ones((3, 4), object)}, "depth: expected an array of float32, got object"),
        (frame, {"depth": np.ones((3, 4), np.bool_)}, "depth: expected an array of float32, got bool"),
        (frame, {"sensor": "EXACT"}, "frame 7: sensor: expected a SensorKind, got 'EXACT'"),
        (frame, {"T_world_camera": with_nan((4, 4), np.float64)}, "frame 7: T_world_camera: expected finite values"),
        (frame, {"T_world_camera": 2 * np.eye(4)}, r"expected a rigid transform, got \|R R\^T - I\| = .*, det R ="),
        (
            frame,
            {"T_world_camera": np.diag([1.0, 1.0, -1.0, 1.0])},
            r"expected a rigid transform, got \|R R\^T - I\| = .*, det R =",
        ),
        (frame, {"truth": "none"}, "frame 7: truth: expected a FrameTruth, got str"),
        (frame, {"truth": FrameTruth(np.zeros((2, 2), np.int32), {})}, r"truth\.instance_ids: expected shape"),
        (detections, {"masks": np.zeros((3, 3, 4), np.bool_)}, r"masks: expected shape \(2, any, any\)"),
        (detections, {"scores": np.array([0.9, 1.2], np.float32)}, r"\.scores: expected values in \[0, 1\], got .* to"),
        (
            detections,
            {"class_probabilities": np.full((2, 2), 0.4, np.float32)},
            "expected a probability distribution in each row, got a sum of .* and a minimum of",
        ),
        (
            detections,
            {"class_probabilities": np.array([[1.5, -0.5], [1, 0]], np.float32)},
            "expected a probability distribution in each row, got a sum of .* and a minimum of",
        ),
        (
            clusters,
            {"cluster": np.array([0, 2, 1], np.int32)},
            r"PointClusters\.cluster: expected values in \[-1, 2\), got 0 to 2",
        ),
        (clusters, {"points_world": with_nan((3, 3))}, "points_world: expected finite values, got NaN or infinity"),
        (clusters, {"pixels": np.zeros((2, 2), np.int32)}, "pixels: expected shape"),
        (
            clusters,
            {"class_probabilities": np.zeros((2, 0), np.float32), "classes": ()},
            "expected at least one class for 2 rows, got none",
        ),
        (clusters, {"structure": np.zeros((3, 4), np.uint8)}, "structure: expected an array of bool, got uint8"),
        (clusters, {"structure": np.zeros(12, np.bool_)}, r"structure: expected shape \(any, any\)"),
        (mesh, {"class_ids": np.zeros(2, np.int32)}, "class_ids: expected shape"),
        (mesh, {"triangles": [[0, 1, 2]]}, "triangles: expected an array of int32, got list"),
    ],
)
def test_data_objects_invalid_values_raise_one_line_error(
    make: Callable[..., object], changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(DataError, match=message) as caught:
        make(**changes)
    assert "\n" not in str(caught.value)


def test_instance_mesh_of_instance_has_only_its_vertices() -> None:
    """The mesh is a quad with the vertices 0 to 3. Vertex 1 does not belong to the instance."""
    whole = mesh(
        vertices=np.arange(12, dtype=np.float32).reshape(4, 3),
        triangles=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        colors=np.zeros((4, 3), np.uint8),
        instance_ids=np.array([5, 0, 5, 5], np.int32),
        class_ids=np.array([0, -1, 0, 0], np.int32),
        classes=("chair",),
    )
    box = Box(np.zeros(3), np.ones(3), np.eye(3))
    chair = Instance(5, np.ones(1, np.float32), 0.9, 3, 0, 2, np.array([0, 2, 3], np.int32), box, box)
    own = whole.of(chair)
    assert own.vertices.tolist() == whole.vertices[[0, 2, 3]].tolist()
    assert own.triangles.tolist() == [[0, 1, 2]]
    assert own.instance_ids.tolist() == [5, 5, 5]


def test_frame_converts_image_views_to_contiguous_arrays() -> None:
    """The kernels do not accept views such as bgr[..., ::-1]."""
    bgr = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)
    depth = np.ones((4, 3), np.float32).T
    made = frame(color=bgr[..., ::-1], depth=depth)
    assert made.color.flags.c_contiguous
    assert made.depth.flags.c_contiguous
    assert np.array_equal(made.color, bgr[..., ::-1])


@pytest.mark.parametrize("wrong", [{"width": 0}, {"fx": 0.0}, {"fy": -3.0}, {"cx": np.nan}, {"cy": np.inf}])
def test_camera_out_of_range_value_raises(wrong: dict[str, float]) -> None:
    numbers = {"width": 4, "height": 3, "fx": 5.0, "fy": 5.0, "cx": 1.5, "cy": 1.0}
    with pytest.raises(DataError, match="Camera"):
        Camera(**(numbers | wrong))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            {"fx": 0.82, "fy": 1.09, "cx": 0.5, "cy": 0.5},
            "not as fractions of width and height",
        ),
        (
            {"fx": 1e-300},
            "Camera: expected a field of view of at most 168.6 degrees, got",
        ),
        (
            {"fy": 1e-5},
            "Camera: expected a field of view of at most 168.6 degrees, got",
        ),
        (
            {"cx": 1e9},
            "Camera: expected a field of view of at most 168.6 degrees, got",
        ),
        (
            {"cy": -1e9},
            "Camera: expected a field of view of at most 168.6 degrees, got",
        ),
        ({"fx": 1e300}, "at most 1e\\+06 px"),
        ({"width": 10**9, "height": 10**9}, "at most 33554432 px, got 1000000000x1000000000"),
    ],
)
def test_camera_implausible_intrinsics_raise(wrong: dict[str, float], message: str) -> None:
    numbers = {"width": 640, "height": 480, "fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5}
    with pytest.raises(DataError, match=message):
        Camera(**(numbers | wrong))  # type: ignore[arg-type]


def test_camera_accepts_crops_and_extreme_lenses() -> None:
    Camera(1, 1, 525.0, 525.0, -319.5, 239.5)  # a crop of one pixel
    Camera(640, 480, 60.0, 60.0, 319.5, 239.5)  # field of view of 160 degrees
    Camera(640, 480, 20000.0, 20000.0, 319.5, 239.5)  # field of view of 2 degrees


def test_pose_rigidity_check_tolerates_rounding() -> None:
    rounded = np.round(exp_se3(np.array([1, 2, 3, 0.3, -0.7, 0.2])), 4)
    Pose(rounded)
    with pytest.raises(DataError, match=r"expected a rigid transform, got \|R R\^T - I\| = .*, det R ="):
        Pose(np.round(rounded, 1))
    sheared = rounded.copy()
    sheared[3, 0] = 0.1
    with pytest.raises(DataError, match="expected the last row 0 0 0 1, got"):
        Pose(sheared)


def test_pose_accepts_semidefinite_covariance() -> None:
    for rank in (0, 1, 6):
        J = np.random.default_rng(0).normal(size=(rank, 6)) * np.array([1e-3, 1e-3, 1e-3, 1e-5, 1e-5, 1e-5])
        Pose(np.eye(4), covariance=J.T @ J)
    assert Pose(np.eye(4)).covariance is None


@pytest.mark.parametrize(
    ("entries", "error"),
    [
        ({(0, 1): 0.5}, "symmetric, positive semidefinite"),
        ({(0, 1): 1.5, (1, 0): 1.5}, "symmetric, positive semidefinite"),
        ({(2, 2): -0.1}, "symmetric, positive semidefinite"),
        ({(3, 3): np.nan}, "finite"),
    ],
)
def test_pose_rejects_invalid_covariance(entries: dict[tuple[int, int], float], error: str) -> None:
    C = np.eye(6)
    for index, value in entries.items():
        C[index] = value
    with pytest.raises(DataError, match=rf"Pose\.covariance: expected .*{error}"):
        Pose(np.eye(4), covariance=C)
    with pytest.raises(DataError, match="expected shape"):
        Pose(np.eye(4), covariance=np.eye(3))


# Ground truth that is rendered on access


def deferred(render: Callable[[], np.ndarray], shape: tuple[int, int] = (3, 4)) -> DeferredTruth:
    return DeferredTruth(render, shape, {1: "chair"}, origin="somewhere")


def test_deferred_truth_is_rendered_on_first_access() -> None:
    calls: list[int] = []

    def render() -> np.ndarray:
        calls.append(1)
        return np.ones((3, 4), np.int32)

    seen = frame(truth=deferred(render))
    again = replace(seen, index=8)
    assert seen.truth is not None
    assert (seen.truth.shape, seen.truth.class_names) == ((3, 4), {1: "chair"})
    assert "chair" in repr(seen)
    assert calls == []
    assert again.truth is not None
    for truth in (seen.truth, again.truth, seen.truth):
        np.testing.assert_array_equal(truth.instance_ids, np.ones((3, 4), np.int32))
    assert calls == [1]


def test_deferred_truth_is_rendered_once_for_all_threads() -> None:
    calls: list[int] = []
    entered, gate = threading.Event(), threading.Event()

    def render() -> np.ndarray:
        calls.append(1)
        entered.set()
        assert gate.wait(10)
        return np.full((3, 4), len(calls), np.int32)

    truth = deferred(render)
    with ThreadPoolExecutor(4) as threads:
        asked = [threads.submit(lambda: truth.instance_ids) for _ in range(4)]
        assert entered.wait(10)
        gate.set()
        found = [one.result(10) for one in asked]
    assert calls == [1]
    assert all(ids is found[0] for ids in found)


def test_deferred_truth_render_error_is_raised_on_access() -> None:
    outcomes: list[DataError | np.ndarray] = [DataError("the mesh is gone"), np.ones((3, 4), np.int32)]

    def render() -> np.ndarray:
        outcome = outcomes.pop(0)
        if isinstance(outcome, DataError):
            raise outcome
        return outcome

    seen = frame(truth=deferred(render))
    assert seen.truth is not None
    with pytest.raises(DataError, match="the mesh is gone"):
        _ = seen.truth.instance_ids
    assert seen.truth.instance_ids.all()


@pytest.mark.parametrize("wrong", [np.ones((4, 3), np.int32), np.ones((3, 4), np.int64)], ids=["shape", "dtype"])
def test_deferred_truth_invalid_image_raises(wrong: np.ndarray) -> None:
    with pytest.raises(DataError, match=r"DeferredTruth\.instance_ids: expected"):
        _ = deferred(lambda: wrong).instance_ids


def test_deferred_truth_shape_mismatch_raises_before_rendering() -> None:
    with pytest.raises(DataError, match=r"frame 7: truth\.instance_ids: expected shape \(3, 4\), got \(2, 2\)"):
        frame(truth=deferred(lambda: pytest.fail("rendered"), (2, 2)))

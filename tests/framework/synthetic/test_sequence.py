"""Tests for rendered rooms as sequences."""

import hashlib
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from framework.data import FrameTruth
from framework.errors import ConfigError
from framework.geometry import back_project, inverse, project, rotation_angle, transform
from framework.sensors.noise_models import SensorChoice, SensorKind
from framework.synthetic.room import RoomKind
from framework.synthetic.sequence import Synthetic

pytestmark = pytest.mark.integration

SMALL = {"kind": RoomKind.BEDROOM, "width": 160, "height": 120}


@pytest.fixture(scope="module")
def bedroom():
    return Synthetic(seed=1, **SMALL)


@pytest.fixture(scope="module")
def exact():
    return Synthetic(seed=1, noise=0.0, kind=RoomKind.KITCHEN, width=320, height=240)


def digest(frame):
    parts = (frame.color, frame.depth, frame.truth.instance_ids, frame.T_world_camera)
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def test_synthetic_frames_are_complete(bedroom):
    frame = bedroom[5]
    assert len(bedroom) == 240
    assert (frame.index, frame.timestamp) == (5, pytest.approx(5 / 30))
    assert isinstance(frame.truth, FrameTruth)
    assert frame.color.std() > 10
    assert 0.6 < (frame.depth > 0).mean() <= 1
    assert set(np.unique(frame.truth.instance_ids)) <= {0, *frame.truth.class_names}


def test_synthetic_images_have_gradient_on_all_surfaces(bedroom):
    """Photometric alignment requires texture in all parts of the image."""
    for k in (0, 80, 160):
        gray = bedroom[k].color.astype(float).mean(axis=2)
        tiles = gray.reshape(6, 20, 8, 20).transpose(0, 2, 1, 3).reshape(48, -1)
        assert np.median(tiles.std(axis=1)) > 3


def test_synthetic_frames_are_independent_of_order_and_threads(bedroom):
    picked = [3, 40, 77, 110]
    one_by_one = [digest(bedroom[k]) for k in picked]
    with ThreadPoolExecutor(4) as pool:
        at_once = list(pool.map(lambda k: digest(bedroom[k]), picked[::-1]))[::-1]
    assert one_by_one == at_once


def test_synthetic_frame_fraction_does_not_change_frames(bedroom):
    share = Synthetic(seed=1, frame_fraction=0.1, **SMALL)
    assert len(share) == 24
    indices = [share[k].index for k in (0, 9, 23)]
    assert indices == sorted(indices)
    assert digest(share[9]) == digest(bedroom[indices[1]])
    assert len(share.scene_truth().points_world) > 0


def test_synthetic_frames_are_identical_in_other_process(bedroom):
    program = (
        "from tests_digest import digest, Synthetic, SMALL\nprint(digest(Synthetic(seed=1, start=70, **SMALL)[7]))"
    )
    here = Path(__file__)
    code = program.replace("tests_digest", here.stem)
    environment = os.environ | {"PYTHONPATH": f"{here.parent}:{here.parents[3]}"}
    environment |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    answer = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=here.parents[3], capture_output=True, text=True, timeout=120
    )
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout.split()[-1] == digest(bedroom[77])


def test_synthetic_room_depends_on_seed_and_scene(bedroom):
    from framework.synthetic.room import furnish

    stream = bedroom._stream
    same, other_seed, other_scene = (
        furnish(RoomKind.BEDROOM, np.random.default_rng(key)).surfaces.vertices
        for key in ([1, stream], [2, stream], [1, stream + 1])
    )
    np.testing.assert_array_equal(same, bedroom.room.surfaces.vertices)
    assert same.shape != other_seed.shape or not np.array_equal(same, other_seed)
    assert same.shape != other_scene.shape or not np.array_equal(same, other_scene)


def test_synthetic_frames_agree_after_reprojection(exact):
    """Each point must have the same depth and color in both images."""
    a, b = exact[60], exact[72]
    v, u = np.nonzero(a.depth > 0)
    pixels = np.stack([u, v], axis=1).astype(np.int32)
    world = transform(a.T_world_camera, back_project(a.camera, pixels, a.depth[v, u]).astype(np.float64))
    in_b = transform(inverse(b.T_world_camera), world)
    seen = project(b.camera, in_b)
    x, y = np.floor(seen[:, 0]).astype(int), np.floor(seen[:, 1]).astype(int)
    inside = (in_b[:, 2] > 0) & (x >= 0) & (x < b.camera.width - 1) & (y >= 0) & (y < b.camera.height - 1)
    x, y, seen, z = x[inside], y[inside], seen[inside], in_b[inside, 2]
    own = a.truth.instance_ids[v, u][inside]
    same = np.all([b.truth.instance_ids[y + j, x + i] == own for i in (0, 1) for j in (0, 1)], axis=0)
    f, g = seen[:, 0] - x, seen[:, 1] - y
    weights = [((1 - f) * (1 - g), 0, 0), (f * (1 - g), 1, 0), ((1 - f) * g, 0, 1), (f * g, 1, 1)]
    # on planes, interpolated inverse depth is exact
    inverse_depth = sum(w / np.maximum(b.depth[y + j, x + i], 1e-6) for w, i, j in weights)
    error = np.abs(1 / inverse_depth - z)[same]
    visible = error < 0.05  # other points are occluded in b
    assert visible.mean() > 0.9
    assert np.median(error) < 1e-5
    assert np.quantile(error[visible], 0.9) < 1e-3
    color = sum(w[:, None] * b.color[y + j, x + i] for w, i, j in weights)
    difference = np.abs(color - a.color[v, u][inside])[same][visible].mean(axis=1)
    assert np.median(difference) < 4


def test_camera_path_has_hand_held_motion(bedroom, exact):
    for sequence in (bedroom, exact):
        poses = [sequence.path.pose(k) for k in range(len(sequence))]
        position = np.array([T[:3, 3] for T in poses])
        speed = np.linalg.norm(np.diff(position, axis=0), axis=1) * 30
        turns = [rotation_angle(a[:3, :3].T @ b[:3, :3]) for a, b in pairwise(poses)]
        assert speed.max() <= 0.5
        assert np.rad2deg(max(turns)) * 30 <= 30
        assert np.rad2deg(sum(turns)) > 90
        assert position[:, 2].min() > 1.2
        assert position[:, 2].max() < 1.7
        assert np.abs(np.diff(position, n=3, axis=0)).max() < 1e-4  # m; the motion has no jerk


def test_camera_path_keeps_distance_from_walls_and_furniture(bedroom, exact):
    for sequence in (bedroom, exact):
        layout = sequence.room.layout
        position = np.array([sequence.path.pose(k)[:2, 3] for k in range(len(sequence))])
        walls = np.array([layout.width, layout.depth]) / 2 - np.abs(position)
        assert walls.min() >= 0.5
        for instance, piece in sequence.room.objects:
            low, high = piece.bounds()
            if instance and piece.kind != "rug" and low[2] < 1.9:
                outside = np.maximum(np.maximum(low[:2] - position, position - high[:2]), 0)
                assert np.linalg.norm(outside, axis=1).min() >= 0.5, piece.kind


def test_synthetic_scene_truth_lies_on_exact_surface(exact):
    truth = Synthetic(seed=1, noise=0.0, kind=RoomKind.KITCHEN, width=160, height=120, stride=60).scene_truth()
    assert truth.class_names == exact.class_names
    import open3d as o3d

    surfaces = exact.room.surfaces
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(surfaces.vertices), o3d.core.Tensor(np.ascontiguousarray(surfaces.triangles.astype(np.uint32)))
    )
    nearest = scene.compute_closest_points(o3d.core.Tensor(truth.points_world))
    distance = np.linalg.norm(nearest["points"].numpy() - truth.points_world, axis=1)
    assert np.quantile(distance, 0.9) < 1e-3
    owner = surfaces.instance_ids[nearest["primitive_ids"].numpy().astype(np.int64)]
    assert (owner == truth.instance_ids).mean() > 0.98


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"frames": 0}, "dataset.frames"),
        ({"width": 1}, "dataset.width"),
        ({"noise": -0.5}, "dataset.noise"),
        ({"noise": float("nan")}, "dataset.noise"),
        ({"max_depth": 0.0}, "dataset.max_depth"),
        ({"ground_truth_spacing": -1.0}, "dataset.ground_truth_spacing"),
        ({"seed": -1}, "seed"),
        ({"start": 240}, "dataset.start"),
        ({"stride": 0}, "dataset.stride"),
        ({"frame_fraction": 0.0}, "dataset.frame_fraction"),
    ],
)
def test_synthetic_parameter_out_of_range_raises(values, name):
    with pytest.raises(ConfigError, match=name):
        Synthetic(**values)


def test_synthetic_simulated_color_delay_moves_color_and_truth():
    """The delay is the time between two frames, so each frame has the color of the next frame."""
    plain = Synthetic(seed=1, noise=0.0, **SMALL)
    late = Synthetic(seed=1, noise=0.0, simulated_color_delay=1 / 30, **SMALL)
    np.testing.assert_array_equal(late[3].depth, plain[3].depth)
    np.testing.assert_array_equal(late[3].color, plain[4].color)
    np.testing.assert_array_equal(late[3].truth.instance_ids, plain[4].truth.instance_ids)
    assert late.constant_color_delay() is None
    assert Synthetic(seed=1, color_delay="0.01", **SMALL).constant_color_delay() == 0.01


@pytest.mark.parametrize(
    ("noise", "choice", "kind"),
    [
        (1.0, SensorChoice.AUTO, SensorKind.KINECT_V1),
        (0.0, SensorChoice.AUTO, SensorKind.EXACT),
        (1.0, SensorChoice.TIME_OF_FLIGHT, SensorKind.TIME_OF_FLIGHT),
    ],
)
def test_synthetic_frames_have_noise_of_their_sensor(noise, choice, kind):
    video = Synthetic(seed=1, noise=noise, sensor=choice, **SMALL)
    frame = video[0]
    exact, _ = video.exact_view(frame.T_world_camera)
    error = np.median(np.abs(frame.depth - exact)[frame.depth > 0])
    assert frame.sensor is kind
    typical = np.median(kind.sigma(frame.depth[frame.depth > 0]))
    assert error == 0 if kind is SensorKind.EXACT else 0.4 * typical < error < 1.2 * typical

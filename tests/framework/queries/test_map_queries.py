"""Tests for queries of growing and of stored maps."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from framework.api import Map, Mapper, load_map
from framework.data import Camera
from framework.datasets.tum_rgbd import TumRgbd
from framework.errors import ConfigError, DataError
from framework.mapping.instances.instance_list import InstanceList
from framework.queries import map_queries
from tests.support.scenes.corner_room import CornerRoom

pytestmark = pytest.mark.integration
REPEATED = pytest.mark.acceptance  # the same rule with other values

CHECKOUT = Path(__file__).resolve().parents[3]
STAGES = ("detector=ground_truth", "tracker=ground_truth", "refiner=identity", "fuser.voxel_size=0.04")


@pytest.fixture(scope="module")
def mapper() -> Mapper:
    mapper = Mapper(*STAGES)
    for frame in CornerRoom():
        mapper.add(frame)
    return mapper


@pytest.fixture(scope="module")
def stored(mapper: Mapper, tmp_path_factory: pytest.TempPathFactory) -> Map:
    path = tmp_path_factory.mktemp("stored") / "map.npz"
    mapper.save(path)
    return load_map(path)


@pytest.fixture(params=["growing", "stored"])
def asked(request: pytest.FixtureRequest, mapper: Mapper, stored: Map) -> Map:
    return mapper if request.param == "growing" else stored


def test_map_instances_are_filtered_by_class(asked: Map) -> None:
    names = {asked.name(instance) for instance in asked.instances().values()}
    assert len(names) >= 1
    for name in names:
        of_class = asked.instances(name)
        assert of_class
        assert all(asked.name(instance) == name for instance in of_class.values())
    absent = next(name for name in asked.classes if name not in names)
    assert asked.instances(absent) == {}
    with pytest.raises(
        DataError, match=f"class: expected a class of this map, got '{absent}x'; did you mean '{absent}'"
    ):
        asked.instances(f"{absent}x")


def test_map_nearest_returns_object_with_nearest_surface(asked: Map) -> None:
    vertices = asked.mesh().vertices
    for instance in asked.instances().values():
        on_it = vertices[instance.vertices[0]]
        found = asked.nearest(on_it)
        assert found is not None
        assert found.id == instance.id
        of_class = asked.nearest((50.0, 50.0, 50.0), asked.name(instance))
        assert of_class is not None
        assert asked.name(of_class) == asked.name(instance)
    for wrong in ((1.0, 2.0), (np.nan, 0.0, 0.0)):
        with pytest.raises(DataError, match="point: expected 3 finite coordinates"):
            asked.nearest(wrong)


def test_map_at_pixel_matches_view(asked: Map) -> None:
    frame = CornerRoom()[3]
    assert frame.T_world_camera is not None
    view = asked.view(frame.camera, frame.T_world_camera)
    shown = set(np.unique(view.instance_ids).tolist()) - {0}
    assert shown
    assert shown <= set(asked.instances())
    assert (view.class_ids[view.instance_ids == 0] == -1).all()
    for key in shown:
        v, u = np.argwhere(view.instance_ids == key)[0]
        found = asked.at_pixel(int(u), int(v), frame.camera, frame.T_world_camera)
        assert found is not None
        assert found.id == key
    v, u = np.argwhere(view.instance_ids == 0)[0]
    assert asked.at_pixel(int(u), int(v), frame.camera, frame.T_world_camera) is None
    with pytest.raises(DataError, match=r"pixel: expected u, v in an image of .*, got \(-1, 0\)"):
        asked.at_pixel(-1, 0, frame.camera, frame.T_world_camera)


@pytest.mark.parametrize("fuser", ["bayesian_tsdf", "object_volumes", "open3d_vbg", "class_only_fusion"])
def test_map_queries_equal_slow_reference(fuser: str) -> None:
    """Compare `at_pixel` with the whole view, and `nearest` with a search of all vertices."""
    mapper = Mapper(*STAGES[:-1], f"fuser={fuser}", "fuser.voxel_size=0.04")
    rng = np.random.default_rng(0)
    for frame in CornerRoom(frames=3):
        mapper.add(frame)
        assert frame.T_world_camera is not None
        camera = replace(frame.camera, width=frame.camera.width - 3, cx=frame.camera.cx - 0.3)  # no whole tiles
        view = mapper.view(camera, frame.T_world_camera)
        for v in (*range(0, camera.height, 7), camera.height - 1):
            for u in (*range(0, camera.width, 9), camera.width - 1):
                found = mapper.at_pixel(u, v, camera, frame.T_world_camera)
                assert (found.id if found else 0) == view.instance_ids[v, u]
        instances, vertices = mapper.instances(), mapper.mesh().vertices
        for class_ in (None, *{mapper.name(instance) for instance in instances.values()}):
            for point in rng.uniform(-3, 3, (10, 3)):
                nearest = mapper.nearest(point, class_)
                distances = {
                    key: np.linalg.norm(vertices[instance.vertices] - point, axis=1).min()
                    for key, instance in instances.items()
                    if class_ is None or mapper.name(instance) == class_
                }
                assert (nearest.id if nearest else 0) == min(distances, key=distances.__getitem__, default=0)
    assert len(mapper.instances()) >= 2


def test_map_queries_repeated_do_not_list_instances_again(mapper: Mapper) -> None:
    instances, floor = mapper.instances(), mapper.floor()
    with mock.patch.object(map_queries, "floor_height", side_effect=AssertionError):
        assert mapper.floor() == floor
    assert mapper.instances() is instances
    key = next(iter(instances))
    assert mapper.instances()[key] is instances[key]
    assert pickle.loads(pickle.dumps(instances)).keys() == instances.keys()


def test_map_nearest_leaves_far_instances_out(mapper: Mapper) -> None:
    """The vertices of an object are read only if its box is nearer than the nearest vertex."""
    copy: Map = pickle.loads(pickle.dumps(Map(mapper.scene)))
    instances = copy.instances()
    assert isinstance(instances, InstanceList)
    key = next(iter(instances))
    found = copy.nearest(mapper.mesh().vertices[mapper.instances()[key].vertices[0]])
    assert found is not None
    assert found.id == key
    assert [*instances._created] == [key]


@pytest.mark.parametrize(
    "fuser",
    [
        "bayesian_tsdf",
        "object_volumes",
        *(pytest.param(name, marks=REPEATED) for name in ("open3d_vbg", "class_only_fusion")),
    ],
)
def test_map_objects_of_class_are_not_created(fuser: str) -> None:
    mapper = Mapper(*STAGES[:-1], f"fuser={fuser}", "fuser.voxel_size=0.04")
    for frame in CornerRoom():
        mapper.add(frame)
    everything = mapper.instances()
    assert isinstance(everything, InstanceList)
    for class_ in mapper.classes:
        found = mapper.instances(class_)
        assert isinstance(found, InstanceList)
        assert found is mapper.instances(class_)
        assert not found._created
        assert [*found] == [key for key, instance in everything.items() if mapper.name(instance) == class_]
        assert all(found[key] is everything[key] for key in found)


def test_map_mesh_of_object_contains_its_triangles(mapper: Mapper) -> None:
    whole = mapper.mesh()
    for key, instance in mapper.instances().items():
        part = mapper.mesh(key)
        inside = np.isin(whole.triangles, instance.vertices).all(axis=1)
        np.testing.assert_array_equal(instance.vertices[part.triangles], whole.triangles[inside])
        np.testing.assert_array_equal(part.vertices, whole.vertices[instance.vertices])
        assert (part.instance_ids == key).all()


def test_map_view_hides_unconfirmed_instances() -> None:
    """After one frame, each object has a single detection."""
    mapper = Mapper(*STAGES, "fuser.min_observations=3")
    frame = CornerRoom()[0]
    mapper.add(frame)
    assert frame.T_world_camera is not None
    assert mapper.scene.render(frame.camera, frame.T_world_camera).instance_ids.any()
    assert mapper.instances() == {}
    assert not mapper.view(frame.camera, frame.T_world_camera).instance_ids.any()


def test_mapper_at_pixel_uses_last_frame_by_default(mapper: Mapper) -> None:
    last = CornerRoom()[len(CornerRoom()) - 1]
    assert last.T_world_camera is not None
    for u, v in ((10, 10), (last.camera.width // 2, last.camera.height // 2)):
        by_default = mapper.at_pixel(u, v)
        by_hand = mapper.at_pixel(u, v, last.camera, last.T_world_camera)
        assert (by_default and by_default.id) == (by_hand and by_hand.id)
    with pytest.raises(DataError, match=r"Mapper\.at_pixel: expected a mapped frame, got none"):
        Mapper(*STAGES).at_pixel(0, 0)


def test_map_mesh_of_instance_contains_only_its_vertices(asked: Map) -> None:
    for instance in asked.instances().values():
        own = asked.mesh(instance)
        assert len(own.vertices) == len(instance.vertices)
        assert (own.instance_ids == instance.id).all()
        np.testing.assert_array_equal(own.vertices, asked.mesh(instance.id).vertices)
    with pytest.raises(DataError, match="instance: expected an id of this map, got 999"):
        asked.mesh(999)


def test_mapper_add_reports_new_and_removed_instances() -> None:
    mapper = Mapper(*STAGES)
    known: set[int] = set()
    for frame in CornerRoom():
        added = mapper.add(frame)
        assert not added.lost
        assert known.isdisjoint(added.new)
        assert known.issuperset(added.removed)
        known = (known | set(added.new)) - set(added.removed)
        assert known == mapper.scene.instance_ids()
    assert known


def test_mapper_add_arrays_equals_add_frame() -> None:
    by_hand, by_frame = Mapper(*STAGES, "detector=none"), Mapper(*STAGES, "detector=none")
    for k, frame in enumerate(CornerRoom()):
        by_frame.add(frame)
        camera = frame.camera if k == 0 else None
        added = by_hand.add(frame.color, frame.depth, pose=frame.T_world_camera, camera=camera)
        np.testing.assert_array_equal(added.T_world_camera, frame.T_world_camera)
    np.testing.assert_array_equal(by_hand.mesh().vertices, by_frame.mesh().vertices)


def test_mapper_add_incomplete_frame_raises() -> None:
    frame = CornerRoom()[0]
    mapper = Mapper(*STAGES)
    with pytest.raises(DataError, match=r"Mapper\.add: expected a Frame, or color and depth, got only ndarray"):
        mapper.add(frame.color)
    with pytest.raises(DataError, match=r"Mapper\.add: expected a camera in the first call, got none"):
        mapper.add(frame.color, frame.depth, pose=frame.T_world_camera)
    small = Camera(10, 10, 5.0, 5.0, 4.5, 4.5)
    with pytest.raises(DataError, match="color"):
        mapper.add(frame.color, frame.depth, pose=frame.T_world_camera, camera=small)


@pytest.mark.parametrize("value", ["a b", "it's", r"C:\x\new", "x=1,2", "[1]", "{a: b}", "null", "é", "a\\"])
def test_mapper_accepts_keyword_parameters(value: str) -> None:
    named = Mapper(
        detector="none", tracker="ground_truth", threads=1, detection_cache_dir=value, debug=False, resume_from=None
    )
    assert type(named.pipeline.detector).__name__ == "NoDetections"
    assert Mapper("detector=none", **{"fuser.voxel_size": 0.05}).scene.statistics.voxels == 0  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="detector: expected a string, path, number, bool or None"):
        Mapper(detector=["none"])


def test_mapper_and_command_line_maps_are_identical(tmp_path: Path) -> None:
    """Six frames of the demo are tracked, with the default detector."""
    asked = ("fuser.voxel_size=0.02", "seed=3")
    line = [sys.executable, "-m", "framework", "dataset=desk", "dataset.stop=6", *asked, "hydra.run.dir=run"]
    done = subprocess.run(
        line, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(CHECKOUT)}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    mapper = Mapper(*asked)
    for frame in TumRgbd(CHECKOUT / "data" / "desk", scene="rgbd_dataset_freiburg1_rpy", stop=6):
        times = {"timestamp": frame.timestamp, "depth_timestamp": frame.depth_time}
        mapper.add(frame.color, frame.depth, pose=frame.T_world_camera, camera=frame.camera, **times)
    mapper.save(tmp_path / "map.npz")
    assert (tmp_path / "map.npz").read_bytes() == (tmp_path / "run" / "map.npz").read_bytes()
    assert mapper.instances()

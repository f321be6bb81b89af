"""Tests for sequences of buildings and the cache of their images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from framework.errors import ConfigError
from framework.geometry import transform
from framework.sensors.noise_models import SensorChoice
from framework.synthetic.buildings import rendering_cache
from framework.synthetic.buildings.building import Building
from framework.synthetic.buildings.building_sequence import SyntheticBuilding

pytestmark = pytest.mark.integration

FRAME = 90


@pytest.fixture(scope="module", autouse=True)
def constant_light() -> Any:
    """Buildings without computed light, which takes half a minute."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Building, "irradiance", lambda building: np.full_like(building.surfaces.vertices, 0.6))
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("buildings")


def building(folder: Path, **parameters: Any) -> SyntheticBuilding:
    return SyntheticBuilding(rooms=4, designs=1, width=160, height=120, cache_dir=str(folder), **parameters)


def test_building_frames_do_not_depend_on_cache(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rendered = building(folder)[FRAME]
    monkeypatch.setattr(SyntheticBuilding, "_renderer", None)
    cached = building(folder)[FRAME]
    for name in ("color", "depth", "T_world_camera"):
        np.testing.assert_array_equal(getattr(rendered, name), getattr(cached, name))
    assert rendered.truth is not None
    assert cached.truth is not None
    np.testing.assert_array_equal(rendered.truth.instance_ids, cached.truth.instance_ids)


def test_building_sensors_share_rendered_images(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kinect = building(folder)[FRAME]
    monkeypatch.setattr(SyntheticBuilding, "_renderer", None)
    stereo = building(folder, sensor=SensorChoice.REALSENSE_D435)[FRAME]
    assert not np.array_equal(kinect.depth, stereo.depth)
    np.testing.assert_array_equal(kinect.color, stereo.color)


def test_building_damaged_cache_is_replaced(folder: Path) -> None:
    sequence = building(folder)
    expected = sequence[FRAME]
    [path] = folder.glob(f"*/{FRAME:06d}_depth.png")
    path.write_bytes(path.read_bytes()[:100])
    np.testing.assert_array_equal(sequence[FRAME].depth, expected.depth)
    assert path.stat().st_size > 100


def test_building_cache_key_contains_code(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = rendering_cache.RenderingCache(folder, 1).folder
    monkeypatch.setattr(rendering_cache, "_code_hash", lambda: "changed")
    assert rendering_cache.RenderingCache(folder, 1).folder != before


def test_building_depth_without_errors_is_exact(folder: Path) -> None:
    sequence = building(folder, noise=0.0, distortion=0.0, sensor=SensorChoice.EXACT)
    frame = sequence[FRAME]
    assert frame.T_world_camera is not None
    depth, ids = sequence.exact_view(frame.T_world_camera)
    read = frame.depth > 0
    np.testing.assert_allclose(frame.depth[read], depth[read], atol=6e-5)
    assert read[(depth > 0) & (depth < sequence.max_depth - 0.001)].all()
    assert not read[depth > sequence.max_depth + 0.001].any()
    assert frame.truth is not None
    np.testing.assert_array_equal(frame.truth.instance_ids, ids)


def test_building_distortion_grows_with_square_of_depth(folder: Path) -> None:
    exact = building(folder, noise=0.0, distortion=0.0)[FRAME].depth
    errors = building(folder, noise=0.0, distortion=1.0)[FRAME].depth - exact
    read = (exact > 0) & (exact < 4)
    relative = errors[read] / exact[read] ** 2  # 1/m
    assert 1e-4 < np.abs(relative).max() < 6e-3
    pattern = np.zeros(exact.shape)
    pattern[read] = relative
    across = read[:, :-1] & read[:, 1:]
    assert np.abs(np.diff(pattern, axis=1))[across].max() < 2e-4, "expected a low-frequency pattern"
    again = building(folder, noise=0.0, distortion=1.0)[FRAME + 1]
    before = building(folder, noise=0.0, distortion=0.0)[FRAME + 1].depth
    both = read & (before > 0)
    np.testing.assert_allclose(
        (again.depth - before)[both] / before[both] ** 2, pattern[both], atol=2e-5, err_msg="expected a fixed pattern"
    )


def test_building_truth_lies_on_surfaces_of_instances(folder: Path) -> None:
    sequence = building(folder, stop=200)
    truth = sequence.scene_truth()
    assert set(np.unique(truth.instance_ids)) <= {0, *sequence.class_names}
    assert "chair" in {truth.class_names[k] for k in np.unique(truth.instance_ids) if k}
    T_camera_world = np.linalg.inv(sequence.tour.pose(0))
    assert np.isfinite(transform(T_camera_world, truth.points_world)).all()


def test_building_with_too_few_rooms_raises(folder: Path) -> None:
    with pytest.raises(ConfigError, match="rooms: expected a value in"):
        SyntheticBuilding(rooms=3, cache_dir=str(folder))

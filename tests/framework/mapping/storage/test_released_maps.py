"""Tests that this version reads the maps of its own and of the previous minor version.

If a change of a file format breaks these tests, do not replace the stored files. Add a reader for the old format, and
the files of the new version, as described in released_maps/README.md.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from framework.mapping.instance_map import FORMAT
from framework.mapping.storage.map_file import read_format
from framework.tracking.keyframes import FILE_FORMAT
from instancemap import Mapper, load_map, open_dataset

RELEASED = sorted(path.parent for path in Path(__file__).parent.glob("released_maps/*/map.npz"))
EXPECTED = {2: "tv", 3: "dining table"}  # ids and classes of the instances that probably exist


def test_released_maps_include_current_formats() -> None:
    assert str(FORMAT) in {read_format(run / "map.npz") for run in RELEASED}
    assert FILE_FORMAT in {read_format(run / "keyframes.npz") for run in RELEASED}


@pytest.mark.parametrize("run", RELEASED, ids=lambda run: run.name)
def test_released_map_query_finds_instances(run: Path) -> None:
    scene = load_map(run / "map.npz")
    instances = scene.instances()
    assert len(instances) == 3
    assert {key: scene.name(found) for key, found in instances.items() if found.exists > 0.5} == EXPECTED
    assert list(scene.instances("tv")) == [2]
    assert set(scene.mesh().instance_ids.tolist()) >= EXPECTED.keys()


@pytest.mark.parametrize("run", RELEASED, ids=lambda run: run.name)
def test_released_map_resumes_with_next_frames(run: Path) -> None:
    mapper = Mapper(resume_from=run, backend="none", detector="none", **{"fuser.voxel_size": 0.05})
    voxels = mapper.scene.statistics.voxels
    results = [mapper.add(frame) for frame in open_dataset("desk", start=5, stop=8)]
    assert not results[-1].lost
    assert mapper.scene.statistics.voxels > voxels
    assert mapper.instances().keys() >= EXPECTED.keys()

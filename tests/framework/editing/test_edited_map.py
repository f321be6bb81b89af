"""Tests for the edits of a voxel map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf
from scipy.spatial import KDTree

from framework.commands.running.run import run
from framework.config import composition
from framework.data import Int32
from framework.editing.edited_map import EditedMap
from framework.editing.edits import Delete, Merge, Rename, Split
from framework.errors import DataError
from framework.mapping.instance_map import InstanceMap
from framework.mapping.instances.instance_list import Confirmation, InstanceClass
from tests.support import reported_run

pytestmark = pytest.mark.integration

CHAIR, COUCH = 1, 2  # ids of the spheres
STORAGES = {
    "compact": {},
    "exact": {"storage": "EXACT", "instance_class": "VOXELS"},
    "votes": {"_target_": "plugins.fusers.label_vote.LabelVote", "instance_class": "VOXELS"},
}


@pytest.fixture(scope="module", params=STORAGES)
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the map file of the corner room, made by different fusers."""
    directory = tmp_path_factory.mktemp("run")
    config = reported_run.CONFIG | {"fuser": reported_run.CONFIG["fuser"] | STORAGES[request.param]}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(composition, "_added", [reported_run.FAKES])
        run(OmegaConf.create(config), directory, {})
    return directory / "map.npz"


@pytest.fixture
def scene(made: Path) -> InstanceMap:
    return InstanceMap.load(made)


def ids_of(scene: InstanceMap) -> Int32:
    return scene.mesh().instance_ids.copy()


def add_runner_up(scene: InstanceMap) -> None:
    """Add evidence of the other sphere to each voxel with an instance."""
    evidence = scene.labels.in_use()
    known = evidence.instance_ids[:, 0] > 0
    evidence.instance_ids[known, 1] = CHAIR + COUCH - evidence.instance_ids[known, 0]
    evidence.instance_value[known, 1] = evidence.instance_value[known, 0] / 2


def test_edited_map_without_edits_has_same_mesh(scene: InstanceMap) -> None:
    add_runner_up(scene)
    before, classes, found = ids_of(scene), scene.mesh().class_ids.copy(), scene.instances()
    EditedMap(scene)
    assert {CHAIR, COUCH} <= set(np.unique(before).tolist())
    np.testing.assert_array_equal(ids_of(scene), before)
    np.testing.assert_array_equal(scene.mesh().class_ids, classes)
    assert [one.confidence for one in scene.instances().values()] == [one.confidence for one in found.values()]
    assert not scene.labels.in_use().instance_ids[:, 1:].any()


def test_edited_map_removes_tentative_instances(scene: InstanceMap) -> None:
    """The chair is too small to be confirmed, so its vertices are background before and after."""
    add_runner_up(scene)
    sizes = np.bincount(ids_of(scene))
    assert sizes[CHAIR] < sizes[COUCH]
    area = float(sizes[[CHAIR, COUCH]].mean()) * scene.volume.voxel_size**2
    scene.confirmation = Confirmation(min_observations=2, min_area=area)
    scene.volume.changed()
    before = ids_of(scene)
    EditedMap(scene)
    np.testing.assert_array_equal(ids_of(scene), before)
    assert [*scene.instances()] == [*scene.table.records] == [COUCH]
    assert set(np.unique(scene.labels.in_use().instance_ids).tolist()) == {0, COUCH}


def test_delete_changes_instance_to_background(scene: InstanceMap) -> None:
    """Voxels of the deleted instance do not become part of their second most likely instance."""
    add_runner_up(scene)
    before = ids_of(scene)
    assert EditedMap(scene).apply(Delete((CHAIR,))) == "delete 1"
    np.testing.assert_array_equal(ids_of(scene), np.where(before == CHAIR, 0, before))
    assert [*scene.instances()] == [COUCH]


def test_merge_unites_vertices_and_observations(scene: InstanceMap) -> None:
    before, old = ids_of(scene), scene.instances()
    EditedMap(scene).apply(Merge((COUCH, CHAIR)))
    np.testing.assert_array_equal(ids_of(scene) == COUCH, before > 0)
    [merged] = scene.instances().values()
    assert merged.observations == max(one.observations for one in old.values())  # both are seen in every frame


def test_split_by_parts_reverts_merge(scene: InstanceMap) -> None:
    """The couch is larger and keeps the id."""
    before = ids_of(scene)
    edited = EditedMap(scene)
    edited.apply(Merge((CHAIR, COUCH)))
    message = edited.apply(Split(CHAIR))
    assert message.endswith("; new: 3")
    np.testing.assert_array_equal(ids_of(scene), np.array([0, 3, 1])[before])
    assert scene.table.records[3].observed_in == scene.table.records[1].observed_in
    assert scene.table.records[3].observed_in is not scene.table.records[1].observed_in


def test_split_id_is_smallest_unused_id(scene: InstanceMap) -> None:
    """The id of a merged instance is not reused. Ids of tentative instances may be reused."""
    scene.table.last_id = 9
    edited = EditedMap(scene)
    edited.apply(Merge((COUCH, CHAIR)))
    edited.apply(Split(COUCH))
    assert [*scene.instances()] == [2, 3]
    edited.apply(Merge((COUCH, 3)))
    edited.apply(Split(COUCH))
    assert [*scene.instances()] == [2, 4]
    assert scene.table.last_id == 9


def test_voxel_positions_are_near_surface(scene: InstanceMap) -> None:
    """Fusers label voxels up to 2 voxels from the measured surface."""
    edited = EditedMap(scene)
    distances, _ = KDTree(scene.mesh().vertices).query(edited._positions())
    assert distances.max() < 4 * scene.volume.voxel_size


@pytest.mark.parametrize(("key", "name"), [(CHAIR, "couch"), (COUCH, "chair")])
def test_rename_sets_class_of_instance_and_vertices(scene: InstanceMap, key: int, name: str) -> None:
    others = scene.mesh().class_ids[ids_of(scene) != key].copy()
    EditedMap(scene).apply(Rename(key, name))
    class_id = scene.classes.index(name)
    assert scene.instances()[key].class_probabilities.tolist() == [float(k == class_id) for k in range(2)]
    assert (scene.mesh().class_ids[ids_of(scene) == key] == class_id).all()
    np.testing.assert_array_equal(scene.mesh().class_ids[ids_of(scene) != key], others)


@pytest.mark.parametrize("source", InstanceClass)
def test_rename_to_new_class_keeps_other_instances(scene: InstanceMap, source: InstanceClass, tmp_path: Path) -> None:
    scene.instance_class = source
    edited = EditedMap(scene)
    other = scene.instances()[COUCH].class_probabilities
    classes = scene.mesh().class_ids.copy()
    assert edited.apply(Rename(CHAIR, "forklift")).startswith("rename 1: 1 (forklift, ")
    assert scene.classes == ("chair", "couch", "forklift")
    scene.save(tmp_path / "map.npz")
    loaded = InstanceMap.load(tmp_path / "map.npz")
    for one in (scene, loaded):
        assert one.instances()[CHAIR].class_probabilities.tolist() == [0.0, 0.0, 1.0]
        np.testing.assert_allclose(one.instances()[COUCH].class_probabilities, [*other, 0.0], atol=1e-6)
        np.testing.assert_array_equal(one.mesh().class_ids, np.where(ids_of(one) == CHAIR, 2, classes))


def test_instance_of_new_class_keeps_class_when_merged(scene: InstanceMap) -> None:
    edited = EditedMap(scene)
    edited.apply(Rename(CHAIR, "forklift"))
    edited.apply(Merge((COUCH, CHAIR)))
    assert scene.instances()[COUCH].class_probabilities[2] > 0.99


def test_rename_to_256th_class_keeps_other_instances(scene: InstanceMap, tmp_path: Path) -> None:
    edited = EditedMap(scene)
    classes = scene.mesh().class_ids.copy()
    for k in range(253):
        scene.add_class(f"class {k}")
    edited.apply(Rename(CHAIR, "forklift"))
    scene.save(tmp_path / "map.npz")
    for one in (scene, InstanceMap.load(tmp_path / "map.npz")):
        assert one.instances()[CHAIR].class_probabilities.argmax() == 255
        np.testing.assert_array_equal(one.mesh().class_ids, np.where(ids_of(one) == CHAIR, 255, classes))


def test_new_class_of_full_map_is_error(scene: InstanceMap, monkeypatch: pytest.MonkeyPatch) -> None:
    edited = EditedMap(scene)
    monkeypatch.setattr("framework.data.MAX_CLASSES", 2)
    with pytest.raises(DataError, match="expected at most 2 classes, got 3"):
        edited.apply(Rename(CHAIR, "forklift"))


@pytest.mark.parametrize(
    ("name", "remark"),
    [
        ("forklift", "rename 1: new class 'forklift'"),
        ("Chair", "rename 1: new class 'Chair' (similar to 'chair')"),
        ("tv", "rename 1: new class 'tv'"),
    ],
)
def test_new_class_is_reported(scene: InstanceMap, name: str, remark: str, caplog: pytest.LogCaptureFixture) -> None:
    edited = EditedMap(scene)
    edited.apply(Rename(CHAIR, name))
    edited.apply(Rename(COUCH, name))
    assert [record.getMessage() for record in caplog.records] == [remark]


def test_edited_map_file_round_trip_is_identical(scene: InstanceMap, tmp_path: Path) -> None:
    edited = EditedMap(scene)
    for edit in (Merge((CHAIR, COUCH)), Split(CHAIR), Rename(3, "couch"), Delete((1,))):
        edited.apply(edit)
    scene.save(tmp_path / "map.npz")
    loaded = InstanceMap.load(tmp_path / "map.npz")
    np.testing.assert_array_equal(loaded.mesh().instance_ids, scene.mesh().instance_ids)
    np.testing.assert_array_equal(loaded.mesh().class_ids, scene.mesh().class_ids)
    assert loaded.instances()[3].class_probabilities.tolist() == [0.0, 1.0]


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (Delete((3,)), "expected an instance out of 1, 2, got 3"),
        (Merge((1, 4)), "expected an instance out of 1, 2, got 4"),
        (Split(1), "expected at least two parts with"),
    ],
)
def test_edit_of_unknown_name_raises_data_error(scene: InstanceMap, edit: Delete, message: str) -> None:
    edited = EditedMap(scene)
    with pytest.raises(DataError) as raised:
        edited.apply(edit)
    assert str(raised.value).startswith(message)

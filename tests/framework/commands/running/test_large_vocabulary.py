"""A run with as many classes as LVIS has, from the detections to the exports."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from omegaconf import OmegaConf

from framework.commands.results.evaluate import evaluate_runs
from framework.commands.running.run import run
from framework.evaluation.instances import Transfer
from framework.exporting.exports import ExportFormat, export
from framework.files.json_file import read_json
from framework.mapping.instance_map import InstanceMap
from framework.runs.instances_file import read_instances
from framework.runs.mesh_file import read_mesh
from framework.testing.corner_room import CLASSES
from tests.support import reported_run

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("fakes_registered")]

LVIS = 1203  # number of classes
FORMATS = (ExportFormat.GLB, ExportFormat.PLY, ExportFormat.OBJ, ExportFormat.SCANNET, ExportFormat.NPZ)


def test_run_with_1203_classes_matches_run_with_2_classes(tmp_path: Path) -> None:
    """The classes of the spheres are the last ones."""
    unused = LVIS - len(CLASSES)
    for name, count in (("few", 0), ("many", unused)):
        detector = reported_run.CONFIG["detector"] | {"unused_classes": count}
        run(OmegaConf.create(reported_run.CONFIG | {"detector": detector}), tmp_path / name, {})
    few, many = tmp_path / "few", tmp_path / "many"

    maps = [InstanceMap.load(path / "map.npz") for path in (few, many)]
    assert [len(scene.classes) for scene in maps] == [len(CLASSES), LVIS]
    assert [scene.labels.evidence.class_ids.itemsize for scene in maps] == [1, 2]
    for meshes in ([read_mesh(path / "mesh.ply") for path in (few, many)], [scene.mesh() for scene in maps]):
        np.testing.assert_array_equal(meshes[0].instance_ids, meshes[1].instance_ids)
        np.testing.assert_array_equal(
            np.where(meshes[0].class_ids >= 0, meshes[0].class_ids + unused, -1), meshes[1].class_ids
        )
    named = [{one.id: one.class_name for one in read_instances(path / "instances.json")} for path in (few, many)]
    assert named[0] == named[1] == {1: CLASSES[0], 2: CLASSES[1]}

    assert evaluate_runs([few, many], Transfer.TO_TRUTH, write=True) == 0
    ap50 = [read_json(path / "metrics.json")["instances.ap50"] for path in (few, many)]
    assert ap50[0] == ap50[1] > 0

    assert len(o3d.io.read_triangle_mesh(str(many / "mesh.ply")).vertices) > 0
    written = [export(path, FORMATS) for path in (few, many)]
    assert [path.relative_to(few) for path in written[0]] == [path.relative_to(many) for path in written[1]]
    for ours, other in zip(*written, strict=True):
        if ours.suffix == ".ply":  # the header contains the classes
            assert len(o3d.io.read_triangle_mesh(str(other)).vertices) > 0
        elif ours.suffix == ".glb":  # contains the class probabilities
            assert b'"class":"chair"' in other.read_bytes() or b'"class":"couch"' in other.read_bytes()
        else:
            assert ours.read_bytes() == other.read_bytes(), ours

"""Tests for the mesh exports."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pytest
import trimesh
from PIL import ImageColor
from scipy.spatial.transform import Rotation

from framework.data import Box, Structure
from framework.errors import ConfigError, DataError
from framework.exporting.decimation import decimated
from framework.exporting.exports import PREDICTIONS, Chosen, ExportFormat, export
from framework.exporting.glb import glb
from framework.exporting.object_meshes import Coloring, linear, parts
from framework.exporting.upright_room import UprightRoom, facing, objects_of, read_room, surface_points
from framework.exporting.usd import Collision, convex_hull
from framework.rendering.palette import instance_colors
from framework.runs.instances_file import StoredInstance
from framework.runs.mesh_file import read_mesh, write_mesh
from tests.support.scenes.exported_room import Y_UP, ExportedRoom
from tests.support.terminals import terminal_stderr

TURNED = ExportedRoom(R_world_room=Y_UP, shift=(0.5, -1.25, 2.0))
TABLE_SIZE, CUBE_SIZE = (1.2, 0.8, 0.75), (0.2, 0.2, 0.2)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run whose world frame has y up and an origin above the floor."""
    return TURNED.write(tmp_path_factory.mktemp("runs") / "turned")


@pytest.fixture(scope="module")
def room(run: Path) -> UprightRoom:
    return read_room(run)


def header(data: bytes) -> dict[str, Any]:
    """Return the JSON part of a GLB file."""
    return dict(json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")]))


def bounds(low: tuple[float, ...], high: tuple[float, ...]) -> Any:
    return pytest.approx(np.array([low, high]), abs=1e-5)


def test_read_room_places_floor_at_zero(room: UprightRoom) -> None:
    assert room.up_known
    assert room.floor_known
    assert room.mesh.vertices[:, 2].min() == pytest.approx(0, abs=1e-5)
    assert room.mesh.vertices[:, 2].max() == pytest.approx(2.5, abs=1e-5)
    np.testing.assert_allclose(room.T_room_world[:3, :3] @ Y_UP[:, 2], (0, 0, 1), atol=1e-12)
    table, cube, _ = room.objects
    assert (table.name, cube.name) == ("dining_table_1", "cube_2")
    assert (table.base, table.top, cube.base, cube.top) == pytest.approx((0, 0.75, 0.75, 0.95), abs=1e-5)
    assert sorted(table.box.extent[:2]) == pytest.approx([0.8, 1.2], abs=1e-4)
    assert table.probability == pytest.approx(0.9)


def test_read_room_with_z_up_keeps_world_xy(tmp_path: Path) -> None:
    scene = ExportedRoom(shift=(1.0, -2.0, 0.5))
    room = read_room(scene.write(tmp_path / "run"))
    expected = np.eye(4)
    expected[2, 3] = -0.5
    np.testing.assert_allclose(room.T_room_world, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("shift", "tilt"),
    [
        ((6000, 6000, 0), (0.3, -0.2, 0)),
        ((-8000, 200, 40), (1, 0, 0)),
        ((500, -900, -3), (0, 2, 0)),
        ((3000, 0, 0), (-0.5, 1.5, 30)),
        ((0, 9000, 100), (5, 5, 90)),
    ],
    ids=str,
)
def test_read_room_far_from_origin_keeps_world_xy(
    tmp_path: Path, shift: tuple[float, float, float], tilt: tuple[float, float, float]
) -> None:
    """A rotation about the origin of the world frame would move the room by up to a kilometer."""
    scene = ExportedRoom(shift=shift, R_world_room=Rotation.from_euler("xyz", tilt, degrees=True).as_matrix())
    room, world = read_room(scene.write(tmp_path / "run")), scene.mesh().vertices
    middles = [(vertices.min(axis=0) + vertices.max(axis=0))[:2] / 2 for vertices in (world, room.mesh.vertices)]
    np.testing.assert_allclose(middles[1], middles[0], atol=0.2)
    assert room.mesh.vertices[:, 2].min() == pytest.approx(0, abs=2e-3)
    np.testing.assert_allclose(room.T_room_world[:3, :3] @ scene.R_world_room[:, 2], (0, 0, 1), atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "ending"), [(ExportFormat.PLY, "ply"), (ExportFormat.OBJ, "obj"), (ExportFormat.GLB, "glb")]
)
def test_exported_objects_are_centered_on_origin_in_meters(
    kind: ExportFormat, ending: str, run: Path, tmp_path: Path
) -> None:
    written = export(run, [kind], tmp_path, Chosen(("cube", "1")))
    assert sorted(path.name for path in written) == [f"cube_2.{ending}", f"dining_table_1.{ending}"]
    for name, (x, y, z) in (("dining_table_1", TABLE_SIZE), ("cube_2", CUBE_SIZE)):
        found = trimesh.load(tmp_path / "objects" / f"{name}.{ending}", process=False).bounds
        if kind is ExportFormat.GLB:  # y up
            assert found == bounds((-x / 2, 0, -y / 2), (x / 2, z, y / 2))
        else:
            assert found == bounds((-x / 2, -y / 2, 0), (x / 2, y / 2, z))


def test_exported_scene_contains_all_objects_in_place(run: Path, tmp_path: Path) -> None:
    export(run, [ExportFormat.GLB, ExportFormat.PLY, ExportFormat.OBJ], tmp_path)
    whole = read_mesh(run / "mesh.ply")
    scene = trimesh.load(tmp_path / "scene.glb", process=False)
    assert {"room", "dining_table_1", "cube_2", "picture_3"} <= set(scene.graph.nodes)
    assert sum(len(mesh.faces) for mesh in scene.geometry.values()) == len(whole.triangles)
    cube = scene.graph.get("cube_2")[0]
    low, high = (trimesh.transform_points(scene.geometry["cube_2"].bounds, cube)).round(5)
    np.testing.assert_allclose(np.abs(high - low), (0.2, 0.2, 0.2), atol=1e-4)
    assert low[1] == pytest.approx(0.75, abs=1e-4)
    np.testing.assert_allclose(scene.bounds[:, 1], (0, 2.5), atol=1e-4)
    for ending in ("ply", "obj"):
        found = trimesh.load(tmp_path / f"scene.{ending}", process=False, force="mesh")
        np.testing.assert_allclose(found.bounds[:, 2], (0, 2.5), atol=1e-4)
        assert len(found.faces) == len(whole.triangles)
        original = trimesh.Trimesh(whole.vertices, whole.triangles, process=False)
        assert found.area == pytest.approx(original.area, rel=1e-4)


def test_export_triangles_between_objects_belong_to_room(room: UprightRoom) -> None:
    ids = np.where(room.mesh.vertices[:, 0] > 2.02, 1, 2).astype(np.int32)
    mesh = replace(room.mesh, instance_ids=ids)
    box = room.objects[0].box
    two = [StoredInstance(key, "half", 0.5, {}, 1, 0, 0, int((ids == key).sum()), None, box) for key in (1, 2)]
    halves = replace(room, mesh=mesh, objects=objects_of(mesh, two))
    found = parts(halves)
    seams = len(found[0].mesh.triangles)
    assert seams >= 2 * (4 * 3 / 0.1)  # at least the triangles across floor and ceiling
    assert sum(len(part.mesh.triangles) for part in found) == len(mesh.triangles)
    assert (surface_points(halves, 1.0).owner == 0).sum() == seams


@pytest.mark.parametrize(("degrees", "yaw", "swapped"), [(80, -10, True), (10, 10, False), (190, 10, False)])
def test_export_facing_aligns_box_with_room_x_axis(degrees: float, yaw: float, swapped: bool) -> None:
    angle = np.radians(degrees)
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    found = facing(Box(np.zeros(3), np.array([1.0, 2.0, 3.0]), rotation))
    assert found.extent.tolist() == ([2, 1, 3] if swapped else [1, 2, 3])
    assert np.degrees(np.arctan2(found.rotation[1, 0], found.rotation[0, 0])) == pytest.approx(yaw)


def test_glb_nodes_have_object_metadata(room: UprightRoom) -> None:
    found = header(glb(parts(room)))
    extras = {node["name"]: node.get("extras") for node in found["nodes"]}
    names = {"id": 2, "class": "cube", "label_space": "own classes"}
    assert extras["cube_2"] == names | {"probability": pytest.approx(0.9), "confidence": 0.8, "exists": 0.8}
    assert not extras["room"]
    assert found["asset"]["version"] == "2.0"
    assert found["extensionsUsed"] == ["KHR_materials_unlit"]
    materials = [found["materials"][mesh["primitives"][0]["material"]] for mesh in found["meshes"]]
    assert [material.get("doubleSided", False) for material in materials] == [False, True, True, True]


def test_glb_colors_are_linear_with_16_bits(room: UprightRoom) -> None:
    data = glb(parts(room))
    found = header(data)
    cube = next(mesh for mesh in found["meshes"] if mesh["name"] == "cube_2")
    accessor = found["accessors"][cube["primitives"][0]["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["normalized"], accessor["type"]) == (5123, True, "VEC4")
    view = found["bufferViews"][accessor["bufferView"]]
    start = 28 + int.from_bytes(data[12:16], "little") + view["byteOffset"]
    color = np.frombuffer(data, "<u2", 4, start) / 65535
    # IEC 61966-2-1: the linear value of 220 is ((220 / 255 + 0.055) / 1.055)^2.4
    np.testing.assert_allclose(color, (0.715694, 0.012983, 0.012983, 1), atol=2e-5)
    every = linear(np.arange(256, dtype=np.uint8))
    assert (every[0], every[255]) == (0, 1)
    assert len(np.unique(np.rint(every * 65535))) == 256  # all colors are distinct


@pytest.mark.parametrize("coloring", [Coloring.INSTANCE, Coloring.CLASS])
def test_export_colors_one_object_uniformly(coloring: Coloring, tmp_path: Path) -> None:
    two = ExportedRoom(things={"cube": [(1, 1, 0, 1.2, 1.2, 0.2)], "other": [(2, 2, 0, 2.2, 2.2, 0.2)]})
    run = two.write(tmp_path / "run")
    entries = json.loads((run / "instances.json").read_text())
    entries[1]["class"] = "cube"
    (run / "instances.json").write_text(json.dumps(entries))
    export(run, [ExportFormat.PLY, ExportFormat.GLB], tmp_path, Chosen(coloring=coloring))
    mesh = read_mesh(tmp_path / "scene.ply")
    colors = [np.unique(mesh.colors[mesh.instance_ids == key], axis=0) for key in (0, 1, 2)]
    assert [len(each) for each in colors] == [1, 1, 1]
    assert (colors[1] == colors[2]).all() == (coloring is Coloring.CLASS)
    assert "extensionsUsed" not in header((tmp_path / "scene.glb").read_bytes())  # the materials are lit
    assert sorted(path.stem for path in (tmp_path / "objects").glob("*.glb")) == ["cube_1", "cube_2"]


def test_exported_meshes_are_readable_by_open3d_and_trimesh(run: Path, tmp_path: Path) -> None:
    export(run, [ExportFormat.PLY, ExportFormat.OBJ], tmp_path)
    for path in (run / "mesh.ply", tmp_path / "scene.ply"):
        mesh = read_mesh(path)
        legacy = o3d.io.read_triangle_mesh(str(path))
        np.testing.assert_array_equal(np.rint(np.asarray(legacy.vertex_colors) * 255), mesh.colors)
        assert len(legacy.triangles) == len(mesh.triangles)
        points = o3d.t.io.read_point_cloud(str(path)).point
        np.testing.assert_array_equal(points["instance"].numpy().ravel(), mesh.instance_ids)
        np.testing.assert_array_equal(points["class"].numpy().ravel(), mesh.class_ids)
        np.testing.assert_array_equal(points["colors"].numpy(), mesh.colors)
        loaded = trimesh.load(path, process=False)
        np.testing.assert_array_equal(loaded.visual.vertex_colors[:, :3], mesh.colors)
        raw = loaded.metadata["_ply_raw"]["vertex"]["data"]
        np.testing.assert_array_equal(raw["instance"].ravel(), mesh.instance_ids)
        np.testing.assert_array_equal(raw["class"].ravel(), mesh.class_ids)
    cube = trimesh.load(tmp_path / "objects" / "cube_2.obj", process=False)
    assert {tuple(color) for color in cube.visual.vertex_colors[:, :3].tolist()} == {ImageColor.getrgb("#dc1e1e")}
    named = [line for line in (tmp_path / "scene.obj").read_text().splitlines() if line.startswith("o ")]
    assert named == ["o room", "o dining_table_1", "o cube_2", "o picture_3"]


def test_usd_stage_has_semantics_and_collision_shapes(run: Path, tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom, UsdPhysics, UsdSemantics

    export(run, [ExportFormat.USD], tmp_path)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetDefaultPrim().GetPath() == "/World"
    cube = stage.GetPrimAtPath("/World/cube_2")
    assert UsdSemantics.LabelsAPI(cube, "class").GetLabelsAttr().Get() == ["cube"]
    assert cube.GetCustomDataByKey("instancemap:id") == 2
    assert not UsdPhysics.RigidBodyAPI(cube).GetRigidBodyEnabledAttr().Get()
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default", "guide"]).ComputeWorldBound(cube).ComputeAlignedRange()
    assert (box.GetMax() - box.GetMin())[2] == pytest.approx(0.2, abs=1e-4)
    assert box.GetMin()[2] == pytest.approx(0.75, abs=1e-4)
    color = UsdGeom.Mesh(stage.GetPrimAtPath("/World/cube_2/visual")).GetDisplayColorPrimvar()
    assert color.GetInterpolation() == "vertex"
    np.testing.assert_allclose(color.Get()[0], (0.715694, 0.012983, 0.012983), atol=1e-5)
    collision = stage.GetPrimAtPath("/World/cube_2/collision")
    assert collision.HasAPI(UsdPhysics.CollisionAPI)
    assert UsdGeom.Mesh(collision).GetPurposeAttr().Get() == "guide"
    assert UsdPhysics.MeshCollisionAPI(collision).GetApproximationAttr().Get() == "convexHull"
    assert len(UsdGeom.Mesh(collision).GetPointsAttr().Get()) == 8
    room = stage.GetPrimAtPath("/World/room")
    assert UsdPhysics.MeshCollisionAPI(room).GetApproximationAttr().Get() == "none"
    export(run, [ExportFormat.USD], tmp_path / "boxes", Chosen(("cube",), collision=Collision.BOX))
    alone = Usd.Stage.Open(str(tmp_path / "boxes" / "objects" / "cube_2.usdc"))
    proxy = UsdGeom.Cube(alone.GetPrimAtPath("/World/cube_2/collision"))
    bound = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["guide"]).ComputeWorldBound(proxy.GetPrim())
    low, high = (
        np.array(corner) for corner in (bound.ComputeAlignedRange().GetMin(), bound.ComputeAlignedRange().GetMax())
    )
    np.testing.assert_allclose((low, high), ((-0.1, -0.1, 0), (0.1, 0.1, 0.2)), atol=1e-5)


def test_usd_room_has_subset_of_each_structure(tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom, UsdSemantics

    run = ExportedRoom().write(tmp_path / "run")
    mesh = read_mesh(run / "mesh.ply")
    heights = mesh.vertices[:, 2]
    structure = np.select([heights < 0.01, heights > 2.49], [Structure.FLOOR, Structure.CEILING], Structure.NONE)
    write_mesh(run / "mesh.ply", replace(mesh, structure=structure.astype(np.uint8)))
    export(run, [ExportFormat.USD], tmp_path)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    room = UsdGeom.Mesh(stage.GetPrimAtPath("/World/room"))
    points, corners = np.array(room.GetPointsAttr().Get()), np.array(room.GetFaceVertexIndicesAttr().Get())
    subsets = UsdGeom.Subset.GetAllGeomSubsets(room)
    assert sorted(one.GetPrim().GetName() for one in subsets) == ["ceiling", "floor"]
    for one in subsets:
        name = one.GetPrim().GetName()
        assert UsdSemantics.LabelsAPI(one.GetPrim(), "class").GetLabelsAttr().Get() == [name]
        used = points[corners.reshape(-1, 3)[np.array(one.GetIndicesAttr().Get())].ravel()]
        np.testing.assert_allclose(used[:, 2], 0 if name == "floor" else 2.5, atol=1e-4)


def test_usd_export_without_usd_core_error_names_extra(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(DataError, match=r"pip install 'instancemap\[usd\]'"):
        export(run, [ExportFormat.GLB, ExportFormat.USD], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_convex_hull_faces_outward() -> None:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    found = convex_hull(np.concatenate([corners, np.full((5, 3), 0.5, np.float32)]))
    assert found is not None
    assert trimesh.Trimesh(*found, process=False).volume == pytest.approx(1.0)
    assert convex_hull(corners[:3]) is None
    assert convex_hull(corners[corners[:, 2] == 0]) is None


def test_glb_normals_of_degenerate_triangles_have_unit_length(room: UprightRoom) -> None:
    """The glTF validator of Khronos requires unit normals, also for degenerate triangles."""
    mesh = replace(room.mesh, vertices=room.mesh.vertices.copy())
    own = room.objects[1].vertices
    mesh.vertices[own[:50]] = mesh.vertices[own[0]]
    scene = trimesh.load(
        trimesh.util.wrap_as_stream(glb(parts(replace(room, mesh=mesh)), Coloring.CLASS)),
        file_type="glb",
        process=False,
    )
    for part in scene.geometry.values():
        np.testing.assert_allclose(np.linalg.norm(part.vertex_normals, axis=1), 1, atol=1e-5)


def test_export_small_fragments_belong_to_room_not_object(tmp_path: Path) -> None:
    """Small fragments are caused by wrong labels at depth edges. A table leg is larger."""
    table = [(0.8, 1.0, 0.7, 2.0, 1.8, 0.75), (0.8, 1.0, 0, 0.85, 1.05, 0.65)]
    speck = (3.5, 2.5, 0.9, 3.51, 2.51, 0.91)
    run = ExportedRoom(things={"dining table": [*table, speck]}).write(tmp_path / "run")
    [found] = read_room(run).objects
    assert found.box.extent == pytest.approx((1.2, 0.8, 0.75), abs=1e-4)
    [loaded] = export(run, [ExportFormat.PLY], tmp_path, Chosen(("1",)))
    assert len(read_mesh(loaded).vertices) == len(found.vertices)
    whole = export(run, [ExportFormat.PLY], tmp_path)[0]
    assert len(read_mesh(whole).triangles) == len(read_mesh(run / "mesh.ply").triangles)


def test_export_decimated_parts_keep_shape_colors_and_labels(room: UprightRoom) -> None:
    fewer = parts(room, 400)
    assert 200 < sum(len(part.mesh.triangles) for part in fewer) <= 420
    for full, part in zip(parts(room), fewer, strict=True):
        np.testing.assert_allclose(part.mesh.vertices.min(axis=0), full.mesh.vertices.min(axis=0), atol=0.02)
        np.testing.assert_allclose(part.mesh.vertices.max(axis=0), full.mesh.vertices.max(axis=0), atol=0.02)
        assert set(np.unique(part.mesh.instance_ids)) <= set(np.unique(full.mesh.instance_ids))
        np.testing.assert_array_equal(np.unique(part.mesh.colors, axis=0), np.unique(full.mesh.colors, axis=0))
    assert decimated(room.mesh, len(room.mesh.triangles)) is room.mesh


def test_export_decimation_shows_progress_bar_in_terminal(room: UprightRoom, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TQDM_DISABLE", raising=False)
    with terminal_stderr(100, monkeypatch) as shown:
        parts(room, 400)
    assert "decimating room:   0%" in shown[0]
    for one in room.objects:
        assert f"decimating {one.name}: " in shown[0]


def test_export_is_deterministic(run: Path, tmp_path: Path) -> None:
    formats = [ExportFormat.GLB, ExportFormat.PLY, ExportFormat.USD, ExportFormat.OBJ]
    first = export(run, formats, tmp_path / "a", Chosen(triangles=300))
    second = export(run, formats, tmp_path / "b", Chosen(triangles=300))
    assert len(first) == 16
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_export_converts_class_names_to_identifiers(tmp_path: Path) -> None:
    scene = ExportedRoom(things={"cube": [(1, 1, 0, 1.2, 1.2, 0.2)], "other": [(2, 2, 0, 2.2, 2.2, 0.2)]})
    run = scene.write(tmp_path / "run")
    entries = json.loads((run / "instances.json").read_text())
    entries[0]["class"], entries[1]["class"] = "../../étagère 'x'", "日本"
    (run / "instances.json").write_text(json.dumps(entries))
    written = export(run, [ExportFormat.GLB, ExportFormat.USD, ExportFormat.OBJ, ExportFormat.PLY], tmp_path / "out")
    assert {path.stem for path in written} == {"scene", "tag_re_x_1", "object_2"}
    assert {path.parent for path in written} == {tmp_path / "out", tmp_path / "out" / "objects"}
    from pxr import Usd, UsdSemantics

    stage = Usd.Stage.Open(str(tmp_path / "out" / "scene.usdc"))
    prim = stage.GetPrimAtPath("/World/object_2")
    assert UsdSemantics.LabelsAPI(prim, "class").GetLabelsAttr().Get() == ["日本"]
    assert export(run, [ExportFormat.GLB], tmp_path / "one", Chosen(("日本",))) == [
        tmp_path / "one/objects/object_2.glb"
    ]


def test_export_escapes_control_characters_in_class_names(tmp_path: Path) -> None:
    run = ExportedRoom().write(tmp_path / "run")
    path = run / "instances.json"
    path.write_text(path.read_text().replace('"class": "cube"', '"class": "cube \\u001b\\u202e"'))
    export(run, [one for one in ExportFormat if one not in PREDICTIONS], tmp_path / "out")
    nodes = header((tmp_path / "out/scene.glb").read_bytes())["nodes"]
    assert r"cube \x1b\u202e" in [node.get("extras", {}).get("class") for node in nodes]


def test_export_invalid_unicode_class_name_raises(tmp_path: Path) -> None:
    run = ExportedRoom().write(tmp_path / "run")
    path = run / "instances.json"
    path.write_text(path.read_text().replace('"class": "cube"', '"class": "cube \\ud800"'))
    with pytest.raises(DataError, match=r"instances\.json: expected valid Unicode, got the lone surrogate"):
        export(run, [ExportFormat.GLB], tmp_path / "out")


def test_exported_instance_colors_match_overview(tmp_path: Path) -> None:
    """Colors do not depend on the selected objects or on the confidence of other objects."""
    run = ExportedRoom().write(tmp_path / "run")
    entries = json.loads((run / "instances.json").read_text())
    entries[0]["confidence"] = 0.1
    (run / "instances.json").write_text(json.dumps(entries))
    mesh = read_mesh(run / "mesh.ply")
    centroids = np.array([mesh.vertices[mesh.instance_ids == key].mean(axis=0) for key in (2, 3)], np.float64)
    expected = dict(zip((2, 3), instance_colors(centroids), strict=True))
    for objects in ((), ("2", "3"), ("3",)):
        files = export(run, [ExportFormat.PLY], tmp_path / "out", Chosen(objects, coloring=Coloring.INSTANCE))
        for path in files:
            found = read_mesh(path)
            for key in {2, 3} & set(found.instance_ids.tolist()):
                colors = found.colors[found.instance_ids == key]
                np.testing.assert_array_equal(np.unique(colors, axis=0), [expected[key]])


def test_export_object_with_three_vertices_is_written(tmp_path: Path) -> None:
    run = ExportedRoom().write(tmp_path / "run")
    mesh = read_mesh(run / "mesh.ply")
    ids = np.where(mesh.instance_ids == 2, 0, mesh.instance_ids).astype(np.int32)
    ids[np.flatnonzero(mesh.instance_ids == 2)[:3]] = 2
    write_mesh(run / "mesh.ply", replace(mesh, instance_ids=ids))
    entries = json.loads((run / "instances.json").read_text())
    entries[1]["vertices"] = 3
    (run / "instances.json").write_text(json.dumps(entries))
    written = export(run, [ExportFormat.GLB, ExportFormat.USD, ExportFormat.OBJ, ExportFormat.PLY], tmp_path / "out")
    assert len(written) == 16
    node = next(one for one in header((tmp_path / "out/scene.glb").read_bytes())["nodes"] if one["name"] == "cube_2")
    assert node["extras"]["id"] == 2
    assert len(read_mesh(tmp_path / "out/objects/cube_2.ply").vertices) == 3


def test_export_mesh_without_triangles_writes_object_vertices(tmp_path: Path) -> None:
    """Without triangles, no vertex is connected to others, and none may be removed as a fragment."""
    run = ExportedRoom().write(tmp_path / "run")
    mesh = read_mesh(run / "mesh.ply")
    write_mesh(run / "mesh.ply", replace(mesh, triangles=mesh.triangles[:0]))
    written = export(
        run,
        [ExportFormat.GLB, ExportFormat.USD, ExportFormat.PLY, ExportFormat.OBJ],
        tmp_path / "out",
        Chosen(("cube",)),
    )
    assert len(read_mesh(tmp_path / "out" / "objects" / "cube_2.ply").vertices) == (mesh.instance_ids == 2).sum()
    assert len(written) == 4
    with pytest.raises(DataError, match="expected a surface to export, got an empty map"):
        export(run, [ExportFormat.GLB], tmp_path / "out")


def test_export_partial_run_without_objects_writes_scene(tmp_path: Path) -> None:
    run = ExportedRoom().write(tmp_path / "run")
    (run / "metrics.json").rename(run / "metrics.partial.json")
    (run / "instances.json").unlink()
    (run / "trajectory.txt").unlink()
    [scene] = export(run, [ExportFormat.PLY])
    assert scene == run / "export" / "scene.ply"
    assert len(read_mesh(scene).vertices) == len(read_mesh(run / "mesh.ply").vertices)
    with pytest.raises(
        DataError, match="object: expected an id or class of this run, got 'chair'; the run has no objects"
    ):
        export(run, [ExportFormat.PLY], chosen=Chosen(("chair",)))


def test_export_invalid_selection_raises(run: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected a run directory"):
        export(tmp_path, [ExportFormat.GLB])
    with pytest.raises(DataError, match="object: expected an id or class of this run, got 'cub'; did you mean 'cube'"):
        export(run, [ExportFormat.GLB], tmp_path, Chosen(("cub",)))
    with pytest.raises(DataError, match=r"object: expected a probability >= 0.99 for 'cube', got at most 0.80"):
        export(run, [ExportFormat.GLB], tmp_path, Chosen(("cube",), min_probability=0.99))
    assert export(run, [ExportFormat.GLB], tmp_path, Chosen(("2",), min_probability=0.99)) == [
        tmp_path / "objects/cube_2.glb"
    ]
    assert export(run, [ExportFormat.GLB], tmp_path, Chosen(min_probability=0.99)) == [tmp_path / "scene.glb"]
    with pytest.raises(ConfigError, match="triangles: expected at least 4, got 0"):
        Chosen(triangles=0)


def test_export_up_option_replaces_missing_up_direction(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = TURNED.write(tmp_path / "run", figures=False)
    export(run, [ExportFormat.PLY], tmp_path / "as_it_is")
    assert "expected an up direction, got none" in caplog.text
    assert read_mesh(tmp_path / "as_it_is" / "scene.ply").vertices[:, 1].max() == pytest.approx(1.25, abs=1e-5)
    caplog.clear()
    export(run, [ExportFormat.PLY], tmp_path / "given", up=(0, 2, 0), floor=-1.25)
    assert not caplog.text
    assert read_mesh(tmp_path / "given" / "scene.ply").vertices[:, 2].min() == pytest.approx(0, abs=1e-5)
    with pytest.raises(DataError, match="up: expected a nonzero direction of 3 finite numbers"):
        read_room(run, up=(0, 0, 0))

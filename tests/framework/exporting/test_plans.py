"""Tests for floor plans, ROS maps and scene graphs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import yaml
from PIL import Image

from framework.data import Structure
from framework.errors import DataError
from framework.exporting import occupancy, scene_graph
from framework.exporting.exports import Chosen, ExportFormat, export
from framework.exporting.occupancy import FREE, OCCUPIED, UNKNOWN, Plan, levels, looked_through, plan
from framework.exporting.relations import relations
from framework.exporting.rooms import rooms
from framework.exporting.upright_room import UprightRoom, middles, read_room, surface_points
from framework.rendering.viewpoint import looking
from tests.support.scenes.exported_room import CUBE, TABLE, Y_UP, Block, ExportedRoom

SCHEMA = json.loads((Path(scene_graph.__file__).parent / "scene_graph.schema.json").read_text())
RESOLUTION = 0.1
OFF = 0.05  # m, offset of the room along x and y; no wall may be on a cell border


def stored(tmp_path: Path, **scene: object) -> UprightRoom:
    return read_room(ExportedRoom(**scene).write(tmp_path / "run"))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ExportedRoom(shift=(OFF, OFF, 0.0)).write(tmp_path_factory.mktemp("runs") / "room")


@pytest.fixture(scope="module")
def room(run: Path) -> UprightRoom:
    return read_room(run)


@pytest.fixture(scope="module")
def low(room: UprightRoom) -> Plan:
    """Return a floor plan for a robot that is lower than the table."""
    return plan(room, RESOLUTION, 0.5)


@pytest.fixture(scope="module")
def high(room: UprightRoom) -> Plan:
    return plan(room, RESOLUTION, 1.0)


def at(found: Plan, x: float, y: float) -> tuple[bool, bool]:
    """Return the values of the masks `occupied` and `free` at x, y, m."""
    [[row, column]] = found.cells(np.array([[x + OFF, y + OFF]]))
    return bool(found.occupied[row, column]), bool(found.free[row, column])


def expected(found: list, source: int) -> list[tuple[str, int | str]]:
    return [(relation.name, relation.target) for relation in found if relation.source == source]


@pytest.mark.parametrize("n", [1, 2, 5])
def test_triangle_sample_weights_are_evenly_distributed(n: int) -> None:
    weights = middles(n)
    assert weights.shape == (n * n, 3)
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    np.testing.assert_allclose(weights.mean(axis=0), 1 / 3)
    assert weights.min() > 0


def test_surface_points_have_owner_and_given_spacing(room: UprightRoom) -> None:
    found = surface_points(room, 0.02)
    cube = found.points[found.owner == 2]
    np.testing.assert_allclose(cube.min(axis=0), (1.25, 1.25, 0.75), atol=0.01)
    np.testing.assert_allclose(cube.max(axis=0), (1.45, 1.45, 0.95), atol=0.01)
    top = found.points[(found.owner == 2) & found.level]
    np.testing.assert_allclose(top[:, 2], 0.95, atol=1e-5)
    with pytest.raises(DataError, match="increase resolution"):
        surface_points(room, 1e-5)


def test_plan_cells_are_occupied_at_object_footprints(low: Plan, high: Plan) -> None:
    inside = (slice(2, -2),) * 2
    assert low.shape == (33, 43)  # 3 x 4 m, and a margin
    assert at(low, 0.825, 1.025) == (True, False)  # a leg
    assert at(low, 1.4, 1.4) == (False, False)  # under the table, where the floor is not observed
    assert at(high, 1.4, 1.4) == (True, False)
    legs = [(0.825, 1.025), (1.975, 1.025), (0.825, 1.775), (1.975, 1.775)]
    assert all(at(low, *leg)[0] for leg in legs)
    assert 4 <= low.occupied[inside].sum() <= 16  # a leg of 5 cm is in one to four cells
    table = high.occupied[inside].sum() * RESOLUTION**2
    assert 1.2 * 0.8 <= table <= 1.4 * 1.0  # including the cells at its edges
    assert low.occupied[1, 1:-1].all()
    assert not low.occupied[0].any()


def test_plan_observed_space_under_table_is_free(tmp_path: Path) -> None:
    low = plan(stored(tmp_path, shift=(OFF, OFF, 0.0), eyes=((3.5, 1.4, 0.3), (0.3, 1.4, 0.3))), RESOLUTION, 0.5)
    assert at(low, 1.4, 1.4) == (False, True)


def test_plan_highest_object_per_cell_is_order_independent(low: Plan, tmp_path: Path) -> None:
    turned = plan(stored(tmp_path, things={"cube": CUBE, "table": TABLE}, shift=(OFF, OFF, 0.0)), RESOLUTION, 0.5)
    for (x, y), key in (((1.3, 1.3), 2), ((1.0, 1.2), 1), ((3.5, 1.0), 0)):
        [[row, column]] = low.cells(np.array([[x + OFF, y + OFF]]))
        assert low.highest[row, column] == key
        assert turned.highest[row, column] == (0, 2, 1)[key]


def test_plan_wall_cells_match_room_walls(low: Plan) -> None:
    assert low.wall[1:-1, [1, -2]].all()
    assert low.wall[[1, -2], 1:-1].sum() >= 76  # except behind the picture
    assert low.wall.sum() == low.wall[1:-1, [1, -2]].sum() + low.wall[[1, -2], 2:-2].sum()


def test_plan_free_cells_are_observed_floor(room: UprightRoom, low: Plan) -> None:
    open_floor = low.floor & ~low.occupied
    assert low.free[open_floor].mean() > 0.95
    assert not (low.free & ~open_floor).any()
    blind = plan(replace(room, poses=room.poses[:0]), RESOLUTION, 0.5)
    assert not blind.free.any()
    np.testing.assert_array_equal(blind.occupied, low.occupied)


def test_plan_looked_through_excludes_occluded_points(room: UprightRoom) -> None:
    """All points are on the optical axis of a camera that faces the cube."""
    pose = np.eye(4)
    pose[:3, :3] = looking(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    pose[:3, 3] = (0.4, 1.35, 0.85)
    places = np.array([(0.8, 1.35, 0.85), (1.15, 1.35, 0.85), (1.35, 1.35, 0.85), (1.8, 1.35, 0.85), (0.2, 1.35, 0.85)])
    seen = looked_through(replace(room, poses=pose[None]), places)
    # two points in front of the cube, one in it, one behind it, and one behind the camera
    assert seen.tolist() == [True, True, False, False, False]


def test_ros_map_matches_map_server_thresholds(run: Path, low: Plan, tmp_path: Path) -> None:
    written = export(run, [ExportFormat.FLOORPLAN], tmp_path, Chosen(resolution=RESOLUTION, robot_height=0.5))
    assert [path.name for path in written] == ["floor_plan.png", "floor_plan.geojson", "map.pgm", "map.yaml"]
    header = yaml.safe_load((tmp_path / "map.yaml").read_text())
    image = Image.open(tmp_path / header["image"])
    assert (image.format, image.mode, image.size) == ("PPM", "L", (43, 33))
    gray = np.asarray(image)
    np.testing.assert_array_equal(gray, levels(low))
    # map_server: p = (255 - gray) / 255; occupied above one threshold, free below the other
    p = (255 - gray.astype(float)) / 255
    assert {level: bool(p[gray == level].max() < header["free_thresh"]) for level in (FREE, UNKNOWN, OCCUPIED)} == {
        FREE: True,
        UNKNOWN: False,
        OCCUPIED: False,
    }
    assert (p[gray == OCCUPIED] > header["occupied_thresh"]).all()
    assert (p[gray == UNKNOWN] < header["occupied_thresh"]).all()
    # the pixel of a table leg, from the origin at the lower left corner
    x, y, turn = header["origin"]
    assert turn == 0
    column, row = int((0.825 + OFF - x) / header["resolution"]), int((1.025 + OFF - y) / header["resolution"])
    assert gray[len(gray) - 1 - row, column] == OCCUPIED


def test_floor_plan_geojson_has_polygons_in_meters(run: Path, tmp_path: Path) -> None:
    export(run, [ExportFormat.FLOORPLAN], tmp_path, Chosen(resolution=RESOLUTION))
    found = json.loads((tmp_path / "floor_plan.geojson").read_text())
    assert found["type"] == "FeatureCollection"
    assert "not longitude and latitude" in found["coordinates_are"]
    assert "crs" not in found
    table, cube, _ = found["features"]
    [ring] = cube["geometry"]["coordinates"]
    assert ring[0] == ring[-1]
    x, y = np.array(ring).T
    assert float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) / 2) == pytest.approx(0.04, abs=1e-4)  # counterclockwise
    assert (min(x), max(x), min(y), max(y)) == pytest.approx((1.25, 1.45, 1.25, 1.45), abs=1e-4)
    assert cube["properties"]["class"] == "cube"
    assert (table["properties"]["base"], table["properties"]["top"]) == pytest.approx((0, 0.75), abs=1e-4)


def test_floor_plan_image_is_deterministic_and_not_blank(run: Path, tmp_path: Path) -> None:
    export(run, [ExportFormat.FLOORPLAN], tmp_path / "a", Chosen(resolution=RESOLUTION))
    export(run, [ExportFormat.FLOORPLAN, ExportFormat.GRAPH], tmp_path / "b", Chosen(resolution=RESOLUTION))
    for name in ("floor_plan.png", "floor_plan.geojson", "map.pgm", "map.yaml"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    image = np.asarray(Image.open(tmp_path / "a" / "floor_plan.png").convert("RGB"))
    assert image.shape[1] > 1200
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 50  # shades, objects and text


@pytest.mark.filterwarnings("error")
def test_floor_plan_accepts_any_class_name(tmp_path: Path) -> None:
    names = ("日本 $x_1$", "a" * 3000, "")
    run = ExportedRoom().write(tmp_path / "run")
    entries = json.loads((run / "instances.json").read_text())
    for entry, name in zip(entries, names, strict=True):
        entry["class"] = name
    (run / "instances.json").write_text(json.dumps(entries))
    export(run, [ExportFormat.FLOORPLAN, ExportFormat.GRAPH], tmp_path, Chosen(resolution=RESOLUTION))
    found = json.loads((tmp_path / "scene_graph.json").read_text())
    jsonschema.validate(found, SCHEMA)
    assert tuple(node["class"] for node in found["nodes"][:3]) == names


def test_floor_plan_of_room_without_objects_is_written(tmp_path: Path) -> None:
    run = ExportedRoom().write(tmp_path / "run")
    (run / "instances.json").unlink()
    assert len(export(run, [ExportFormat.FLOORPLAN, ExportFormat.GRAPH], tmp_path, Chosen(resolution=RESOLUTION))) == 5
    found = json.loads((tmp_path / "scene_graph.json").read_text())
    assert [node["kind"] for node in found["nodes"]] == ["floor", "walls", "room"]
    assert found["edges"] == []


def test_relations_cube_is_on_table_and_table_on_floor(room: UprightRoom, low: Plan) -> None:
    found = relations(room, low)
    assert expected(found, 2) == [("on", 1)]
    assert expected(found, 1) == [("on", "floor")]
    assert expected(found, 3) == [("attached_to", "walls")]
    assert next(one for one in found if one.source == 2).measures["height"] == pytest.approx(0.75, abs=0.02)
    without = relations(room, None)
    assert expected(without, 2) == [("on", 1)]
    assert expected(without, 1) == expected(without, 3) == []


def test_relations_stacked_object_is_on_object_below(tmp_path: Path) -> None:
    """The top of the lower object is occluded and missing in the mesh."""
    lower, upper = (1.2, 1.2, 0.75, 1.4, 1.4, 0.85), (1.2, 1.2, 0.85, 1.4, 1.4, 0.95)
    room = stored(tmp_path, things={"dining table": TABLE, "book": [lower], "other": [upper]})
    found = relations(room, None)
    assert expected(found, 2) == [("on", 1)]
    assert expected(found, 3) == [("on", 2)]


def test_relations_objects_on_same_table_are_next_to_each_other(tmp_path: Path) -> None:
    things = {
        "dining table": TABLE,
        "book": [(1.0, 1.2, 0.75, 1.2, 1.4, 0.79)],
        "cup": [(1.4, 1.2, 0.75, 1.5, 1.3, 0.85)],
        "far": [(3.2, 0.4, 0.0, 3.6, 0.8, 0.5)],
    }
    found = relations(stored(tmp_path, things=things), None)
    assert expected(found, 2) == [("on", 1), ("next_to", 3)]
    assert expected(found, 3) == [("on", 1)]
    gap = next(one.measures["distance"] for one in found if one.name == "next_to")
    assert gap == pytest.approx(0.2, abs=0.03)
    assert not [one for one in found if 4 in (one.source, one.target)]


CUPBOARD: list[Block] = [
    (1.0, 2.6, 0.0, 1.02, 3.0, 1.0),
    (1.98, 2.6, 0.0, 2.0, 3.0, 1.0),
    (1.0, 2.98, 0.0, 2.0, 3.0, 1.0),
    *((1.02, 2.6, z, 1.98, 2.98, z + 0.02) for z in (0.0, 0.5, 0.98)),
]


def test_relations_objects_inside_container_have_relation_in(tmp_path: Path) -> None:
    box: list[Block] = [
        (2.6, 0.6, 0.0, 3.2, 1.2, 0.02),
        (2.6, 0.6, 0.0, 2.62, 1.2, 0.5),
        (3.18, 0.6, 0.0, 3.2, 1.2, 0.5),
        (2.62, 0.6, 0.0, 3.18, 0.62, 0.5),
        (2.62, 1.18, 0.0, 3.18, 1.2, 0.5),
    ]
    things = {
        "cupboard": CUPBOARD,
        "book": [(1.4, 2.7, 0.52, 1.6, 2.9, 0.75)],
        "box": box,
        "ball": [(2.8, 0.8, 0.02, 3.0, 1.0, 0.22)],
        "vase": [(1.4, 2.7, 1.0, 1.5, 2.8, 1.2)],
    }
    found = relations(stored(tmp_path, things=things), None)
    assert expected(found, 2) == [("in", 1)]
    assert expected(found, 4) == [("in", 3)]
    assert expected(found, 5) == [("on", 1)]


SEAT: list[Block] = [(1.0, 1.0, 0.0, 2.0, 1.8, 0.4), (1.0, 1.7, 0.4, 2.0, 1.8, 0.9)]
ARMS: list[Block] = [(1.0, 1.0, 0.4, 1.1, 1.7, 0.7), (1.9, 1.0, 0.4, 2.0, 1.7, 0.7)]


@pytest.mark.parametrize("seat", [SEAT, SEAT + ARMS])
def test_relations_pillow_is_on_couch(seat: list[Block], tmp_path: Path) -> None:
    """The back of the couch is higher than its seat."""
    things = {"couch": seat, "pillow": [(1.3, 1.3, 0.4, 1.7, 1.6, 0.6)]}
    assert expected(relations(stored(tmp_path, things=things), None), 2) == [("on", 1)]


def test_relations_bag_under_table_is_on_floor(tmp_path: Path) -> None:
    things = {"dining table": TABLE, "bag": [(1.2, 1.2, 0.0, 1.5, 1.5, 0.3)]}
    room = stored(tmp_path, things=things)
    assert expected(relations(room, plan(room, RESOLUTION, 0.5)), 2) == [("on", "floor")]


def test_scene_graph_matches_schema(run: Path, tmp_path: Path) -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    [path] = export(run, [ExportFormat.GRAPH], tmp_path, Chosen(resolution=RESOLUTION))
    graph = json.loads(path.read_text())
    jsonschema.validate(graph, SCHEMA)
    names = [node["id"] for node in graph["nodes"]]
    assert names == ["dining_table_1", "cube_2", "picture_3", "floor", "walls", "room_1"]
    edges = {(edge["source"], edge["relation"], edge["target"]) for edge in graph["edges"]}
    assert ("cube_2", "on", "dining_table_1") in edges
    assert ("cube_2", "in", "room_1") in edges
    assert all(edge[0] in names and edge[2] in names for edge in edges)
    assert graph["nodes"][-1]["area"] == pytest.approx(12, rel=0.1)
    np.testing.assert_allclose(graph["nodes"][1]["obb"]["center"], (1.35, 1.35, 0.85), atol=1e-3)


def divided(door: float) -> list[Block]:
    """Return a wall that divides the floor into two rooms of 4 x 3 m. Its door is `door` m wide."""
    low, high = 1.5 - door / 2, 1.5 + door / 2
    return [(4.0, 0.0, 0.0, 4.1, low, 2.5), (4.0, high, 0.0, 4.1, 3.0, 2.5)]


TWO_ROOMS = {
    "things": {"dining table": TABLE, "bed": [(6.0, 1.0, 0.0, 7.9, 2.5, 0.5)]},
    "walls": [(0, 0, 0, 8, 3, 2.5)],
    "eyes": ((0.4, 0.4, 1.5), (3.5, 2.5, 1.5), (4.6, 0.4, 1.5), (7.5, 2.6, 1.5)),
}


def test_scene_graph_door_separates_two_rooms(tmp_path: Path) -> None:
    run = ExportedRoom(**TWO_ROOMS, blocks=divided(0.9), R_world_room=Y_UP).write(tmp_path / "run")  # type: ignore[arg-type]
    [path] = export(run, [ExportFormat.GRAPH])
    graph = json.loads(path.read_text())
    jsonschema.validate(graph, SCHEMA)
    assert [node["id"] for node in graph["nodes"] if node["kind"] == "room"] == ["room_1", "room_2"]
    of = {edge["source"]: edge["target"] for edge in graph["edges"] if edge["target"].startswith("room")}
    assert {of["dining_table_1"], of["bed_2"]} == {"room_1", "room_2"}
    [door] = [edge for edge in graph["edges"] if edge["relation"] == "door"]
    # the room is turned about the center of the map on the floor, whose y is 0 in this world frame
    assert door["place"] == pytest.approx([4.05, 0], abs=0.15)
    assert door["width"] == pytest.approx(0.9, abs=0.15)
    areas = [node["area"] for node in graph["nodes"] if node["kind"] == "room"]
    assert areas == pytest.approx([12, 12], rel=0.1)


def test_rooms_with_wide_opening_are_one_room(tmp_path: Path) -> None:
    room = stored(tmp_path, **TWO_ROOMS, blocks=divided(1.6))
    assert rooms(plan(room, RESOLUTION, 1.0)).count == 1


def by_hand(text: str) -> Plan:
    """Return a floor plan from text with cells of 0.5 m: # = wall, . = free, o = occupied, space = unknown."""
    rows = np.array([list(row) for row in text.split("\n")])[::-1]
    free, wall, occupied = rows == ".", rows == "#", rows == "o"
    return Plan(0.5, np.zeros(2), occupied | wall, free, free, wall, np.zeros(rows.shape, np.int32))


def test_rooms_are_separated_by_wall_with_door() -> None:
    one = by_hand(
        "##############\n#......o.....#\n#......o.....#\n#......o.....#\n#............#\n#.. .........#\n##############"
    )
    assert rooms(one).count == 1
    two = by_hand(
        "##############\n#......#.....#\n#......#.....#\n#............#\n#......#.....#\n#......#.....#\n##############"
    )
    found = rooms(two)
    assert found.count == 2
    assert found.area(1) >= found.area(2) > 1
    assert found.of(np.array([[1.1, 1.1]])) == 1
    assert found.of(np.array([[5.2, 1.2]])) == 2
    assert rooms(by_hand("    \n    ")).count == 0


def test_plan_export_without_up_or_floor_raises(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = ExportedRoom().write(tmp_path / "run", figures=False)
    for kind in (ExportFormat.FLOORPLAN, ExportFormat.GRAPH):
        with pytest.raises(DataError, match=f"expected an up direction for {kind.value}.*--up X Y Z"):
            export(run, [kind])
    with pytest.raises(DataError, match=r"expected a floor height for floorplan.*--floor M"):
        export(run, [ExportFormat.FLOORPLAN], up=(0, 0, 1))
    [path] = export(run, [ExportFormat.GRAPH], up=(0, 0, 1))
    assert "floor, walls and rooms" in caplog.text
    assert {node["kind"] for node in json.loads(path.read_text())["nodes"]} == {"object"}
    assert len(export(run, [ExportFormat.FLOORPLAN], up=(0, 0, 1), floor=0)) == 4


def test_plan_parameters_out_of_range_raise(room: UprightRoom, monkeypatch: pytest.MonkeyPatch) -> None:
    for wrong in ({"resolution": 0.0}, {"robot_height": 9.0}, {"min_probability": float("nan")}):
        with pytest.raises(Exception, match=f"{next(iter(wrong))}"):
            Chosen(**wrong)
    monkeypatch.setattr(occupancy, "MAX_CELLS", 100)
    with pytest.raises(DataError, match=r"plan: expected at most .* cells, got 43 x 33 cells"):
        plan(room, RESOLUTION, 1.0)


def test_plan_without_furniture_fronts_has_no_wall_there(room: UprightRoom, low: Plan) -> None:
    heights = room.mesh.vertices[:, 2]
    structure = np.where((heights > 0.01) & (heights < 2.49), np.uint8(Structure.FRONT), np.uint8(0))
    fronts = replace(room, mesh=replace(room.mesh, structure=structure))
    assert low.wall.any()
    assert not plan(fronts, RESOLUTION, 0.5).wall.any()


def test_plan_wall_of_map_may_be_low(room: UprightRoom) -> None:
    low_part = room.mesh.vertices[:, 2] < 0.3
    triangles = room.mesh.triangles[low_part[room.mesh.triangles].all(axis=1)]
    mesh = replace(room.mesh, triangles=triangles)
    walls = replace(mesh, structure=np.full(len(low_part), Structure.WALL, np.uint8))
    assert not plan(replace(room, mesh=mesh), RESOLUTION, 0.5).wall.any()
    assert plan(replace(room, mesh=walls), RESOLUTION, 0.5).wall.any()

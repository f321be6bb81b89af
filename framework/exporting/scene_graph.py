"""Scene graphs with objects, rooms and their relations.

The file format is defined by scene_graph.schema.json.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from framework.exporting.occupancy import Plan
from framework.exporting.relations import Relation, relations
from framework.exporting.rooms import Rooms, rooms
from framework.exporting.upright_room import RoomObject, UprightRoom
from framework.files.json_file import write_json
from framework.vocabulary.label_spaces import label_space_of

DIGITS = 4  # decimal places of lengths in m and areas in m^2


def write_scene_graph(path: Path, room: UprightRoom, plan: Plan | None) -> None:
    """Write the scene graph of a room.

    Without a floor plan, the floor, walls and rooms are omitted.
    """
    write_json(path, scene_graph(room, plan))


def scene_graph(room: UprightRoom, plan: Plan | None) -> dict[str, Any]:
    """Return the scene graph of a room as JSON-serializable data."""
    divided = rooms(plan) if plan is not None else None
    nodes = [_object_node(one) for one in room.objects]
    edges = _edges(room, relations(room, plan))
    if divided is not None:
        nodes += [{"id": "floor", "kind": "floor"}, {"id": "walls", "kind": "walls"}, *_room_nodes(divided)]
        edges += _room_edges(room, divided)
    label_space = label_space_of(room.mesh.classes)
    origin = {"map_origin": list(room.origin)} if room.origin else {}
    T_room_world = room.T_room_world.tolist()
    return {"T_room_world": T_room_world, **origin, "label_space": label_space, "nodes": nodes, "edges": edges}


def _object_node(one: RoomObject) -> dict[str, Any]:
    return {
        "id": one.name,
        "kind": "object",
        "instance": one.id,
        "class": one.class_name,
        "probability": one.probability,
        "confidence": one.confidence,
        "exists": one.existence,
        "obb": {
            "center": np.round(one.box.center, DIGITS).tolist(),
            "extent": np.round(one.box.extent, DIGITS).tolist(),
            "rotation": one.box.rotation.tolist(),
        },
    }


def _room_nodes(divided: Rooms) -> list[dict[str, Any]]:
    return [
        {
            "id": f"room_{k}",
            "kind": "room",
            "area": round(divided.area(k), DIGITS),
            "center": np.round(divided.center(k), DIGITS).tolist(),
        }
        for k in range(1, divided.count + 1)
    ]


def _edges(room: UprightRoom, found: list[Relation]) -> list[dict[str, Any]]:
    names: dict[int | str, str] = {one.id: one.name for one in room.objects}
    return [
        {
            "source": names[one.source],
            "relation": one.name,
            "target": names.get(one.target, str(one.target)),
            **{key: round(value, DIGITS) for key, value in one.measures.items()},
        }
        for one in found
    ]


def _room_edges(room: UprightRoom, divided: Rooms) -> list[dict[str, Any]]:
    """Return the edges between objects and rooms, and the doors between rooms."""
    inside = [(one, divided.of(room.mesh.vertices[one.vertices, :2].astype(np.float64))) for one in room.objects]
    placed = [{"source": one.name, "relation": "in", "target": f"room_{k}"} for one, k in inside if k]
    doors = [
        {
            "source": f"room_{door.rooms[0]}",
            "relation": "door",
            "target": f"room_{door.rooms[1]}",
            "place": np.round(door.place, DIGITS).tolist(),
            "width": round(door.width, DIGITS),
        }
        for door in divided.doors
    ]
    return placed + doors

"""The footprints of objects as GeoJSON, in metres of the room.

RFC 7946 takes coordinates for longitude and latitude; these are not, and the file says so in its first lines.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from framework.data import Float64
from framework.exporting.upright_room import RoomObject, UprightRoom
from framework.files.json_file import write_json

COORDINATES = "metres in the room: x, y; z is up, and the floor at 0. They are not longitude and latitude."
DIGITS = 4  # behind the point, of metres


def write_geojson(path: Path, room: UprightRoom) -> None:
    """Writes a polygon for each object: the outline of its convex hull, counterclockwise."""
    write_json(
        path,
        {
            "type": "FeatureCollection",
            "coordinates_are": COORDINATES,
            "T_room_world": room.T_room_world.tolist(),
            "features": [_feature(room, one) for one in room.objects],
        },
    )


def outline(room: UprightRoom, one: RoomObject) -> Float64:
    """(N, 2) m, the corners of an object's hull on the floor, counterclockwise; of its box where it has no area."""
    points = room.mesh.vertices[one.vertices, :2]
    hull = cv2.convexHull(np.ascontiguousarray(points), clockwise=False)[:, 0].astype(np.float64)
    return hull if len(hull) >= 3 else one.footprint


def _feature(room: UprightRoom, one: RoomObject) -> dict[str, Any]:
    ring = np.round(outline(room, one), DIGITS).tolist()
    return {
        "type": "Feature",
        "id": one.id,
        "properties": {
            "name": one.name,
            "class": one.class_name,
            "probability": one.probability,
            "confidence": one.confidence,
            "base": round(one.base, DIGITS),
            "top": round(one.top, DIGITS),
            "box": np.round(one.footprint, DIGITS).tolist(),
        },
        "geometry": {"type": "Polygon", "coordinates": [[*ring, ring[0]]]},
    }

"""Stored run of a room made of boxes: a table on the floor, a cube on the table and a picture on the wall."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from framework.data import Float64, Instance, InstanceMesh
from framework.files.tum_trajectory import write_tum
from framework.geometry import transform
from framework.mapping.instances.instance_list import aligned_box, box_around
from framework.rendering.viewpoint import looking
from framework.runs.instances_file import write_instances
from framework.runs.mesh_file import write_mesh

SIDE = 0.05  # m, size of the squares of a face, two triangles each
UP = np.array([0.0, 0.0, 1.0])
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # R_world_room of a world frame with y up
Block = tuple[float, float, float, float, float, float]  # x0 y0 z0 x1 y1 z1 m

WALLS: list[Block] = [(0, 0, 0, 4, 3, 2.5)]  # walls, floor and ceiling, visible from inside
TABLE: list[Block] = [
    (0.8, 1.0, 0.7, 2.0, 1.8, 0.75),
    *((x, y, 0, x + 0.05, y + 0.05, 0.7) for x in (0.8, 1.95) for y in (1.0, 1.75)),
]
CUBE: list[Block] = [(1.2, 1.2, 0.75, 1.4, 1.4, 0.95)]
PICTURE: list[Block] = [(2.8, 2.95, 1.2, 3.3, 3.0, 1.6)]


def faces(block: Block, inward: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices (V, 3), m, and triangles (T, 3) of a box. The triangles face outward unless `inward`."""
    low, high = np.array(block[:3]), np.array(block[3:])
    vertices, triangles, count = [], [], 0
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        n = [max(1, round((high[k] - low[k]) / SIDE)) for k in (u, v)]
        grid = np.stack(np.meshgrid(*(np.linspace(low[k], high[k], m + 1) for k, m in zip((u, v), n, strict=True))), -1)
        number = np.arange((n[0] + 1) * (n[1] + 1)).reshape(n[1] + 1, n[0] + 1)
        a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
        quads = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
        for at, outward in ((low[axis], False), (high[axis], True)):
            points = np.empty((grid[..., 0].size, 3))
            points[:, axis], points[:, [u, v]] = at, grid.reshape(-1, 2)
            vertices.append(points)
            triangles.append((quads if outward != inward else quads[:, ::-1]) + count)
            count += len(points)
    return np.concatenate(vertices), np.concatenate(triangles)


def look_about(places: Sequence[tuple[float, float, float]], n: int = 12) -> Float64:
    """Return T_room_camera (F, 4, 4) of cameras at `places` (m), in `n` directions and at three pitch angles."""
    poses = []
    for place in places:
        for angle in np.linspace(0, 2 * np.pi, n, endpoint=False):
            for down in (0.15, 0.6, 1.5):
                pose = np.eye(4)
                pose[:3, :3] = looking(np.array([np.cos(angle), np.sin(angle), -down]), UP)
                pose[:3, 3] = place
                poses.append(pose)
    return np.array(poses)


@dataclass
class ExportedRoom:
    """A room with objects and camera positions."""

    things: dict[str, list[Block]] = field(
        default_factory=lambda: {"dining table": TABLE, "cube": CUBE, "picture": PICTURE}
    )
    walls: list[Block] = field(default_factory=lambda: WALLS)
    blocks: list[Block] = field(default_factory=list)  # boxes that belong to no object, visible from outside
    eyes: Sequence[tuple[float, float, float]] = ((0.4, 0.4, 1.5), (3.5, 2.5, 1.5), (0.4, 2.6, 1.5), (3.5, 0.4, 1.5))
    R_world_room: Float64 = field(default_factory=lambda: np.eye(3))
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, position of the room in the world frame

    @property
    def T_world_room(self) -> Float64:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.R_world_room, self.shift
        return T

    def mesh(self) -> InstanceMesh:
        """Return the mesh in the world frame. Objects are numbered from 1 in the order of `things`."""
        solid = [(k, block, False) for k, blocks in enumerate(self.things.values(), start=1) for block in blocks]
        solid += [(0, block, False) for block in self.blocks] + [(0, block, True) for block in self.walls]
        vertices, triangles, ids, count = [], [], [], 0
        for key, block, inward in solid:
            points, corners = faces(block, inward)
            vertices.append(points)
            triangles.append(corners + count)
            ids.append(np.full(len(points), key))
            count += len(points)
        owner = np.concatenate(ids).astype(np.int32)
        palette = np.array([[180, 180, 180], [120, 60, 20], [220, 30, 30], [30, 30, 220], [20, 160, 20]], np.uint8)
        placed = transform(self.T_world_room, np.concatenate(vertices))
        return InstanceMesh(
            placed.astype(np.float32),
            np.concatenate(triangles).astype(np.int32),
            palette[owner % len(palette)],
            owner,
            np.where(owner > 0, owner - 1, -1).astype(np.int32),
            tuple(self.things),
        )

    def write(self, run: Path, figures: bool = True) -> Path:
        """Write a run directory. Without `figures`, metrics.json has no up direction and no floor height."""
        run.mkdir(parents=True, exist_ok=True)
        mesh, up = self.mesh(), self.R_world_room @ UP
        write_mesh(run / "mesh.ply", mesh)
        found = {}
        for key in range(1, len(self.things) + 1):
            own = np.flatnonzero(mesh.instance_ids == key).astype(np.int32)
            points = mesh.vertices[own]
            probabilities = np.full(len(self.things), 0.1 / max(len(self.things) - 1, 1), np.float32)
            probabilities[key - 1] = 0.9
            found[key] = Instance(key, probabilities, 0.8, 5, 0, 9, own, aligned_box(points), box_around(points, up))
        write_instances(run / "instances.json", mesh, found, tuple(self.things))
        room = {f"map.up.{axis}": value for axis, value in zip("xyz", up.tolist(), strict=True)}
        room["map.floor_m"] = float(np.array(self.shift) @ up)
        (run / "metrics.json").write_text(json.dumps({"instances.count": len(found), **(room if figures else {})}))
        poses = self.T_world_room @ look_about(self.eyes)
        write_tum(run / "trajectory.txt", np.arange(len(poses)) / 30, poses)
        return run

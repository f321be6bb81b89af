"""Changes during a synthetic sequence: a person, a door, lights, and a camera that stops."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from framework.data import Camera, Float32, Float64
from framework.rendering.rasterizer import Rasterizer
from framework.synthetic.furniture.piece import Furniture, Rng
from framework.synthetic.furniture.solids import axis_rotation
from framework.synthetic.lights import WALL_BRIGHTNESS
from framework.synthetic.renderer import Rendering, to_srgb
from framework.synthetic.shading_kernels import LitSurfaces, Viewpoint, lose_readings, shade
from framework.synthetic.surfaces import Surfaces, assemble
from framework.synthetic.walk import FRAME_RATE, CameraPath
from framework.synthetic.walking_person import part_poses, person

PERSON_DISTANCE = 0.35  # m, distance of the person's path from the camera path
SWEEP, SWEEP_PERIOD = 0.8, 5.0  # rad and s, amplitude and period of the person's motion across the view
DOOR_ANGLE, DOOR_PERIOD = np.deg2rad(80.0), 6.0  # maximum angle and period of the door, rad and s
LEAF = (0, 1, 2, 6)  # parts of furniture.clutter.door that turn
SWITCHED, SWITCH_PERIOD = 0.5, 2.0  # brightness after the switch, and time between two switches, s
PAUSE = 60  # frames, alternating lengths of motion and pause


class Dynamics(StrEnum):
    """Change during a synthetic sequence."""

    NONE = "none"
    PERSON = "person"  # a person walks to and fro in front of the camera, at up to about 2 m/s
    DOOR = "door"  # the door of the room opens and closes
    LIGHTS = "lights"  # half of the light is switched off and on, and the rest changes slowly
    PAUSE = "pause"  # the camera stops and starts abruptly, every two seconds

    def camera_frame(self, frame: float) -> float:
        """Return the frame of the steady camera path whose pose the camera has at `frame`."""
        if self is not Dynamics.PAUSE:
            return frame
        return PAUSE * (frame // (2 * PAUSE)) + min(frame % (2 * PAUSE), PAUSE)

    def brightness(self, frame: float) -> float:
        """Return the brightness of the light, relative to the constant light."""
        if self is not Dynamics.LIGHTS:
            return 1.0
        time = frame / FRAME_RATE
        return (SWITCHED if time // SWITCH_PERIOD % 2 else 1.0) * (0.8 + 0.2 * float(np.cos(2 * np.pi * time / 5.0)))


@dataclass(frozen=True)
class MovingObject:
    """An object of rigid parts that move."""

    surfaces: Surfaces  # each part in its own frame
    poses: Callable[[float], Float64]  # T_world_part (P, 4, 4) of the parts at a frame

    def vertices_at(self, frame: float) -> Float32:
        """Return the vertices (V, 3) at a frame, m, world frame."""
        return self._moved(frame, self.surfaces.vertices, 1.0)

    def _moved(self, frame: float, vectors: Float32, w: float) -> Float32:
        """Return points (w = 1) or directions (w = 0) of the vertices (V, 3) in the world frame."""
        part = np.zeros(len(vectors), np.int32)
        part[self.surfaces.triangles] = self.surfaces.parts[:, None]
        T = self.poses(frame)[part]
        return np.asarray(np.einsum("vij,vj->vi", T[:, :3, :3], vectors) + w * T[:, :3, 3], np.float32)

    def render(self, camera: Camera, T_world_camera: Float64, frame: float, brightness: float = 1.0) -> Rendering:
        """Return a view of the object alone, in diffuse light from above."""
        s, vertices = self.surfaces, self.vertices_at(frame)
        corners = vertices[s.triangles].astype(np.float64)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        up = self._moved(frame, s.normals, 0.0)[:, 2:]
        lit = LitSurfaces(
            texture=s.texture,
            irradiance=np.repeat((WALL_BRIGHTNESS * (0.75 + 0.25 * up)).astype(np.float32), 3, axis=1),
            triangles=s.triangles,
            normals=normals.astype(np.float32),
            materials=s.materials,
            parts=s.parts,
            table=s.material_table,
        )
        buffer = Rasterizer(vertices, s.triangles).draw(camera, T_world_camera)
        T = np.ascontiguousarray(T_world_camera, np.float64)
        view = Viewpoint(T, *(float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy)))
        light, incidence = np.empty((*camera.shape, 3), np.float32), np.empty(camera.shape, np.float32)
        shade(lit, view, buffer.triangle, buffer.depth, buffer.uv, light, incidence)
        unread = np.empty(camera.shape, np.float32)
        lose_readings(s.materials, s.material_table, buffer.triangle, incidence, unread)
        ids = np.append(s.instance_ids, np.int32(0))[buffer.triangle]
        return Rendering(to_srgb(light * np.float32(brightness)), buffer.depth, ids, incidence, unread)


def in_front(moving: Rendering, room: Rendering) -> Rendering:
    """Return the view of a room with a moving object."""
    nearer = (moving.depth > 0) & ((room.depth == 0) | (moving.depth < room.depth))
    return Rendering(
        color=np.where(nearer[..., None], moving.color, room.color),
        depth=np.where(nearer, moving.depth, room.depth),
        instance_ids=np.where(nearer, moving.instance_ids, room.instance_ids),
        incidence=np.where(nearer, moving.incidence, room.incidence),
        unread=np.where(nearer, moving.unread, room.unread),
    )


def walking_person(instance: int, path: CameraPath, frames: int, rng: Rng) -> MovingObject:
    """Return a person who walks to and fro on the opposite side of the camera's ellipse.

    Args:
        instance: The instance id.
        path: The camera path.
        frames: The number of frames.
        rng: The random number generator.
    """
    surfaces = assemble([(instance, person(rng))])
    times = np.arange(frames + 1) / FRAME_RATE
    phase = path.start + path.turn * path.phase_speed * times + np.pi
    phase += SWEEP * np.sin(2 * np.pi * times / SWEEP_PERIOD)
    positions = path.center + (path.radii + PERSON_DISTANCE) * np.stack([np.cos(phase), np.sin(phase)], axis=1)
    steps = np.gradient(positions, axis=0)
    headings = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    distances = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])

    def poses(frame: float) -> Float64:
        x, y, heading, distance = (
            float(np.interp(frame, np.arange(frames + 1), values))
            for values in (positions[:, 0], positions[:, 1], headings, distances)
        )
        T_world_body = np.eye(4)
        T_world_body[:3, :3], T_world_body[:2, 3] = axis_rotation("z", heading - np.pi / 2), (x, y)
        return part_poses(T_world_body, distance)

    return MovingObject(surfaces, poses)


def opening_door(instance: int, door: Furniture) -> tuple[Furniture, MovingObject]:
    """Return the frame of a door, and its leaf, which opens and closes.

    Args:
        instance: The instance id of the door.
        door: The closed door, in its final pose.
    """
    leaf = replace(door, parts=[door.parts[k] for k in LEAF])
    frame = replace(door, parts=[part for k, part in enumerate(door.parts) if k not in LEAF])
    corners, handle = door.parts[LEAF[0]][0].vertices, door.parts[LEAF[-1]][0].vertices.mean(axis=0)
    hinge = corners[np.linalg.norm((corners - handle)[:, :2], axis=1).argmax()]
    across, out = (corners.mean(axis=0) - hinge)[:2], (handle - corners.mean(axis=0))[:2]
    sign = np.sign(across[0] * out[1] - across[1] * out[0])  # the handle is on the side of the room

    def poses(k: float) -> Float64:
        R = axis_rotation("z", sign * DOOR_ANGLE * (1 - np.cos(2 * np.pi * k / FRAME_RATE / DOOR_PERIOD)) / 2)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, hinge - R @ hinge
        return np.broadcast_to(T, (len(LEAF), 4, 4))

    return frame, MovingObject(assemble([(instance, leaf)]), poses)

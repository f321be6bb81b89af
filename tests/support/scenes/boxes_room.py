"""Room with two boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d

from framework.data import Camera, Frame, InstanceMesh, SceneTruth
from framework.errors import DataError
from framework.interfaces import RGBDSequence
from framework.rendering.viewpoint import looking

Z_UP = np.eye(3)


def box(
    center: tuple[float, ...], extent: tuple[float, ...], inside_out: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    made = o3d.geometry.TriangleMesh.create_box(*extent).subdivide_midpoint(4)
    triangles = np.asarray(made.triangles)
    return np.asarray(made.vertices) - np.array(extent) / 2 + center, triangles[:, ::-1] if inside_out else triangles


def furnished(R: np.ndarray = Z_UP) -> InstanceMesh:
    """Return a room of 4 x 3 x 2.5 m with a red box (1) and a blue box (2). R rotates the world frame."""
    parts = [box((0, 0, 1.25), (4, 3, 2.5), True), box((-1, 0, 0.4), (0.8,) * 3), box((1, 0.3, 0.4), (0.8,) * 3)]
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    ids = np.repeat([0, 1, 2], [len(vertices) for vertices, _ in parts]).astype(np.int32)
    return InstanceMesh(
        vertices=(np.concatenate([vertices for vertices, _ in parts]) @ R.T).astype(np.float32),
        triangles=np.concatenate([t + o for (_, t), o in zip(parts, offsets, strict=False)]).astype(np.int32),
        colors=np.array([[180, 180, 180], [220, 30, 30], [30, 30, 220]], np.uint8)[ids],
        instance_ids=ids,
        class_ids=ids - 1,
        classes=("chair", "couch"),
    )


def walk(R: np.ndarray = Z_UP, n: int = 20) -> np.ndarray:
    """Return camera poses (n, 4, 4) at eye height. The camera looks around the room and slightly down."""
    poses = np.tile(np.eye(4), (n, 1, 1))
    for pose, angle in zip(poses, np.linspace(0, 2 * np.pi, n, endpoint=False), strict=True):
        pose[:3, :3] = R @ looking(np.array([np.cos(angle), np.sin(angle), -0.4]), np.array([0.0, 0, 1]))
        pose[:3, 3] = R @ [0.3 * np.cos(angle), 0.3 * np.sin(angle), 1.5]
    return poses


@dataclass
class BoxesRoom(RGBDSequence):
    """The room as a dataset with a labeled surface, but without frames."""

    scene: str = "boxes"  # sequence name; "gone" cannot be read

    def __post_init__(self) -> None:
        if self.scene == "gone":
            raise DataError("expected an existing scene, got none")
        self.camera, self.name = Camera(4, 3, 3.0, 3.0, 1.5, 1.0), self.scene

    def __len__(self) -> int:
        return 0

    def __getitem__(self, k: int) -> Frame:
        raise IndexError(k)

    def scene_truth(self) -> SceneTruth:
        mesh = furnished()
        return SceneTruth(mesh.vertices, mesh.instance_ids, {1: "chair", 2: "couch"})

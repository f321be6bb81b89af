"""Acceptance tests for the default refiner and fuser.

Touching objects must be separate instances, and each object must be one instance.
"""

import numpy as np
import pytest

from framework.data import Detections, Frame, Pose
from framework.interfaces import MapFuser
from framework.refinement.lifting import lift
from tests.support.registered import built
from tests.support.scenes.box_scene import BoxScene, bled, chair, detected, look_from, table

pytestmark = pytest.mark.acceptance

VOXEL = 0.02  # m
CHAIR, TABLE, COUCH = 0, 1, 2


def mapped(frames: list[Frame], detections: list[Detections], refiner: str = "chain") -> MapFuser:
    """Return the fuser after the frames have been mapped with true poses."""
    cleaner = built("refiner", refiner)
    fuser = built("fuser", "bayesian_tsdf", f"fuser.voxel_size={VOXEL}")
    for frame, found in zip(frames, detections, strict=True):
        pose = Pose(frame.T_world_camera)
        fuser.fuse(frame, pose, cleaner.refine(lift(found, frame, pose), frame))
    return fuser


def shares(scene: BoxScene, fuser: MapFuser) -> np.ndarray:
    """Return the fraction (O + 1, I + 1) of the vertices of each object that belong to each instance.

    Row 0 is the room. Column 0 contains the vertices without an instance.
    """
    mesh = fuser.scene.mesh()
    owners = scene.owners(mesh.vertices, VOXEL)
    ids = [0, *fuser.scene.instances()]
    counts = np.array([[((owners == k) & (mesh.instance_ids == i)).sum() for i in ids] for k in range(scene.count)])
    return counts / counts.sum(axis=1, keepdims=True)


def true_mask(frame: Frame, *objects: int) -> np.ndarray:
    assert frame.truth is not None
    return np.isin(frame.truth.instance_ids, objects)


def assert_one_each(scene: BoxScene, fuser: MapFuser, least: float) -> None:
    """Check that one instance covers at least the fraction `least` of each object, and that the room has none."""
    found = shares(scene, fuser)
    assert found.shape[1] == scene.count, f"expected {scene.count - 1} instances, got {found.shape[1] - 1}"
    assert sorted(found[1:, 1:].argmax(axis=1)) == list(range(scene.count - 1))
    assert (found[1:, 1:].max(axis=1) > least).all(), found.round(3)
    assert found[0, 0] > 0.99, found[0].round(4)


# a fridge and a couch side by side, with contact between two faces
TOUCHING = [[(-0.6, 1.0, 0.0, 0.0, 1.6, 1.5)], [(0.0, 0.9, 0.0, 0.9, 1.6, 0.7)]]


def test_instances_of_touching_objects_are_separated() -> None:
    """Every other frame has one mask for both objects instead of two. All masks bleed by 8 px."""
    scene = BoxScene(TOUCHING)
    frames = [scene.frame(look_from(-1.2 + 0.1 * k, -1.6, 1.4, (0.1, 1.2, 0.5)), k) for k in range(24)]
    detections = []
    for frame in frames:
        first, second = bled(true_mask(frame, 1), 8), bled(true_mask(frame, 2), 8)
        apart = frame.index % 2 == 1
        detections.append(detected([first, second], [TABLE, COUCH]) if apart else detected([first | second], [COUCH]))
    assert_one_each(scene, mapped(frames, detections), 0.9)


def test_instance_of_bleeding_mask_excludes_neighbor() -> None:
    scene = BoxScene(TOUCHING)
    frames = [scene.frame(look_from(-1.2 + 0.1 * k, -1.6, 1.4, (0.1, 1.2, 0.5)), k) for k in range(24)]
    detections = [detected([bled(true_mask(frame, 1), 8)], [TABLE]) for frame in frames]
    found = shares(scene, mapped(frames, detections))
    assert found.shape[1] == 2
    assert found[1, 1] > 0.9
    assert found[2, 1] < 0.03
    bleeding = shares(scene, mapped(frames, detections, refiner="identity"))
    assert bleeding[2, 1] > 2 * found[2, 1]


def test_instances_of_adjacent_chairs_stay_separate() -> None:
    """The chairs are identical and 10 cm apart. A third of their detections are missing."""
    scene = BoxScene([chair(-0.275, 1.2), chair(0.275, 1.2)])
    frames = [
        scene.frame(look_from(2.4 * np.sin(a), 1.2 - 2.4 * np.cos(a), 1.3, (0.0, 1.2, 0.5)), k)
        for k, a in enumerate(np.linspace(-1.3, 1.3, 36))
    ]
    detections = []
    for frame in frames:
        seen = [k for k in (1, 2) if frame.index % 3 != k]
        detections.append(detected([bled(true_mask(frame, k), 4) for k in seen], [CHAIR] * len(seen)))
    assert_one_each(scene, mapped(frames, detections), 0.9)


def test_table_seen_from_two_sides_is_one_instance() -> None:
    """The camera jumps from one side of the table to the other side."""
    scene = BoxScene([table(0.0, 0.0)])
    sides = [(x, y, 1.2) for y in (-2.2, 1.8) for x in np.linspace(-0.8, 0.8, 12)]
    frames = [scene.frame(look_from(*at, (0.0, 0.0, 0.5)), k) for k, at in enumerate(sides)]
    detections = [detected([bled(true_mask(frame, 1), 4)], [TABLE]) for frame in frames]
    assert_one_each(scene, mapped(frames, detections), 0.9)

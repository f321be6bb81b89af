"""A walking person of rigid, rounded parts."""

from __future__ import annotations

import numpy as np

from framework.data import Float64
from framework.synthetic import paints
from framework.synthetic.furniture.piece import Furniture, Rng
from framework.synthetic.furniture.solids import Section, Solid, axis_rotation, lathe, loft, rounded_box
from framework.synthetic.paints import Material, Texture

HIP, SHOULDER = (0.09, 0.92), (0.22, 1.42)  # m, lateral and vertical positions of the joints
THIGH, SHIN, UPPER_ARM, FOREARM = 0.44, 0.42, 0.30, 0.34  # m, lengths
STRIDE = 1.4  # m, path length of two steps
SWING = 0.5  # rad, maximum angle of the thighs from the vertical
SIDES = (-1.0, 1.0)


def person(rng: Rng) -> Furniture:
    """Return the parts of a person, in their own frames: torso, head, then thigh, shin, foot and arms of each side.

    Torso and head are in the frame of the body, which faces +y. A limb hangs from its joint at the origin.
    """
    body = Furniture("person", "person")
    color, white = paints.pick(rng, paints.CLOTHS), (0.90, 0.88, 0.84)
    shirt = Material(Texture.CHECKS, color, white, 0.12, seed=paints.new_seed(rng))
    trousers, skin = paints.cloth(rng, (0.42, 0.46, 0.55)), paints.paint(rng, (0.86, 0.66, 0.54))
    torso = [(0.84, 0.10, 0.08), (0.88, 0.16, 0.11), (1.15, 0.15, 0.11), (1.40, 0.19, 0.12), (1.50, 0.06, 0.06)]
    body.add(loft([Section(*section) for section in torso]), shirt)
    body.add(lathe([(1.47, 0.05), (1.54, 0.06), (1.57, 0.09), (1.64, 0.105), (1.71, 0.085), (1.75, 0.03)]), skin)
    for _ in SIDES:
        body.add(_limb(THIGH, 0.08, 0.055), trousers)
        body.add(_limb(SHIN, 0.055, 0.04), trousers)
        body.add(rounded_box(0.09, 0.26, 0.08, 0.03, 2), paints.leather(rng), y=0.06, z=-SHIN - 0.02)
        body.add(_limb(UPPER_ARM, 0.05, 0.04), shirt)
        body.add(_limb(FOREARM, 0.04, 0.03), skin)
    return body


def _limb(length: float, top: float, bottom: float) -> Solid:
    """Return a rounded cone that hangs from the origin. Lengths and radii are in m."""
    ends = [(-length - 0.7 * bottom, 0.5 * bottom), (-length, bottom), (0.0, top), (0.7 * top, 0.5 * top)]
    return lathe(ends, 16)


def part_poses(T_world_body: Float64, distance: float) -> Float64:
    """Return the poses T_world_part (12, 4, 4) of the parts of `person`.

    Args:
        T_world_body: The pose (4, 4) of the body.
        distance: The path length up to now, m, which determines the phase of the steps.
    """
    phase = 2 * np.pi * distance / STRIDE
    poses = [np.eye(4), np.eye(4)]
    for side in SIDES:
        swing = side * np.sin(phase)
        knee = 0.35 * (1 + side * np.cos(phase))  # bent while the leg swings forward
        thigh = _joint(side * HIP[0], HIP[1], SWING * swing)
        shin = thigh @ _joint(0.0, -THIGH, -knee)
        arm = _joint(side * SHOULDER[0], SHOULDER[1], -0.8 * SWING * swing)
        poses += [thigh, shin, shin, arm, arm @ _joint(0.0, -UPPER_ARM, 0.35)]
    return np.asarray(T_world_body @ np.stack(poses))


def _joint(x: float, z: float, angle: float) -> Float64:
    """Return the pose (4, 4) of a limb that hangs from (x, 0, z), m, and is swung forward by an angle in rad."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = axis_rotation("x", angle), (x, 0.0, z)
    return T

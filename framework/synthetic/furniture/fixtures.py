"""Random refrigerators, televisions, toilets and backpacks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from framework.synthetic import paints
from framework.synthetic.furniture.piece import Furniture, Rng
from framework.synthetic.furniture.solids import Section, Solid, cylinder, grid_triangles, loft, rounded_box, tube
from framework.synthetic.paints import Texture


def refrigerator(rng: Rng) -> Furniture:
    """Return a random refrigerator."""
    piece = Furniture("refrigerator", "refrigerator")
    width, depth, height = rng.uniform(0.60, 0.72), rng.uniform(0.60, 0.66), rng.uniform(1.60, 1.82)
    colors = ((0.90, 0.91, 0.91), (0.70, 0.72, 0.74), (0.62, 0.16, 0.14), (0.62, 0.78, 0.74))
    enamel = paints.metal(rng, paints.pick(rng, colors))
    rubber, chrome = paints.paint(rng, (0.13, 0.13, 0.14)), paints.metal(rng, (0.75, 0.76, 0.78))
    piece.add(rounded_box(width - 0.04, depth - 0.10, 0.06, 0.003), rubber, y=-0.03, z=0.03)
    piece.add(rounded_box(width, depth - 0.07, height - 0.05, 0.012, 2), enamel, y=-0.035, z=height / 2 + 0.025)
    piece.add(rounded_box(width - 0.03, 0.02, height - 0.08, 0.002), rubber, y=depth / 2 - 0.065, z=height / 2 + 0.025)
    split = height * rng.uniform(0.62, 0.70)
    hinge = 1 if rng.uniform() < 0.5 else -1
    for low, high in ((0.07, split - 0.006), (split + 0.006, height - 0.005)):
        door = rounded_box(width - 0.004, 0.055, high - low, 0.018, 3)
        piece.add(door, enamel, y=depth / 2 - 0.028, z=(low + high) / 2)
        span = min(0.36, 0.6 * (high - low))
        z = high - 0.06 - span if low < 0.1 else low + 0.06
        x, y = hinge * (width / 2 - 0.055), depth / 2
        grip = [(x, y - 0.005, z), (x, y + 0.04, z + 0.02), (x, y + 0.04, z + span - 0.02), (x, y - 0.005, z + span)]
        piece.add(tube(grip, 0.010), chrome)
    for _ in range(int(rng.integers(2, 6))):  # notes held by magnets
        w, h = rng.uniform(0.06, 0.14), rng.uniform(0.06, 0.16)
        note = rounded_box(w, 0.004, h, 0.001).flat(0, 2)
        x, z = rng.uniform(-0.22, 0.22) * width, rng.uniform(0.45, 0.62) * height
        kind = Texture.PAINTING if rng.uniform() < 0.5 else Texture.BOOK
        piece.add(note, paints.picture(rng, kind, w, h), x, depth / 2 + 0.0015, z)
    return piece


def tv(rng: Rng) -> Furniture:
    """Return a flat-screen television on a stand."""
    piece = Furniture("tv", "tv")
    width = rng.uniform(0.90, 1.20)
    height = width * 9 / 16
    case = paints.paint(rng, (0.09, 0.09, 0.10), 1.5)
    piece.add(rounded_box(width, 0.035, height, 0.010, 2), case, z=height / 2 + 0.07)
    piece.add(rounded_box(0.5 * width, 0.04, 0.5 * height, 0.012, 2), case, y=-0.03, z=height / 2 + 0.05)
    glass = rounded_box(width - 0.03, 0.004, height - 0.035, 0.001).flat(0, 2)
    mirrored = replace(glass, texture=glass.texture * (-1, 1, 1) + (width - 0.03, 0, 0))
    screen = paints.picture(rng, Texture.SCREEN, width - 0.03, height - 0.035, emission=0.85)
    piece.add(mirrored, screen, y=0.0175, z=height / 2 + 0.073)
    piece.add(rounded_box(0.10, 0.03, 0.09, 0.006), case, y=-0.012, z=0.05)
    foot = [Section(0.0, 0.22 * width, 0.10, n=3.5), Section(0.014, 0.21 * width, 0.09, n=3.5)]
    piece.add(loft(foot, 32), case)
    return piece


def toilet(rng: Rng) -> Furniture:
    """Return a random toilet."""
    piece = Furniture("toilet", "toilet")
    white = paints.glaze(rng, (0.93, 0.93, 0.91), 0.95, 0.05)
    seat_color = paints.paint(rng, (0.88, 0.88, 0.86), 0.93, 0.05) if rng.uniform() < 0.6 else paints.wood(rng)
    chrome, water = paints.metal(rng, (0.78, 0.79, 0.80)), paints.paint(rng, (0.72, 0.80, 0.84))
    rim = rng.uniform(0.38, 0.41)
    foot = [(0.0, 0.115, 0.19, -0.04, 2.6, 1.05), (0.03, 0.110, 0.185, -0.04, 2.6, 1.05)]
    waist = [(0.14, 0.100, 0.16, -0.04, 2.4, 1.05), (0.24, 0.125, 0.17, -0.01, 2.2, 1.25)]
    top = [(0.32, 0.165, 0.19, 0.02, 2.1, 1.30), *((z, 0.182, 0.20, 0.03, 2.1, 1.32) for z in (rim - 0.02, rim))]
    bowl = [Section(z, a, b, 0, y, n, front) for z, a, b, y, n, front in (*foot, *waist, *top)]
    piece.add(loft(bowl, 40, 0.05), white)
    piece.add(rounded_box(0.24, 0.20, 0.30, 0.03, 3), white, y=-0.21, z=rim - 0.16)
    opened = rng.uniform() < 0.5
    shape = (0.0, 0.182, 0.20), (0.012, 0.190, 0.205), (0.026, 0.182, 0.20)
    lid = [Section(z, a, b, n=2.15, front=1.30) for z, a, b in shape]
    if opened:
        surface = (0.0, 0.118, 0.125), (0.003, 0.116, 0.123)
        inside = [Section(z, a, b, y=0.035, n=2.1, front=1.42) for z, a, b in surface]
        piece.add(_ring(0.185, 0.203, 0.118, 0.125, 0.03, 1.32, 1.42), seat_color, z=rim)
        piece.add(loft(inside, 40), water, z=rim + 0.001)
        raised = loft(lid, 40, 0.05).moved(y=0.20).turned("x", np.pi / 2)
        piece.add(raised, seat_color, y=-0.16, z=rim + 0.02)
    else:
        for flatter, height, material in ((0.7, 0.001, white), (1.0, 0.020, seat_color)):
            closed = [Section(s.z * flatter, s.a, s.b, 0, 0.03, s.n, 1.32) for s in lid]
            piece.add(loft(closed, 40, 0.05), material, z=rim + height)
    tank = rng.uniform(0.36, 0.42)
    piece.add(rounded_box(tank, 0.17, 0.36, 0.035, 4, 0.06), white, y=-0.285, z=rim + 0.16)
    piece.add(rounded_box(tank + 0.02, 0.19, 0.035, 0.014, 3), white, y=-0.285, z=rim + 0.352)
    piece.add(cylinder(0.025, 0.012), chrome, y=-0.285, z=rim + 0.368)
    return piece


def _ring(a: float, b: float, inner_a: float, inner_b: float, height: float, front: float, inner_front: float) -> Solid:
    """Return a toilet seat, an egg-shaped ring with its base at z = 0.

    `a`, `b` and `front` describe the outer edge as in Section. The other parameters describe the inner edge.
    """
    n, m = 40, 8
    around, across = np.meshgrid(np.linspace(0, 2 * np.pi, n + 1), np.linspace(0, 2 * np.pi, m + 1), indexing="ij")
    blend = 0.5 + 0.5 * np.cos(across)  # 1 at the outer edge, 0 at the inner edge
    stretch = np.where(np.sin(around) > 0, blend * front + (1 - blend) * inner_front, 1.0)
    x = (blend * a + (1 - blend) * inner_a) * np.cos(around)
    y = 0.03 + (blend * b + (1 - blend) * inner_b) * np.sin(around) * stretch
    z = height * (0.5 + 0.5 * np.sign(np.sin(across)) * np.abs(np.sin(across)) ** 0.7)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    flat = Solid(vertices, vertices, grid_triangles(n + 1, m + 1, flip=False), vertices)
    return flat.deformed(lambda points: points)


def backpack(rng: Rng) -> Furniture:
    """Return a random backpack."""
    piece = Furniture("backpack", "backpack")
    color = paints.vivid(rng)
    bag, trim = paints.cloth(rng, color), paints.cloth(rng, paints.shade(color, 0.45))
    dark = paints.cloth(rng, (0.15, 0.15, 0.17))
    w, d, h = rng.uniform(0.14, 0.17), rng.uniform(0.085, 0.105), rng.uniform(0.42, 0.50)
    bottom = [(0.0, 0.90, 0.85, 0, 3.5), (0.02, 1.0, 1.0, 0, 3.5), (0.45 * h, 1.04, 1.08, 0, 3.2)]
    top = [(0.75, 0.96, 0.92, 0, 3.0), (0.90, 0.82, 0.70, -0.008, 2.6), (0.97, 0.58, 0.45, -0.014, 2.3)]
    body = [*bottom, *((z * h, *rest) for z, *rest in top), (h, 0.25, 0.18, -0.018, 2.0)]
    piece.add(loft([Section(z, a * w, b * d, 0, y, n) for z, a, b, y, n in body], 36, 0.04), bag)
    hem = [(0.03, 0.72, 0.050, 3.2), (0.07, 0.80, 0.058, 3.2)]
    pocket = [*hem, (0.34 * h, 0.80, 0.054, 3.0), (0.45 * h, 0.66, 0.030, 2.6), (0.48 * h, 0.40, 0.012, 2.4)]
    piece.add(loft([Section(z, a * w, b, n=n) for z, a, b, n in pocket], 30, 0.04), trim, y=0.98 * d)
    flap = loft([Section(0.03, 0.03, 0.06, n=3), Section(0.30 * h, 0.028, 0.055, n=3)], 20)
    strap = np.array([(0.35, -0.75, 0.90), (0.55, -1.30, 0.75), (0.65, -1.45, 0.45), (0.80, -1.00, 0.12)])
    for side in (-1, 1):
        piece.add(flap, trim, side * w)
        piece.add(tube(strap * (side * w, d, h), 0.022, 8), dark)
    arch = np.array([(-0.97, 0.3, 0.50), (-0.80, 0.66, 0.76), (0.0, 0.74, 0.86), (0.80, 0.66, 0.76), (0.97, 0.3, 0.50)])
    piece.add(tube(arch * (w, d, h), 0.006, 6), dark)
    piece.add(tube([(-0.03, -0.02, h - 0.015), (0.0, -0.02, h + 0.035), (0.03, -0.02, h - 0.015)], 0.008, 8), dark)
    return piece

"""Random clutter, i.e. objects without a class that are excluded from evaluation."""

from __future__ import annotations

import numpy as np

from framework.data import Float64
from framework.synthetic import paints
from framework.synthetic.furniture.piece import Furniture, Rng
from framework.synthetic.furniture.solids import Solid, cushion, cylinder, lathe, leg, panel, rounded_box, tube
from framework.synthetic.paints import Material, Texture

WEAVE = 0.04  # m, vertex spacing of cloth with creases
LAMP_GLOW = 2.2  # emission of a lampshade, 1 = radiance of a white wall in the mean light of the room


def cupboard(rng: Rng) -> Furniture:
    """Return a cupboard with two doors."""
    piece = Furniture("cupboard")
    width, depth, height = rng.uniform(0.9, 1.2), rng.uniform(0.45, 0.58), rng.uniform(1.8, 2.05)
    body, knob = paints.wood(rng), paints.metal(rng)
    piece.add(rounded_box(width - 0.03, depth - 0.05, 0.07, 0.003), body, y=-0.01, z=0.035)
    piece.add(rounded_box(width, depth - 0.03, height - 0.07, 0.006), body, y=-0.015, z=height / 2 + 0.035)
    piece.add(rounded_box(width + 0.04, depth + 0.02, 0.03, 0.008, 2), body, z=height + 0.015)
    for x in (-1, 1):
        door = rounded_box(width / 2 - 0.012, 0.024, height - 0.10, 0.008, 2)
        piece.add(door, body, x * width / 4, depth / 2 - 0.015, height / 2 + 0.035)
        for low, high in ((0.14, 0.48), (0.54, 0.93)):
            field = rounded_box(width / 2 - 0.16, 0.016, (high - low) * height, 0.007, 1)
            piece.add(field, body, x * width / 4, depth / 2 - 0.002, (low + high) / 2 * height)
        ball = lathe([(0.0, 0.006), (0.012, 0.015), (0.025, 0.008)], 14)
        piece.add(ball.turned("x", -np.pi / 2), knob, x * 0.035, depth / 2 - 0.003, 0.52 * height)
    return piece


def low_board(rng: Rng) -> Furniture:
    """Return a random low sideboard."""
    size = rng.uniform(1.35, 1.6), rng.uniform(0.40, 0.45), rng.uniform(0.46, 0.56)
    return _drawers("low board", rng, *size, 3)


def nightstand(rng: Rng) -> Furniture:
    """Return a random nightstand."""
    size = rng.uniform(0.46, 0.52), rng.uniform(0.37, 0.42), rng.uniform(0.48, 0.56)
    return _drawers("nightstand", rng, *size, 1)


def _drawers(kind: str, rng: Rng, width: float, depth: float, height: float, columns: int) -> Furniture:
    piece = Furniture(kind)
    body, knob = paints.wood(rng), paints.metal(rng)
    front = paints.paint(rng, (0.88, 0.87, 0.84)) if rng.uniform() < 0.4 else body
    piece.add_legs(leg(0.04, 0.12), body, width / 2 - 0.05, depth / 2 - 0.05)
    piece.add(rounded_box(width, depth - 0.02, height - 0.12, 0.006), body, y=-0.01, z=height / 2 + 0.06)
    for k in range(columns):
        w = width / columns
        x = (k - (columns - 1) / 2) * w
        for row in range(2):
            h = (height - 0.15) / 2
            z = 0.135 + (row + 0.5) * h
            piece.add(rounded_box(w - 0.03, 0.02, h - 0.015, 0.005), front, x, depth / 2 - 0.012, z)
            handle = [(x - 0.05, depth / 2 - 0.003, z), (x, depth / 2 + 0.016, z), (x + 0.05, depth / 2 - 0.003, z)]
            piece.add(tube(handle, 0.005, 6), knob)
    return piece


def counter(rng: Rng) -> Furniture:
    """Return a kitchen counter with doors, a worktop and a sink."""
    piece = Furniture("kitchen counter")
    width, depth = rng.uniform(1.3, 1.6), 0.60
    front = paints.paint(rng, paints.pick(rng, ((0.86, 0.86, 0.84), (0.42, 0.53, 0.56), (0.60, 0.25, 0.20))))
    stone = Material(Texture.PAINT, (0.36, 0.35, 0.34), (0.62, 0.60, 0.58), 0.012, seed=paints.new_seed(rng))
    steel, dark = paints.metal(rng), paints.paint(rng, (0.15, 0.15, 0.15))
    piece.add(rounded_box(width - 0.01, depth - 0.10, 0.10, 0.003), dark, y=-0.04, z=0.05)
    piece.add(rounded_box(width, depth - 0.04, 0.76, 0.004), front, y=-0.02, z=0.48)
    piece.add(rounded_box(width + 0.02, depth + 0.02, 0.04, 0.008, 2), stone, z=0.88)
    for k in range(3):
        x = (k - 1.0) * width / 3
        piece.add(rounded_box(width / 3 - 0.012, 0.02, 0.73, 0.006), front, x, depth / 2 - 0.03, 0.48)
        grip = [(x - 0.07, depth / 2 - 0.022, 0.80), (x, depth / 2 + 0.005, 0.80), (x + 0.07, depth / 2 - 0.022, 0.80)]
        piece.add(tube(grip, 0.006, 6), steel)
    x = 0.22 * width
    piece.add(rounded_box(0.46, 0.40, 0.012, 0.005), steel, x, 0.0, 0.902)
    piece.add(rounded_box(0.38, 0.32, 0.004, 0.001), dark, x, 0.0, 0.909)
    tap = [(x, -0.22, 0.90), (x, -0.22, 1.12), (x, -0.15, 1.18), (x, -0.06, 1.12), (x, -0.05, 1.08)]
    piece.add(tube(tap, 0.012), steel)
    pot = lathe([(0.0, 0.10), (0.12, 0.105), (0.13, 0.108), (0.145, 0.03)], 24)
    piece.add(pot, paints.metal(rng, paints.vivid(rng)), -0.28 * width, -0.05, 0.90)
    return piece


def floor_lamp(rng: Rng) -> Furniture:
    """Return a random floor lamp."""
    piece = Furniture("floor lamp")
    stem = paints.metal(rng, (0.25, 0.24, 0.23))
    height = rng.uniform(1.5, 1.7)
    piece.add(cylinder(0.15, 0.02, 0.14, 28), stem)
    piece.add(cylinder(0.012, height - 0.15), stem, z=0.02)
    piece.add(lathe([(0.0, 0.20), (0.26, 0.14)], 26), _glowing(rng), z=height - 0.22)
    return piece


def table_lamp(rng: Rng) -> Furniture:
    """Return a random table lamp."""
    piece = Furniture("table lamp")
    foot = [(0.0, 0.06), (0.02, 0.065), (0.10, 0.05), (0.16, 0.015)]
    piece.add(lathe(foot, 20, 0.03), paints.paint(rng, paints.vivid(rng)))
    piece.add(cylinder(0.008, 0.10), paints.metal(rng), z=0.15)
    piece.add(lathe([(0.0, 0.095), (0.15, 0.07)], 26), _glowing(rng), z=0.22)
    return piece


def _glowing(rng: Rng) -> Material:
    return Material(
        Texture.FABRIC, (0.96, 0.88, 0.70), (0.90, 0.78, 0.56), 0.1, seed=paints.new_seed(rng), emission=LAMP_GLOW
    )


def plant(rng: Rng) -> Furniture:
    """Return a potted plant with broad leaves."""
    piece = Furniture("plant")
    pot = paints.paint(rng, paints.pick(rng, ((0.70, 0.38, 0.26), (0.85, 0.84, 0.80), (0.30, 0.36, 0.42))))
    green = Material(Texture.LEAF, (0.16, 0.36, 0.14), (0.36, 0.55, 0.22), seed=paints.new_seed(rng))
    soil = paints.paint(rng, (0.20, 0.14, 0.10), 0.6, 0.01)
    piece.add(lathe([(0.0, 0.12), (0.28, 0.17), (0.30, 0.175)], 26), pot)
    piece.add(lathe([(0.0, 0.155), (0.004, 0.15)], 26), soil, z=0.30)
    for k in range(13):
        angle, tilt, reach = 2.4 * k + rng.uniform(-0.2, 0.2), rng.uniform(0.15, 0.95), rng.uniform(0.45, 0.75)
        width = rng.uniform(0.05, 0.075)
        blade = rounded_box(2 * width, reach, 0.006, 0.0025, 1, 0.05)

        def droop(p: Float64, reach: float = reach, tilt: float = tilt) -> Float64:
            f = p[:, 1] / reach + 0.5
            p[:, 0] *= np.sin(np.pi * np.clip(0.06 + 0.93 * f, 0, 1)) ** 0.8
            p[:, 2] += 0.25 * np.abs(p[:, 0])
            along = f * reach
            bend = tilt * (0.4 + 1.1 * f)
            y, z = along * np.sin(bend), along * np.cos(bend) + p[:, 2]
            p[:, 1], p[:, 2] = y, z
            return p

        piece.add(blade.deformed(droop).turned("z", angle), green, z=0.30)
    return piece


def carton(rng: Rng) -> Furniture:
    """Return a random cardboard box with packing tape."""
    piece = Furniture("cardboard box")
    x, y, z = rng.uniform(0.32, 0.5), rng.uniform(0.28, 0.4), rng.uniform(0.25, 0.4)
    board = Material(Texture.FABRIC, (0.72, 0.56, 0.38), (0.64, 0.48, 0.31), 0.15, seed=paints.new_seed(rng))
    tape = paints.paint(rng, (0.82, 0.74, 0.58))
    piece.add(rounded_box(x, y, z, 0.004), board, z=z / 2)
    piece.add(rounded_box(x + 0.002, 0.06, z + 0.003, 0.001), tape, z=z / 2)
    return piece


def pouf(rng: Rng) -> Furniture:
    """Return a random pouf."""
    piece = Furniture("pouf")
    radius, height = rng.uniform(0.22, 0.27), rng.uniform(0.34, 0.4)
    profile = [(0.0, 0.9), (0.06, 1.0), (height - 0.07, 1.0), (height - 0.02, 0.92), (height, 0.6)]
    piece.add(lathe([(z, r * radius) for z, r in profile], 32), paints.patterned_cloth(rng))
    return piece


def mug(rng: Rng) -> Furniture:
    """Return a random mug."""
    piece = Furniture("mug")
    glaze = paints.glaze(rng, paints.vivid(rng))
    piece.add(lathe([(0.0, 0.034), (0.008, 0.04), (0.095, 0.042)], 22), glaze)
    piece.add(tube([(0.038, 0.0, 0.02), (0.066, 0.0, 0.03), (0.066, 0.0, 0.065), (0.04, 0.0, 0.078)], 0.006, 8), glaze)
    return piece


def vase(rng: Rng) -> Furniture:
    """Return a random vase."""
    piece = Furniture("vase")
    profile = ((0.0, 0.05), (0.02, 0.06), (0.12, 0.085), (0.20, 0.05), (0.26, 0.032), (0.29, 0.045))
    piece.add(lathe(profile, 26, 0.03), paints.glaze(rng, paints.vivid(rng), 0.7, 0.03))
    for k in range(5):
        x, y = 0.06 * np.cos(1.26 * k), 0.06 * np.sin(1.26 * k)
        green = Material(Texture.LEAF, (0.16, 0.36, 0.14), (0.36, 0.55, 0.22), seed=k)
        piece.add(tube([(0.0, 0.0, 0.25), (0.5 * x, 0.5 * y, 0.36), (x, y, 0.45)], 0.003, 5), green)
        blossom = cushion(0.07, 0.07, 0.045, 0.6).moved(x, y, 0.46)
        piece.add(blossom, paints.cloth(rng, paints.vivid(rng)))
    return piece


def bowl(rng: Rng) -> Furniture:
    """Return a bowl with fruit."""
    piece = Furniture("bowl")
    profile = [(0.0, 0.06), (0.015, 0.07), (0.05, 0.12), (0.08, 0.14)]
    piece.add(lathe(profile, 30, 0.03), paints.glaze(rng, (0.86, 0.84, 0.80)))
    fruit = ((0.80, 0.20, 0.15), (0.85, 0.60, 0.15), (0.45, 0.62, 0.20))
    for k in range(5):
        r, angle = 0.036, 1.256 * k
        ball = rounded_box(2 * r, 2 * r, 2 * r, r, 4)
        piece.add(ball, paints.paint(rng, fruit[k % 3], 0.8, 0.02), 0.07 * np.cos(angle), 0.07 * np.sin(angle), 0.095)
    return piece


def painting(rng: Rng) -> Furniture:
    """Return a framed painting.

    The back is at y = 0.
    """
    piece = Furniture("picture")
    width, height = rng.uniform(0.5, 0.9), rng.uniform(0.4, 0.65)
    frame = paints.wood(rng)
    canvas = panel(width - 0.05, height - 0.05).moved(y=0.022, z=0.025)
    piece.add(canvas, paints.picture(rng, Texture.PAINTING, width - 0.05, height - 0.05))
    piece.add_pair(rounded_box(0.035, 0.03, height, 0.006), frame, width / 2 - 0.017, 0.016, height / 2)
    for z in (0.0175, height - 0.0175):
        piece.add(rounded_box(width - 0.07, 0.03, 0.035, 0.006), frame, 0, 0.016, z)
    return piece


def window(rng: Rng) -> Furniture:
    """Return a window with curtains.

    The back is at y = 0, and the sill is at z = 0.
    """
    piece = Furniture("window")
    width, height = rng.uniform(1.2, 1.5), rng.uniform(1.15, 1.3)
    white = paints.paint(rng, (0.92, 0.92, 0.90))
    glass = Material(
        Texture.SKY, (0.6, 0.8, 1.0), (0.2, 0.4, 0.1), 0.1, (width, height), paints.new_seed(rng), 1.5, dark=1
    )
    piece.add(panel(width, height), glass, y=0.012)
    for x in (-width / 2, 0.0, width / 2):
        piece.add(rounded_box(0.06, 0.05, height + 0.06, 0.006), white, x, 0.026, height / 2)
    for z in (0.0, height):
        piece.add(rounded_box(width + 0.06, 0.05, 0.06, 0.006), white, 0, 0.0262, z)
    piece.add(rounded_box(width + 0.2, 0.14, 0.03, 0.008, 2), white, 0, 0.072, -0.05)
    rod, fabric = paints.metal(rng), paints.patterned_cloth(rng)
    piece.add(tube([(-width / 2 - 0.35, 0.11, height + 0.14), (width / 2 + 0.35, 0.11, height + 0.14)], 0.012), rod)

    def pleat(p: Float64) -> Float64:
        p[:, 1] += 0.028 * np.sin(2 * np.pi * p[:, 0] / 0.09)
        return p

    drape = rounded_box(0.36, 0.012, height + 0.55, 0.004, 1, 0.018).deformed(pleat)
    piece.add_pair(drape, fabric, width / 2 + 0.14, 0.11, height / 2 - 0.14)
    return piece


def door(rng: Rng) -> Furniture:
    """Return a closed door in its frame.

    The back is at y = 0.
    """
    piece = Furniture("door")
    leaf = paints.wood(rng) if rng.uniform() < 0.5 else paints.paint(rng, (0.90, 0.89, 0.86))
    frame, steel = paints.paint(rng, (0.93, 0.92, 0.90)), paints.metal(rng)
    piece.add(rounded_box(0.84, 0.03, 2.02, 0.004), leaf, 0, 0.018, 1.015)
    for z, h in ((0.55, 0.75), (1.45, 0.85)):
        piece.add(rounded_box(0.58, 0.012, h, 0.005), leaf, 0, 0.034, z)
    piece.add_pair(rounded_box(0.08, 0.05, 2.11, 0.006), frame, 0.46, 0.026, 1.055)
    piece.add(rounded_box(1.0, 0.051, 0.08, 0.006), frame, 0, 0.0265, 2.08)
    piece.add(tube([(0.34, 0.03, 1.02), (0.34, 0.075, 1.02), (0.30, 0.08, 1.02), (0.22, 0.08, 1.02)], 0.01), steel)
    return piece


def rug(rng: Rng, width: float, depth: float) -> Furniture:
    """Return a random rug with the given side lengths, m."""
    piece = Furniture("rug")
    base = paints.pick(rng, paints.CLOTHS)
    other = paints.shade(paints.pick(rng, paints.CLOTHS), 1.2)
    woven = Material(Texture.RUG, base, other, rng.uniform(0.22, 0.34), (width, depth), paints.new_seed(rng))
    piece.add(rounded_box(width, depth, 0.012, 0.004).flat(0, 1), woven, z=0.0065)
    return piece


def partition(rng: Rng) -> Furniture:
    """Return a half-height tiled partition wall for a toilet."""
    piece = Furniture("partition")
    tile = Material(Texture.TILES, (0.72, 0.82, 0.84), (0.55, 0.56, 0.56), 0.15, seed=paints.new_seed(rng))
    piece.add(rounded_box(0.09, 0.62, 0.95, 0.004).flat(1, 2), tile, z=0.475)
    piece.add(rounded_box(0.12, 0.65, 0.03, 0.006), paints.wood(rng), z=0.965)
    return piece


def ceiling_lamp(rng: Rng) -> Furniture:
    """Return a hanging globe lamp.

    The ceiling is at z = 0.
    """
    piece = Furniture("ceiling lamp")
    globe = [(-0.34, 0.06), (-0.30, 0.15), (-0.22, 0.19), (-0.14, 0.13), (-0.10, 0.03)]
    piece.add(lathe(globe, 28, 0.05), _glowing(rng))
    piece.add(cylinder(0.006, 0.11), paints.metal(rng), z=-0.11)
    piece.add(cylinder(0.05, 0.02), paints.metal(rng), z=-0.021)
    return piece


def throw_cushion(rng: Rng) -> Furniture:
    """Return a random throw cushion."""
    piece = Furniture("cushion")
    side = rng.uniform(0.38, 0.5)
    piece.add(cushion(side, rng.uniform(0.8, 1.0) * side, rng.uniform(0.13, 0.18)), paints.patterned_cloth(rng))
    return piece.placed(0.0, 0.0, -float(piece.bounds()[0][2]))


def blanket(rng: Rng, width: float, depth: float) -> Furniture:
    """Return a creased blanket with the given side lengths, m."""
    piece = Furniture("blanket")
    sheet = rounded_box(width, depth, 0.03, 0.012, 2, WEAVE)
    piece.add(_crumpled(sheet, rng, 0.03, 0.05), paints.patterned_cloth(rng), z=0.015)
    return piece


def clothes(rng: Rng) -> Furniture:
    """Return a heap of two garments."""
    piece = Furniture("clothes")
    for k in range(2):
        sheet = rounded_box(rng.uniform(0.42, 0.55), rng.uniform(0.34, 0.42), 0.035, 0.016, 2, WEAVE)
        heap = _crumpled(sheet, rng, 0.05, 0.08).turned("z", rng.uniform(-0.7, 0.7))
        x, y = rng.uniform(-0.06, 0.06), rng.uniform(-0.06, 0.06)
        piece.add(heap, paints.cloth(rng), x, y, 0.018 + 0.04 * k)
    return piece


def _crumpled(sheet: Solid, rng: Rng, height: float, fringe: float) -> Solid:
    """Add random creases to a sheet.

    `height` is the maximum height of the creases, and `fringe` is the maximum horizontal displacement, m.
    """
    a, b, c, d = rng.uniform(0, 2 * np.pi, 4)

    def crumple(p: Float64) -> Float64:
        x, y = p[:, 0].copy(), p[:, 1].copy()
        wave = np.sin(9 * x + 2.5 * np.sin(6 * y + a) + b) + np.sin(8 * y + 3 * np.sin(5 * x + c) + d)
        p[:, 2] += height * (0.5 + 0.25 * wave)
        p[:, 0] += fringe / 2 * (np.sin(5 * y + b) + np.sin(11 * y + c))
        p[:, 1] += fringe / 2 * (np.sin(6 * x + d) + np.sin(10 * x + a))
        return p

    return sheet.deformed(crumple)

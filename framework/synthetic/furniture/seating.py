"""Random beds, chairs and couches."""

from __future__ import annotations

import numpy as np

from framework.data import Float64
from framework.synthetic import paints
from framework.synthetic.furniture.piece import Furniture, Rng
from framework.synthetic.furniture.solids import cushion, cylinder, leg, rounded_box, tube


def bed(rng: Rng) -> Furniture:
    """Return a random bed."""
    piece = Furniture("bed", "bed")
    wide = rng.uniform() < 0.7
    width, length = (rng.uniform(1.4, 1.7) if wide else rng.uniform(0.9, 1.05)), rng.uniform(1.95, 2.08)
    frame, sheet = paints.wood(rng), paints.cloth(rng, (0.90, 0.89, 0.86))
    cover, throw, pillow = (paints.patterned_cloth(rng), paints.cloth(rng), paints.cloth(rng, (0.93, 0.91, 0.88)))
    piece.add_legs(leg(0.07, 0.16, 0.8), frame, width / 2 - 0.06, length / 2 - 0.08)
    for side in (-1.0, 1.0):
        piece.add(rounded_box(0.04, length, 0.16, 0.010), frame, side * (width / 2 - 0.02), 0, 0.22)
        piece.add(rounded_box(width - 0.078, 0.04, 0.16, 0.010), frame, 0, side * (length / 2 - 0.02), 0.22)
    piece.add(rounded_box(width - 0.08, length - 0.08, 0.03, 0.003), frame, z=0.27)
    piece.add(rounded_box(width - 0.05, length - 0.07, 0.24, 0.06, 3), sheet, y=0.01, z=0.40)
    reach = 0.68 * length
    y_cover = length / 2 - reach / 2 + 0.015
    duvet = rounded_box(width + 0.05, reach, 0.30, 0.06, 3, 0.05)

    def crumple(p: Float64) -> Float64:
        top = np.clip((p[:, 2] + 0.05) / 0.15, 0, 1)
        wave = np.sin(9 * p[:, 0] + 2.5 * np.sin(5 * p[:, 1])) + np.sin(7 * p[:, 1] + 3 * np.sin(4 * p[:, 0]))
        p[:, 2] += 0.010 * top * wave
        p[:, 0] += 0.008 * (1 - top) * np.sin(16 * p[:, 1]) * np.sign(p[:, 0])
        return p

    piece.add(duvet.deformed(crumple), cover, y=y_cover, z=0.425)
    fold = rounded_box(width + 0.04, 0.26, 0.06, 0.03, 3, 0.06)
    piece.add(fold, sheet, y=y_cover - reach / 2 + 0.08, z=0.585)
    if rng.uniform() < 0.7:
        piece.add(rounded_box(width + 0.075, 0.46, 0.28, 0.05, 3), throw, y=length / 2 - 0.52, z=0.462)
    sides = (-1.0, 1.0) if wide else (0.0,)
    for side in sides:
        soft = cushion(min(0.68, width / len(sides) - 0.08), 0.44, 0.20).turned("x", -0.35)
        piece.add(soft.turned("z", rng.uniform(-0.08, 0.08)), pillow, side * width / 4, -length / 2 + 0.33, 0.64)
    height = rng.uniform(0.85, 1.1)
    if rng.uniform() < 0.5:
        board = rounded_box(width + 0.06, 0.09, height - 0.2, 0.035, 3)
        piece.add(board, paints.cloth(rng), y=-length / 2 - 0.03, z=height / 2 + 0.1)
    else:
        piece.add(rounded_box(width + 0.06, 0.05, height - 0.3, 0.012), frame, y=-length / 2 - 0.02, z=height / 2 + 0.1)
        for x in (-width / 2, width / 2):
            piece.add(rounded_box(0.075, 0.075, height, 0.015, 2), frame, x, -length / 2 - 0.02, height / 2)
    return piece


def chair(rng: Rng) -> Furniture:
    """Return a wooden dining chair with slats, spindles or an upholstered back."""
    piece = Furniture("chair", "chair")
    frame, pad = paints.wood(rng), paints.cloth(rng)
    width, depth = rng.uniform(0.42, 0.47), rng.uniform(0.42, 0.46)
    seat, height = rng.uniform(0.44, 0.47), rng.uniform(0.85, 1.0)
    style = int(rng.integers(3))
    bend = 0.6 * height + 0.2
    post = [(0.0, -0.04, 0.006), (0.0, 0.01, 0.5 * seat), (0.0, 0.0, seat), (0.0, -0.05, bend), (0.0, -0.11, height)]
    for x in (-1, 1):
        piece.add(leg(0.042, seat - 0.02), frame, x * (width / 2 - 0.03), depth / 2 - 0.03)
        piece.add(tube(post, 0.020), frame, x * (width / 2 - 0.025), -depth / 2 + 0.03)
        rail = rounded_box(0.02, depth - 0.07, 0.03, 0.004)
        piece.add(rail, frame, x * (width / 2 - 0.03), 0, 0.45 * seat)
    piece.add(rounded_box(width - 0.08, 0.02, 0.03, 0.004), frame, z=0.45 * seat)
    piece.add(rounded_box(width, depth, 0.035, 0.012, 2), frame, z=seat - 0.017)
    if style != 0:
        piece.add(rounded_box(width - 0.03, depth - 0.03, 0.05, 0.024, 3), pad, z=seat + 0.02)

    def lean(z: float) -> float:
        return float(np.interp(z, [seat, bend, height], [0.0, -0.05, -0.11])) - depth / 2 + 0.03

    def bow(p: Float64) -> Float64:
        p[:, 1] -= 0.035 * (1 - (2 * p[:, 0] / width) ** 2)
        return p

    inside = width - 0.06
    if style == 2:
        low, high = seat + 0.10, height - 0.01
        slab = rounded_box(inside + 0.03, 0.05, high - low, 0.022, 3, 0.05).deformed(bow).turned("x", 0.13)
        piece.add(slab, pad, 0, lean((low + high) / 2) + 0.02, (low + high) / 2)
        return piece
    top = rounded_box(inside + 0.02, 0.026, 0.085, 0.010, 2, 0.05).deformed(bow).turned("x", 0.18)
    piece.add(top, frame, 0, lean(height - 0.05), height - 0.05)
    if style == 0:
        for z in np.linspace(seat + 0.14, height - 0.18, 3):
            slat = rounded_box(inside + 0.02, 0.016, 0.055, 0.006, 1, 0.05).deformed(bow).turned("x", 0.14)
            piece.add(slat, frame, 0, lean(float(z)), float(z))
    else:
        for x in np.linspace(-0.36, 0.36, 5) * inside:
            sag = 0.035 * (1 - (2 * x / width) ** 2)
            spindle = [(float(x), lean(seat) + 0.015, seat), (float(x), lean(height - 0.09) - sag, height - 0.09)]
            piece.add(tube(spindle, 0.009), frame)
    return piece


def office_chair(rng: Rng) -> Furniture:
    """Return a random office chair."""
    piece = Furniture("office chair", "chair")
    dark, pad = paints.metal(rng, (0.16, 0.16, 0.17)), paints.cloth(rng)
    seat = rng.uniform(0.46, 0.52)
    for k in range(5):
        angle = 2 * np.pi * k / 5 + 0.3
        x, y = 0.29 * np.cos(angle), 0.29 * np.sin(angle)
        piece.add(tube([(0.0, 0.0, 0.12), (0.6 * x, 0.6 * y, 0.10), (x, y, 0.075)], 0.018), dark)
        piece.add(cylinder(0.028, 0.045).turned("x", np.pi / 2).turned("z", angle), dark, x, y, 0.029)
    piece.add(cylinder(0.028, seat - 0.12), dark, z=0.08)
    piece.add(rounded_box(0.50, 0.48, 0.09, 0.042, 4, 0.06), pad, z=seat)

    def wrap(p: Float64) -> Float64:
        p[:, 1] += 0.9 * p[:, 0] ** 2
        return p

    back = rounded_box(0.46, 0.07, 0.56, 0.033, 4, 0.06).deformed(wrap).turned("x", 0.12)
    piece.add(back, pad, 0, -0.27, seat + 0.42)
    piece.add(tube([(0.0, -0.12, seat - 0.06), (0.0, -0.30, seat - 0.04), (0.0, -0.31, seat + 0.25)], 0.02), dark)
    for x in (-0.29, 0.29):
        arm = [(0.75 * x, 0.0, seat - 0.03), (x, 0.0, seat), (x, 0.0, seat + 0.19)]
        piece.add(tube(arm, 0.015), dark)
        piece.add(rounded_box(0.06, 0.26, 0.03, 0.014, 2), dark, x, 0.0, seat + 0.205)
    return piece


def couch(rng: Rng) -> Furniture:
    """Return a random couch."""
    piece, width, depth, arm = _couch_body(rng)
    for x in (-1, 1):
        if rng.uniform() < 0.7:
            pillow = cushion(0.42, 0.42, 0.16).turned("x", np.pi / 2 + 0.35).turned("z", -0.45 * x)
            piece.add(pillow, paints.patterned_cloth(rng), x * (width / 2 - arm - 0.24), -depth / 2 + 0.50, 0.64)
    return piece


def bare_couch(rng: Rng) -> Furniture:
    """Return a couch without pillows."""
    return _couch_body(rng)[0]


def _couch_body(rng: Rng) -> tuple[Furniture, float, float, float]:
    """Return a couch without pillows, with its width, its depth and the width of its arms, m."""
    piece = Furniture("couch", "couch")
    cover, feet = paints.cloth(rng), paints.wood(rng)
    seats = int(rng.integers(2, 4))
    arm, depth, seat_width = rng.uniform(0.16, 0.24), rng.uniform(0.86, 0.96), rng.uniform(0.60, 0.70)
    width = seats * seat_width + 2 * arm
    piece.add_legs(cylinder(0.022, 0.11, 0.032), feet, width / 2 - 0.09, depth / 2 - 0.09)
    piece.add(rounded_box(width - 0.02, depth - 0.02, 0.19, 0.03, 2), cover, z=0.20)
    piece.add(rounded_box(width - 0.03, 0.22, 0.62, 0.08, 4), cover, y=-depth / 2 + 0.12, z=0.48)
    piece.add_pair(rounded_box(arm, depth, 0.50, 0.075, 4), cover, (width - arm) / 2, 0, 0.36)
    for k in range(seats):
        x = (k - (seats - 1) / 2) * seat_width
        piece.add(rounded_box(seat_width - 0.008, depth - 0.20, 0.17, 0.055, 4), cover, x, 0.10, 0.365)
        back = cushion(seat_width - 0.02, 0.46, 0.24, 0.35).turned("x", np.pi / 2 + 0.22)
        piece.add(back, cover, x, -depth / 2 + 0.32, 0.63)
    return piece, width, depth, arm

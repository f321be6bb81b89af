"""Parametric furniture of the nine classes of SceneNN, under COCO's names.

Every piece stands on z = 0 about the origin and faces +y: its back, if it has one, is at negative y. Sizes are those of
common furniture, drawn at random.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from framework.data import Float64
from framework.synthetic import palette
from framework.synthetic.solids import (
    Section,
    Solid,
    cushion,
    cylinder,
    leg,
    loft,
    rounded_box,
    tube,
)
from framework.synthetic.textures import Material, Texture

Rng = np.random.Generator


@dataclass
class Furniture:
    """One object: its parts, each a solid of one material."""

    kind: str  # what it is, for people: "office chair"
    class_name: str | None  # COCO's name; None = not evaluated
    parts: list[tuple[Solid, Material]] = field(default_factory=list)

    def add(self, solid: Solid, material: Material) -> None:
        self.parts.append((solid, material))

    def bounds(self) -> tuple[Float64, Float64]:
        """The lower and upper corner (3,) of its axis-aligned box, m."""
        lows = np.array([solid.vertices.min(axis=0) for solid, _ in self.parts])
        highs = np.array([solid.vertices.max(axis=0) for solid, _ in self.parts])
        return lows.min(axis=0), highs.max(axis=0)

    def placed(self, x: float, y: float, z: float = 0.0, angle: float = 0.0) -> Furniture:
        """Turned by `angle` (rad, counter-clockwise from above), then moved."""
        parts = [(solid.turned("z", angle).moved(x, y, z), material) for solid, material in self.parts]
        return Furniture(self.kind, self.class_name, parts)


def corners(x: float, y: float) -> tuple[tuple[float, float], ...]:
    return (-x, -y), (x, -y), (x, y), (-x, y)


def bed(rng: Rng) -> Furniture:
    piece = Furniture("bed", "bed")
    wide = rng.uniform() < 0.7
    width, length = (rng.uniform(1.4, 1.7) if wide else rng.uniform(0.9, 1.05)), rng.uniform(1.95, 2.08)
    frame, sheet = palette.wood(rng), palette.cloth(rng, (0.90, 0.89, 0.86))
    cover, throw, pillow = palette.patterned_cloth(rng), palette.cloth(rng), palette.cloth(rng, (0.93, 0.91, 0.88))
    for x, y in corners(width / 2 - 0.06, length / 2 - 0.08):
        piece.add(leg(0.07, 0.16, 0.8).moved(x, y), frame)
    piece.add(rounded_box(width, length, 0.16, 0.012).moved(z=0.22), frame)
    piece.add(rounded_box(width - 0.05, length - 0.07, 0.24, 0.06, 3).moved(y=0.01, z=0.40), sheet)
    reach = 0.68 * length
    y_cover = length / 2 - reach / 2 + 0.015
    duvet = rounded_box(width + 0.05, reach, 0.30, 0.06, 3, 0.05)

    def crumple(p: Float64) -> Float64:
        top = np.clip((p[:, 2] + 0.05) / 0.15, 0, 1)
        wave = np.sin(9 * p[:, 0] + 2.5 * np.sin(5 * p[:, 1])) + np.sin(7 * p[:, 1] + 3 * np.sin(4 * p[:, 0]))
        p[:, 2] += 0.010 * top * wave
        p[:, 0] += 0.008 * (1 - top) * np.sin(16 * p[:, 1]) * np.sign(p[:, 0])
        return p

    piece.add(duvet.deformed(crumple).moved(y=y_cover, z=0.425), cover)
    fold = rounded_box(width + 0.04, 0.26, 0.06, 0.03, 3, 0.06)
    piece.add(fold.moved(y=y_cover - reach / 2 + 0.08, z=0.585), sheet)
    if rng.uniform() < 0.7:
        piece.add(rounded_box(width + 0.075, 0.46, 0.28, 0.05, 3).moved(y=length / 2 - 0.52, z=0.462), throw)
    sides = (-1.0, 1.0) if wide else (0.0,)
    for side in sides:
        soft = cushion(min(0.68, width / len(sides) - 0.08), 0.44, 0.20).turned("x", -0.35)
        piece.add(soft.turned("z", rng.uniform(-0.08, 0.08)).moved(side * width / 4, -length / 2 + 0.33, 0.64), pillow)
    height = rng.uniform(0.85, 1.1)
    if rng.uniform() < 0.5:
        board = rounded_box(width + 0.06, 0.09, height - 0.2, 0.035, 3)
        piece.add(board.moved(y=-length / 2 - 0.03, z=height / 2 + 0.1), palette.cloth(rng))
    else:
        piece.add(
            rounded_box(width + 0.06, 0.05, height - 0.3, 0.012).moved(y=-length / 2 - 0.02, z=height / 2 + 0.1), frame
        )
        for x in (-width / 2, width / 2):
            piece.add(rounded_box(0.075, 0.075, height, 0.015, 2).moved(x, -length / 2 - 0.02, height / 2), frame)
    return piece


def chair(rng: Rng) -> Furniture:
    """A wooden dining chair with slats, spindles or an upholstered back."""
    piece = Furniture("chair", "chair")
    frame, pad = palette.wood(rng), palette.cloth(rng)
    width, depth, seat, height = (
        rng.uniform(0.42, 0.47),
        rng.uniform(0.42, 0.46),
        rng.uniform(0.44, 0.47),
        rng.uniform(0.85, 1.0),
    )
    style = int(rng.integers(3))
    for x in (-1, 1):
        piece.add(leg(0.042, seat - 0.02).moved(x * (width / 2 - 0.03), depth / 2 - 0.03), frame)
        back_leg = [
            (0.0, -0.04, 0.0),
            (0.0, 0.01, 0.5 * seat),
            (0.0, 0.0, seat),
            (0.0, -0.05, 0.6 * height + 0.2),
            (0.0, -0.11, height),
        ]
        piece.add(tube(back_leg, 0.020).moved(x * (width / 2 - 0.025), -depth / 2 + 0.03), frame)
        rail = rounded_box(0.02, depth - 0.07, 0.03, 0.004)
        piece.add(rail.moved(x * (width / 2 - 0.03), 0, 0.45 * seat), frame)
    piece.add(rounded_box(width - 0.08, 0.02, 0.03, 0.004).moved(z=0.45 * seat), frame)
    piece.add(rounded_box(width, depth, 0.035, 0.012, 2).moved(z=seat - 0.017), frame)
    if style != 0:
        piece.add(rounded_box(width - 0.03, depth - 0.03, 0.05, 0.024, 3).moved(z=seat + 0.02), pad)

    def lean(z: float) -> float:
        return float(np.interp(z, [seat, 0.6 * height + 0.2, height], [0.0, -0.05, -0.11])) - depth / 2 + 0.03

    def bow(p: Float64) -> Float64:
        p[:, 1] -= 0.035 * (1 - (2 * p[:, 0] / width) ** 2)
        return p

    inside = width - 0.06
    if style == 2:
        low, high = seat + 0.10, height - 0.01
        slab = rounded_box(inside + 0.03, 0.05, high - low, 0.022, 3, 0.05).deformed(bow).turned("x", 0.13)
        piece.add(slab.moved(0, lean((low + high) / 2) + 0.02, (low + high) / 2), pad)
        return piece
    top = rounded_box(inside + 0.02, 0.026, 0.085, 0.010, 2, 0.05).deformed(bow).turned("x", 0.18)
    piece.add(top.moved(0, lean(height - 0.05), height - 0.05), frame)
    if style == 0:
        for z in np.linspace(seat + 0.14, height - 0.18, 3):
            slat = rounded_box(inside + 0.02, 0.016, 0.055, 0.006, 1, 0.05).deformed(bow).turned("x", 0.14)
            piece.add(slat.moved(0, lean(float(z)), float(z)), frame)
    else:
        for x in np.linspace(-0.36, 0.36, 5) * inside:
            sag = 0.035 * (1 - (2 * x / width) ** 2)
            spindle = [(float(x), lean(seat) + 0.015, seat), (float(x), lean(height - 0.09) - sag, height - 0.09)]
            piece.add(tube(spindle, 0.009), frame)
    return piece


def office_chair(rng: Rng) -> Furniture:
    piece = Furniture("office chair", "chair")
    dark, pad = palette.metal(rng, (0.16, 0.16, 0.17)), palette.cloth(rng)
    seat = rng.uniform(0.46, 0.52)
    for k in range(5):
        angle = 2 * np.pi * k / 5 + 0.3
        x, y = 0.29 * np.cos(angle), 0.29 * np.sin(angle)
        piece.add(tube([(0.0, 0.0, 0.12), (0.6 * x, 0.6 * y, 0.10), (x, y, 0.075)], 0.018), dark)
        piece.add(cylinder(0.028, 0.045).turned("x", np.pi / 2).turned("z", angle).moved(x, y, 0.029), dark)
    piece.add(cylinder(0.028, seat - 0.12).moved(z=0.08), dark)
    piece.add(rounded_box(0.50, 0.48, 0.09, 0.042, 4, 0.06).moved(z=seat), pad)

    def wrap(p: Float64) -> Float64:
        p[:, 1] += 0.9 * p[:, 0] ** 2
        return p

    back = rounded_box(0.46, 0.07, 0.56, 0.033, 4, 0.06).deformed(wrap).turned("x", 0.12)
    piece.add(back.moved(0, -0.27, seat + 0.42), pad)
    piece.add(tube([(0.0, -0.12, seat - 0.06), (0.0, -0.30, seat - 0.04), (0.0, -0.31, seat + 0.25)], 0.02), dark)
    for x in (-0.29, 0.29):
        arm = [(0.75 * x, 0.0, seat - 0.03), (x, 0.0, seat), (x, 0.0, seat + 0.19)]
        piece.add(tube(arm, 0.015), dark)
        piece.add(rounded_box(0.06, 0.26, 0.03, 0.014, 2).moved(x, 0.0, seat + 0.205), dark)
    return piece


def couch(rng: Rng) -> Furniture:
    piece = Furniture("couch", "couch")
    cover, feet = palette.cloth(rng), palette.wood(rng)
    seats = int(rng.integers(2, 4))
    arm, depth, seat_width = rng.uniform(0.16, 0.24), rng.uniform(0.86, 0.96), rng.uniform(0.60, 0.70)
    width = seats * seat_width + 2 * arm
    for x, y in corners(width / 2 - 0.09, depth / 2 - 0.09):
        piece.add(cylinder(0.022, 0.11, 0.032).moved(x, y), feet)
    piece.add(rounded_box(width - 0.02, depth - 0.02, 0.19, 0.03, 2).moved(z=0.20), cover)
    piece.add(rounded_box(width - 0.03, 0.22, 0.62, 0.08, 4).moved(y=-depth / 2 + 0.12, z=0.48), cover)
    for x in (-1, 1):
        piece.add(rounded_box(arm, depth, 0.50, 0.075, 4).moved(x * (width - arm) / 2, 0, 0.36), cover)
    for k in range(seats):
        x = (k - (seats - 1) / 2) * seat_width
        piece.add(rounded_box(seat_width - 0.008, depth - 0.20, 0.17, 0.055, 4).moved(x, 0.10, 0.365), cover)
        back = cushion(seat_width - 0.02, 0.46, 0.24, 0.35).turned("x", np.pi / 2 + 0.22)
        piece.add(back.moved(x, -depth / 2 + 0.32, 0.63), cover)
    for x in (-1, 1):
        if rng.uniform() < 0.7:
            pillow = cushion(0.42, 0.42, 0.16).turned("x", np.pi / 2 + 0.35).turned("z", -0.45 * x)
            piece.add(pillow.moved(x * (width / 2 - arm - 0.24), -depth / 2 + 0.50, 0.64), palette.patterned_cloth(rng))
    return piece


def dining_table(rng: Rng) -> Furniture:
    round_top = rng.uniform() < 0.3
    top_material = palette.wood(rng)
    if round_top:
        piece = Furniture("round table", "dining table")
        radius, height = rng.uniform(0.50, 0.58), rng.uniform(0.73, 0.76)
        profile = (
            (0.0, 0.27),
            (0.025, 0.27),
            (0.06, 0.07),
            (0.30, 0.045),
            (height - 0.08, 0.06),
            (height - 0.035, 0.16),
        )
        piece.add(loft([Section(z, r, r) for z, r in profile], 28), top_material)
        rim = [Section(height - 0.034, radius - 0.01, radius - 0.01), Section(height - 0.024, radius, radius)]
        rim += [Section(height - 0.008, radius, radius), Section(height, radius - 0.008, radius - 0.008)]
        piece.add(loft(rim, 44), top_material)
        return piece
    return _table(
        "table", rng.uniform(1.25, 1.6), rng.uniform(0.78, 0.90), rng.uniform(0.73, 0.76), top_material, 0.065
    )


def desk(rng: Rng) -> Furniture:
    return _table("desk", rng.uniform(1.2, 1.45), rng.uniform(0.62, 0.72), 0.73, palette.wood(rng), 0.05)


def coffee_table(rng: Rng) -> Furniture:
    """Low; COCO's annotators call it a dining table too."""
    return _table(
        "coffee table",
        rng.uniform(0.85, 1.1),
        rng.uniform(0.48, 0.58),
        rng.uniform(0.38, 0.44),
        palette.wood(rng),
        0.05,
    )


def _table(kind: str, width: float, depth: float, height: float, material: Material, thickness: float) -> Furniture:
    piece = Furniture(kind, "dining table")
    piece.add(rounded_box(width, depth, 0.032, 0.008, 2).moved(z=height - 0.016), material)
    inset = thickness / 2 + 0.04
    for x, y in corners(width / 2 - inset, depth / 2 - inset):
        piece.add(leg(thickness, height - 0.03, 0.65).moved(x, y), material)
    apron = 0.09 if height > 0.5 else 0.05
    for y in (-1, 1):
        board = rounded_box(width - 2 * inset, 0.02, apron, 0.003)
        piece.add(board.moved(0, y * (depth / 2 - inset), height - 0.031 - apron / 2), material)
    for x in (-1, 1):
        board = rounded_box(0.02, depth - 2 * inset, apron, 0.003)
        piece.add(board.moved(x * (width / 2 - inset), 0, height - 0.031 - apron / 2), material)
    return piece


def book(rng: Rng) -> Furniture:
    """A closed book lying flat."""
    piece = Furniture("book", "book")
    _add_book(piece, rng, rng.uniform(0.17, 0.25), rng.uniform(0.24, 0.32), rng.uniform(0.025, 0.05), Offset())
    return piece


def book_pile(rng: Rng) -> Furniture:
    """Three or four books on each other: one instance, as SceneNN's annotators label "books"."""
    piece = Furniture("pile of books", "book")
    z = 0.0
    for k in range(int(rng.integers(3, 5))):
        thickness, shrink = rng.uniform(0.025, 0.045), 1 - 0.07 * k
        offset = Offset(z, rng.uniform(-0.25, 0.25), rng.uniform(-0.01, 0.01))
        _add_book(piece, rng, 0.23 * shrink, 0.30 * shrink, thickness, offset)
        z += thickness + 0.0005
    return piece


@dataclass(frozen=True)
class Offset:
    """Where a part lies within its piece."""

    z: float = 0.0  # m
    angle: float = 0.0  # rad
    x: float = 0.0  # m


def _add_book(piece: Furniture, rng: Rng, width: float, height: float, thickness: float, at: Offset) -> None:
    color = palette.vivid(rng)
    ink = (0.95, 0.92, 0.82) if sum(color) < 1.6 else (0.12, 0.10, 0.10)
    cover = Material(Texture.BOOK, color, ink, 0.1, (width, height), int(rng.integers(4096)))
    pages = Material(Texture.PAGES, (0.93, 0.90, 0.82), (0.78, 0.74, 0.66), seed=int(rng.integers(4096)))
    board = 0.003
    parts = (
        (rounded_box(width, height, board, 0.001).flat(1, 0).moved(z=thickness - board / 2), cover),
        (rounded_box(width, height, board, 0.001).flat(1, 0).moved(z=board / 2), cover),
        (
            rounded_box(board, height, thickness - 0.0012, 0.001).moved(
                -width / 2 + board / 2 - 0.0005, 0, thickness / 2
            ),
            palette.cloth(rng, color),
        ),
        (
            rounded_box(width - 0.008, height - 0.010, thickness - 2 * board, 0.0005).moved(0.001, 0, thickness / 2),
            pages,
        ),
    )
    for solid, material in parts:
        piece.add(_picture_upright(solid, material, width).turned("z", at.angle).moved(at.x, 0, at.z), material)


def _picture_upright(solid: Solid, material: Material, width: float) -> Solid:
    """A cover's texture with s along the width and t along the height."""
    if material.texture is not Texture.BOOK:
        return solid
    s = solid.vertices[:, 0] + width / 2
    t = solid.vertices[:, 1] - solid.vertices[:, 1].min()
    return Solid(solid.vertices, solid.normals, solid.triangles, np.stack([s, t, np.zeros_like(s)], axis=1))


def refrigerator(rng: Rng) -> Furniture:
    piece = Furniture("refrigerator", "refrigerator")
    width, depth, height = rng.uniform(0.60, 0.72), rng.uniform(0.60, 0.66), rng.uniform(1.60, 1.82)
    colors = ((0.90, 0.91, 0.91), (0.70, 0.72, 0.74), (0.62, 0.16, 0.14), (0.62, 0.78, 0.74))
    enamel = palette.metal(rng, palette.pick(rng, colors))
    rubber, chrome = palette.paint(rng, (0.13, 0.13, 0.14)), palette.metal(rng, (0.75, 0.76, 0.78))
    piece.add(rounded_box(width - 0.04, depth - 0.10, 0.06, 0.003).moved(y=-0.03, z=0.03), rubber)
    piece.add(rounded_box(width, depth - 0.07, height - 0.05, 0.012, 2).moved(y=-0.035, z=height / 2 + 0.025), enamel)
    piece.add(
        rounded_box(width - 0.03, 0.02, height - 0.08, 0.002).moved(y=depth / 2 - 0.065, z=height / 2 + 0.025), rubber
    )
    split = height * rng.uniform(0.62, 0.70)
    hinge = 1 if rng.uniform() < 0.5 else -1
    for low, high in ((0.07, split - 0.006), (split + 0.006, height - 0.005)):
        door = rounded_box(width - 0.004, 0.055, high - low, 0.018, 3).moved(y=depth / 2 - 0.028, z=(low + high) / 2)
        piece.add(door, enamel)
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
        piece.add(note.moved(x, depth / 2 + 0.0015, z), palette.picture(rng, kind, w, h))
    return piece


def tv(rng: Rng) -> Furniture:
    """A flat screen on a foot."""
    piece = Furniture("tv", "tv")
    width = rng.uniform(0.90, 1.20)
    height = width * 9 / 16
    case = palette.paint(rng, (0.09, 0.09, 0.10), 1.5)
    piece.add(rounded_box(width, 0.035, height, 0.010, 2).moved(z=height / 2 + 0.07), case)
    piece.add(rounded_box(0.5 * width, 0.04, 0.5 * height, 0.012, 2).moved(y=-0.03, z=height / 2 + 0.05), case)
    glass = rounded_box(width - 0.03, 0.004, height - 0.035, 0.001).flat(0, 2)
    mirrored = Solid(glass.vertices, glass.normals, glass.triangles, glass.texture * (-1, 1, 1) + (width - 0.03, 0, 0))
    screen = palette.picture(rng, Texture.SCREEN, width - 0.03, height - 0.035, emission=0.85)
    piece.add(mirrored.moved(y=0.0175, z=height / 2 + 0.073), screen)
    piece.add(rounded_box(0.10, 0.03, 0.09, 0.006).moved(y=-0.012, z=0.05), case)
    foot = [Section(0.0, 0.22 * width, 0.10, n=3.5), Section(0.014, 0.21 * width, 0.09, n=3.5)]
    piece.add(loft(foot, 32), case)
    return piece


def toilet(rng: Rng) -> Furniture:
    piece = Furniture("toilet", "toilet")
    white = palette.paint(rng, (0.93, 0.93, 0.91), 0.95, 0.05)
    seat_color = palette.paint(rng, (0.88, 0.88, 0.86), 0.93, 0.05) if rng.uniform() < 0.6 else palette.wood(rng)
    chrome, water = palette.metal(rng, (0.78, 0.79, 0.80)), palette.paint(rng, (0.72, 0.80, 0.84))
    rim = rng.uniform(0.38, 0.41)
    bowl = [
        Section(0.0, 0.115, 0.19, y=-0.04, n=2.6, front=1.05),
        Section(0.03, 0.110, 0.185, y=-0.04, n=2.6, front=1.05),
        Section(0.14, 0.100, 0.16, y=-0.04, n=2.4, front=1.05),
        Section(0.24, 0.125, 0.17, y=-0.01, n=2.2, front=1.25),
        Section(0.32, 0.165, 0.19, y=0.02, n=2.1, front=1.30),
        Section(rim - 0.02, 0.182, 0.20, y=0.03, n=2.1, front=1.32),
        Section(rim, 0.182, 0.20, y=0.03, n=2.1, front=1.32),
    ]
    piece.add(loft(bowl, 40, 0.05), white)
    piece.add(rounded_box(0.24, 0.20, 0.30, 0.03, 3).moved(y=-0.21, z=rim - 0.16), white)
    opened = rng.uniform() < 0.5
    lid = [
        Section(0.0, 0.182, 0.20, n=2.15, front=1.30),
        Section(0.012, 0.190, 0.205, n=2.15, front=1.30),
        Section(0.026, 0.182, 0.20, n=2.15, front=1.30),
    ]
    if opened:
        inside = [
            Section(0.0, 0.118, 0.125, y=0.035, n=2.1, front=1.42),
            Section(0.003, 0.116, 0.123, y=0.035, n=2.1, front=1.42),
        ]
        piece.add(_ring(0.185, 0.203, 0.118, 0.125, 0.03, 1.32, 1.42).moved(z=rim), seat_color)
        piece.add(loft(inside, 40).moved(z=rim + 0.001), water)
        raised = loft(lid, 40, 0.05).moved(y=0.20).turned("x", np.pi / 2 + 0.12)
        piece.add(raised.moved(y=-0.175, z=rim + 0.02), seat_color)
    else:
        piece.add(
            loft([Section(s.z * 0.7, s.a, s.b, 0, 0.03, s.n, 1.32) for s in lid], 40, 0.05).moved(z=rim + 0.001), white
        )
        piece.add(
            loft([Section(s.z, s.a, s.b, 0, 0.03, s.n, 1.32) for s in lid], 40, 0.05).moved(z=rim + 0.020), seat_color
        )
    tank = rng.uniform(0.36, 0.42)
    piece.add(rounded_box(tank, 0.17, 0.36, 0.035, 4, 0.06).moved(y=-0.285, z=rim + 0.16), white)
    piece.add(rounded_box(tank + 0.02, 0.19, 0.035, 0.014, 3).moved(y=-0.285, z=rim + 0.352), white)
    piece.add(cylinder(0.025, 0.012).moved(y=-0.285, z=rim + 0.368), chrome)
    return piece


def _ring(a: float, b: float, inner_a: float, inner_b: float, height: float, front: float, inner_front: float) -> Solid:
    """A toilet seat: an egg-shaped ring about y = 0.03, from z = 0 to `height`."""
    n, m = 40, 8
    around, across = np.meshgrid(np.linspace(0, 2 * np.pi, n + 1), np.linspace(0, 2 * np.pi, m + 1), indexing="ij")
    blend = 0.5 + 0.5 * np.cos(across)  # 1 at the outer edge, 0 at the inner one
    stretch = np.where(np.sin(around) > 0, blend * front + (1 - blend) * inner_front, 1.0)
    x = (blend * a + (1 - blend) * inner_a) * np.cos(around)
    y = 0.03 + (blend * b + (1 - blend) * inner_b) * np.sin(around) * stretch
    z = height * (0.5 + 0.5 * np.sign(np.sin(across)) * np.abs(np.sin(across)) ** 0.7)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    index = np.arange((n + 1) * (m + 1), dtype=np.int32).reshape(n + 1, m + 1)
    p, q, r, s = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    triangles = np.stack([np.stack([p, q, r], -1), np.stack([p, r, s], -1)]).reshape(-1, 3)
    flat = Solid(vertices, vertices, triangles, vertices)
    return flat.deformed(lambda points: points)


def backpack(rng: Rng) -> Furniture:
    piece = Furniture("backpack", "backpack")
    color = palette.vivid(rng)
    bag, trim = palette.cloth(rng, color), palette.cloth(rng, palette.shade(color, 0.45))
    dark = palette.cloth(rng, (0.15, 0.15, 0.17))
    w, d, h = rng.uniform(0.14, 0.17), rng.uniform(0.085, 0.105), rng.uniform(0.42, 0.50)
    body = [
        Section(0.0, 0.90 * w, 0.85 * d, n=3.5),
        Section(0.02, w, d, n=3.5),
        Section(0.45 * h, 1.04 * w, 1.08 * d, n=3.2),
        Section(0.75 * h, 0.96 * w, 0.92 * d, n=3.0),
        Section(0.90 * h, 0.82 * w, 0.70 * d, y=-0.008, n=2.6),
        Section(0.97 * h, 0.58 * w, 0.45 * d, y=-0.014, n=2.3),
        Section(h, 0.25 * w, 0.18 * d, y=-0.018),
    ]
    piece.add(loft(body, 36, 0.04), bag)
    pocket = [
        Section(0.03, 0.72 * w, 0.050, n=3.2),
        Section(0.07, 0.80 * w, 0.058, n=3.2),
        Section(0.34 * h, 0.80 * w, 0.054, n=3.0),
        Section(0.45 * h, 0.66 * w, 0.030, n=2.6),
        Section(0.48 * h, 0.40 * w, 0.012, n=2.4),
    ]
    piece.add(loft(pocket, 30, 0.04).moved(y=0.98 * d), trim)
    for side in (-1, 1):
        piece.add(
            loft([Section(0.03, 0.03, 0.06, n=3), Section(0.30 * h, 0.028, 0.055, n=3)], 20).moved(side * 1.0 * w), trim
        )
        strap = [
            (side * 0.35 * w, -0.75 * d, 0.90 * h),
            (side * 0.55 * w, -1.30 * d, 0.75 * h),
            (side * 0.65 * w, -1.45 * d, 0.45 * h),
            (side * 0.80 * w, -1.00 * d, 0.12 * h),
        ]
        band = tube(strap, 0.022, 8)
        piece.add(band, dark)
    arch = [
        (-0.97 * w, 0.3 * d, 0.50 * h),
        (-0.80 * w, 0.66 * d, 0.76 * h),
        (0.0, 0.74 * d, 0.86 * h),
        (0.80 * w, 0.66 * d, 0.76 * h),
        (0.97 * w, 0.3 * d, 0.50 * h),
    ]
    piece.add(tube(arch, 0.006, 6), dark)
    piece.add(tube([(-0.03, -0.02, h - 0.015), (0.0, -0.02, h + 0.035), (0.03, -0.02, h - 0.015)], 0.008, 8), dark)
    return piece


LABELED: dict[str, Callable[[Rng], Furniture]] = {
    "bed": bed,
    "chair": chair,
    "couch": couch,
    "dining table": dining_table,
    "book": book,
    "refrigerator": refrigerator,
    "tv": tv,
    "toilet": toilet,
    "backpack": backpack,
}
"""A maker for each of the nine classes."""

"""Random small objects, and shelves with objects.

Only books have a class.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from framework.synthetic import paints
from framework.synthetic.furniture import clutter, tabletops
from framework.synthetic.furniture.piece import Furniture, Rng
from framework.synthetic.furniture.solids import Section, cylinder, lathe, loft, rounded_box
from framework.synthetic.paints import Material, Texture

MakeThing = Callable[[Rng], Furniture]


def papers(rng: Rng) -> Furniture:
    """Return an untidy stack of paper."""
    piece = Furniture("papers")
    z = 0.0
    for _ in range(int(rng.integers(2, 5))):
        thickness = rng.uniform(0.004, 0.014)
        sheet = rounded_box(0.21, 0.297, thickness, 0.001).flat(0, 1).turned("z", rng.uniform(-0.3, 0.3))
        ink = Material(Texture.BOOK, (0.92, 0.91, 0.88), (0.30, 0.30, 0.33), 0.1, (0.21, 0.297), paints.new_seed(rng))
        piece.add(sheet, ink, rng.uniform(-0.02, 0.02), rng.uniform(-0.02, 0.02), z + thickness / 2)
        z += thickness
    return piece


def bottle(rng: Rng) -> Furniture:
    """Return a random bottle."""
    piece = Furniture("bottle")
    r, height = rng.uniform(0.033, 0.042), rng.uniform(0.26, 0.32)
    profile = ((0.0, 0.95 * r), (0.01, r), (0.6 * height, r), (0.75 * height, 0.4 * r), (height, 0.38 * r))
    glass = replace(paints.glaze(rng, paints.vivid(rng)), shiny=paints.POLISHED)
    piece.add(lathe(profile, 20, 0.04), glass)
    return piece


def waste_bin(rng: Rng) -> Furniture:
    """Return a full waste bin."""
    piece = Furniture("bin")
    r, height = rng.uniform(0.11, 0.14), rng.uniform(0.27, 0.34)
    color = paints.pick(rng, ((0.12, 0.12, 0.13), (0.62, 0.63, 0.64), (0.75, 0.30, 0.22)))
    piece.add(cylinder(0.82 * r, height, r, 24), paints.metal(rng, color))
    crumpled = rounded_box(1.2 * r, 1.2 * r, 0.1, 0.045, 3).turned("z", rng.uniform(0, 1))
    piece.add(crumpled, paints.paint(rng, (0.90, 0.89, 0.86), 0.7, 0.02), z=height)
    return piece


def basket(rng: Rng) -> Furniture:
    """Return a basket of laundry."""
    piece = Furniture("basket")
    a, b, height = rng.uniform(0.20, 0.26), rng.uniform(0.16, 0.20), rng.uniform(0.26, 0.36)
    wicker = Material(Texture.CHECKS, (0.66, 0.50, 0.32), (0.50, 0.36, 0.22), 0.03, seed=paints.new_seed(rng))
    piece.add(loft([Section(0.0, 0.85 * a, 0.85 * b, n=3), Section(height, a, b, n=3)], 28), wicker)
    heap = clutter.clothes(rng)
    low, high = heap.bounds()
    fit = min(1.7 * a / (high - low)[0], 1.7 * b / (high - low)[1])
    for solid, material in heap.parts:
        piece.add(solid.deformed(lambda p: p * (fit, fit, 1.0)), material, z=height - 0.03)
    return piece


def shoes(rng: Rng) -> Furniture:
    """Return a random pair of shoes."""
    piece = Furniture("shoes")
    color = paints.vivid(rng)
    upper, sole = paints.cloth(rng, color), paints.paint(rng, (0.85, 0.84, 0.80))
    heel = [Section(z, 0.045, 0.14, n=2.6) for z in (0.0, 0.025)]
    shape = [Section(0.024, 0.042, 0.135, n=2.5), Section(0.06, 0.038, 0.10, y=-0.03, n=2.3)]
    shape.append(Section(0.10, 0.032, 0.055, y=-0.07, n=2.2))
    for side in (-1, 1):
        turn, x = rng.uniform(-0.2, 0.2), 0.065 * side
        piece.add(loft(heel, 20).turned("z", turn), sole, x)
        piece.add(loft(shape, 20).turned("z", turn), upper, x)
    return piece


def carton_stack(rng: Rng) -> Furniture:
    """Return a stack of two cardboard boxes."""
    piece, upper = clutter.carton(rng), clutter.carton(rng)
    top, angle = float(piece.bounds()[1][2]), rng.uniform(-0.15, 0.15)
    for solid, material in upper.parts:
        smaller = solid.deformed(lambda p: 0.8 * p)
        piece.add(smaller.turned("z", angle), material, z=top)
    return piece


def book_row(rng: Rng) -> Furniture:
    """Return a row of upright books, labeled as one instance."""
    row = Furniture("row of books", "book")
    end = 0.0
    for _ in range(int(rng.integers(5, 9))):
        book = tabletops.book(rng)
        low, high = book.bounds()
        end += float(high[2] - low[2]) + 0.0005
        for solid, material in book.parts:
            # A flat book has its spine at -x and its cover up. After the rotation, the spine faces the front and the
            # cover faces the side.
            standing = solid.turned("z", -np.pi / 2).turned("y", -np.pi / 2)
            row.add(standing, material, end, 0.0, float(high[1] - low[1]) / 2)
    return row.placed(-end / 2, 0.0)


def shelf(rng: Rng) -> Furniture:
    """Return an open shelf with objects, labeled as one instance without a class."""
    piece = Furniture("shelf")
    wood = paints.wood(rng)
    width, depth, height = rng.uniform(0.75, 1.0), 0.30, rng.uniform(1.5, 1.9)
    boards = int(rng.integers(4, 6))
    piece.add_pair(rounded_box(0.022, depth, height, 0.002), wood, width / 2 - 0.011, 0, height / 2)
    piece.add(rounded_box(width - 0.04, 0.01, height, 0.002), wood, 0, -depth / 2 + 0.006, height / 2)
    pitch = (height - 0.06) / boards
    for k in range(boards + 1):
        z = 0.03 + k * pitch
        piece.add(rounded_box(width - 0.04, depth - 0.01, 0.022, 0.002), wood, 0, 0.004, z)
        if k < boards:
            _fill(piece, rng, -width / 2 + 0.04, width / 2 - 0.04, z + 0.012, 0.8 * pitch)
    return piece


def _fill(piece: Furniture, rng: Rng, start: float, end: float, z: float, height: float) -> None:
    """Place binders and boxes side by side on a shelf board.

    Args:
        piece: The shelf.
        rng: The random number generator.
        start: The start of the board along x, m.
        end: The end of the board along x, m.
        z: The height of the board, m.
        height: The maximum height of the objects, m.
    """
    x = start
    while True:
        wide = rng.uniform() < 0.2
        w, h = (rng.uniform(0.16, 0.26) if wide else rng.uniform(0.025, 0.07)), height * rng.uniform(0.55, 1.0)
        if x + w > end:
            return
        d = rng.uniform(0.17, 0.23)
        binder = rounded_box(w - 0.002, d, h, 0.003).moved(x + w / 2, -0.13 + d / 2, z + h / 2)
        piece.add(binder, paints.paint(rng, paints.vivid(rng), 0.8, 0.05))
        x += w + (rng.uniform(0.03, 0.15) if rng.uniform() < 0.2 else 0.0)


ON_FLOORS: tuple[MakeThing, ...] = (
    clutter.carton, carton_stack, waste_bin, basket, shoes, clutter.plant, clutter.throw_cushion, clutter.pouf
)  # fmt: skip
ON_TABLES: tuple[MakeThing, ...] = (papers, bottle, clutter.mug, papers, clutter.bowl)
ON_TOPS: tuple[MakeThing, ...] = (clutter.carton, clutter.throw_cushion, basket, papers)


def some(rng: Rng, makers: tuple[MakeThing, ...], count: int) -> list[Furniture]:
    """Return random objects, each created by one of the functions in `makers`."""
    return [makers[int(rng.integers(len(makers)))](rng) for _ in range(count)]

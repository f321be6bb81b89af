"""Random tables and books."""

from __future__ import annotations

from framework.synthetic import paints
from framework.synthetic.furniture.piece import Furniture, Rng
from framework.synthetic.furniture.solids import lathe, leg, rounded_box
from framework.synthetic.paints import Material, Texture


def dining_table(rng: Rng) -> Furniture:
    """Return a random dining table."""
    round_top = rng.uniform() < 0.3
    top_material = paints.wood(rng)
    if round_top:
        piece = Furniture("round table", "dining table")
        radius, height = rng.uniform(0.50, 0.58), rng.uniform(0.73, 0.76)
        foot = [(0.0, 0.27), (0.025, 0.27), (0.06, 0.07), (0.30, 0.045), (height - 0.08, 0.06), (height - 0.035, 0.16)]
        piece.add(lathe(foot, 28), top_material)
        below, above = [(height - 0.034, radius - 0.01), (height - 0.024, radius)], (height, radius - 0.008)
        piece.add(lathe([*below, (height - 0.008, radius), above], 44), top_material)
        return piece
    size = rng.uniform(1.25, 1.6), rng.uniform(0.78, 0.90), rng.uniform(0.73, 0.76)
    return _table("table", *size, top_material, 0.065)


def long_table(rng: Rng) -> Furniture:
    """Return a rectangular dining table."""
    return _table("table", rng.uniform(1.3, 1.7), rng.uniform(0.80, 0.92), 0.745, paints.wood(rng), 0.065)


def desk(rng: Rng) -> Furniture:
    """Return a random desk."""
    return _table("desk", rng.uniform(1.2, 1.45), rng.uniform(0.62, 0.72), 0.73, paints.wood(rng), 0.05)


def coffee_table(rng: Rng) -> Furniture:
    """Return a low table.

    Its class is dining table, as in COCO.
    """
    size = rng.uniform(0.85, 1.1), rng.uniform(0.48, 0.58), rng.uniform(0.38, 0.44)
    return _table("coffee table", *size, paints.wood(rng), 0.05)


def _table(kind: str, width: float, depth: float, height: float, material: Material, thickness: float) -> Furniture:
    piece = Furniture(kind, "dining table")
    piece.add(rounded_box(width, depth, 0.032, 0.008, 2), material, z=height - 0.016)
    inset = thickness / 2 + 0.04
    piece.add_legs(leg(thickness, height - 0.03, 0.65), material, width / 2 - inset, depth / 2 - inset)
    apron = 0.09 if height > 0.5 else 0.05
    z = height - 0.031 - apron / 2
    for y in (-1, 1):
        piece.add(rounded_box(width - 2 * inset, 0.02, apron, 0.003), material, 0, y * (depth / 2 - inset), z)
    piece.add_pair(rounded_box(0.02, depth - 2 * inset, apron, 0.003), material, width / 2 - inset, 0, z)
    return piece


def book(rng: Rng) -> Furniture:
    """Return a closed book that lies flat."""
    piece = Furniture("book", "book")
    _add_book(piece, rng, rng.uniform(0.17, 0.25), rng.uniform(0.24, 0.32), rng.uniform(0.025, 0.05))
    return piece


def book_pile(rng: Rng) -> Furniture:
    """Return a pile of three or four books, labeled as one instance."""
    piece = Furniture("pile of books", "book")
    z = 0.0
    for k in range(int(rng.integers(3, 5))):
        thickness, shrink = rng.uniform(0.025, 0.045), 1 - 0.07 * k
        angle, x = rng.uniform(-0.25, 0.25), rng.uniform(-0.01, 0.01)
        _add_book(piece, rng, 0.23 * shrink, 0.30 * shrink, thickness, angle, x, z)
        z += thickness + 0.0005
    return piece


def _add_book(
    piece: Furniture,
    rng: Rng,
    width: float,
    height: float,
    thickness: float,
    angle: float = 0.0,
    x: float = 0.0,
    z: float = 0.0,
) -> None:
    color = paints.vivid(rng)
    ink = (0.95, 0.92, 0.82) if sum(color) < 1.6 else (0.12, 0.10, 0.10)
    cover = Material(Texture.BOOK, color, ink, 0.1, (width, height), paints.new_seed(rng))
    pages = Material(Texture.PAGES, (0.93, 0.90, 0.82), (0.78, 0.74, 0.66), seed=paints.new_seed(rng))
    board = 0.003
    side = rounded_box(width, height, board, 0.001).flat(0, 1)
    back = rounded_box(board, height, thickness - 0.0012, 0.001)
    block = rounded_box(width - 0.008, height - 0.010, thickness - 2 * board, 0.0005)
    parts = (
        (side.moved(z=thickness - board / 2), cover),
        (side.moved(z=board / 2), cover),
        (back.moved(-width / 2 + board / 2 - 0.0005, 0, thickness / 2), paints.cloth(rng, color)),
        (block.moved(0.001, 0, thickness / 2), pages),
    )
    for solid, material in parts:
        piece.add(solid.turned("z", angle), material, x, 0, z)

"""What lies about on beds and couches: cushions, blankets and clothes. None is of the nine classes."""

from __future__ import annotations

import numpy as np

from framework.data import Float64
from framework.synthetic import paints
from framework.synthetic.furniture.piece import Furniture, Rng
from framework.synthetic.furniture.solids import Solid, cushion, rounded_box

WEAVE = 0.04  # m, between the vertices of cloth: what a crease can follow


def throw_cushion(rng: Rng) -> Furniture:
    piece = Furniture("cushion", None)
    side = rng.uniform(0.38, 0.5)
    piece.add(cushion(side, rng.uniform(0.8, 1.0) * side, rng.uniform(0.13, 0.18)), paints.patterned_cloth(rng))
    return piece.placed(0.0, 0.0, -float(piece.bounds()[0][2]))


def blanket(rng: Rng, width: float, depth: float) -> Furniture:
    """A thrown-down blanket, with creases up to 3 cm high."""
    piece = Furniture("blanket", None)
    sheet = rounded_box(width, depth, 0.03, 0.012, 2, WEAVE)
    piece.add(_crumpled(sheet, rng, 0.03, 0.05).moved(z=0.015), paints.patterned_cloth(rng))
    return piece


def clothes(rng: Rng) -> Furniture:
    """Two garments in a heap."""
    piece = Furniture("clothes", None)
    for k in range(2):
        sheet = rounded_box(rng.uniform(0.42, 0.55), rng.uniform(0.34, 0.42), 0.035, 0.016, 2, WEAVE)
        heap = _crumpled(sheet, rng, 0.05, 0.08).turned("z", rng.uniform(-0.7, 0.7))
        piece.add(
            heap.moved(rng.uniform(-0.06, 0.06), rng.uniform(-0.06, 0.06), 0.018 + 0.04 * k),
            paints.cloth(rng),
        )
    return piece


def _crumpled(sheet: Solid, rng: Rng, height: float, fringe: float) -> Solid:
    """With creases that rise up to `height` m, and a border that wanders by up to `fringe` m."""
    a, b, c, d = rng.uniform(0, 2 * np.pi, 4)

    def crumple(p: Float64) -> Float64:
        x, y = p[:, 0].copy(), p[:, 1].copy()
        wave = np.sin(9 * x + 2.5 * np.sin(6 * y + a) + b) + np.sin(8 * y + 3 * np.sin(5 * x + c) + d)
        p[:, 2] += height * (0.5 + 0.25 * wave)
        p[:, 0] += fringe / 2 * (np.sin(5 * y + b) + np.sin(11 * y + c))
        p[:, 1] += fringe / 2 * (np.sin(6 * x + d) + np.sin(10 * x + a))
        return p

    return sheet.deformed(crumple)

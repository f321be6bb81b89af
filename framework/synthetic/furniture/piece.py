"""One piece of furniture: parts in a local frame.

It stands on z = 0 about the origin and faces +y: its back, if it has one, is at negative y.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from framework.data import Float64
from framework.synthetic.furniture.solids import Solid
from framework.synthetic.paints import Material

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

    def tilted(self, angle: float) -> Furniture:
        """Turned by `angle` rad about x, its front going up, then lifted so that it stands on z = 0 again."""
        parts = [(solid.turned("x", angle), material) for solid, material in self.parts]
        tilted = Furniture(self.kind, self.class_name, parts)
        return tilted.placed(0.0, 0.0, -float(tilted.bounds()[0][2]))


def corners(x: float, y: float) -> tuple[tuple[float, float], ...]:
    return (-x, -y), (x, -y), (x, y), (-x, y)

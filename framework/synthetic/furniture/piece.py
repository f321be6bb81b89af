"""Furniture pieces of synthetic scenes.

A piece is at the origin of its local frame, stands on z = 0, and faces +y.
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
    """A piece of furniture, composed of solids with one material each."""

    kind: str  # readable name, such as "office chair"
    class_name: str | None = None  # COCO class; None = not evaluated
    parts: list[tuple[Solid, Material]] = field(default_factory=list)

    def add(self, solid: Solid, material: Material, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> None:
        """Add a part at an offset in m."""
        self.parts.append((solid.moved(x, y, z), material))

    def add_pair(self, solid: Solid, material: Material, x: float, y: float = 0.0, z: float = 0.0) -> None:
        """Add a part twice, at the offsets x and -x, m."""
        for side in (-1, 1):
            self.add(solid, material, side * x, y, z)

    def add_legs(self, solid: Solid, material: Material, x: float, y: float) -> None:
        """Add a part four times, at the corners (±x, ±y), m."""
        for corner in ((-x, -y), (x, -y), (x, y), (-x, y)):
            self.add(solid, material, *corner)

    def bounds(self) -> tuple[Float64, Float64]:
        """Return the lower and upper corner (3,) of the axis-aligned bounding box, m."""
        lows = np.array([solid.vertices.min(axis=0) for solid, _ in self.parts])
        highs = np.array([solid.vertices.max(axis=0) for solid, _ in self.parts])
        return lows.min(axis=0), highs.max(axis=0)

    def placed(self, x: float, y: float, z: float = 0.0, angle: float = 0.0) -> Furniture:
        """Return a copy that is rotated about z, then translated.

        The angle is in rad, and the translation is in m.
        """
        parts = [(solid.turned("z", angle).moved(x, y, z), material) for solid, material in self.parts]
        return Furniture(self.kind, self.class_name, parts)

    def tilted(self, angle: float) -> Furniture:
        """Return a copy that is tilted backward by an angle in rad and placed on z = 0."""
        parts = [(solid.turned("x", angle), material) for solid, material in self.parts]
        tilted = Furniture(self.kind, self.class_name, parts)
        return tilted.placed(0.0, 0.0, -float(tilted.bounds()[0][2]))

"""The colours of instances that come one after the other: each keeps the one that it got."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from framework.data import Float64, InstanceMesh, UInt8
from framework.rendering.palette import instance_colors

TINT = 0.6  # of the instance's colour, in that of its vertices; the rest is their own brightness


class InstanceColors:
    """The palette of overview.png, by instance."""

    def __init__(self) -> None:
        self._centroids: dict[int, Float64] = {}  # (3,) m, where each was when it was first seen
        self._colors: dict[int, UInt8] = {}  # (3,) RGB

    def add(self, centroids: Mapping[int, Float64]) -> None:
        """Takes instances with their centroids (3,) m; those that are known keep their colour."""
        new = {key: centroids[key] for key in sorted(centroids.keys() - self._centroids.keys())}
        if new:
            self._centroids |= new
            everything = instance_colors(np.array([*self._centroids.values()], np.float64))
            self._colors = dict(zip(self._centroids, everything, strict=True))

    def __getitem__(self, instance_id: int) -> UInt8:
        return self._colors[instance_id]

    def painted(self, mesh: InstanceMesh) -> UInt8:
        """(V, 3) RGB of a mesh's vertices: their own colours, and those of the instances where they have one."""
        palette = np.zeros((int(mesh.instance_ids.max(initial=0)) + 1, 3), np.float32)
        for key in np.unique(mesh.instance_ids[mesh.instance_ids > 0]).tolist():
            palette[key] = self._colors[key]
        chosen = mesh.instance_ids > 0
        gray = mesh.colors[chosen].mean(axis=1, keepdims=True, dtype=np.float32)
        colors = mesh.colors.copy()
        colors[chosen] = (1 - TINT) * gray + TINT * palette[mesh.instance_ids[chosen]]
        return colors

    def known(self) -> Mapping[int, UInt8]:
        """RGB (3,) by instance."""
        return self._colors

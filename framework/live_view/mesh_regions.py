"""Changed regions of a growing mesh."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import blake2b

import numpy as np

from framework.data import Float32, Int32, Int64, UInt8

Region = tuple[int, int, int]
"""Index (x, y, z) of a cube: vertex position divided by the side, rounded down."""


@dataclass(frozen=True)
class MeshPart:
    """The triangles whose first vertex is in a region, with their vertices."""

    vertices: Float32  # (V, 3) m, in the world frame
    triangles: Int32  # (F, 3) vertex indices; no vertices and no triangles = removed part
    colors: UInt8  # (V, 3) RGB


class MeshRegions:
    """Partition of a growing mesh into cubes, to find the parts that change."""

    def __init__(self, side: float) -> None:
        self.side = side  # m
        self._digests: dict[Region, bytes] = {}

    def changed(self, vertices: Float32, triangles: Int32, colors: UInt8) -> Iterator[tuple[Region, MeshPart]]:
        """Yield the regions and parts of a mesh that changed or were removed since the last call.

        Args:
            vertices: Vertices (V, 3) in the world frame, m.
            triangles: Vertex indices (F, 3).
            colors: RGB vertex colors (V, 3).
        """
        gone = set(self._digests)
        for region, chosen in _by_region(vertices, triangles, self.side):
            gone.discard(region)
            used, corners = np.unique(triangles[chosen], return_inverse=True)
            part = MeshPart(vertices[used], corners.reshape(-1, 3).astype(np.int32), colors[used])
            digest = blake2b(part.vertices.tobytes(), digest_size=16)
            digest.update(part.triangles.tobytes())
            digest.update(part.colors.tobytes())
            if self._digests.get(region) != digest.digest():
                self._digests[region] = digest.digest()
                yield region, part
        for region in sorted(gone):
            del self._digests[region]
            yield region, MeshPart(vertices[:0], triangles[:0], colors[:0])


def _by_region(vertices: Float32, triangles: Int32, side: float) -> Iterator[tuple[Region, Int64]]:
    """Yield each nonempty region with its triangle indices (M,), in ascending order."""
    if not len(triangles):
        return
    cubes = np.floor(vertices[triangles[:, 0]] / np.float32(side)).astype(np.int64)
    low = cubes.min(axis=0)
    shape = tuple((cubes.max(axis=0) - low + 1).tolist())
    codes = np.ravel_multi_index(tuple((cubes - low).T), shape)
    # NumPy uses the faster radix sort for 16-bit keys
    order = np.argsort(codes.astype(np.uint16) if np.prod(shape) <= 2**16 else codes, kind="stable")
    ordered = codes[order]
    starts = np.flatnonzero(np.diff(ordered, prepend=-1))
    for start, end in zip(starts, [*starts[1:], len(order)], strict=True):
        x, y, z = (np.array(np.unravel_index(ordered[start], shape)) + low).tolist()
        yield (x, y, z), order[start:end]

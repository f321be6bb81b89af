"""Which cells hang together, as a forest: `parents[cell]` is a cell of the same piece, a root its own parent.

SciPy's DisjointSet is a Python object, which kernels cannot call.
"""

from __future__ import annotations

from numba import njit

from framework.data import Int32


@njit(cache=True, nogil=True)
def root(parents: Int32, cell: int) -> int:
    """The root of the cell's piece; shortens the way to it for the next time."""
    while parents[cell] != cell:
        parents[cell] = parents[parents[cell]]
        cell = parents[cell]
    return cell


@njit(cache=True, nogil=True)
def unite(parents: Int32, a: int, b: int) -> None:
    """Joins the pieces of two cells. The smaller root stays one: pieces are named after their first cells."""
    a, b = root(parents, a), root(parents, b)
    if a < b:
        parents[b] = a
    else:
        parents[a] = b

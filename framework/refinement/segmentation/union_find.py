"""Union-find for kernels.

`parents[cell]` is a cell of the same component. The root of a component is its own parent.
"""

from __future__ import annotations

from framework.compilation.kernel_cache import njit
from framework.data import Int32


@njit(cache=True, nogil=True)
def root(parents: Int32, cell: int) -> int:
    """Return the root of the component of a cell."""
    while parents[cell] != cell:  # with path halving
        parents[cell] = parents[parents[cell]]
        cell = parents[cell]
    return cell


@njit(cache=True, nogil=True)
def unite(parents: Int32, a: int, b: int) -> None:
    """Join the components of two cells.

    The smaller root remains.
    """
    a, b = root(parents, a), root(parents, b)
    if a < b:
        parents[b] = a
    else:
        parents[a] = b

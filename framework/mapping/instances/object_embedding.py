"""Object embeddings: the mean embedding of the detections of an object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from framework.data import LONGEST_EMBEDDING, LONGEST_SPACE, Array, Float32, Float64, check_array
from framework.errors import DataError
from framework.mapping.storage.map_header import LARGEST_COUNT, MapHeader

ARRAYS = ("embedding_ids", "embedding_sums", "embedding_weights", "embedding_counts")
"""Arrays of a map file with D-dimensional embeddings of M instances.

Their shapes and types are (M,) int32, (M, D) float64, (M,) float64 and (M,) int64.
"""

SPACE = "embedding_space"  # key of the embedding space in a saved table
MAX_WEIGHT = 1e12  # maximum weight of an embedding


@dataclass(frozen=True)
class ObjectEmbedding:
    """The embedding of an object, stored as the weighted sum of the unit embeddings of its detections."""

    sum: Float64  # (D,)
    weight: float  # > 0, the sum of the weights
    count: int  # number of vectors, >= 1

    @classmethod
    def of(cls, embedding: Float32, weight: float) -> ObjectEmbedding:
        """Return the embedding for a single unit vector (D,)."""
        return cls(weight * embedding.astype(np.float64), weight, 1)

    def __add__(self, other: ObjectEmbedding) -> ObjectEmbedding:
        if self.sum.shape != other.sum.shape:
            raise DataError(
                f"detector: expected embeddings of equal length, got {len(self.sum)} and {len(other.sum)} numbers; map "
                "again with one embedding model"
            )
        return ObjectEmbedding(self.sum + other.sum, self.weight + other.weight, self.count + other.count)

    @property
    def mean(self) -> Float32:
        """Normalized sum (D,) of the embeddings, or zeros if they cancel out."""
        length = float(np.linalg.norm(self.sum))
        return np.asarray(self.sum / length if length > 0 else self.sum, np.float32)

    @property
    def spread(self) -> float:
        """Spread of the embeddings in [0, 1], 0 = all equal."""
        # 1 minus the length of the weighted mean of the unit vectors
        return float(np.clip(1 - np.linalg.norm(self.sum) / self.weight, 0, 1))


def added(known: ObjectEmbedding | None, new: ObjectEmbedding | None) -> ObjectEmbedding | None:
    """Return the sum of two embeddings, each of which may be None."""
    if known is None or new is None:
        return known or new
    return known + new


def agreed_space(known: str, found: str) -> str:
    """Return the embedding space of the map, which is set by its first embeddings.

    Args:
        known: The embedding space of the map, or "" before its first embeddings.
        found: The space of the current embeddings.

    Raises:
        DataError: If the two differ.
    """
    if known and known != found:
        raise DataError(
            f"detector: expected embeddings from {known} (as in the map), got {found}; use the embedding "
            "model of the map, or map again"
        )
    return found


def embedding_arrays(embeddings: Mapping[int, ObjectEmbedding]) -> dict[str, Array]:
    """Return the arrays of embeddings for a map file.

    The result is empty if there are no embeddings.
    """
    if not embeddings:
        return {}
    values = list(embeddings.values())
    return {
        "embedding_ids": np.array(list(embeddings), np.int32),
        "embedding_sums": np.stack([value.sum for value in values]),
        "embedding_weights": np.array([value.weight for value in values], np.float64),
        "embedding_counts": np.array([value.count for value in values], np.int64),
    }


def read_embeddings(plain: MapHeader, arrays: Mapping[str, Any]) -> tuple[str, dict[int, ObjectEmbedding]]:
    """Return the embedding space and the embeddings by instance id of a map file.

    The space is "" if the file has no embeddings.

    Raises:
        DataError: If the embeddings are invalid.
    """
    if SPACE not in plain.values:
        return "", {}
    space = plain.values[SPACE]
    if not isinstance(space, str) or not 0 < len(space) <= LONGEST_SPACE:
        raise DataError(
            f"{plain.name}.{SPACE}: expected a string of 1 to {LONGEST_SPACE} characters, got {space!r:.60}"
        )
    missing = [name for name in ARRAYS if name not in arrays]
    if missing:
        raise DataError(f"expected the arrays {', '.join(missing)} for the embedding space {space}, got none")
    ids, sums, weights, counts = (arrays[name] for name in ARRAYS)
    n = len(ids) if ids.ndim else 0
    dimension = sums.shape[1] if sums.ndim == 2 else 0
    if not 1 <= dimension <= LONGEST_EMBEDDING:
        raise DataError(f"embedding_sums: expected (M, D) with D in [1, {LONGEST_EMBEDDING}], got {sums.shape}")
    check_array("embedding_ids", ids, (n,), np.int32)
    check_array("embedding_sums", sums, (n, dimension), np.float64)
    check_array("embedding_weights", weights, (n,), np.float64)
    check_array("embedding_counts", counts, (n,), np.int64)
    if len(np.unique(ids)) < n:
        raise DataError("embedding_ids: expected unique instances, got duplicates")
    if n and not (weights.min() > 0 and weights.max() <= MAX_WEIGHT):
        raise DataError(
            f"embedding_weights: expected values in (0, {MAX_WEIGHT:g}], got {weights.min()} to {weights.max()}"
        )
    if n and not (counts.min() >= 1 and counts.max() <= LARGEST_COUNT):
        raise DataError(
            f"embedding_counts: expected values in [1, {LARGEST_COUNT}], got {counts.min()} to {counts.max()}"
        )
    with np.errstate(over="ignore"):  # invalid values may overflow
        lengths = np.linalg.norm(sums / weights[:, None], axis=1)
    if n and lengths.max() > 1 + 1e-3:
        raise DataError(f"embedding_sums: expected vectors with norm / weight of at most 1, got {lengths.max():.4g}")
    return space, {
        int(k): ObjectEmbedding(sums[i], float(weights[i]), int(counts[i])) for i, k in enumerate(ids.tolist())
    }

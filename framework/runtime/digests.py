"""Digests of the result of each stage and frame, to find the first difference between two runs."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import singledispatch

import numpy as np

from framework.data import Array, Detections, PointClusters, Pose
from framework.interfaces import SceneMap


@dataclass(frozen=True)
class StageDigest:
    """The digest of the result of one stage for one frame."""

    frame: int  # Frame.index
    stage: str
    digest: int  # CRC-32


@singledispatch
def digest_of(result: object) -> int:
    """Return a CRC-32 of the result of a stage."""
    raise TypeError(f"expected the result of a stage, got {type(result).__name__}")


@digest_of.register
def _(found: Detections) -> int:
    return _of_arrays(found.boxes, found.scores, found.class_probabilities)  # the lifted clusters depend on the masks


@digest_of.register
def _(pose: Pose) -> int:
    return _of_arrays(pose.T_world_camera, np.array([pose.lost]))


@digest_of.register
def _(clusters: PointClusters) -> int:
    return _of_arrays(clusters.points_world, clusters.cluster, clusters.scores, clusters.class_probabilities)


@digest_of.register
def _(scene: SceneMap) -> int:
    return scene.digest()


def _of_arrays(*arrays: Array) -> int:
    """Return a CRC-32 of the shapes of arrays and the sums of their 64-bit words."""
    digest = 0
    for array in arrays:
        values = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        end = len(values) // 8 * 8
        # a CRC of all bytes would take ten times as long
        total = int(values[:end].view(np.uint64).sum()) + int(values[end:].sum())
        digest = zlib.crc32(f"{array.shape}{total};".encode(), digest)
    return digest

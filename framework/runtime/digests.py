"""Digests of the results of each stage and frame, which locate the first difference between two runs."""

from __future__ import annotations

import zlib
from dataclasses import astuple, dataclass
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
    return _of_arrays(found.boxes, found.scores, found.class_probabilities)  # masks: see the lifted clusters


@digest_of.register
def _(pose: Pose) -> int:
    return _of_arrays(pose.T_world_camera, np.array([pose.lost]))


@digest_of.register
def _(clusters: PointClusters) -> int:
    return _of_arrays(clusters.points_world, clusters.cluster, clusters.scores, clusters.class_probabilities)


@digest_of.register
def _(scene: SceneMap) -> int:
    return zlib.crc32(repr((astuple(scene.statistics), sorted(scene.instance_ids()))).encode())


def _of_arrays(*arrays: Array) -> int:
    """Return a CRC-32 of the shapes and byte sums of arrays. A CRC of all bytes takes ten times as long."""
    digest = 0
    for array in arrays:
        words = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        words = words.view(np.uint32) if len(words) % 4 == 0 else words
        digest = zlib.crc32(f"{array.shape}{int(words.sum(dtype=np.uint64))};".encode(), digest)
    return digest

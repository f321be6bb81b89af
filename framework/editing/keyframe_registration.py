"""Registration of two sets of keyframes by their features.

Keyframes with similar visual words are matched. A rigid transform follows from three matches of a pair of keyframes
(RANSAC: Fischler and Bolles, 1981). The transform with which the most matches of all pairs agree is refined.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from framework.data import Bool, Float64
from framework.evaluation.trajectory import umeyama
from framework.geometry import pose_distance, transform
from framework.tracking.features import match
from framework.tracking.keyframes import Keyframe, similarity

CANDIDATES = 6  # maximum number of keyframes of one map that are matched with a keyframe of the other map
MAX_RATIO = 0.8  # maximum ratio of best to second-best descriptor distance
MAX_ERROR = 0.06  # m, maximum distance of the points of an inlier; includes the drift of both maps
MIN_PAIR_MATCHES = 8  # minimum number of matches of a pair of keyframes for a hypothesis
TRIALS = 400  # number of random samples of each pair of keyframes
MIN_INLIERS = 40  # minimum number of inliers of a transform; different rooms have up to 20
MIN_SIDE = 0.1  # m, minimum side of the triangle of a sample
REFINEMENTS = 5  # maximum number of least-squares fits to all inliers
SAME = 1.0  # m and rad, maximum difference of transforms that are the same solution


class PointMatches(NamedTuple):
    """Matched points of two maps."""

    points_a: Float64  # (M, 3) m, in the world of the first map
    points_b: Float64  # (M, 3) m, in the world of the second map
    starts: list[int]  # first match of each pair of keyframes, and M

    def inliers(self, T_a_b: Float64) -> Bool:
        """Return a Boolean array (M,), True for the matches that agree with a transform (4, 4)."""
        return np.asarray(np.linalg.norm(transform(T_a_b, self.points_b) - self.points_a, axis=1) <= MAX_ERROR)

    def part(self, chosen: Bool | slice) -> PointMatches:
        """Return some of the matches as those of one pair."""
        points_a, points_b = self.points_a[chosen], self.points_b[chosen]
        return PointMatches(points_a, points_b, [0, len(points_a)])


class Registration(NamedTuple):
    """A transform between two maps, with its evidence."""

    T_a_b: Float64  # (4, 4)
    matches: PointMatches  # the inliers
    other_inliers: int  # number of inliers of the best different transform


def match_keyframes(keyframes_a: Sequence[Keyframe], keyframes_b: Sequence[Keyframe]) -> PointMatches:
    """Return the matched points of the keyframes with similar visual words."""
    bags = np.stack([one.bag for one in keyframes_a])
    found_a, found_b, starts = [np.zeros((0, 3))], [np.zeros((0, 3))], [0]
    for b in keyframes_b:
        for k in np.argsort(-similarity(b.bag, bags), kind="stable")[:CANDIDATES]:
            a = keyframes_a[k]
            pairs = match(b.descriptors, a.descriptors, MAX_RATIO)
            if len(pairs) >= MIN_PAIR_MATCHES:
                found_b.append(b.points_world[pairs[:, 0]].astype(np.float64))
                found_a.append(a.points_world[pairs[:, 1]].astype(np.float64))
                starts.append(starts[-1] + len(pairs))
    return PointMatches(np.concatenate(found_a), np.concatenate(found_b), starts)


def register(matches: PointMatches) -> Registration | None:
    """Return the transform with the most inliers, or None if there are too few."""
    rng = np.random.default_rng(0)
    hypotheses = []
    for start, end in zip(matches.starts[:-1], matches.starts[1:], strict=True):
        best = _best_of_pair(matches.part(slice(start, end)), rng)
        if best is not None:
            hypotheses.append((int(matches.inliers(best).sum()), best))
    if max((count for count, _ in hypotheses), default=0) < MIN_INLIERS:
        return None
    T_a_b = _refined(max(hypotheses, key=lambda one: one[0])[1], matches)
    others = [count for count, other in hypotheses if pose_distance(T_a_b, other) > SAME]
    return Registration(T_a_b, matches.part(matches.inliers(T_a_b)), max(others, default=0))


def _best_of_pair(pair: PointMatches, rng: np.random.Generator) -> Float64 | None:
    """Return the transform (4, 4) of three matches with the most inliers of a pair of keyframes."""
    samples = rng.integers(len(pair.points_a), size=(TRIALS, 3))
    a, b = pair.points_a[samples], pair.points_b[samples]  # (TRIALS, 3, 3)
    sides_a, sides_b = (np.linalg.norm(one - np.roll(one, 1, axis=1), axis=2) for one in (a, b))
    sound = (sides_a.min(axis=1) >= MIN_SIDE) & (np.abs(sides_a - sides_b).max(axis=1) <= 2 * MAX_ERROR)
    if not sound.any():
        return None
    transforms = _fitted(a[sound], b[sound])
    moved = np.einsum("nij,mj->nmi", transforms[:, :3, :3], pair.points_b) + transforms[:, None, :3, 3]
    counts = (np.linalg.norm(moved - pair.points_a, axis=2) <= MAX_ERROR).sum(axis=1)
    return np.asarray(transforms[counts.argmax()])


def _fitted(a: Float64, b: Float64) -> Float64:
    """Return the rigid transforms (N, 4, 4) that best align the points b (N, 3, 3) with a (N, 3, 3)."""
    center_a, center_b = a.mean(axis=1, keepdims=True), b.mean(axis=1, keepdims=True)
    U, _, Vt = np.linalg.svd((a - center_a).transpose(0, 2, 1) @ (b - center_b))  # Kabsch, 1976
    U[:, :, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[:, None]
    transforms = np.tile(np.eye(4), (len(a), 1, 1))
    transforms[:, :3, :3] = U @ Vt
    transforms[:, :3, 3] = center_a[:, 0] - np.einsum("nij,nj->ni", transforms[:, :3, :3], center_b[:, 0])
    return transforms


def _refined(T_a_b: Float64, matches: PointMatches) -> Float64:
    """Return the least-squares transform of all matches that agree with a transform."""
    inliers = matches.inliers(T_a_b)
    for _ in range(REFINEMENTS):
        before, refined = inliers, np.eye(4)
        refined[:3, :3], refined[:3, 3] = umeyama(matches.points_b[before], matches.points_a[before])
        inliers = matches.inliers(refined)
        if inliers.sum() < before.sum():
            break
        T_a_b = refined
        if np.array_equal(inliers, before):
            break
    return T_a_b

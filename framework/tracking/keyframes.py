"""Keyframes: what the camera has seen from where, so that a lost camera can be found again.

After PTAM (Klein and Murray 2007) and ORB-SLAM (Mur-Artal et al. 2015): the lost frame's bag of visual words proposes
the few keyframes that may show the same place; matched features with depth and P3P in RANSAC tell the pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from framework.config.validation import check_bounds
from framework.data import Array, Float32, Float64, Frame, UInt8, check_array, check_rigid
from framework.errors import ConfigError, DataError
from framework.geometry import back_project, transform
from framework.runtime.cpu_budget import stand_back
from framework.tracking.absolute_pose import AbsolutePose, AbsolutePoseEstimator
from framework.tracking.features import DESCRIPTOR_LENGTH, FeatureExtractor, Features, match

SAVED: Mapping[str, tuple[tuple[int | None, ...], type]] = {
    "poses": ((None, 4, 4), np.float64),  # T_world_camera
    "counts": ((None,), np.int32),  # of points, of each
    "points_world": ((None, 3), np.float32),  # m, of one after the other
    "descriptors": ((None, DESCRIPTOR_LENGTH), np.uint8),
}
"""The arrays that keyframes are saved as: shapes and types."""

BARREN_SEPARATION = 0.25  # of that between keyframes: what has too few features is worth another look from here on


@dataclass(frozen=True)
class Keyframe:
    """The features of one trusted frame that have a depth."""

    T_world_camera: Float64  # (4, 4)
    points_world: Float32  # (F, 3) m
    descriptors: UInt8  # (F, 128)
    bag: Float32  # of visual words

    @property
    def bytes(self) -> int:
        return self.points_world.nbytes + self.descriptors.nbytes + self.bag.nbytes


@dataclass
class Keyframes:
    """A bounded database of keyframes.

    `add` is offered every trusted frame; the features of one that shows something new are found by a thread of its own.
    Whatever else is asked or told waits for that first, so that all answers are as if nothing had been put off.
    `relocalize` costs the same whatever the number of keyframes, but for the comparison of their bags of words.

    Measured on 640x480 frames of redkitchen on one core: a frame that is not new takes 0.02 ms, one that is added
    20 ms in its thread, a lost one 30 to 50 ms (of which features 20; the bags of 200 keyframes 4). With keyframes from
    frames 0 to 149, every second frame of 150 to 299 is found (24 inliers and a ratio of 0.2 at the least, 0.06 m in
    the median and 0.2 m at worst), also among 69 keyframes of another flat. Garbage, black frames and three other
    scenes are not (6 inliers at most), nor mirrored frames of the same kitchen (17 inliers at a ratio of 0.17, 20 at
    0.12).
    """

    max_keyframes: int = 200  # >= 1; beyond, the one that the others replace best is dropped
    min_distance: float = 0.25  # m, > 0: a keyframe is this far from every other, or turned, or half of each
    min_angle: float = 0.3  # rad, > 0
    max_features: int = 800  # >= 1, of a frame
    min_features: int = 30  # >= 4, with depth: a frame with fewer does not become a keyframe
    candidates: int = 6  # >= 1, keyframes that a lost frame is matched with
    max_ratio: float = 0.8  # in (0, 1]: of a match's distance to that of the second best
    max_error: float = 4.0  # px, > 0: of the reprojection of an inlier
    min_inliers: int = 20  # >= 4
    min_inlier_ratio: float = 0.15  # of the matches, in (0, 1]; low, because `candidates` may show other places
    seed: int = 0

    def __post_init__(self) -> None:
        check_bounds(
            self,
            max_keyframes=(1, 100_000),
            min_distance=(1e-3, 100.0),
            min_angle=(1e-3, 10.0),
            max_features=(1, 100_000),
            min_features=(4, 100_000),
            candidates=(1, 1000),
            max_ratio=(1e-3, 1.0),
        )
        self.extractor = FeatureExtractor(self.max_features)
        self._estimator = AbsolutePoseEstimator(self.max_error, self.min_inliers, self.min_inlier_ratio, self.seed)
        self._words = VisualWords(self.seed)
        self._keyframes: list[Keyframe] = []
        self._poses = np.zeros((0, 4, 4))  # of the keyframes
        self._barren: Float64 | None = None  # where the last frame was that had too few features
        self._offered: tuple[Float64, Future[Keyframe | None]] | None = None  # its pose, and what it is found to be

    def __getstate__(self) -> dict[str, Any]:
        """For pickling: without the thread."""
        self._settle()
        return vars(self)

    def __len__(self) -> int:
        self._settle()
        return len(self._keyframes)

    @property
    def byte_count(self) -> int:
        """Bytes that the keyframes take."""
        self._settle()
        return sum(keyframe.bytes for keyframe in self._keyframes)

    def saved(self) -> dict[str, Array]:
        """What `restore` makes them of again; nothing where there is none."""
        self._settle()
        if not self._keyframes:
            return {}
        return {
            "poses": self._poses,
            "counts": np.array([len(keyframe.points_world) for keyframe in self._keyframes], np.int32),
            "points_world": np.concatenate([keyframe.points_world for keyframe in self._keyframes]),
            "descriptors": np.concatenate([keyframe.descriptors for keyframe in self._keyframes]),
        }

    def restore(self, arrays: Mapping[str, Array]) -> None:
        """Takes over the keyframes that another one has `saved`.

        Raises ConfigError where it has saved nothing, DataError where these are none.
        """
        if not arrays:
            raise ConfigError("the run before has left no keyframes, by which a camera finds itself in its map")
        if set(arrays) != set(SAVED):
            raise DataError(f"keyframes are {', '.join(SAVED)}, found {', '.join(arrays) or 'nothing'}")
        for name, (shape, kind) in SAVED.items():
            check_array(name, arrays[name], shape, kind)
        counts = np.asarray(arrays["counts"], np.int64)
        poses, points, descriptors = (arrays[name] for name in ("poses", "points_world", "descriptors"))
        if (
            len(counts) != len(poses)
            or counts.min(initial=0) < 0
            or not counts.sum() == len(points) == len(descriptors)
        ):
            raise DataError(f"keyframes' counts {counts.tolist()!s:.60} are not those of their poses and points")
        self._settle()
        ends = np.cumsum(counts)
        for k, T_world_camera in enumerate(np.asarray(poses, np.float64)):
            check_rigid(f"keyframe {k}", T_world_camera)
            of_this = slice(ends[k] - counts[k], ends[k])
            found = np.ascontiguousarray(descriptors[of_this], np.uint8)
            points_world = np.ascontiguousarray(points[of_this], np.float32)
            self._keyframes.append(Keyframe(T_world_camera, points_world, found, self._words.bag(found)))
        self._poses = np.concatenate([self._poses, np.asarray(poses, np.float64)])

    def add(self, frame: Frame, T_world_camera: Float64) -> None:
        """Offers a frame, which becomes a keyframe if no other one is near and it has features enough.

        That turns out in a thread of its own; what goes wrong in it is raised by whatever is called next and waits.
        """
        if self._near_offered(T_world_camera):
            return  # whether that one becomes a keyframe or has too few features, this one is too near to it
        if not self.is_new(T_world_camera) or self._near_barren(T_world_camera):
            return
        worker = ThreadPoolExecutor(1, "keyframe", stand_back)
        self._offered = T_world_camera.copy(), worker.submit(self._extracted, frame, T_world_camera.copy())
        worker.shutdown(wait=False)  # it ends with this frame

    def _settle(self) -> None:
        """Waits until the frame that was offered last is a keyframe or is not one. Raises what went wrong with it."""
        if self._offered is None:
            return
        T_world_camera, found = self._offered
        try:
            keyframe = found.result()
        finally:
            self._offered = None
        if keyframe is None:
            self._barren = T_world_camera
        else:
            self._append(keyframe)

    def add_with(self, frame: Frame, features: Features, T_world_camera: Float64) -> bool:
        """Makes `frame`, whose features are known, a keyframe if it has enough of them and no other one is near; True
        when it has become one.
        """
        features = features.with_depth()
        if len(features) < self.min_features or not self.is_new(T_world_camera):
            return False
        self._append(self.keyframe(frame, features, T_world_camera))
        return True

    def _extracted(self, frame: Frame, T_world_camera: Float64) -> Keyframe | None:
        """What a frame is as a keyframe; None where it has too few features."""
        features = self.extractor.extract(frame).with_depth()
        return self.keyframe(frame, features, T_world_camera) if len(features) >= self.min_features else None

    def _append(self, keyframe: Keyframe) -> None:
        self._keyframes.append(keyframe)
        self._poses = np.concatenate([self._poses, keyframe.T_world_camera[None]])
        if len(self._keyframes) > self.max_keyframes:
            self._drop_most_redundant()

    def keyframe(self, frame: Frame, features: Features, T_world_camera: Float64) -> Keyframe:
        """What a frame would be as a keyframe; `add_with` keeps it."""
        features = features.with_depth()
        points = back_project(frame.camera, features.pixels, features.depth)
        points_world = np.asarray(transform(T_world_camera, points), np.float32)
        return Keyframe(
            T_world_camera.copy(), points_world, features.descriptors, self._words.bag(features.descriptors)
        )

    def is_new(self, T_world_camera: Float64) -> bool:
        """Whether no keyframe was seen from near here. Takes microseconds."""
        self._settle()
        return bool((self._separation(self._poses, T_world_camera) >= 1).all())

    def _near_offered(self, T_world_camera: Float64) -> bool:
        """Whether the frame that is still being looked at was seen from nearer to here than the next one may be."""
        if self._offered is None:
            return False
        return bool(self._separation(self._offered[0][None], T_world_camera)[0] < BARREN_SEPARATION)

    def _near_barren(self, T_world_camera: Float64) -> bool:
        """Whether the last frame with too few features was seen from near here: this one would cost as much in vain."""
        if self._barren is None:
            return False
        return bool(self._separation(self._barren[None], T_world_camera)[0] < BARREN_SEPARATION)

    def relocalize(self, frame: Frame) -> AbsolutePose | None:
        """The pose of `frame`, wherever it was taken, with the inliers that speak for it; None if it is not known."""
        features = self.extractor.extract(frame)
        return self.locate(frame, features, self.alike(features))

    def alike(self, features: Features) -> list[Keyframe]:
        """The keyframes that look most like an image with these features, best first."""
        self._settle()
        if not self._keyframes:
            return []
        bags = np.stack([keyframe.bag for keyframe in self._keyframes])
        order = np.argsort(-similarity(self._words.bag(features.descriptors), bags), kind="stable")
        return [self._keyframes[k] for k in order[: self.candidates]]

    def nearest(self, T_world_camera: Float64) -> list[Keyframe]:
        """The keyframes seen from nearest to a pose, best first."""
        self._settle()
        order = np.argsort(self._separation(self._poses, T_world_camera), kind="stable")
        return [self._keyframes[k] for k in order[: self.candidates]]

    def locate(self, frame: Frame, features: Features, keyframes: Sequence[Keyframe]) -> AbsolutePose | None:
        """The pose of `frame` from its features' matches with several keyframes at once; None if they do not tell."""
        if not keyframes:
            return None
        matches = [match(features.descriptors, keyframe.descriptors, self.max_ratio) for keyframe in keyframes]
        query = np.concatenate([pairs[:, 0] for pairs in matches])
        points_world = np.concatenate(
            [keyframe.points_world[pairs[:, 1]] for keyframe, pairs in zip(keyframes, matches, strict=True)]
        )
        return self._estimator.estimate(frame.camera, features.pixels[query], points_world, features.depth[query])

    def _separation(self, poses: Float64, T_world_camera: Float64) -> Float64:
        """How far (K,) a pose is from others (K, 4, 4): 1 = far enough for a keyframe of its own."""
        distance = np.linalg.norm(poses[:, :3, 3] - T_world_camera[:3, 3], axis=1)
        cosine = (np.einsum("kij,ij->k", poses[:, :3, :3], T_world_camera[:3, :3]) - 1) / 2
        return np.asarray(distance / self.min_distance + np.arccos(np.clip(cosine, -1, 1)) / self.min_angle)

    def _drop_most_redundant(self) -> None:
        """Drops the older one of the two keyframes that are nearest to each other."""
        separation = np.stack([self._separation(self._poses, T) for T in self._poses])
        np.fill_diagonal(separation, np.inf)
        oldest = int(separation.min(axis=1).argmin())
        del self._keyframes[oldest]
        self._poses = np.delete(self._poses, oldest, axis=0)


BITS = 12  # 4096 words: with fewer, words are too common to tell places apart; with more, too rare to be met again


class VisualWords:
    """A fixed vocabulary, drawn with `seed`.

    A feature's word is the signs of its descriptor's scalar products with a few random vectors (locality-sensitive
    hashing, Charikar 2002). Images are compared by tf-idf (Sivic and Zisserman 2003).
    """

    def __init__(self, seed: int) -> None:
        # as many +1 as -1, so that every vector is orthogonal to the mean descriptor, and sums of bytes are exact
        half = np.repeat(np.array([1, -1], np.float32), DESCRIPTOR_LENGTH // 2)
        rng = np.random.default_rng([seed, BITS])
        self._directions = np.ascontiguousarray(rng.permuted(np.tile(half, (BITS, 1)), axis=1).T)
        self._place = 1 << np.arange(BITS)

    def bag(self, descriptors: UInt8) -> Float32:
        """How often each word occurs, (2^BITS,), damped by a square root."""
        if len(descriptors) == 0:
            return np.zeros(1 << BITS, np.float32)
        words = (cv2.gemm(descriptors.astype(np.float32), self._directions, 1, None, 0) > 0) @ self._place
        return np.sqrt(np.bincount(words, minlength=1 << BITS)).astype(np.float32)


def similarity(bag: Float32, bags: Float32) -> Float32:
    """How similar one image's bag of words is to those of K others (K, 2^BITS): (K,) in [0, 1]."""
    shown_in = np.count_nonzero(bags, axis=0)
    idf = np.log((1 + len(bags)) / (1 + shown_in)).astype(np.float32)
    if not idf.any():
        idf[:] = 1  # of one or two images every word may be in all
    weighted, query = bags * idf, bag * idf
    norms = np.linalg.norm(weighted, axis=1) * np.linalg.norm(query)
    return np.asarray((weighted * query).sum(axis=1) / np.maximum(norms, 1e-9), np.float32)

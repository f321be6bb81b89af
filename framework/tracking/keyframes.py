"""Keyframes for the relocalization of a lost camera.

Visual words select candidate keyframes for a lost frame. Matched features with depth give its pose by P3P in RANSAC.
See PTAM (Klein and Murray, 2007) and ORB-SLAM (Mur-Artal et al., 2015).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from framework.config.validation import check_bounds
from framework.data import Array, Float32, Float64, Frame, Int64, UInt8, check_array, check_rigid
from framework.errors import ConfigError, DataError
from framework.files.atomic_write import path_exists
from framework.geometry import back_project, transform
from framework.interfaces import SubmapChange
from framework.mapping.storage.map_file import read_arrays, write_map
from framework.runtime.cpu_budget import lower_priority
from framework.tracking.absolute_pose import AbsolutePose, AbsolutePoseEstimator
from framework.tracking.features import DESCRIPTOR_LENGTH, FeatureExtractor, Features, match

FILE_FORMAT = "places 1"  # increment it when the meaning of the arrays changes
SAVED: Mapping[str, tuple[tuple[int | None, ...], type]] = {
    "poses": ((None, 4, 4), np.float64),  # T_world_camera
    "counts": ((None,), np.int32),  # number of points of each keyframe
    "points_world": ((None, 3), np.float32),  # m, keyframe by keyframe
    "descriptors": ((None, DESCRIPTOR_LENGTH), np.uint8),
}
"""Shapes and types of the arrays of saved keyframes."""

MIN_RETRY_SEPARATION = 0.25  # minimum separation from a frame with too few features; new keyframes need 1
WORD_BITS = 12  # number of bits of a visual word, i.e. 4096 words


@dataclass(frozen=True)
class Keyframe:
    """The features with depth of a frame with a reliable pose."""

    T_world_camera: Float64  # (4, 4)
    points_world: Float32  # (F, 3) m
    descriptors: UInt8  # (F, 128) RootSIFT
    bag: Float32  # (2^WORD_BITS,) bag of visual words
    submap: int = 0

    def corrected(self, change: SubmapChange) -> Keyframe:
        """Return the keyframe after a change of its submap."""
        T_new_old = change.motions.get(self.submap)
        if T_new_old is None:
            return self
        points_world = np.asarray(transform(T_new_old, self.points_world), np.float32)
        return replace(self, T_world_camera=T_new_old @ self.T_world_camera, points_world=points_world)


@dataclass
class Keyframes:
    """A bounded database of keyframes.

    Call `add` for every frame with a reliable pose. Features of new views are extracted in a background thread. A view
    is new if distance / min_distance + angle / min_angle >= 1 for all keyframes. Methods that use the keyframes wait
    for the thread first, so that results do not depend on timing.

    Call `correct` after each change of the submaps. Keyframes of hidden submaps are kept, but they are not matched, and
    views of their places are new.
    """

    max_keyframes: int = 200  # maximum number of keyframes, >= 1; above it, the most redundant keyframe is removed
    min_distance: float = 0.25  # minimum distance of a new view without rotation, m, > 0
    min_angle: float = 0.3  # minimum angle of a new view without translation, rad, > 0
    max_features: int = 800  # maximum number of features of a frame, >= 1
    min_features: int = 30  # minimum number of features with depth in a keyframe, >= 4
    candidates: int = 6  # maximum number of keyframes matched with a frame, >= 1
    max_ratio: float = 0.8  # maximum ratio of best to second-best descriptor distance (Lowe's ratio test), in (0, 1]
    max_error: float = 4.0  # maximum reprojection error of an inlier, px, > 0
    min_inliers: int = 20  # minimum number of inliers, >= 4
    # minimum fraction of inliers among the matches, in (0, 1]; low, because not all candidates overlap with the frame
    min_inlier_ratio: float = 0.15
    seed: int = 0  # seed of RANSAC and of the visual words, >= 0

    def __post_init__(self) -> None:
        check_bounds(
            self, max_keyframes=(1, 100_000), min_distance=(1e-3, 100.0), min_angle=(1e-3, 10.0),
            max_features=(1, 100_000), min_features=(4, 100_000), candidates=(1, 1000), max_ratio=(1e-3, 1.0),
        )  # fmt: skip
        self.extractor = FeatureExtractor(self.max_features)
        self._estimator = AbsolutePoseEstimator(self.max_error, self.min_inliers, self.min_inlier_ratio, self.seed)
        self._words = VisualWords(self.seed)
        self._keyframes: list[Keyframe] = []
        self._poses = np.zeros((0, 4, 4))  # poses of the keyframes
        self._submap = 0  # submap of the next keyframes
        self._hidden: frozenset[int] = frozenset()  # hidden submaps
        self._barren: Float64 | None = None  # pose of the last frame with too few features
        self._offered: tuple[Float64, Future[Keyframe | None]] | None = None  # pose and keyframe under construction

    def __getstate__(self) -> dict[str, Any]:
        """Return the state after waiting for the background thread."""
        self._settle()
        return vars(self)

    def __len__(self) -> int:
        self._settle()
        return len(self._keyframes)

    def __iter__(self) -> Iterator[Keyframe]:
        self._settle()
        return iter([*self._keyframes])

    def saved(self) -> dict[str, Array]:
        """Return the keyframes as arrays.

        The result is empty if there are no keyframes.
        """
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
        """Add the saved keyframes of another database.

        Raises:
            ConfigError: If there are no keyframes.
            DataError: If the arrays are invalid.
        """
        if not arrays:
            raise ConfigError(
                "resume_from or localize_in: expected a run with stored keyframes, got no keyframes; map again with a "
                "tracker that stores keyframes, such as tracker=voxel_hashing_icp"
            )
        if set(arrays) != set(SAVED):
            raise DataError(f"keyframes: expected the arrays {list(SAVED)}, got {list(arrays)}")
        for name, (shape, kind) in SAVED.items():
            check_array(name, arrays[name], shape, kind)
        counts, poses = np.asarray(arrays["counts"], np.int64), np.asarray(arrays["poses"], np.float64)
        points, descriptors = arrays["points_world"], arrays["descriptors"]
        total = len(points) if len(points) == len(descriptors) else -1
        if len(counts) != len(poses) or counts.min(initial=0) < 0 or counts.sum() != total:
            raise DataError(
                f"keyframe counts: expected {len(poses)} counts >= 0 whose sum equals the numbers of points "
                f"({len(points)}) and descriptors ({len(descriptors)}), got {counts.tolist()!s:.60}"
            )
        self._settle()
        for k, end in enumerate(np.cumsum(counts)):
            check_rigid(f"keyframe {k}", poses[k])
            own = slice(end - counts[k], end)
            own_descriptors = np.ascontiguousarray(descriptors[own], np.uint8)
            points_world = np.ascontiguousarray(points[own], np.float32)
            self._keyframes.append(Keyframe(poses[k], points_world, own_descriptors, self._words.bag(own_descriptors)))
        self._poses = np.concatenate([self._poses, poses])

    def correct(self, change: SubmapChange) -> None:
        """Move the keyframes with their submaps."""
        self._settle()  # the keyframe under construction belongs to the submap before the change
        self._keyframes = [keyframe.corrected(change) for keyframe in self._keyframes]
        self._poses = np.array([keyframe.T_world_camera for keyframe in self._keyframes]).reshape(-1, 4, 4)
        self._barren = None
        self._hidden = self._hidden - change.shown | change.hidden
        self._submap = change.submap

    def add(self, frame: Frame, T_world_camera: Float64) -> None:
        """Add the frame as a keyframe if its view is new and has enough features.

        Features are extracted in a background thread. The next method that waits for this thread raises the exceptions
        of the thread.
        """
        if self._offered is not None and self._is_retry(self._offered[0], T_world_camera):
            return  # too close to the frame under construction, even if that frame has too few features for a keyframe
        if not self.is_new(T_world_camera) or self._is_retry(self._barren, T_world_camera):
            return
        worker = ThreadPoolExecutor(1, "keyframe", lower_priority)
        self._offered = T_world_camera.copy(), worker.submit(self._extracted, frame, T_world_camera.copy())
        worker.shutdown(wait=False)  # the thread ends after this frame

    def _settle(self) -> None:
        """Wait for the background thread, and add its keyframe."""
        if self._offered is None:
            return
        T_world_camera, keyframe_future = self._offered
        try:
            keyframe = keyframe_future.result()
        finally:
            self._offered = None
        if keyframe is None:
            self._barren = T_world_camera
        else:
            self._append(keyframe)

    def add_with(self, frame: Frame, features: Features, T_world_camera: Float64) -> bool:
        """Add the frame with the given features as a keyframe, and return True if it was added.

        The frame is added if its view is new and it has enough features.
        """
        features = features.with_depth()
        if len(features) < self.min_features or not self.is_new(T_world_camera):
            return False
        self._append(self.keyframe(frame, features, T_world_camera))
        return True

    def _extracted(self, frame: Frame, T_world_camera: Float64) -> Keyframe | None:
        """Return the frame as a keyframe, or None if it has too few features."""
        features = self.extractor.extract(frame).with_depth()
        return self.keyframe(frame, features, T_world_camera) if len(features) >= self.min_features else None

    def _append(self, keyframe: Keyframe) -> None:
        """Add a keyframe, and remove the most redundant keyframe if there are too many."""
        self._keyframes.append(keyframe)
        self._poses = np.concatenate([self._poses, keyframe.T_world_camera[None]])
        if len(self._keyframes) > self.max_keyframes:
            separation = np.stack([self._separation(self._poses, T) for T in self._poses])
            np.fill_diagonal(separation, np.inf)
            redundant = int(separation.min(axis=1).argmin())  # the older one of the nearest pair
            del self._keyframes[redundant]
            self._poses = np.delete(self._poses, redundant, axis=0)

    def keyframe(self, frame: Frame, features: Features, T_world_camera: Float64) -> Keyframe:
        """Return the frame as a keyframe without adding it."""
        features = features.with_depth()
        points = back_project(frame.camera, features.pixels, features.depth)
        points_world = np.asarray(transform(T_world_camera, points), np.float32)
        bag = self._words.bag(features.descriptors)
        return Keyframe(T_world_camera.copy(), points_world, features.descriptors, bag, self._submap)

    def is_new(self, T_world_camera: Float64) -> bool:
        """Return True if a camera pose (4, 4) is far enough from all keyframes."""
        visible = self._visible()
        return bool((self._separation(self._poses[visible], T_world_camera) >= 1).all())

    def _visible(self) -> Int64:
        """Return the indices of the keyframes in visible submaps."""
        self._settle()
        return np.flatnonzero([keyframe.submap not in self._hidden for keyframe in self._keyframes])

    def _is_retry(self, T_world_other: Float64 | None, T_world_camera: Float64) -> bool:
        """Return True if a pose is too close to another pose to extract features again."""
        if T_world_other is None:
            return False
        return bool(self._separation(T_world_other[None], T_world_camera)[0] < MIN_RETRY_SEPARATION)

    def relocalize(self, frame: Frame) -> AbsolutePose | None:
        """Return the pose of a frame without a prior pose, or None if it is not found."""
        features = self.extractor.extract(frame)
        return self.locate(frame, features, self.alike(features))

    def alike(self, features: Features) -> list[Keyframe]:
        """Return the keyframes whose visual words are most similar to those of the features, best first."""
        visible = self._visible()
        if not len(visible):
            return []
        bags = np.stack([self._keyframes[k].bag for k in visible])
        order = np.argsort(-similarity(self._words.bag(features.descriptors), bags), kind="stable")
        return [self._keyframes[k] for k in visible[order[: self.candidates]]]

    def nearest(self, T_world_camera: Float64) -> list[Keyframe]:
        """Return the keyframes nearest to a camera pose (4, 4), nearest first."""
        visible = self._visible()
        order = np.argsort(self._separation(self._poses[visible], T_world_camera), kind="stable")
        return [self._keyframes[k] for k in visible[order[: self.candidates]]]

    def locate(self, frame: Frame, features: Features, keyframes: Sequence[Keyframe]) -> AbsolutePose | None:
        """Return the pose of a frame from its matches with the given keyframes, or None if it is not found."""
        if not keyframes:
            return None
        matches = [match(features.descriptors, keyframe.descriptors, self.max_ratio) for keyframe in keyframes]
        query = np.concatenate([pairs[:, 0] for pairs in matches])
        points_world = np.concatenate(
            [keyframe.points_world[pairs[:, 1]] for keyframe, pairs in zip(keyframes, matches, strict=True)]
        )
        return self._estimator.estimate(frame.camera, features.pixels[query], points_world, features.depth[query])

    def _separation(self, poses: Float64, T_world_camera: Float64) -> Float64:
        """Return the separation (K,) of a camera pose from other poses (K, 4, 4)."""
        # 1 = far enough for a new keyframe
        distance = np.linalg.norm(poses[:, :3, 3] - T_world_camera[:3, 3], axis=1)
        cosine = (np.einsum("kij,ij->k", poses[:, :3, :3], T_world_camera[:3, :3]) - 1) / 2
        return np.asarray(distance / self.min_distance + np.arccos(np.clip(cosine, -1, 1)) / self.min_angle)


class VisualWords:
    """A vocabulary of visual words that depends only on a random seed.

    The bits of a word are the signs of the scalar products of the descriptor with random vectors (Charikar, 2002).
    """

    def __init__(self, seed: int) -> None:
        # equal numbers of +1 and -1: each vector is orthogonal to a constant vector, and sums of bytes are exact
        half = np.repeat(np.array([1, -1], np.float32), DESCRIPTOR_LENGTH // 2)
        rng = np.random.default_rng([seed, WORD_BITS])
        self._directions = np.ascontiguousarray(rng.permuted(np.tile(half, (WORD_BITS, 1)), axis=1).T)

    def bag(self, descriptors: UInt8) -> Float32:
        """Return the bag of words (2^WORD_BITS,) of descriptors (F, 128)."""
        if len(descriptors) == 0:
            return np.zeros(1 << WORD_BITS, np.float32)
        signs = cv2.gemm(descriptors.astype(np.float32), self._directions, 1, None, 0) > 0
        words = signs @ (1 << np.arange(WORD_BITS))
        # square roots of the word counts
        return np.sqrt(np.bincount(words, minlength=1 << WORD_BITS)).astype(np.float32)


def similarity(bag: Float32, bags: Float32) -> Float32:
    """Return the tf-idf similarity (K,), in [0, 1], of a bag of words to other bags (K, 2^WORD_BITS)."""
    document_counts = np.count_nonzero(bags, axis=0)  # Sivic and Zisserman, 2003
    idf = np.log((1 + len(bags)) / (1 + document_counts)).astype(np.float32)
    if not idf.any():
        idf[:] = 1  # every word occurs in all images
    weighted, query = bags * idf, bag * idf
    norms = np.linalg.norm(weighted, axis=1) * np.linalg.norm(query)
    return np.asarray((weighted * query).sum(axis=1) / np.maximum(norms, 1e-9), np.float32)


def write_keyframes(path: Path, keyframes: Mapping[str, Array]) -> None:
    """Write the arrays of `Keyframes.saved` to a file."""
    write_map(path, {"format": FILE_FORMAT, "names": sorted(keyframes)}, keyframes)


def read_keyframes(path: Path) -> dict[str, Array]:
    """Return the arrays in a file written by `write_keyframes`.

    The result is empty if there is no file.

    Raises:
        DataError: If the file is invalid.
    """
    if not path_exists(path):
        return {}
    arrays = read_arrays(path, FILE_FORMAT)
    if not arrays:
        raise DataError(f"{path}: expected the arrays {list(SAVED)}, got none; map again")
    return arrays

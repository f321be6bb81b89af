"""Sparse tracking by matching image features with keyframes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from framework.data import Array, Float64, Frame, Pose
from framework.interfaces import PoseTracker, SceneMap, SubmapChange
from framework.tracking.features import Features
from framework.tracking.keyframes import Keyframes


@dataclass
class PycolmapPnp(PoseTracker):
    """Matching of features with the nearest keyframes, and pose estimation by the PnP RANSAC of pycolmap.

    If tracking fails, the tracker relocalizes among all keyframes. It does not use the map. See `Keyframes` for the
    parameters.
    """

    max_features: int = 800  # maximum number of features of a frame, >= 1
    min_features: int = 30  # minimum number of features with depth in a keyframe, >= 4
    max_keyframes: int = 200  # maximum number of keyframes, >= 1; above it, the most redundant keyframe is removed
    # minimum distance between keyframes of equal orientation, m, > 0; new keyframe if distance / min_distance + angle /
    # min_angle >= 1
    min_distance: float = 0.15
    min_angle: float = 0.2  # minimum angle between keyframes at equal position, rad, > 0; see min_distance
    candidates: int = 4  # maximum number of keyframes to match with a frame, >= 1
    max_ratio: float = 0.8  # maximum ratio of best to second-best descriptor distance (Lowe's ratio test), in (0, 1]
    max_error: float = 4.0  # maximum reprojection error of an inlier, px, > 0
    min_inliers: int = 20  # minimum number of inliers, >= 4; below it, the pose is lost
    # minimum fraction of inliers among the matches, in (0, 1]; below it, the pose is lost
    min_inlier_ratio: float = 0.15
    seed: int = 0  # seed of RANSAC and of the visual words, >= 0

    def __post_init__(self) -> None:
        self._keyframes = Keyframes(**vars(self))
        self._T_world_last: Float64 | None = None  # last reliable pose
        self._submap = 0  # submap of the next frame

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        features = self._keyframes.extractor.extract(frame)
        if self._T_world_last is None and len(self._keyframes) == 0:
            return self._begin(frame, features)
        near = [] if self._T_world_last is None else self._keyframes.nearest(self._T_world_last)
        found = self._keyframes.locate(frame, features, near)
        if found is None:
            found = self._keyframes.locate(frame, features, self._keyframes.alike(features))
        if found is None:
            T_world_last = np.eye(4) if self._T_world_last is None else self._T_world_last
            reason = f"too few of the frame's {len(features)} features match the keyframes"
            return Pose(T_world_last, lost=True, reason=reason)
        self._T_world_last = found.T_world_camera
        self._keyframes.add_with(frame, features, found.T_world_camera)
        return Pose(found.T_world_camera)

    def correct(self, change: SubmapChange) -> None:
        self._keyframes.correct(change)
        if self._T_world_last is not None:
            self._T_world_last = change.moved(self._submap, self._T_world_last)
        self._submap = change.submap

    def keyframes(self) -> Mapping[str, Array]:
        return self._keyframes.saved()

    def load_keyframes(self, keyframes: Mapping[str, Array], scene: SceneMap) -> None:
        self._keyframes.restore(keyframes)

    def _begin(self, frame: Frame, features: Features) -> Pose:
        """Return the first pose, which defines the world frame, or a lost pose if the frame has too few features."""
        T_world_camera = np.eye(4) if frame.T_world_camera is None else frame.T_world_camera
        if not self._keyframes.add_with(frame, features, T_world_camera):
            reason = f"the frame has fewer than {self.min_features} features with depth"
            return Pose(T_world_camera, lost=True, reason=reason)
        self._T_world_last = T_world_camera
        return Pose(T_world_camera)

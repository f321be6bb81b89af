"""Frame-to-model tracking: geometric and photometric alignment of each frame to a view of the map."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from framework.config.validation import check_bounds, require
from framework.data import Array, Bool, Camera, Float64, Frame, Pose
from framework.errors import DataError
from framework.geometry import exp_se3, inverse, nearest_rotation, rotation_angle
from framework.interfaces import PoseTracker, SceneMap, SubmapChange
from framework.tracking.absolute_pose import AbsolutePose
from framework.tracking.alignment import LinearWeights, NormalEquations, Weights, linearize, model_view, smoothed
from framework.tracking.depth_scale import DepthScale
from framework.tracking.features import FrameFeatures
from framework.tracking.keyframes import Keyframes
from framework.tracking.pyramid import PyramidLevel, build_pyramid, is_coarse, is_scattered, model_intensities
from framework.tracking.raw_keyframe import COMPARED, NEW_DISTANCE, KeyframeTerm, RawKeyframe
from framework.tracking.uncertainty import is_significant, pose_covariance

LEVELS = 3
CONVERGED = 1e-4  # maximum last step of the finest level, m and rad; the limit is four times larger per coarser level
# maximum motion of a possibly stationary camera, m and rad; larger motions always change the pose
STANDING = 1e-3
SAME_POSE = 0.05  # maximum difference between poses that count as equal, m and rad
SMALLEST = 8  # minimum side of the coarsest level, px
# minimum agreement_in_front near the predicted pose; replaces min_agreement, because an object may have been removed
CHANGED_SCENE = 0.95
EXPECTED_AGREEMENT = 0.8  # minimum agreement near the predicted pose in a steady motion
EXPECTED_BEHIND = 0.1  # maximum fraction behind the surface near the predicted pose in a steady motion
STEADY = 5  # minimum number of consecutive frames with a correct prediction in a steady motion
VISITED = 64  # number of visited poses that are tried for a lost camera, one per frame
VISITED_SEPARATION = 0.1  # minimum separation of these poses, m and rad
RECOVERY_INFORMATION = 2.0  # factor of min_information for a lost camera
# factor of min_information below which odometry determines the motion, because noise of normals simulates information
ODOMETRY_INFORMATION = 5.0


class ResidualWeights(Enum):
    """Weights of residuals.

    See framework/tracking/alignment.py.
    """

    TUKEY = "weights by residual over expected noise, with larger noise at coarse levels and exposure compensation"
    LINEAR = "weights of VoxelHashing's code, equal at all levels, without noise model and exposure compensation"


class Alignment(NamedTuple):
    """Result of the alignment of a frame.

    Fractions are relative to the visible points unless stated otherwise.
    """

    T_world_camera: Float64  # (4, 4)
    matched: float  # fraction of points with a nonzero weight
    agreement: float  # fraction of points that agree with the map
    behind: float  # fraction of points behind the surface of the map
    agreement_in_front: float  # fraction of points that agree with the map, among those not behind its surface
    reason: str  # reason for rejection, empty if the pose is possible
    doubt: str  # reason to require confirmation by a second source, empty if it is not required
    covariance: Float64 | None = None  # (6, 6) Pose.covariance; None = unknown

    @property
    def reliable(self) -> bool:
        """True if the pose is possible and needs no confirmation."""
        return not (self.reason or self.doubt)


class Directions(NamedTuple):
    """Principal directions of motion, with translations in units of the typical depth."""

    vectors: Float64  # (6, 6) orthonormal columns
    determined: Bool  # (6,) True = the points determine the motion along the column of `vectors`


@dataclass
class VoxelHashingIcp(PoseTracker):
    """Coarse-to-fine ICP with color against a view of the map, as in VoxelHashing and ElasticFusion.

    The tracker detects lost poses. A pose is accepted if most points agree with the map. Near the predicted pose of a
    steady motion, less agreement is sufficient. Because wrong poses can also agree with the map, all other poses are
    compared with the pose from features, if there is one.

    The prediction is the motion measured by odometry, if the frames have odometry, and otherwise constant velocity. A
    frame near the prediction of odometry may determine only a part of the motion. Odometry determines the rest.

    A frame is always lost if too few points match, if the motion is implausible, or if the points do not determine the
    motion. All other checks are our additions. Set min_agreement=0 and max_occluded=1 to disable the checks of
    agreement, and relocalize=false to disable the comparison with features.
    """

    residual_weights: ResidualWeights = ResidualWeights.TUKEY  # weights of residuals
    finest_scale: float = 0.5  # scale of the finest level and of the map's view relative to the image, a power of 1/2
    finest_side: int = 640  # maximum side of the finest level, px, >= 0; larger levels are halved; 0 = unlimited
    iterations_coarse: int = 8  # number of iterations at 1/4 of the finest resolution, in [0, 1000]
    iterations_middle: int = 6  # number of iterations at 1/2 of the finest resolution, in [0, 1000]
    iterations_fine: int = 4  # number of iterations at the finest resolution, in [1, 1000]
    # maximum distance of corresponding points, m, in [0.0001, 10]; increases with depth beyond 5 m (TUKEY)
    max_distance: float = 0.1
    # maximum distance of a point from the map's surface to agree with the map, m, in [0.0001, 10]; at least 3 sigma of
    # depth noise
    close_distance: float = 0.05
    min_normal_dot: float = 0.7  # minimum cosine between corresponding normals, in [-1, 1]
    # cut-off of point-to-plane distances, in standard deviations, in [0.001, 1000] (TUKEY)
    geometric_scale: float = 4.0
    photometric_scale: float = 4.0  # cut-off of intensity differences, in standard deviations, in [0.001, 1000] (TUKEY)
    # standard deviation of differences between intensities of 0 to 1, in [0.001, 1] (TUKEY)
    intensity_noise: float = 0.05
    # difference between intensities of 0 to 1 at which the weight reaches 0, in [0.001, 1] (LINEAR)
    max_intensity_difference: float = 0.1
    color_weight: float = 0.1  # weight lambda of the photometric term, >= 0; 0 = ICP only
    color_levels: int = 3  # number of levels with color, from the coarsest, in [1, 3]
    depth_weight: float = 1.0  # weight of the point-to-plane term, in [0, 1]; 0 = color only
    # maximum translation between frames, m, in [0.001, 100]; above it, the pose is lost; increases with depth beyond 5
    # m (TUKEY)
    max_translation: float = 0.3
    max_rotation: float = 0.35  # maximum rotation between frames, rad, in [0.001, 3.15]; above it, the pose is lost
    min_visible: float = 0.05  # minimum fraction of a frame's points that are visible in the map, in [0, 1]
    min_matched: float = 0.4  # minimum fraction of the visible points with a nonzero weight, in [0, 1]
    # minimum ratio of smallest to mean eigenvalue of the dimensionless normal matrix, in [0, 1]; doubled while lost
    min_information: float = 1e-3
    # minimum fraction of the visible points that agree with the map, in [0, 1]; 0 = no check
    min_agreement: float = 0.92
    # maximum fraction of the visible points behind the map's surface, in [0, 1]; 1 = no check
    max_occluded: float = 0.015
    raw_keyframe: bool = True  # True = align to a keyframe with raw depth in addition to the map; False = map only
    relocalize: bool = True  # True = relocalize against keyframes and visited poses; False = no relocalization
    seed: int = 0  # seed of the relocalization, >= 0

    def __post_init__(self) -> None:
        check_bounds(
            self, finest_scale=(1 / 64, 1.0), finest_side=(0, 1_000_000), iterations_coarse=(0, 1000),
            iterations_middle=(0, 1000), iterations_fine=(1, 1000),
            max_distance=(1e-4, 10.0), close_distance=(1e-4, 10.0),
            min_normal_dot=(-1.0, 1.0), geometric_scale=(1e-3, 1e3), photometric_scale=(1e-3, 1e3),
            intensity_noise=(1e-3, 1.0), max_intensity_difference=(1e-3, 1.0), color_weight=(0.0, 1e3),
            color_levels=(1, LEVELS), depth_weight=(0.0, 1.0),
            max_translation=(1e-3, 100.0), max_rotation=(1e-3, 3.15), min_visible=(0.0, 1.0),
            min_matched=(0.0, 1.0), min_information=(0.0, 1.0), min_agreement=(0.0, 1.0), max_occluded=(0.0, 1.0),
        )  # fmt: skip
        require(np.log2(self.finest_scale) % 1 == 0, "tracker.finest_scale", self.finest_scale, "1, 1/2, 1/4, ...")
        require(
            self.depth_weight > 0 or self.color_levels == LEVELS,
            "tracker.color_levels", self.color_levels, f"{LEVELS} if depth_weight is 0",
        )  # fmt: skip
        self._weights = Weights(*(np.float32(getattr(self, name)) for name in Weights._fields))
        self._T_world_last: Float64 | None = None  # last reliable pose
        self._T_last_next = np.eye(4)  # motion to the next frame under constant velocity
        self._T_world_odom: Float64 | None = None  # odometry frame at the last reliable frame with odometry
        self._lost_frames = 0  # number of consecutive lost frames
        self._steady_frames = 0  # number of consecutive frames with a correct prediction
        self._keyframes = Keyframes(seed=self.seed)
        self._visited: deque[tuple[int, Float64]] = deque(maxlen=VISITED)  # submaps and poses
        self._submap = 0  # submap of the next frame
        self._T_world_doubted: Float64 | None = None  # pose of the last frame if only its confirmation failed
        self._last: FrameFeatures | None = None  # features of the last reliable frame
        self._stored_scene: SceneMap | None = None  # map to relocalize in; None after success
        self._raw_keyframe: RawKeyframe | None = None
        self._scale = DepthScale()  # scale of the current frame
        self._scattered_depth = False  # True if neighbors of many readings have no depth
        self._coarse_depth = False  # True if depth is too coarse for normals from neighboring readings

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        seen = FrameFeatures(frame, self._keyframes.extractor)
        if self._stored_scene is not None:
            return self._relocalize_in_stored(seen, self._stored_scene)
        if self._T_world_last is None or scene.statistics.voxels == 0:
            return self._initialize(seen, scene)
        levels = self._pyramid(frame)
        T_world_odometry = self._predicted_by_odometry(frame)
        T_world_predicted = self._T_world_last @ self._T_last_next if T_world_odometry is None else T_world_odometry
        if self._lost_frames:
            alignment = self._align_lost(levels, scene, T_world_odometry)
        elif T_world_odometry is None:
            alignment = self._align_predicted(levels, scene, T_world_predicted, self._T_world_last)
        else:
            alignment = self._align_odometry(levels, scene, T_world_odometry)
        if not (alignment.reliable and self._steady_frames >= STEADY) and levels[0].depth.any():
            alignment = self._relocalized(alignment, seen, levels, scene)
            if not self._scale.near(alignment.T_world_camera, T_world_predicted, SAME_POSE):
                self._steady_frames = 0
        if not alignment.reliable:
            self._lost_frames += 1
            self._steady_frames = 0
            self._T_last_next = np.eye(4)
            self._T_world_doubted = None if alignment.reason else alignment.T_world_camera
            return Pose(self._T_world_last, lost=True, reason=self._loss(alignment, frame))
        alignment = self._held(alignment)
        T_last_next = inverse(self._T_world_last) @ alignment.T_world_camera
        self._T_last_next = np.eye(4) if self._lost_frames or self._is_jump(T_last_next) else T_last_next
        if self.raw_keyframe:
            self._update_raw_keyframe(levels, alignment.T_world_camera)
        return self._accept(seen, alignment.T_world_camera, alignment.covariance)

    def _held(self, alignment: Alignment) -> Alignment:
        """Return the alignment, with the last pose if the motion is too small to be significant.

        Slow motions add up until they are significant.
        """
        assert self._T_world_last is not None
        if self._lost_frames or alignment.covariance is None:
            return alignment
        if not self._scale.near(self._T_world_last, alignment.T_world_camera, STANDING):
            return alignment
        if is_significant(inverse(self._T_world_last) @ alignment.T_world_camera, alignment.covariance):
            return alignment
        return alignment._replace(T_world_camera=self._T_world_last)

    def correct(self, change: SubmapChange) -> None:
        self._keyframes.correct(change)
        visited = [(submap, change.moved(submap, T)) for submap, T in self._visited if submap not in change.hidden]
        self._visited = deque(visited, maxlen=VISITED)
        # the last frame, and all that predicts the next one, keep their relative poses
        if self._T_world_last is not None:
            self._T_world_last = change.moved(self._submap, self._T_world_last)
        if self._T_world_odom is not None:
            self._T_world_odom = change.moved(self._submap, self._T_world_odom)
        if self._raw_keyframe is not None:
            T_world_camera = change.moved(self._submap, self._raw_keyframe.T_world_camera)
            self._raw_keyframe = replace(self._raw_keyframe, T_world_camera=T_world_camera)
        self._submap = change.submap

    def renew_colors(self) -> None:
        self._raw_keyframe = None

    def keyframes(self) -> Mapping[str, Array]:
        return self._keyframes.saved()

    def load_keyframes(self, keyframes: Mapping[str, Array], scene: SceneMap) -> None:
        self._keyframes.restore(keyframes)
        self._stored_scene = scene

    def _pyramid(self, frame: Frame) -> list[PyramidLevel]:
        self._coarse_depth = is_coarse(frame.depth, self._coarse_depth, frame.sensor)
        self._scattered_depth = self.raw_keyframe and is_scattered(frame.depth)
        finest = self._finest_scale(frame.camera)
        levels = build_pyramid(frame.camera, frame.depth, frame.color, finest, LEVELS, frame.sensor)
        if self.residual_weights is ResidualWeights.TUKEY:
            self._scale = DepthScale.of(levels[-1].depth)
        return levels

    def _finest_scale(self, camera: Camera) -> float:
        """Return the scale of the finest level relative to the image, which is smaller for large images."""
        scale = self.finest_scale  # otherwise, the coarsest level would be too fine for large motions
        while self.finest_side and max(camera.shape) * scale > self.finest_side:
            scale /= 2
        return scale

    def _loss(self, alignment: Alignment, frame: Frame) -> str:
        """Return the reason for a lost pose."""
        reason = alignment.reason or alignment.doubt
        # mention the fraction of pixels with depth if many isolated pixels have none
        if not is_scattered(frame.depth):
            return reason
        return f"{reason}; only {np.mean(frame.depth > 0):.0%} of the pixels have depth, most without neighbors"

    def _relocalize_in_stored(self, seen: FrameFeatures, scene: SceneMap) -> Pose:
        """Return the pose in a stored map from features, or a lost pose.

        The pose must be confirmed by an alignment.
        """
        alignment = Alignment(np.eye(4), 0, 0, 0, 0, "not relocalized in the stored map yet", "")
        found = self._keyframes.relocalize(seen.frame)
        if found is not None:
            alignment = self._confirmed(alignment, found.T_world_camera, self._pyramid(seen.frame), scene)
        if not alignment.reliable:
            return Pose(np.eye(4), lost=True, reason=alignment.reason)
        self._stored_scene = None
        return self._accept(seen, alignment.T_world_camera, alignment.covariance)

    def _predicted_by_odometry(self, frame: Frame) -> Float64 | None:
        """Return the pose (4, 4) that the motion by odometry predicts; None = odometry is unknown."""
        if self._T_world_odom is None or frame.T_odom_camera is None:
            return None
        return self._T_world_odom @ frame.T_odom_camera

    def _align_odometry(self, levels: list[PyramidLevel], scene: SceneMap, T_world_odometry: Float64) -> Alignment:
        """Return the alignment that starts at the pose predicted by odometry.

        If it is not reliable, start at the prediction of constant velocity, whose result needs confirmation.
        """
        assert self._T_world_last is not None
        alignment = self._align_predicted(levels, scene, T_world_odometry, T_world_odometry, completed=True)
        if alignment.reliable:
            return alignment
        again = self._align(levels, scene, self._T_world_last @ self._T_last_next, self._T_world_last)
        if not again.reliable:
            return alignment
        self._steady_frames = 0
        return again

    def _align_predicted(
        self, levels: list[PyramidLevel], scene: SceneMap, T_world_predicted: Float64, T_world_from: Float64,
        completed: bool = False,
    ) -> Alignment:  # fmt: skip
        """Return the alignment that starts at the predicted pose.

        Near the prediction, less agreement with the map is sufficient. See `_align` for the other arguments.
        """
        alignment = self._align(levels, scene, T_world_predicted, T_world_from, completed)
        if not self._scale.near(alignment.T_world_camera, T_world_predicted, SAME_POSE):
            self._steady_frames = 0
            return alignment
        self._steady_frames += 1
        object_removed = alignment.agreement_in_front >= CHANGED_SCENE
        expected = alignment.agreement >= EXPECTED_AGREEMENT and alignment.behind <= EXPECTED_BEHIND
        enough = object_removed or (expected and self._steady_frames >= STEADY)
        if enough and alignment.matched >= self.min_matched:
            return alignment._replace(doubt="")
        return alignment

    def _align_lost(
        self, levels: list[PyramidLevel], scene: SceneMap, T_world_odometry: Float64 | None
    ) -> Alignment:  # fmt: skip
        """Return the alignment that starts at the prediction of odometry, the last pose or the unconfirmed pose.

        The unconfirmed pose is that of the last frame, if only its confirmation failed.
        """
        assert self._T_world_last is not None
        if T_world_odometry is not None:
            alignment = self._align_twice(levels, scene, T_world_odometry)
            if alignment.reliable:
                return alignment
        alignment = self._align_twice(levels, scene, self._T_world_last)
        if alignment.reliable or self._T_world_doubted is None:
            return alignment
        again = self._align_twice(levels, scene, self._T_world_doubted)
        return alignment if again.reason else again

    def _initialize(self, seen: FrameFeatures, scene: SceneMap) -> Pose:
        """Return the first pose, which defines the world frame, or a lost pose if the frame has too little depth."""
        frame = seen.frame
        if min(frame.camera.shape) * self._finest_scale(frame.camera) < SMALLEST * 2 ** (LEVELS - 1):
            side = min(frame.camera.shape) * self._finest_scale(frame.camera) / 2 ** (LEVELS - 1)
            raise DataError(
                f"tracker.finest_scale: expected at least {SMALLEST} px for the shorter side of the coarsest of "
                f"{LEVELS} levels, got {side:.3g} px with {self.finest_scale:g} for images of "
                f"{frame.camera.width}x{frame.camera.height} px; increase tracker.finest_scale or use larger images"
            )
        T_world_camera = np.eye(4) if frame.T_world_camera is None else frame.T_world_camera
        nearest, farthest = scene.depth_range
        readings = np.mean((frame.depth > 0) & (frame.depth >= nearest) & (frame.depth <= farthest))
        if readings < max(self.min_visible, 1 / frame.depth.size):
            few = f"only {readings:.1%} of the pixels have depth from {nearest:g} to {farthest:g} m"
            return Pose(T_world_camera, lost=True, reason=few if frame.depth.any() else "the frame has no depth")
        if self.raw_keyframe:
            self._update_raw_keyframe(self._pyramid(frame), T_world_camera)
        return self._accept(seen, T_world_camera, np.zeros((6, 6)))

    def _update_raw_keyframe(self, levels: list[PyramidLevel], T_world_camera: Float64) -> None:
        """Replace the raw keyframe if it is missing or too far away."""
        key = self._raw_keyframe
        if key is None or not self._scale.near(key.T_world_camera, T_world_camera, NEW_DISTANCE):
            self._raw_keyframe = RawKeyframe.of(levels, T_world_camera, self._scattered_depth)

    def _is_jump(self, T_last_next: Float64) -> bool:
        step, turn = np.linalg.norm(T_last_next[:3, 3]), rotation_angle(T_last_next[:3, :3])
        return bool(step > self.max_translation * self._scale.growth or turn > self.max_rotation)

    def _accept(self, seen: FrameFeatures, T_world_camera: Float64, covariance: Float64 | None) -> Pose:
        self._T_world_last = T_world_camera
        if seen.frame.T_odom_camera is not None:
            self._T_world_odom = T_world_camera @ inverse(seen.frame.T_odom_camera)
        self._T_world_doubted = None
        self._lost_frames = 0
        if self.relocalize:
            self._last = seen
            if seen.known:
                self._keyframes.add_with(seen.frame, seen.found, T_world_camera)
            else:
                self._keyframes.add(seen.frame, T_world_camera)
            if not any(self._scale.near(T, T_world_camera, VISITED_SEPARATION) for _, T in reversed(self._visited)):
                self._visited.append((self._submap, T_world_camera))
        return Pose(T_world_camera, covariance=covariance)

    def _relocalized(
        self, alignment: Alignment, seen: FrameFeatures, levels: list[PyramidLevel], scene: SceneMap
    ) -> Alignment:
        """Return the alignment, confirmed or replaced by the pose from features.

        If the camera is lost, an alignment from a visited pose is also tried.
        """
        if not self.relocalize:
            return alignment
        found = self._pose_from_features(seen)
        if found is not None:
            alignment = self._confirmed(alignment, found.T_world_camera, levels, scene)
        if self._lost_frames and self._visited and not alignment.reliable:
            _, T_world_visited = self._visited[-1 - self._lost_frames % len(self._visited)]
            again = self._align_twice(levels, scene, T_world_visited)
            if again.reliable:
                return again
        return alignment

    def _confirmed(
        self, alignment: Alignment, T_world_found: Float64, levels: list[PyramidLevel], scene: SceneMap
    ) -> Alignment:
        """Return the alignment, or an alignment that starts at the pose from features.

        The result is reliable if alignment and features agree.
        """
        if alignment.reliable and self._scale.near(alignment.T_world_camera, T_world_found, self.max_distance):
            return alignment
        again = self._align(levels, scene, T_world_found, T_world_found)
        agrees = not again.reason and self._scale.near(again.T_world_camera, T_world_found, self.max_distance)
        if agrees and (alignment.reason or again.reliable or again.agreement > alignment.agreement):
            return again._replace(doubt="")
        if alignment.reason:
            return alignment
        if self._scale.near(alignment.T_world_camera, T_world_found, self.max_distance):
            return alignment._replace(doubt="")
        return alignment._replace(doubt=alignment.doubt or "features and alignment with the map disagree")

    def _pose_from_features(self, seen: FrameFeatures) -> AbsolutePose | None:
        """Return the pose from the features of the last frame and of keyframes, or None."""
        assert self._T_world_last is not None
        # nearby keyframes first, then keyframes with similar features
        near = self._keyframes.nearest(self._T_world_last)
        if self._last is not None:
            near = [self._keyframes.keyframe(self._last.frame, self._last.found, self._T_world_last), *near]
        found = self._keyframes.locate(seen.frame, seen.found, near)
        if found is None:
            found = self._keyframes.locate(seen.frame, seen.found, self._keyframes.alike(seen.found))
        return found

    def _align_twice(self, levels: list[PyramidLevel], scene: SceneMap, T_world_from: Float64) -> Alignment:
        """Align the frame, align it again from the result, and return the second alignment.

        If the two differ, the result needs confirmation.
        """
        alignment = self._align(levels, scene, T_world_from, T_world_from)
        if not alignment.reliable or self.min_agreement == 0:
            return alignment
        again = self._align(levels, scene, alignment.T_world_camera, T_world_from)
        if not self._scale.near(alignment.T_world_camera, again.T_world_camera, SAME_POSE / 2):
            return again._replace(doubt="a second alignment from the result of the first disagrees")
        return again

    def _align(
        self, levels: list[PyramidLevel], scene: SceneMap, T_world_view: Float64, T_world_from: Float64,
        completed: bool = False,
    ) -> Alignment:  # fmt: skip
        """Return the alignment of a frame to a view of the map, computed coarse to fine.

        Args:
            levels: The image pyramid of the frame, finest level first.
            scene: The map.
            T_world_view: The pose (4, 4) of the view, where the alignment starts.
            T_world_from: The pose (4, 4) relative to which the motion is limited.
            completed: True = T_world_view determines the motion that the points do not determine.
        """
        view = scene.render_near(levels[0].camera, T_world_view, levels[0].depth, levels[0].sensor)
        model, intensities = model_view(view), model_intensities(view, LEVELS)
        iterations = (self.iterations_fine, self.iterations_middle, self.iterations_coarse)
        linear = self._linear_weights(scene)
        T_view_camera = np.eye(4)
        term = KeyframeTerm.at(self._raw_keyframe, T_world_view, self._scale)
        brightness = key_brightness = 0.0
        for level in reversed(range(LEVELS)):
            weights, smooth = self._weights_at(level), smoothed(model, level)
            for _ in range(iterations[level]):
                equations = linearize(
                    levels[level], smooth, intensities[level], T_view_camera, weights, brightness, linear
                )
                brightness = equations.brightness if linear is None else 0.0
                A, b = equations.A, equations.b
                if term is not None and level <= COMPARED:
                    own = term.linearized(levels, level, T_view_camera, weights, key_brightness, linear)
                    key_brightness = own.brightness if linear is None else 0.0
                    A, b = A + own.A, b + own.b
                xi = _solved(A, b)
                if completed:
                    xi = self._determined_part(xi, self._directions(equations, ODOMETRY_INFORMATION))
                T_view_camera = exp_se3(xi) @ T_view_camera
                if self._scale.length(xi) < CONVERGED * 4**level:
                    break
        if self._scale.length(xi) >= CONVERGED:  # the counts before a long step do not describe its result
            equations = linearize(levels[0], smooth, intensities[0], T_view_camera, weights, brightness, linear)
            if term is not None:
                own = term.linearized(levels, 0, T_view_camera, weights, key_brightness, linear)
        terms = [equations] if term is None else [equations, own]
        compared = levels[0]
        # until many frames are mapped, the view of the map is empty where depth is scattered
        if self._scattered_depth and term is not None and own.visible > equations.visible:
            equations, compared = own, levels[COMPARED]
        factor = ODOMETRY_INFORMATION if completed else RECOVERY_INFORMATION if self._lost_frames else 1.0
        determined = self._directions(equations, factor).determined.all()
        # linear weights are not inverse variances, and the accuracy of odometry is unknown
        covariance = pose_covariance(terms, T_view_camera) if linear is None and determined else None
        T_world_camera = T_world_view @ T_view_camera
        # products of poses and of their inverses amplify rounding errors exponentially
        T_world_camera[:3, :3] = nearest_rotation(T_world_camera[:3, :3])
        matched, agreement, behind = (
            count / max(equations.visible, 1) for count in (equations.matched, equations.close, equations.behind)
        )
        agreement_in_front = equations.close / max(equations.visible - equations.behind, 1)
        reason = self._rejection(compared, equations, inverse(T_world_from) @ T_world_camera)
        if not (reason or determined or completed):
            reason = "the visible surface does not determine the motion"
        doubt = ""
        if agreement < self.min_agreement or behind > self.max_occluded:
            doubt = f"{agreement:.0%} of the visible points agree with the map, {behind:.1%} lie behind it"
        elif matched < self.min_matched:
            doubt = f"{agreement:.0%} of the visible points agree with the map, but only {matched:.0%} in their normals"
        return Alignment(T_world_camera, matched, agreement, behind, agreement_in_front, reason, doubt, covariance)

    def _linear_weights(self, scene: SceneMap) -> LinearWeights | None:
        """Return the limits of the linear weights, or None for Tukey's weights."""
        if self.residual_weights is ResidualWeights.TUKEY:
            return None
        return LinearWeights(np.float32(scene.depth_range[1]), np.float32(self.max_intensity_difference))

    def _weights_at(self, level: int) -> Weights:
        """Return the weights of a pyramid level, 0 = finest."""
        normals_known = not (self._coarse_depth or self._scattered_depth)
        weights = self._weights._replace(
            min_normal_dot=self._weights.min_normal_dot if normals_known else np.float32(-1),
            color_weight=self._weights.color_weight if level >= LEVELS - self.color_levels else np.float32(0),
        )
        if self.residual_weights is ResidualWeights.LINEAR:
            return weights
        # larger residuals are allowed at coarse levels, which start from less accurate poses
        return weights._replace(
            max_distance=self._weights.max_distance * np.float32(1 + level),
            geometric_scale=self._weights.geometric_scale * np.float32(2**level),
            photometric_scale=self._weights.photometric_scale * np.float32(2**level),
        )

    def _rejection(self, frame: PyramidLevel, equations: NormalEquations, T_from_camera: Float64) -> str:
        """Return the reason for rejecting a pose, "" = the pose is possible.

        Args:
            frame: The level of the frame whose points are counted in `equations`.
            equations: The normal equations at the pose.
            T_from_camera: The motion (4, 4) since the last pose.
        """
        points = int(np.count_nonzero(frame.depth))
        if points == 0:
            return "the frame has no depth"
        if equations.visible < self.min_visible * points:
            return f"only {equations.visible / points:.0%} of the frame's points are visible in the map"
        few_match = equations.matched < self.min_matched * equations.visible
        if few_match and (self.min_agreement == 0 or equations.close < self.min_agreement * equations.visible):
            return f"only {equations.matched / equations.visible:.0%} of the visible points match the map"
        if self._is_jump(T_from_camera):
            step, turn = np.linalg.norm(T_from_camera[:3, 3]), rotation_angle(T_from_camera[:3, :3])
            return f"implausible step of {step:.2f} m and {np.degrees(turn):.0f} deg"
        return ""

    def _directions(self, equations: NormalEquations, factor: float) -> Directions:
        """Return the principal directions of motion, and those with `factor` times the minimum information or more."""
        # The photometric term is not multiplied by lambda, because only the geometric term contains false information
        # from noisy normals.
        color = (1 / self.color_weight - 1) * equations.A_color if self.color_weight > 0 else 0.0
        information, directions = np.linalg.eigh(self._scale.without_units(equations.A + color))
        return Directions(directions, information >= factor * self.min_information * information.mean())

    def _determined_part(self, xi: Float64, directions: Directions) -> Float64:
        """Return the part of a step xi (6,), m and rad, along the determined directions.

        Method: solution remapping of Zhang, Kaess and Singh, ICRA 2016.
        """
        if directions.determined.all():
            return xi
        kept = directions.vectors[:, directions.determined]
        return np.asarray(self._scale.units * (kept @ (kept.T @ (xi / self._scale.units))))


def _solved(A: Float64, b: Float64) -> Float64:
    """Return the Gauss-Newton step (6,), m and rad."""
    # solves A xi = -b; damping keeps undetermined components near 0
    damping = 1e-6 * max(float(np.trace(A)), 1e-12) * np.eye(6)
    return np.asarray(np.linalg.solve(A + damping, -b))

"""The paper's tracker: each frame is aligned to the view ray-cast from the map, by geometry and colour."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from framework.config.validation import check_bounds, require
from framework.data import Array, Float64, Frame, Pose
from framework.errors import DataError
from framework.geometry import exp_se3, inverse, nearest_rotation, rotation_angle
from framework.interfaces import PoseTracker, SceneMap
from framework.tracking.absolute_pose import AbsolutePose
from framework.tracking.alignment import NormalEquations, Weights, linearize, model_view, smoothed
from framework.tracking.features import FrameFeatures
from framework.tracking.keyframes import Keyframes
from framework.tracking.pyramid import PyramidLevel, build_pyramid, is_coarse, model_intensities

LEVELS = 3
FINE_ENOUGH = 1e-4  # m and rad: a shorter step ends the finest level, four times as long a one the level before, ...
SAME_PLACE = 0.05  # m and rad: two alignments that end nearer to each other than this have found the same pose
SMALLEST = 8  # px, of the sides of the coarsest level
CHANGED_SCENE = 0.95  # share of the points not behind the map's surface that agree with it, where a thing was removed
EXPECTED_AGREEMENT = 0.8  # like min_agreement, where a prediction leads that has been right before
EXPECTED_BEHIND = 0.1  # like max_behind, likewise
STEADY = 5  # frames in a row whose prediction was right, after which the next one counts for something
VISITED = 64  # poses, this far apart, that a lost camera tries where features do not tell, one a frame
VISITED_APART = 0.1  # m and rad
SURER = 2.0  # times min_information is what ends a loss: the next frame may well have more


class Alignment(NamedTuple):
    """Where the alignment of a frame has ended."""

    T_world_camera: Float64
    matched: float  # share of the points in view that have a weight
    agreement: float  # share of the points in view that agree with the map
    behind: float  # share of the points in view that are behind the map's surface
    beside: float  # share that agrees, of those that are not behind it
    reason: str  # why it is impossible, empty if it is not
    doubt: str  # why it takes a second witness to trust it, empty if it does not

    @property
    def trusted(self) -> bool:
        return not (self.reason or self.doubt)


@dataclass
class VoxelHashingIcp(PoseTracker):
    """Frame-to-model ICP plus RGB, coarse to fine, with lost detection (after VoxelHashing and ElasticFusion).

    A pose is trusted for what agrees with the map, more easily where the prediction has led, and for features that lead
    to the same pose. Agreement alone does not tell: measured on every fourth frame, alignments that began at the pose
    or up to 1 m and 1 rad beside it, were within 2 cm and 1.5 degrees of it (right) or 8 cm and 6 degrees off (wrong),
    shares of the points in view:

                                     right, agree / behind, worst 1 %     wrong and not impossible, most that agree
        freiburg1_rpy, every frame   0.84 / 0.12                          0.99
        freiburg1_rpy, every fifth   0.80 / 0.17                          0.97
        redkitchen, every fifth      0.88 / 0.07                          0.49
        a flat in 5 degree steps     0.87 / 0.09                          0.86
        a ScanNet room, every fifth  0.96 / 0.04                          0.75
        a synthetic room, likewise   0.98 / 0.01                          0.95

    So a bound that all right poses pass is one for the place where the camera must be, and another pose takes a second
    witness.
    """

    finest_scale: float = 0.5  # of the image's size, a power of 1/2: the resolution of the view and of the finest level
    iterations_coarse: int = 8  # >= 0, at 1/4 of the finest resolution
    iterations_middle: int = 6  # >= 0, at 1/2
    iterations_fine: int = 4  # >= 1
    max_distance: float = 0.1  # m, > 0: of a point from its model point
    close_distance: float = 0.05  # m, > 0: a reading this near to the map's surface agrees with it; a voxel at least
    min_normal_dot: float = 0.7  # in [-1, 1]: cosine between the normals of a point and its model point
    geometric_scale: float = 4.0  # standard deviations, > 0: Tukey's cut-off of a distance
    photometric_scale: float = 4.0  # standard deviations, > 0: Tukey's cut-off of an intensity difference
    intensity_noise: float = 0.05  # of [0, 1], > 0: standard deviation of an intensity difference
    color_weight: float = 0.1  # lambda, >= 0; 0 = ICP alone
    depth_weight: float = 1.0  # 1, or 0 = colour alone
    max_step: float = 0.3  # m, > 0: a frame that seems to have moved farther is lost
    max_turn: float = 0.35  # rad, > 0: likewise
    min_visible: float = 0.05  # in [0, 1]: share of the points that must fall on the map; some are out of its range
    min_matched: float = 0.4  # in [0, 1]: share of these that must agree with it
    min_information: float = 1e-3  # of the mean, in [0, 1]: a motion that fewer points resist is not determined
    min_agreement: float = 0.92  # in [0, 1]: share of the points in view that lie where the map has its surface ...
    max_occluded: float = 0.015  # in [0, 1]: ... and behind it; what fails takes a second witness, see above
    relocalize: bool = True  # by features, when lost, in doubt or jumping, and from visited places, when lost
    seed: int = 0  # of the relocalization's random samples

    def __post_init__(self) -> None:
        check_bounds(
            self,
            finest_scale=(1 / 64, 1.0),
            iterations_coarse=(0, 1000),
            iterations_middle=(0, 1000),
            iterations_fine=(1, 1000),
            max_distance=(1e-4, 10.0),
            close_distance=(1e-4, 10.0),
            min_normal_dot=(-1.0, 1.0),
            geometric_scale=(1e-3, 1e3),
            photometric_scale=(1e-3, 1e3),
            intensity_noise=(1e-3, 1.0),
            color_weight=(0.0, 1e3),
            depth_weight=(0.0, 1.0),
            max_step=(1e-3, 100.0),
            max_turn=(1e-3, 3.15),
            min_visible=(0.0, 1.0),
            min_matched=(0.0, 1.0),
            min_information=(0.0, 1.0),
            min_agreement=(0.0, 1.0),
            max_occluded=(0.0, 1.0),
        )
        require(np.log2(self.finest_scale) % 1 == 0, "VoxelHashingIcp.finest", self.finest_scale, "1, 1/2, 1/4, ...")
        self._weights = Weights(
            max_distance=np.float32(self.max_distance),
            close_distance=np.float32(self.close_distance),
            min_normal_dot=np.float32(self.min_normal_dot),
            geometric_scale=np.float32(self.geometric_scale),
            photometric_scale=np.float32(self.photometric_scale),
            intensity_noise=np.float32(self.intensity_noise),
            color_weight=np.float32(self.color_weight),
            depth_weight=np.float32(self.depth_weight),
        )
        self._T_world_last: Float64 | None = None  # the last pose that was trusted
        self._T_last_next = np.eye(4)  # its motion since the one before: the constant-velocity prediction
        self._lost_frames = 0  # in a row
        self._steady_frames = 0  # in a row, of which the prediction was right
        self._keyframes = Keyframes(seed=self.seed)
        self._visited: deque[Float64] = deque(maxlen=VISITED)
        self._T_world_doubted: Float64 | None = None  # the last frame's, where it was lost only by doubt
        self._last: FrameFeatures | None = None  # of the last frame that was trusted
        self._before: SceneMap | None = None  # a map from before, until the camera is found in it
        self._coarse_depth = False  # too coarse for normals from neighboring readings

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        seen = FrameFeatures(frame, self._keyframes.extractor)
        if self._before is not None:
            return self._entered(seen, self._before)
        if self._T_world_last is None or scene.statistics.voxels == 0:
            return self._first(seen, scene)
        levels = build_pyramid(frame.camera, frame.depth, frame.color, self.finest_scale, LEVELS)
        self._coarse_depth = is_coarse(frame.depth, otherwise=self._coarse_depth)
        T_world_predicted = self._T_world_last @ self._T_last_next
        if self._lost_frames:
            alignment = self._resumed(levels, scene)
        else:
            alignment = self._continued(levels, scene, T_world_predicted)
        if not (alignment.trusted and self._steady_frames >= STEADY) and levels[0].depth.any():
            alignment = self._searched(alignment, seen, levels, scene)
            if not _near(alignment.T_world_camera, T_world_predicted, SAME_PLACE):
                self._steady_frames = 0  # features led elsewhere
        if not alignment.trusted:
            self._lost_frames += 1
            self._steady_frames = 0
            self._T_last_next = np.eye(4)
            self._T_world_doubted = None if alignment.reason else alignment.T_world_camera
            return Pose(self._T_world_last, lost=True, reason=alignment.reason or alignment.doubt)
        T_last_next = inverse(self._T_world_last) @ alignment.T_world_camera
        self._T_last_next = np.eye(4) if self._lost_frames or self._is_jump(T_last_next) else T_last_next
        return self._trusted(seen, alignment.T_world_camera)

    def keyframes(self) -> Mapping[str, Array]:
        return self._keyframes.saved()

    def load_keyframes(self, keyframes: Mapping[str, Array], scene: SceneMap) -> None:
        self._keyframes.restore(keyframes)
        self._before = scene

    def _entered(self, seen: FrameFeatures, before: SceneMap) -> Pose:
        """Finds the camera in a map from before: features of its keyframes lead to where alignment with it stays."""
        unknown = Alignment(np.eye(4), 0, 0, 0, 0, "it has not been found in the map from before", "")
        found = self._keyframes.relocalize(seen.frame)
        alignment = unknown
        if found is not None:
            levels = build_pyramid(seen.frame.camera, seen.frame.depth, seen.frame.color, self.finest_scale, LEVELS)
            self._coarse_depth = is_coarse(seen.frame.depth, otherwise=self._coarse_depth)
            alignment = self._checked(unknown, found.T_world_camera, levels, before)
        if not alignment.trusted:
            return Pose(np.eye(4), lost=True, reason=alignment.reason)
        self._before = None
        return self._trusted(seen, alignment.T_world_camera)

    def _continued(self, levels: list[PyramidLevel], scene: SceneMap, T_world_predicted: Float64) -> Alignment:
        """Aligns from where a steady motion has led, and is content with less where it ends there."""
        assert self._T_world_last is not None
        alignment = self._align(levels, scene, T_world_predicted, self._T_world_last)
        if not _near(alignment.T_world_camera, T_world_predicted, SAME_PLACE):
            self._steady_frames = 0
            return alignment
        self._steady_frames += 1
        removed = alignment.beside >= CHANGED_SCENE  # what is behind the map's surface was removed from before it
        expected = alignment.agreement >= EXPECTED_AGREEMENT and alignment.behind <= EXPECTED_BEHIND
        enough = removed or (expected and self._steady_frames >= STEADY)
        if enough and alignment.matched >= self.min_matched:
            return alignment._replace(doubt="")
        return alignment

    def _resumed(self, levels: list[PyramidLevel], scene: SceneMap) -> Alignment:
        """Aligns a lost camera from the last pose that was trusted, and from the last frame's that was in doubt."""
        assert self._T_world_last is not None
        alignment = self._align_twice(levels, scene, self._T_world_last)
        if alignment.trusted or self._T_world_doubted is None:
            return alignment
        again = self._align_twice(levels, scene, self._T_world_doubted)
        return alignment if again.reason else again

    def _first(self, seen: FrameFeatures, scene: SceneMap) -> Pose:
        """The pose that defines the world, of the first frame with something in it to be tracked by."""
        frame = seen.frame
        if min(frame.camera.shape) * self.finest_scale < SMALLEST * 2 ** (LEVELS - 1):
            raise DataError(
                f"images of {frame.camera.width}x{frame.camera.height} px are too small for tracker.finest_scale="
                f"{self.finest_scale:g}: {LEVELS} levels from there leave less than {SMALLEST} px"
            )
        T_world_camera = np.eye(4) if frame.T_world_camera is None else frame.T_world_camera
        nearest, farthest = scene.depth_range
        readings = np.mean((frame.depth > 0) & (frame.depth >= nearest) & (frame.depth <= farthest))
        if readings < max(self.min_visible, 1 / frame.depth.size):
            few = f"{readings:.1%} of the pixels have a depth that is mapped, {nearest:g} to {farthest:g} m"
            return Pose(T_world_camera, lost=True, reason=few if frame.depth.any() else "the frame has no depth")
        return self._trusted(seen, T_world_camera)

    def _is_jump(self, T_last_next: Float64) -> bool:
        """Whether this is farther than a camera moves from one frame to the next."""
        step, turn = np.linalg.norm(T_last_next[:3, 3]), rotation_angle(T_last_next[:3, :3])
        return bool(step > self.max_step or turn > self.max_turn)

    def _trusted(self, seen: FrameFeatures, T_world_camera: Float64) -> Pose:
        self._T_world_last = T_world_camera
        self._T_world_doubted = None
        self._lost_frames = 0
        if self.relocalize:
            self._last = seen
            if seen.known:
                self._keyframes.add_with(seen.frame, seen.found, T_world_camera)
            else:
                self._keyframes.add(seen.frame, T_world_camera)
            if not any(_near(T, T_world_camera, VISITED_APART) for T in reversed(self._visited)):  # the last is nearest
                self._visited.append(T_world_camera)
        return Pose(T_world_camera)

    def _searched(
        self, alignment: Alignment, seen: FrameFeatures, levels: list[PyramidLevel], scene: SceneMap
    ) -> Alignment:
        """The best pose of a frame that alignment alone does not tell: asks features, then goes through visited places.

        Two independent ways to one pose are trusted: features that lead to where alignment leads, too.
        """
        if not self.relocalize:
            return alignment
        found = self._told_by_features(seen)
        if found is not None:
            alignment = self._checked(alignment, found.T_world_camera, levels, scene)
        if self._lost_frames and self._visited and not alignment.trusted:
            T_world_visited = self._visited[-1 - self._lost_frames % len(self._visited)]
            again = self._align_twice(levels, scene, T_world_visited)
            if again.trusted:
                return again
        return alignment

    def _checked(
        self, alignment: Alignment, T_world_found: Float64, levels: list[PyramidLevel], scene: SceneMap
    ) -> Alignment:
        """What to make of an alignment where features tell `T_world_found`: two ways to one pose are trusted."""
        if alignment.trusted and _near(alignment.T_world_camera, T_world_found, self.max_distance):
            return alignment
        again = self._align(levels, scene, T_world_found, T_world_found)
        borne_out = not again.reason and _near(again.T_world_camera, T_world_found, self.max_distance)
        if borne_out and (alignment.reason or again.trusted or again.agreement > alignment.agreement):
            return again._replace(doubt="")
        if alignment.reason:
            return alignment
        if _near(alignment.T_world_camera, T_world_found, self.max_distance):
            return alignment._replace(doubt="")
        return alignment._replace(doubt=alignment.doubt or "features tell another pose than alignment with the map")

    def _told_by_features(self, seen: FrameFeatures) -> AbsolutePose | None:
        """The pose by features of the last trusted frame and of keyframes near it, else of those that look alike."""
        assert self._T_world_last is not None
        near = self._keyframes.nearest(self._T_world_last)
        if self._last is not None:
            near = [self._keyframes.keyframe(self._last.frame, self._last.found, self._T_world_last), *near]
        found = self._keyframes.locate(seen.frame, seen.found, near)
        if found is None:
            found = self._keyframes.locate(seen.frame, seen.found, self._keyframes.alike(seen.found))
        return found

    def _align_twice(self, levels: list[PyramidLevel], scene: SceneMap, T_world_from: Float64) -> Alignment:
        """Aligns from where the camera was, and again from where that ends: only the view from there tells whether the
        frame determines its pose.
        """
        first = self._align(levels, scene, T_world_from, T_world_from)
        if not first.trusted:
            return first
        second = self._align(levels, scene, first.T_world_camera, T_world_from)
        if not _near(first.T_world_camera, second.T_world_camera, SAME_PLACE / 2):
            return second._replace(doubt="two alignments, the second from where the first has ended, do not agree")
        return second

    def _align(
        self, levels: list[PyramidLevel], scene: SceneMap, T_world_view: Float64, T_world_from: Float64
    ) -> Alignment:
        """Aligns a frame to the view of the map at T_world_view, coarse to fine; it comes from T_world_from."""
        view = scene.render_near(levels[0].camera, T_world_view, levels[0].depth)
        model, intensities = model_view(view), model_intensities(view, LEVELS)
        iterations = (self.iterations_fine, self.iterations_middle, self.iterations_coarse)
        T_view_camera = np.eye(4)
        brightness = 0.0
        for level in reversed(range(LEVELS)):
            weights, model_here = self._weights_at(level), smoothed(model, level)
            for _ in range(iterations[level]):
                equations = linearize(levels[level], model_here, intensities[level], T_view_camera, weights, brightness)
                brightness = equations.brightness
                xi = _solved(equations)
                T_view_camera = exp_se3(xi) @ T_view_camera
                if np.abs(xi).max() < FINE_ENOUGH * 4**level:
                    break
        if np.abs(xi).max() >= FINE_ENOUGH:  # too long a step for what was known before it to tell where it has led
            equations = linearize(levels[0], model_here, intensities[0], T_view_camera, weights, brightness)
        T_world_camera = T_world_view @ T_view_camera
        # products of poses and of their inverses amplify rounding errors exponentially
        T_world_camera[:3, :3] = nearest_rotation(T_world_camera[:3, :3])
        matched, agreement, behind = (
            count / max(equations.visible, 1) for count in (equations.matched, equations.close, equations.behind)
        )
        beside = equations.close / max(equations.visible - equations.behind, 1)
        reason = self._why_impossible(levels[0], equations, inverse(T_world_from) @ T_world_camera)
        doubt = ""
        if agreement < self.min_agreement or behind > self.max_occluded:
            doubt = f"{agreement:.0%} of the points in view agree with the map, {behind:.1%} lie behind it"
        elif matched < self.min_matched:
            doubt = f"{agreement:.0%} of the points in view agree with the map, but {matched:.0%} in their normals, too"
        return Alignment(T_world_camera, matched, agreement, behind, beside, reason, doubt)

    def _weights_at(self, level: int) -> Weights:
        """What is an outlier where the pose is known to a fraction of a voxel need not be one on the way there."""
        return self._weights._replace(
            min_normal_dot=np.float32(-1) if self._coarse_depth else self._weights.min_normal_dot,
            max_distance=self._weights.max_distance * np.float32(1 + level),
            geometric_scale=self._weights.geometric_scale * np.float32(2**level),
            photometric_scale=self._weights.photometric_scale * np.float32(2**level),
        )

    def _why_impossible(self, frame: PyramidLevel, equations: NormalEquations, T_from_camera: Float64) -> str:
        """One line that says why this cannot be the pose, empty if it can."""
        points = int(np.count_nonzero(frame.depth))
        if points == 0:
            return "the frame has no depth"
        if equations.visible < self.min_visible * points:
            return f"{equations.visible / points:.0%} of the frame's points fall on the map"
        few_match = equations.matched < self.min_matched * equations.visible
        if few_match and equations.close < self.min_agreement * equations.visible:
            return f"{equations.matched / equations.visible:.0%} of the points in view agree with the map"
        if self._is_jump(T_from_camera):
            step, turn = np.linalg.norm(T_from_camera[:3, 3]), rotation_angle(T_from_camera[:3, :3])
            return f"a step of {step:.2f} m and {np.degrees(turn):.0f} deg is not plausible"
        information = np.linalg.eigvalsh(equations.A)
        least = self.min_information * (SURER if self._lost_frames else 1.0)
        if information[0] < least * information.mean():
            return "the surface in view does not determine the motion"
        return ""


def _near(T_a: Float64, T_b: Float64, limit: float) -> bool:
    """Whether two poses are within `limit` m and rad of each other."""
    T_ab = inverse(T_a) @ T_b
    return bool(np.linalg.norm(T_ab[:3, 3]) < limit and rotation_angle(T_ab[:3, :3]) < limit)


def _solved(equations: NormalEquations) -> Float64:
    """The Gauss-Newton step; undetermined directions stay where the prediction has them."""
    damping = 1e-6 * max(float(np.trace(equations.A)), 1e-12) * np.eye(6)
    return np.asarray(np.linalg.solve(equations.A + damping, -equations.b))

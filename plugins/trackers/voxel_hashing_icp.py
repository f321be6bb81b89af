"""The paper's tracker: each frame is aligned to the view ray-cast from the map, by geometry and colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Float64, Frame, Pose, View
from framework.geometry import exp_se3, inverse, nearest_rotation, rotation_angle
from framework.interfaces import PoseTracker, SceneMap
from framework.parameters import check_bounds, require
from framework.tracking.alignment import NormalEquations, Weights, linearise, model_view
from framework.tracking.pyramid import PyramidLevel, build_pyramid, model_intensities


@dataclass
class VoxelHashingIcp(PoseTracker):
    """Frame-to-model ICP plus RGB, coarse to fine, with lost detection (after VoxelHashing and ElasticFusion)."""

    finest: float = 0.5  # of the image's size, a power of 1/2: the resolution of the view and of the finest level
    iterations_coarse: int = 8  # >= 0, at 1/4 of the finest resolution
    iterations_middle: int = 6  # >= 0, at 1/2
    iterations_fine: int = 4  # >= 1
    max_distance: float = 0.1  # m, > 0: of a point from its model point
    min_normal_dot: float = 0.7  # in [-1, 1]: cosine between the normals of a point and its model point
    geometric_scale: float = 4.0  # standard deviations, > 0: Tukey's cut-off of a distance
    photometric_scale: float = 4.0  # standard deviations, > 0: Tukey's cut-off of an intensity difference
    intensity_noise: float = 0.05  # of [0, 1], > 0: standard deviation of an intensity difference
    color_weight: float = 0.1  # lambda, >= 0; 0 = ICP alone
    depth_weight: float = 1.0  # 1, or 0 = colour alone
    max_step: float = 0.3  # m, > 0: a frame that seems to have moved farther is lost
    max_turn: float = 0.35  # rad, > 0: likewise
    min_visible: float = 0.15  # in [0, 1]: share of the frame's points that must fall on the map
    min_matched: float = 0.4  # in [0, 1]: share of these that must agree with it
    min_information: float = 3e-4  # of the mean, in [0, 1]: a motion that fewer points resist is not determined

    def __post_init__(self) -> None:
        check_bounds(
            self,
            finest=(1 / 64, 1.0),
            iterations_coarse=(0, 1000),
            iterations_middle=(0, 1000),
            iterations_fine=(1, 1000),
            max_distance=(1e-4, 10.0),
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
        )
        require(np.log2(self.finest) % 1 == 0, "VoxelHashingIcp.finest", self.finest, "1, 1/2, 1/4, ...")
        self._weights = Weights(
            max_distance=np.float32(self.max_distance),
            min_normal_dot=np.float32(self.min_normal_dot),
            geometric_scale=np.float32(self.geometric_scale),
            photometric_scale=np.float32(self.photometric_scale),
            intensity_noise=np.float32(self.intensity_noise),
            color_weight=np.float32(self.color_weight),
            depth_weight=np.float32(self.depth_weight),
        )
        self._T_world_last: Float64 | None = None  # the last pose that was trusted
        self._T_last_next = np.eye(4)  # its motion since the one before: the constant-velocity prediction

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        if self._T_world_last is None:
            T_world_camera = np.eye(4) if frame.T_world_camera is None else frame.T_world_camera
            if not frame.depth.any():  # a world that starts with nothing in it would have nothing to be tracked by
                return Pose(T_world_camera, lost=True, reason="the frame has no depth")
            self._T_world_last = T_world_camera
            return Pose(T_world_camera)
        T_world_view = self._T_world_last @ self._T_last_next
        frame_levels = build_pyramid(frame.camera, frame.depth, frame.color, self.finest, levels=3)
        view = scene.render(frame_levels[0].camera, T_world_view)
        T_view_camera, equations = self._align(frame_levels, view)
        T_world_camera = T_world_view @ T_view_camera
        # products of poses and of their inverses amplify rounding errors exponentially
        T_world_camera[:3, :3] = nearest_rotation(T_world_camera[:3, :3])
        reason = self._why_lost(frame_levels[0], equations, T_world_camera)
        if reason:
            self._T_last_next = np.eye(4)
            return Pose(self._T_world_last, lost=True, reason=reason)
        self._T_last_next = inverse(self._T_world_last) @ T_world_camera
        self._T_world_last = T_world_camera
        return Pose(T_world_camera)

    def _align(self, frame_levels: list[PyramidLevel], view: View) -> tuple[Float64, NormalEquations]:
        """T_view_camera, coarse to fine, and the normal equations at it."""
        model = model_view(view)
        intensities = model_intensities(view, levels=3)
        iterations = (self.iterations_fine, self.iterations_middle, self.iterations_coarse)
        T_view_camera = np.eye(4)
        brightness = 0.0
        for level in (2, 1, 0):
            for _ in range(iterations[level]):
                equations = linearise(
                    frame_levels[level], model, intensities[level], T_view_camera, self._weights, brightness
                )
                brightness = equations.brightness
                xi = _solved(equations)
                T_view_camera = exp_se3(xi) @ T_view_camera
                if np.abs(xi).max() < 1e-5:  # m and rad: far below what a frame can tell
                    break
        return T_view_camera, linearise(
            frame_levels[0], model, intensities[0], T_view_camera, self._weights, brightness
        )

    def _why_lost(self, frame: PyramidLevel, equations: NormalEquations, T_world_camera: Float64) -> str:
        """One line that says why the pose is not to be trusted, empty if it is."""
        assert self._T_world_last is not None
        points = int(np.count_nonzero(frame.depth))
        if points == 0:
            return "the frame has no depth"
        if equations.visible < self.min_visible * points:
            return f"{equations.visible / points:.0%} of the frame's points fall on the map"
        if equations.matched < self.min_matched * equations.visible:
            return f"{equations.matched / equations.visible:.0%} of the points in view agree with the map"
        T_last_camera = inverse(self._T_world_last) @ T_world_camera
        step = float(np.linalg.norm(T_last_camera[:3, 3]))
        turn = rotation_angle(T_last_camera[:3, :3])
        if step > self.max_step or turn > self.max_turn:
            return f"a step of {step:.2f} m and {np.degrees(turn):.0f} deg is not plausible"
        information = np.linalg.eigvalsh(equations.A)
        if information[0] < self.min_information * information.mean():
            return "the surface in view does not determine the motion"
        return ""


def _solved(equations: NormalEquations) -> Float64:
    """The Gauss-Newton step; undetermined directions stay where the prediction has them."""
    damping = 1e-6 * max(float(np.trace(equations.A)), 1e-12) * np.eye(6)
    return np.asarray(np.linalg.solve(equations.A + damping, -equations.b))

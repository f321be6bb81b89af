"""Comparison of the depth of a frame with the map at a given pose.

Given poses may jump or have another world frame than the map. Then, the surface is mapped twice. The comparison samples
the frame on a coarse grid of pixels, so its run time does not depend on the image size.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from framework.data import Float64, Frame, Pose
from framework.errors import DataError, FrameError
from framework.geometry import FARTHEST, sampled_camera
from framework.interfaces import SceneMap

SIDE = 80  # maximum number of samples along the longer image side
CLOSE = 0.05  # m, maximum depth difference of agreement; at least 3 sigma of the sensor
MIN_VISIBLE = 0.05  # minimum fraction of samples on the map for a comparison
MIN_SAMPLES = 50  # minimum number of samples on the map for a comparison
# maximum fraction of samples that disagree; real sequences have at most 0.26, jumps of 0.3 m 0.8 (median)
MAX_DISAGREEING = 0.35
MAX_DISAGREEING_RESUMED = 0.4  # maximum fraction for the first frame on a resumed map, whose scene may have changed


class MapAgreement(NamedTuple):
    """Agreement of the depth of a frame with the map."""

    valid: int  # number of samples with depth
    samples: int  # number of samples on the map
    visible: float  # fraction of the samples with depth that are on the map
    disagreeing: float  # fraction of the samples on the map at another depth

    @property
    def known(self) -> bool:
        """True if enough of the map is in view."""
        return self.samples >= MIN_SAMPLES and self.visible >= MIN_VISIBLE

    @property
    def is_apart(self) -> bool:
        """True if the frame has depth, but hardly any of it is on the map."""
        return self.valid >= MIN_SAMPLES and self.visible < MIN_VISIBLE

    @property
    def disagrees(self) -> bool:
        """True if the pose contradicts the map."""
        return self.known and self.disagreeing > MAX_DISAGREEING


def map_agreement(frame: Frame, T_world_camera: Float64, scene: SceneMap) -> MapAgreement:
    """Compare the depth of a frame with the view of the map from its pose.

    A sample agrees if the depth of the map is close at its pixel or at a neighboring sample, because depth edges are
    inaccurate.

    Args:
        frame: The frame.
        T_world_camera: The camera pose (4, 4).
        scene: The map before the frame is fused.
    """
    step = -(-max(frame.camera.width, frame.camera.height) // SIDE)
    depth = frame.depth[step // 2 :: step, step // 2 :: step]
    nearest, farthest = scene.depth_range
    valid = (depth > max(nearest, 0.0)) & (depth < farthest)
    mapped = scene.render_visible(sampled_camera(frame.camera, step), T_world_camera).depth
    visible = valid & (mapped > 0)
    close = np.maximum(CLOSE, 3 * frame.sensor.sigma(depth))
    agreeing = np.zeros_like(visible)
    height, width = depth.shape
    around = np.pad(mapped, 1)
    for row in range(3):
        for column in range(3):
            agreeing |= np.abs(around[row : row + height, column : column + width] - depth) < close
    samples = int(visible.sum())
    return MapAgreement(
        valid=int(valid.sum()),
        samples=samples,
        visible=samples / max(int(valid.sum()), 1),
        disagreeing=float((visible & ~agreeing).sum()) / max(samples, 1),
    )


def check_distance(frame: Frame, pose: Pose) -> None:
    """Raise FrameError if a pose is too far from the origin for the float32 coordinates of maps."""
    distance = float(np.linalg.norm(pose.T_world_camera[:3, 3]))
    if distance > FARTHEST:
        raise FrameError(
            f"frame {frame.index}: expected a pose within {FARTHEST:g} m of the origin, got {distance:.6g} m; subtract "
            "one offset from all poses, in float64"
        )


def check_resumed(frame: Frame, agreement: MapAgreement) -> str:
    """Return a warning about the first frame on a resumed map, "" = none.

    Raises:
        DataError: The given pose contradicts the map.
    """
    if agreement.known and agreement.disagreeing > MAX_DISAGREEING_RESUMED:
        raise DataError(
            f"resume_from: expected given poses in the world frame of the map, got depth of frame {frame.index} that "
            f"differs from the map at {agreement.disagreeing:.0%} of the pixels; transform the poses, or set "
            "tracker=voxel_hashing_icp, which relocalizes in the map"
        )
    if not agreement.known:
        return (
            f"resume_from: expected frame {frame.index} to see the map at its given pose, got {agreement.visible:.0%} "
            "of its depth on the map; if the poses have another world frame, transform them, or set "
            "tracker=voxel_hashing_icp"
        )
    return ""

"""Tracking and fusion of frames without objects."""

from __future__ import annotations

from collections.abc import Sequence

from framework.data import Frame, Pose
from framework.interfaces import PoseTracker
from framework.registry import assemble
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from tests.support.scenes.analytic_scene import NOTHING


def track_and_fuse(tracker: PoseTracker, frames: Sequence[Frame]) -> list[Pose]:
    """Track and fuse the frames as the pipeline does. Lost frames are not fused."""
    fuser = assemble(BayesianTsdf, voxel_size=0.02, max_depth=4.0)
    poses = []
    for frame in frames:
        poses.append(tracker.track(frame, fuser.scene))
        if not poses[-1].lost:
            fuser.fuse(frame, poses[-1], NOTHING)
    return poses

"""Tests for the back end with a pose graph, on a path that leaves a room and returns with drift."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from functools import partial

import numpy as np
import pytest

from framework.data import Camera, Frame, Pose
from framework.geometry import exp_se3, inverse, pose_distance
from framework.interfaces import SubmapChange
from framework.pose_graph.loop_detection import LoopDetection
from framework.pose_graph.submap_anchors import SubmapAnchors
from plugins.backends import pose_graph
from plugins.backends.pose_graph import PoseGraph
from tests.support.scenes.hidden_submaps import HiddenSubmaps
from tests.support.scenes.papered_room import CAMERA, papered_frame

DRIFT = exp_se3(np.array([0.25, 0.05, -0.1, 0.01, 0.04, 0.0]))  # after the path outside of the room
STEP = 0.25  # m
AWAY = 20  # m, length of the path outside, in each direction


def room(T_room_camera: np.ndarray, camera: Camera) -> Frame:
    return papered_frame(T_room_camera, camera=camera)


def inside(x: float) -> np.ndarray:
    return exp_se3(np.array([x, 0, 0, 0, 0.5, 0.0]))


def journey(drift: np.ndarray = DRIFT) -> Iterator[tuple[Frame, np.ndarray]]:
    """Yield each frame and its tracked pose: in the room, outside, and in the room again with drift.

    Frames outside show another room. There, all drift is in the last step.
    """
    there = np.arange(-1, 1, STEP)
    outside = [*np.arange(1, AWAY, STEP), *np.arange(AWAY, 1, -STEP)]
    for k, x in enumerate(there):
        yield papered_frame(inside(x), k), inside(x)
    for k, x in enumerate(outside, len(there)):
        yield papered_frame(inside(0), k, paper=k), inside(x)
    for k, x in enumerate([*there[::-1]] * 2, len(there) + len(outside)):
        yield papered_frame(inside(x), k), drift @ inside(x)


def changes(back_end: PoseGraph, drift: np.ndarray = DRIFT) -> list[tuple[int, SubmapChange]]:
    """Return the changes on the journey by frame. The map of the first two submaps is the room."""
    scene = HiddenSubmaps({0: (room, np.eye(4))})
    found, T_new_old = [], np.eye(4)
    for frame, T_world_camera in journey(drift):
        change = back_end.update(frame, Pose(T_new_old @ T_world_camera), scene)
        if change is not None:
            found.append((frame.index, change))
            T_new_old = change.motions.get(back_end.anchors.current, np.eye(4)) @ T_new_old
    last = back_end.finish(scene)
    return [*found, (frame.index, last)] if last is not None else found

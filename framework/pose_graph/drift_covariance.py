"""Covariance of the drift along the camera path.

Each new view extends the map, and the map keeps the error of its pose. So drift is a random walk. A step with the
separation s from the last frame (1 = a new view, see `view_separation`) adds s times the covariance C of the pose
relative to the map (`Pose.covariance`):

    Q <- Ad Q Ad^T + GROWTH s C,    Ad = adjoint of T_camera_last

In eight synthetic buildings, GROWTH = 44 maximizes the likelihood of the drift between anchors. The larger value
allows for errors that the tracker does not know. Between 500 and 8000, poses are equally accurate.
"""

from __future__ import annotations

import numpy as np

from framework.data import Float64
from framework.geometry import adjoint, inverse
from framework.pose_graph.submap_anchors import view_separation

GROWTH = 2000.0  # covariance of the drift per new view, divided by that of the pose
UNKNOWN = (0.03, 0.015)  # m and rad, standard deviations of the drift per new view if the covariance is unknown
LEAST = (0.005, 0.002)  # m and rad, standard deviations of the drift along a short path


class DriftCovariance:
    """The covariance of the drift since the camera has entered a submap."""

    def __init__(self) -> None:
        self._T_anchor_camera: Float64 | None = None  # in the entered submap
        self._Q = np.zeros((6, 6))  # of the twist (translation, rotation) in the camera frame

    def enter(self, T_anchor_camera: Float64) -> None:
        """Begin at the pose (4, 4) of the camera in the submap that it enters."""
        self._T_anchor_camera, self._Q = T_anchor_camera, np.zeros((6, 6))

    def move(self, T_anchor_camera: Float64, covariance: Float64 | None) -> None:
        """Add a frame.

        Args:
            T_anchor_camera: The pose (4, 4) in the entered submap.
            covariance: `Pose.covariance` of the frame.
        """
        if self._T_anchor_camera is None:
            return
        grown = np.diag(np.repeat(UNKNOWN, 3) ** 2) if covariance is None else GROWTH * covariance
        Ad = adjoint(inverse(T_anchor_camera) @ self._T_anchor_camera)
        separation = view_separation(self._T_anchor_camera[None], T_anchor_camera)[0]
        self._T_anchor_camera, self._Q = T_anchor_camera, Ad @ self._Q @ Ad.T + separation * grown

    def at(self, T_camera_anchor: Float64) -> Float64:
        """Return the covariance (6, 6) of the motion from the anchor of the entered submap to another one.

        Its twist (translation, m, rotation, rad) is in the frame of the other anchor.

        Args:
            T_camera_anchor: The pose (4, 4) of the other anchor in the camera frame.
        """
        Ad = adjoint(inverse(T_camera_anchor))
        return np.asarray(Ad @ self._Q @ Ad.T + np.diag(np.repeat(LEAST, 3) ** 2))

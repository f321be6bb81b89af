"""Uncertainty of an aligned pose.

If the weights are inverse variances, the covariance of a least-squares estimate is A^-1. The assumed variances are
corrected by the residuals: the factor of each term is s^2 = sum w r^2 / n for its n matched points. Errors of
neighboring pixels are correlated, so that CORRELATED points count as one:

    C = CORRELATED A^-1 (sum over terms of s^2 A_term) A^-1

The covariance is relative to the map. It does not include the drift of the map.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from framework.data import Float64
from framework.geometry import adjoint, inverse
from framework.tracking.alignment import NormalEquations

CORRELATED = 16.0  # number of points with a common error, from the errors of tracked poses (docs/results/tracking.md)
MIN_VARIANCE = 1e-18  # minimum variance of a motion, m^2 and rad^2, for data without noise


def pose_covariance(terms: Sequence[NormalEquations], T_view_camera: Float64) -> Float64:
    """Return the covariance (6, 6) of the pose error, a twist (translation, m, rotation, rad) in the camera frame.

    The true pose is T_world_camera exp(twist), as for `Pose.covariance`.

    Args:
        terms: The normal equations of the map and, if used, of the keyframe.
        T_view_camera: The aligned pose (4, 4) of the frame in the view.
    """
    A, spread = np.zeros((6, 6)), np.zeros((6, 6))
    for term in terms:
        A += term.A
        geometric, photometric = term.energy / max(term.matched, 1), term.color_energy / max(term.matched_colors, 1)
        spread += geometric * term.A + (photometric - geometric) * term.A_color
    gain = adjoint(inverse(T_view_camera)) @ np.linalg.pinv(A, hermitian=True)
    C = CORRELATED * gain @ spread @ gain.T
    return np.asarray((C + C.T) / 2)


def is_significant(T_a_b: Float64, covariance: Float64) -> bool:
    """Return True if a small motion is larger than expected from noise alone.

    Args:
        T_a_b: The motion (4, 4).
        covariance: The covariance (6, 6) of its twist, m and rad.
    """
    R = T_a_b[:3, :3]
    xi = np.array([*T_a_b[:3, 3], *(np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2)])
    variances, directions = np.linalg.eigh(covariance)  # xi^T C^-1 xi > 6, its expected value for noise
    return bool(((directions.T @ xi) ** 2 / np.maximum(variances, MIN_VARIANCE)).sum() > len(xi))

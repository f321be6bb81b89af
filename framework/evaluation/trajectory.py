"""Absolute trajectory error (ATE) and relative pose error (RPE), with the same results as evo.

Q_i and P_i are the ground-truth and the estimated T_world_camera of frame i.

- ATE (Sturm et al. 2012): the RMSE of |trans E_i| with E_i = Q_i^-1 S P_i. The rigid transform S aligns the positions
  in the least-squares sense (Umeyama 1991, without scale).
- RPE with delta = 1 frame: the RMSE of |trans E_i| and of the angle of rot E_i, with
  E_i = (Q_i^-1 Q_{i+1})^-1 (P_i^-1 P_{i+1}).

Frames with a lost pose or an unknown ground-truth pose are omitted. The RPE also omits pairs with such a frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from framework.data import Float64, Pose
from framework.errors import DataError


@dataclass(frozen=True)
class TrajectoryError:
    """The errors of one trajectory.

    The ATE is NaN without evaluated frames, and the RPE is NaN without evaluated frame pairs.
    """

    ate_rmse_m: float
    rpe_rmse_m: float
    rpe_rotation_rmse_rad: float
    frames: int  # number of frames in the ATE
    pairs: int  # number of frame pairs in the RPE

    def metrics(self) -> dict[str, float]:
        """Return the errors by their names in metrics.json. NaN values are omitted."""
        flat: dict[str, float] = {}
        if self.frames:
            flat["trajectory.ate_rmse_m"] = self.ate_rmse_m
        if self.pairs:
            flat["trajectory.rpe_rmse_m"] = self.rpe_rmse_m
            flat["trajectory.rpe_rotation_rmse_rad"] = self.rpe_rotation_rmse_rad
        return flat


def evaluate(reference: Sequence[Float64 | None], estimated: Sequence[Pose]) -> TrajectoryError:
    """Return the errors of an estimated trajectory.

    Args:
        reference: Ground-truth pose (4, 4) of each frame; None = unknown.
        estimated: Estimated pose of each frame.

    Raises:
        DataError: The numbers of poses differ.
    """
    if len(reference) != len(estimated):
        raise DataError(
            f"trajectories: expected equal lengths, got {len(reference)} ground-truth and {len(estimated)} estimated "
            "poses"
        )
    usable = np.array([q is not None and not p.lost for q, p in zip(reference, estimated, strict=True)], np.bool_)
    Q = np.array([np.eye(4) if q is None else q for q in reference]).reshape(-1, 4, 4)
    P = np.array([p.T_world_camera for p in estimated]).reshape(-1, 4, 4)
    positions = Q[usable, :3, 3]
    aligned = P[usable, :3, 3]
    if len(aligned):
        R, t = umeyama(aligned, positions)
        aligned = aligned @ R.T + t
    ate = np.linalg.norm(aligned - positions, axis=1)
    i = np.flatnonzero(usable[:-1] & usable[1:])
    E = _inverse(_inverse(Q[i]) @ Q[i + 1]) @ (_inverse(P[i]) @ P[i + 1])
    return TrajectoryError(
        ate_rmse_m=_rmse(ate),
        rpe_rmse_m=_rmse(np.linalg.norm(E[:, :3, 3], axis=1)),
        rpe_rotation_rmse_rad=_rmse(_angles(E[:, :3, :3])),
        frames=int(usable.sum()),
        pairs=len(i),
    )


def umeyama(x: Float64, y: Float64) -> tuple[Float64, Float64]:
    """Return the rigid transform that best aligns the points x (n, 3) with y (n, 3).

    The transform minimizes the sum of |y_i - (R x_i + t)|^2 (Umeyama 1991, eqs. (40) to (43)). R is not unique for
    fewer than three points or for points on a line.

    Returns:
        The rotation R (3, 3) and the translation t (3,).
    """
    mu_x, mu_y = x.mean(axis=0), y.mean(axis=0)
    U, _, Vt = np.linalg.svd((y - mu_y).T @ (x - mu_x) / len(x))
    S = np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = U @ S @ Vt
    return R, mu_y - R @ mu_x


def align(P: Float64, Q: Float64) -> Float64:
    """Return the rigid transform (4, 4) that best aligns the poses P (n, 4, 4) with Q (n, 4, 4).

    At least one pose is required. The rotation is also determined if the camera only rotates.
    """
    R, t = umeyama(_axis_points(P), _axis_points(Q))  # points off the camera centers determine the rotation
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def _axis_points(P: Float64) -> Float64:
    """Return the camera centers and the points 1 m along the axes of each pose, (4n, 3)."""
    positions = P[:, None, :3, 3]
    return np.concatenate([positions, positions + P[:, :3, :3].transpose(0, 2, 1)], axis=1).reshape(-1, 3)


def _inverse(T: Float64) -> Float64:
    """Invert rigid transforms (n, 4, 4)."""
    inverse = np.zeros_like(T)
    inverse[:, :3, :3] = T[:, :3, :3].transpose(0, 2, 1)
    inverse[:, :3, 3] = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    inverse[:, 3, 3] = 1.0
    return inverse


def _angles(R: Float64) -> Float64:
    """Return the angles (n,) of rotations (n, 3, 3), rad."""
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    # unlike arccos, arctan2 is accurate for small angles
    return np.asarray(np.arctan2(np.linalg.norm(axis, axis=1) / 2, (np.trace(R, axis1=1, axis2=2) - 1) / 2))


def _rmse(errors: Float64) -> float:
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan")

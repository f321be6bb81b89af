"""How far an estimated trajectory is from the true one: ATE and RPE, in evo's symbols and with evo's numbers.

Q_i = T_world_camera of frame i, reference; P_i = the same, estimated.

- ATE (absolute trajectory error, Sturm et al. 2012): with the rigid S that aligns the positions best in the least
  squares sense (Umeyama 1991, without scale), E_i = Q_i^-1 S P_i; the RMSE of |trans E_i|.
- RPE (relative pose error) with delta = 1 frame: E_i = (Q_i^-1 Q_{i+1})^-1 (P_i^-1 P_{i+1}); the RMSE of |trans E_i|
  and that of the angle of rot E_i. No alignment is needed.

Frames whose pose is lost or whose true pose is not known are left out; RPE then also leaves out the pairs that they are
in, so that a step always is one frame long.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from framework.data import Float64, Pose
from framework.errors import DataError


@dataclass(frozen=True)
class TrajectoryError:
    """Errors of one trajectory; `nan` where no frame (ATE) or no pair of frames (RPE) could be compared."""

    ate_rmse_m: float
    rpe_rmse_m: float
    rpe_rotation_rmse_rad: float
    frames: int  # that ATE compares
    pairs: int  # that RPE compares

    def metrics(self) -> dict[str, float]:
        """By their names in metrics.json; an error that is not defined is left out."""
        flat: dict[str, float] = {}
        if self.frames:
            flat["trajectory.ate_rmse_m"] = self.ate_rmse_m
        if self.pairs:
            flat["trajectory.rpe_rmse_m"] = self.rpe_rmse_m
            flat["trajectory.rpe_rotation_rmse_rad"] = self.rpe_rotation_rmse_rad
        return flat


def evaluate(reference: Sequence[Float64 | None], estimated: Sequence[Pose]) -> TrajectoryError:
    """Compares pose i with true pose i (T_world_camera, (4, 4); None = not known) of consecutive frames.

    Raises DataError when there are not equally many.
    """
    if len(reference) != len(estimated):
        raise DataError(
            f"trajectories must be equally long, found {len(reference)} true and {len(estimated)} estimated poses"
        )
    usable = np.array([q is not None and not p.lost for q, p in zip(reference, estimated, strict=True)], np.bool_)
    Q = np.array([np.eye(4) if q is None else q for q in reference]).reshape(-1, 4, 4)
    P = np.array([p.T_world_camera for p in estimated]).reshape(-1, 4, 4)
    ate = np.linalg.norm(_aligned(Q[usable, :3, 3], P[usable, :3, 3]) - Q[usable, :3, 3], axis=1)
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
    """R (3, 3) and t (3,) that minimize sum |y_i - (R x_i + t)|^2 over points (n, 3): Umeyama 1991, eqs. (40) to (43).

    Where the points do not determine the rotation (fewer than three, or all on a line), it is one of the best.
    """
    mu_x, mu_y = x.mean(axis=0), y.mean(axis=0)
    U, _, Vt = np.linalg.svd((y - mu_y).T @ (x - mu_x) / len(x))
    S = np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = U @ S @ Vt
    return R, mu_y - R @ mu_x


def _aligned(reference: Float64, estimated: Float64) -> Float64:
    """The estimated positions (n, 3) moved rigidly onto the reference."""
    if not len(estimated):
        return estimated
    R, t = umeyama(estimated, reference)
    return np.asarray(estimated @ R.T + t)


def _inverse(T: Float64) -> Float64:
    """Of rigid transforms (n, 4, 4)."""
    inverse = np.zeros_like(T)
    inverse[:, :3, :3] = T[:, :3, :3].transpose(0, 2, 1)
    inverse[:, :3, 3] = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    inverse[:, 3, 3] = 1.0
    return inverse


def _angles(R: Float64) -> Float64:
    """The angles (n,) of rotations (n, 3, 3), rad, accurate for small ones too: see geometry.rotation_angle."""
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    return np.asarray(np.arctan2(np.linalg.norm(axis, axis=1) / 2, (np.trace(R, axis1=1, axis2=2) - 1) / 2))


def _rmse(errors: Float64) -> float:
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan")

"""Covariance of a registration by `small_gicp`, and its degenerate directions."""

from __future__ import annotations

import numpy as np
import small_gicp
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

# small_gicp models every point as a small plane with variances (1e-3, 1, 1) m² along and across its normal. A pair of
# them has a weight of at least 1/2 in any direction, even along both planes, where nothing is known; 500 across.
TANGENTIAL_WEIGHT, NORMAL_WEIGHT = 0.5, 500.0
MAX_ITERATIONS = 30


class DegenerateSettings(BaseModel):
    """What is done in directions that no surface holds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    degenerate_share: float = Field(
        0.0031,
        gt=0,
        lt=1,
        description="A direction constrained by less than this share of points is degenerate.",
    )
    degenerate_stddev_m: float = Field(10.0, gt=0, description="Standard deviation in degenerate directions.")


def has_converged(result: small_gicp.RegistrationResult) -> bool:
    """Whether the registration converged, or stopped before the limit of iterations."""
    return bool(result.converged or result.iterations < MAX_ITERATIONS - 1)


def _information(result: small_gicp.RegistrationResult, points: small_gicp.PointCloud) -> tuple[Array, float]:
    """Information matrix (6, 6) of the pose in source axes from the planes only, and the sum of their normal weights.

    The Hessian of the registration also contains the weight along the planes. That is no information about the pose:
    the mean of a voxel's points lies anywhere on its wall. So it is subtracted, with J = [-R [p]x, R] of T p for T
    Exp(r, t). The rest is rescaled by the size of the residuals.
    """
    p = np.asarray(points.points())[:, :3]
    along = np.zeros((6, 6))
    along[:3, :3] = np.sum(p * p) * np.eye(3) - p.T @ p
    along[:3, 3:] = cross_matrix(p.sum(axis=0))
    along[3:, :3] = along[:3, 3:].T
    along[3:, 3:] = len(p) * np.eye(3)
    planes = result.H - TANGENTIAL_WEIGHT * result.num_inliers / len(p) * along
    scale = result.num_inliers / max(2 * result.error, 1e-9)  # 1 / mean squared whitened residual
    return scale * planes, scale * NORMAL_WEIGHT * result.num_inliers


def remap_solution(
    guess: Array,
    T: Array,
    result: small_gicp.RegistrationResult,
    points: small_gicp.PointCloud,
    settings: DegenerateSettings,
) -> tuple[Array, Array, bool]:
    """Pose and covariance (6, 6) of a match, and whether any direction is degenerate: along those the guess is kept.

    Solution remapping of Zhang et al. 2016, in a tangent whose rotations are multiplied by the usual distance of the
    source `points`, so that they are comparable with translations. A direction is degenerate when its information, by
    the registration `result`, is below a share of that of all points across their planes.
    """
    information, weight = _information(result, points)
    length_m = np.sqrt(np.mean(np.sum(points.points()[:, :3] ** 2, axis=1)))
    scale = np.repeat([length_m, 1.0], 3)
    eigenvalues, axes = np.linalg.eigh(information / np.outer(scale, scale))
    is_open = eigenvalues < settings.degenerate_share * weight
    variances = np.where(is_open, settings.degenerate_stddev_m**2, 1 / np.where(is_open, 1.0, eigenvalues))
    covariance = (axes * variances) @ axes.T / np.outer(scale, scale)
    if is_open.any():
        held = axes[:, ~is_open]
        T = guess @ exp(held @ (held.T @ (scale * _log(inverse(guess) @ T))) / scale)
    return T, covariance, bool(is_open.any())


def rigid(T: Array) -> Array:
    """The nearest rigid transforms (..., 4, 4): corrects the rounding errors of products of many transforms."""
    result = T.copy()
    result[..., :3, :3] = Rotation.from_matrix(T[..., :3, :3]).as_matrix()
    result[..., 3, :] = 0.0, 0.0, 0.0, 1.0
    return result


def inverse(T: Array) -> Array:
    """Of transforms (..., 4, 4)."""
    return np.asarray(np.linalg.inv(T), np.float64)


def turn_deg(T: Array) -> float:
    """Angle of the rotation of a transform (4, 4)."""
    return float(np.degrees(Rotation.from_matrix(T[:3, :3]).magnitude()))


def adjoint(T: Array) -> Array:
    """(..., 6, 6) with T Exp(x) T⁻¹ = Exp(adjoint x), x = (rotation, translation)."""
    R = T[..., :3, :3]
    result = np.zeros((*T.shape[:-2], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = R
    result[..., 3:, :3] = cross_matrix(T[..., :3, 3]) @ R
    return result


def cross_matrix(v: Array) -> Array:
    """(..., 3, 3) with cross_matrix(v) @ w = v x w."""
    return np.swapaxes(np.cross(v[..., None, :], np.eye(3)), -1, -2)


def _log(T: Array) -> Array:
    """Rotation vector and translation of a small motion, (6,)."""
    return np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]])


def exp(x: Array) -> Array:
    """T (4, 4) of a rotation vector and a translation (6,), which are not coupled."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(x[:3]).as_matrix()
    T[:3, 3] = x[3:]
    return T

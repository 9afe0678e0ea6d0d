"""Transport of 6x6 pose covariances along transforms, and the chi-square distribution of normalized errors.

A covariance is ordered x, y, z, about x, about y, about z; the perturbation is `X = (p + dp, exp(dtheta) R)` with dp
and dtheta along the fixed axes of the frame of reference. For a chain A-B-C, to first order,
`J_AB = [[I, -[R_AB p_BC]x], [0, I]]` and `J_BC = diag(R_AB, R_AB)`: from p_AC = p_AB + R_AB p_BC follows
dp_AC = dp_AB + dtheta_AB x (R_AB p_BC) + R_AB dp_BC.
"""

from __future__ import annotations

import math

import numpy as np

from modelserver.transforms import so3
from modelserver.transforms.large_angle import large_angle_lever_arm
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array

_IDENTITY = np.eye(6)


def compose(X_AB: Pose, cov_AB: Array, X_BC: Pose, cov_BC: Array) -> Array:
    """Return the covariance (6, 6) of `X_AB @ X_BC`, for independent errors."""
    R = np.array(so3.matrix_rows(X_AB.wxyz))
    J = np.eye(6)
    J[:3, 3:] = -so3.skew(R @ X_BC.xyz)
    K = np.zeros((6, 6))
    K[:3, :3] = R
    K[3:, 3:] = R
    return _symmetric(J @ cov_AB @ J.T + K @ cov_BC @ K.T)


def invert(X_AB: Pose, cov_AB: Array) -> Array:
    """Return the covariance (6, 6) of `X_AB.inverse()`, along the axes of B.

    R_BA = R' exp(-dtheta) = exp(-R' dtheta) R', and p_BA = -R' exp(-dtheta) (p + dp), so
    dtheta_BA = -R' dtheta and dp_BA = -R' dp - R' [p]x dtheta.
    """
    Rt = np.array(so3.matrix_rows(X_AB.wxyz)).T
    J = np.zeros((6, 6))
    J[:3, :3] = -Rt
    J[:3, 3:] = -Rt @ so3.skew(X_AB.xyz)
    J[3:, 3:] = -Rt
    return _symmetric(J @ cov_AB @ J.T)


def apply_lever_arm(cov: Array, r: Array) -> Array:
    """Return the covariance (6, 6) at the end of the lever arm `r` (3,), also for large angles (see `large_angle`).

    `cov` is that of the pose at the start of the lever arm; both and `r` are along the same axes.
    """
    M, more = large_angle_lever_arm(cov[3:, 3:], r)
    J = _IDENTITY.copy()
    x, y, z = r.tolist()
    # -[r]x
    J[:3, 3:] = np.array(((-0.0, z, -y), (-z, -0.0, x), (y, -x, -0.0))) @ M
    found = J @ cov @ J.T
    found[:3, :3] += more
    return _symmetric(found)


def rotate(R: Array, cov: Array) -> Array:
    """Return `cov` (6, 6) along axes rotated by the matrix `R` (3, 3)."""
    K = np.zeros((6, 6))
    K[:3, :3] = R
    K[3:, 3:] = R
    return _symmetric(K @ cov @ K.T)


def from_sigmas(position: tuple[float, float, float], rotation: tuple[float, float, float]) -> Array:
    """Return the diagonal covariance (6, 6) of standard deviations in meters and radians."""
    return np.diag(np.square(np.array(position + rotation, dtype=float)))


def find_problem(cov: Array) -> str:
    """Return why a matrix (6, 6) is no covariance, "" if it is one.

    The tolerance covers rounding on the wire: matrices are symmetric and positive semidefinite to 1e-9 of their
    variances.
    """
    if not np.isfinite(cov).all():
        return "it has numbers that are not finite"
    variances = np.diag(cov)
    if float(variances.min()) < 0.0:
        return "a variance in it is negative"
    # meters and radians differ in size: normalize to correlations
    scale = np.sqrt(variances) + 1e-150
    correlation = cov / np.outer(scale, scale)
    if float(np.abs(correlation - correlation.T).max()) > 1e-9:
        return "it is not symmetric"
    if float(np.linalg.eigvalsh(correlation).min()) < -1e-9:
        return "a variance in it is negative along some direction"
    return ""


def _symmetric(cov: Array) -> Array:
    return np.asarray((cov + cov.T) / 2)


def chi_square_survival(value: float, dof: int) -> float:
    """Return the probability that a chi-square variable of `dof` degrees of freedom exceeds `value`.

    In closed form: Abramowitz and Stegun (1964), 26.4.4 for odd `dof`, 26.4.5 for even.
    """
    half = 0.5 * value
    found = math.erfc(math.sqrt(half)) if dof % 2 else 0.0
    exponents = (n + 0.5 * (dof % 2) for n in range(dof // 2))
    return found + math.exp(-half) * math.fsum(half**each / math.gamma(each + 1.0) for each in exponents)

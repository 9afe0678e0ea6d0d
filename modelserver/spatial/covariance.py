"""Transport of 6x6 pose covariances along chains.

A covariance is ordered x, y, z, about x, about y, about z; the perturbation is
`X = (p + dp, exp(dtheta) R)` with dp and dtheta along the fixed axes of the frame of reference. With that
choice a chain A-B-C has `J_AB = [[I, -[R_AB p_BC]x], [0, I]]` and `J_BC = diag(R_AB, R_AB)`, first order in
the perturbations. Derivation: p_AC = p_AB + R_AB p_BC, so dp_AC = dp_AB + dtheta_AB x (R_AB p_BC) + R_AB dp_BC.
"""

from __future__ import annotations

import numpy as np

from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array
from modelserver.spatial.swing import swing


def compose(X_AB: Pose, cov_AB: Array, X_BC: Pose, cov_BC: Array) -> Array:
    """Return the covariance (6, 6) of `X_AB @ X_BC`, the two being independent."""
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


def at_end(cov: Array, r: Array) -> Array:
    """Return the covariance (6, 6) at the end of a lever `r` (3,), of one whose turn may be large; see `swing`.

    `cov` is of the pose at the lever's beginning, all along the same axes.
    """
    M, more = swing(cov[3:, 3:], r)
    J = np.eye(6)
    J[:3, 3:] = -so3.skew(r) @ M
    found = J @ cov @ J.T
    found[:3, :3] += more
    return _symmetric(found)


def rotated(R: Array, cov: Array) -> Array:
    """Return `cov` (6, 6) with its axes turned by the rotation matrix `R` (3, 3)."""
    K = np.zeros((6, 6))
    K[:3, :3] = R
    K[3:, 3:] = R
    return _symmetric(K @ cov @ K.T)


def from_sigmas(position: tuple[float, float, float], rotation: tuple[float, float, float]) -> Array:
    """Return the diagonal covariance (6, 6) of standard deviations in metres and radians."""
    return np.diag(np.square(np.array(position + rotation, dtype=float)))


def fault(cov: Array) -> str:
    """Return what keeps a matrix (6, 6) from being a covariance; empty where nothing does.

    Numbers that went over a wire are symmetric and have no negative variance but for rounding.
    """
    if not np.isfinite(cov).all():
        return "it has numbers that are not finite"
    variances = np.diag(cov)
    if float(variances.min()) < 0.0:
        return "a variance in it is negative"
    # metres and radians are not of one size: each is weighed by its own
    scale = np.sqrt(variances) + 1e-150
    weighed = cov / np.outer(scale, scale)
    if float(np.abs(weighed - weighed.T).max()) > 1e-9:
        return "it is not symmetric"
    if float(np.linalg.eigvalsh(weighed).min()) < -1e-9:
        return "a variance in it is negative along some direction"
    return ""


def _symmetric(cov: Array) -> Array:
    return np.asarray((cov + cov.T) / 2)

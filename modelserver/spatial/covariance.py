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


def bend(turn: Array, r: Array) -> Array:
    """Return what a turn that is unsure adds to the position at the end of a lever, to second order: (3, 3).

    An arm `r` (3,) that turns by theta does not end on the tangent but on an arc, off it by
    `b = (theta theta' - |theta|^2 I) r / 2`. That is small beside `theta x r` while the angle is, and at 20 degrees it
    is what matters most along the arm. `turn` (3, 3) is the covariance of theta, along the axes of `r`. By Isserlis'
    theorem for the fourth moments of a normal distribution, with S the turn and t its trace,

        4 E[b b'] = S (r' S r) + 2 S r r' S - (t S + 2 S^2) r r' - r r' (t S + 2 S^2) + (t^2 + 2 tr S^2) r r'

    b is even in theta and `theta x r` odd, so the two do not correlate; nor do b and theta.
    """
    Sr = turn @ r
    t = float(np.trace(turn))
    across = np.outer(t * Sr + 2.0 * (turn @ Sr), r)
    along = (t * t + 2.0 * float(np.sum(turn * turn))) * np.outer(r, r)
    return np.asarray((turn * float(r @ Sr) + 2.0 * np.outer(Sr, Sr) - across - across.T + along) / 4.0)


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

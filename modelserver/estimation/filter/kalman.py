"""Kalman update in Joseph form (Groves 2013, 3.2): filterpy's KalmanFilter holds the covariance of the error state.

filterpy's object is a workspace: each call sets all that it reads, so no state passes from one call to the next and
the functions are pure. x is one-dimensional, H, R, F, Q are two-dimensional and given always: its defaults broadcast
silently. The error state is zero before each update, for what was estimated has been put into the nominal state.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, Final

import numpy as np

from modelserver.estimation.filterpy_import import import_kalman_filter
from modelserver.transforms.so3 import Array

KalmanFilter: Final = import_kalman_filter()


@lru_cache(maxsize=64)
def _workspace(n: int, m: int) -> tuple[Any, Array]:
    workspace = KalmanFilter(dim_x=n, dim_z=m)
    zero = np.zeros(n)
    zero.flags.writeable = False
    workspace.x = zero
    return workspace, zero


def chi_square_survival(value: float, dof: int) -> float:
    """Return the probability that a chi-square statistic of `dof` degrees of freedom exceeds `value`.

    In closed form: Abramowitz and Stegun (1964), 26.4.4 for odd `dof`, 26.4.5 for even.
    """
    half = 0.5 * value
    found = math.erfc(math.sqrt(half)) if dof % 2 else 0.0
    exponents = (n + 0.5 * (dof % 2) for n in range(dof // 2))
    return found + math.exp(-half) * math.fsum(half**each / math.gamma(each + 1.0) for each in exponents)


@lru_cache(maxsize=256)
def gate_limit(dof: int, risk: float) -> float:
    """Return the value that a chi-square statistic exceeds with probability `risk`, in (0, 1); `dof`: its freedoms."""
    low, high = 0.0, 1.0
    while chi_square_survival(high, dof) > risk:
        low, high = high, 2.0 * high
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if chi_square_survival(middle, dof) > risk else (low, middle)
    return high


def predicted(P: Array, F: Array, Q: Array) -> Array:
    """Return F P F' + Q, all (n, n)."""
    workspace, zero = _workspace(len(P), 1)
    workspace.x = zero
    workspace.P = P
    workspace.predict(F=F, Q=Q)
    found: Array = workspace.P
    return found


def innovation(P: Array, H: Array, R: Array) -> Array:
    """Return S = H P H' + R, (m, m), symmetric."""
    S = H @ P @ H.T + R
    return np.asarray(0.5 * (S + S.T))


def statistic(residual: Array, S: Array) -> float:
    """Return residual' S^-1 residual, chi-square distributed if all is well; infinite where S is singular."""
    if len(residual) == 1:
        return float(residual[0] * residual[0] / S[0, 0]) if S[0, 0] > 0.0 else math.inf
    try:
        return float(residual @ np.linalg.solve(S, residual))
    except np.linalg.LinAlgError:
        return math.inf


def corrected(P: Array, residual: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """Return the error (n) that a residual (m) tells, and the covariance (n, n) after it, in Joseph's form.

    H is (m, n), R is (m, m). Raises numpy.linalg.LinAlgError where the innovation's covariance is singular.
    """
    n, m = len(P), len(residual)
    assert H.shape == (m, n), (H.shape, m, n)
    assert R.shape == (m, m), R.shape
    workspace, zero = _workspace(n, m)
    workspace.x = zero
    workspace.P = P
    workspace.update(residual, R=R, H=H)
    error: Array = workspace.x
    after: Array = workspace.P
    workspace.x = zero
    return error, 0.5 * (after + after.T)

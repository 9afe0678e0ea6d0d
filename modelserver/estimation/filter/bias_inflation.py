"""Covariance inflation of persisted biases by age, for a warm start."""

from __future__ import annotations

import math

import numpy as np

from modelserver.estimation.filter import motion, strapdown
from modelserver.estimation.filter.layout import STRAPDOWN
from modelserver.estimation.filter.nav import Nav
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState
from modelserver.messages import PersistedState
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array

SAME_BIAS = 5.0
"""Sigmas by which the kept gyro biases may differ from what a standing unit tells."""

SWITCHED = 0.25
"""Share of its sigma before it was found by which a bias may differ once its unit was switched off and on again."""


def aged(setup: Setup, kept: PersistedState, age: float, pose_age: float) -> tuple[tuple[float, ...], Array]:
    """Return biases and further states (6 + m) as they are expected now, and the covariance (n, n) of all errors.

    A walk of density q^2 that had reached its sigma before anything was known is taken for a Gauss-Markov process of
    that sigma: its time constant is 2 sigma^2 / q^2, so that what is old enough says no more than nothing does. Older
    than `pose_age`, units may have been switched off and on.
    """
    settings, n = setup.settings, setup.layout.size
    keep, add = np.ones(n), np.zeros(n)
    switched = SWITCHED**2 if age > pose_age else 0.0

    def walked(at: slice, sigma: float, walk: float) -> None:
        share = math.exp(-age * walk * walk / (2.0 * sigma * sigma)) if walk > 0.0 else 1.0
        keep[at] = share
        add[at] = sigma * sigma * (1.0 - share * share + switched)

    walked(slice(9, 12), settings.gyro_bias_sigma, settings.gyro_bias_walk)
    walked(slice(12, 15), settings.accelerometer_bias_sigma, settings.accelerometer_bias_walk)
    switched, at = 0.0, STRAPDOWN
    for extra in setup.layout.extras:
        where = slice(at, at + len(extra.names))
        if math.isfinite(extra.time_constant):
            keep[where] = math.exp(-age / extra.time_constant)
            add[where] = extra.sigma**2 * (1.0 - keep[at] ** 2)
        else:
            walked(where, extra.sigma, extra.walk)
        at = where.stop
    P = np.array(kept.covariance).reshape(n, n) * np.outer(keep, keep)
    P.reshape(-1)[:: n + 1] += add
    values = np.array((*kept.gyro_bias, *kept.accelerometer_bias, *kept.extras)) * keep[9:]
    return tuple(values.tolist()), 0.5 * (P + P.T)


def with_biases(setup: Setup, state: FilterState, nav: Nav, values: tuple[float, ...], P: Array) -> Nav | None:
    """Return the levelled state with kept biases; None where a standing unit's gyros do not fit them.

    Up was found with no accelerometer bias: it is found anew with the kept one, and tied to what that leaves open
    (see `start`). A standing unit's mean rate and the kept biases are weighed with each other.
    """
    n, after = setup.layout.size, nav.covariance.copy()
    rates, mean = np.array(values[:3]), np.array(nav.gyro_bias)
    Pg, Pn = P[9:12, 9:12], nav.covariance[9:12, 9:12]
    levelled = state.standing and bool(nav.covariance[6:9, 12:15].any())
    inertial = motion.inertial(setup, state.mode)
    attitude = nav.attitude
    if levelled:
        S = Pg + Pn
        if (np.abs(mean - rates) > SAME_BIAS * np.sqrt(np.diagonal(S))).any():
            return None
        gain = np.linalg.solve(S, Pg).T
        rates, Pg = rates + gain @ (mean - rates), Pg - gain @ Pg
    if inertial:
        after[9:12, :], after[:, 9:12] = 0.0, 0.0
        after[9:12, 9:12] = 0.5 * (Pg + Pg.T)
        after[12:15, :], after[:, 12:15] = 0.0, 0.0
        Pa = after[12:15, 12:15] = P[12:15, 12:15]
    if levelled:
        g = strapdown.STANDARD_GRAVITY
        x, y, z = nav.up
        attitude = strapdown.level_attitude((x * g - values[3], y * g - values[4], z * g - values[5]))
        R = np.array(so3.matrix_rows(attitude))
        M = np.array((-R[1] / g, R[0] / g, np.zeros(3)))
        after[6:9, :], after[:, 6:9] = 0.0, 0.0
        after[6:9, 6:9] = M @ Pa @ M.T + np.diag((1e-6, 1e-6, 0.0))
        after[6:9, 12:15] = M @ Pa
        after[12:15, 6:9] = after[6:9, 12:15].T
    extras = list(nav.extras)
    for at in range(STRAPDOWN, n):
        # what fades within a minute is of another time
        if not setup.layout.decays[at - STRAPDOWN]:
            extras[at - STRAPDOWN] = values[at - 9]
            after[at, :], after[:, at] = 0.0, 0.0
            after[at, at] = P[at, at]
    nav = nav._replace(extras=tuple(extras), covariance=after)
    if not inertial:
        return nav
    a, b, c = rates.tolist()
    return nav._replace(
        attitude=attitude,
        position=so3.rotate(attitude, setup.rig.imu),
        gyro_bias=(a, b, c),
        accelerometer_bias=(values[3], values[4], values[5]),
    )

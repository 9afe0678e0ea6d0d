"""Measurement update: innovation, chi-square gate (NIS), correction, and the entry in the decision ledger."""

from __future__ import annotations

import math

import numpy as np

from modelserver.estimation.filter import kalman
from modelserver.estimation.filter.measurements.base import Compared
from modelserver.estimation.filter.nav import Nav
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.messages import Decision, Verdict
from modelserver.transforms.so3 import Vector3


def used(
    nav: Nav, compared: Compared, settings: FilterSettings, utime: int, source: str, seq: int, kind: str
) -> tuple[Nav, Decision]:
    """Return the state with a comparison put into it, or as it was where the gate refuses; and what became of it."""
    residual, H, R, monitored, separable, eased = compared
    if not (np.isfinite(residual).all() and np.isfinite(H).all() and np.isfinite(R).all()):
        return nav, Decision(utime, source, seq, kind, Verdict.REJECTED, "nan")
    S = kalman.innovation(nav.covariance, H, R)
    statistic = kalman.statistic(residual, S)
    limit = kalman.gate_limit(len(residual), settings.gate_risk)
    verdict, reason = Verdict.USED, ""
    keep = np.ones(len(residual), dtype=bool)
    if monitored:
        verdict, reason = Verdict.MONITORED, monitored
    elif not statistic <= limit:
        verdict, reason = Verdict.REJECTED, "gate"
        if statistic <= eased * limit:
            # S' = S statistic / limit: the statistic becomes its limit
            verdict, reason = Verdict.USED, "eased"
            R = R + (statistic / limit - 1.0) * S
            separable = False
        if separable and len(residual) > 1:
            single = kalman.gate_limit(1, settings.gate_risk)
            fits = residual * residual <= single * np.diagonal(S)
            if fits.any() and not fits.all():
                residual_, S_ = residual[fits], S[np.ix_(fits, fits)]
                if kalman.statistic(residual_, S_) <= kalman.gate_limit(len(residual_), settings.gate_risk):
                    verdict, reason = Verdict.USED, "part"
                    keep = fits
    decision = Decision(
        utime,
        source,
        seq,
        kind,
        verdict,
        reason,
        tuple(residual.tolist()),
        tuple(S.ravel().tolist()),
        tuple(R.ravel().tolist()),
        statistic,
        limit,
    )
    if verdict is not Verdict.USED:
        return nav, decision
    if reason == "part":
        residual, H, R = residual[keep], H[keep], R[np.ix_(keep, keep)]
    try:
        error, P = kalman.corrected(nav.covariance, residual, H, R)
    except np.linalg.LinAlgError:
        return nav, decision._replace(verdict=Verdict.REJECTED, reason="singular")
    return nav.injected(error, P), decision


def moving(nav: Nav, compared: Compared, base: Vector3, seconds: float) -> Nav:
    """Return a state of unknown speed at the speed that a comparison tells, all else and the covariance as they were.

    Jacobians that grow with speed are those of the true one then. `seconds` is how long the way since the last wheel
    sample took: it was rolled at that speed too.
    """
    residual, H, R = compared.residual, compared.jacobian, compared.noise
    try:
        error, _ = kalman.corrected(nav.covariance, residual, H, R)
    except np.linalg.LinAlgError:
        return nav
    x, y, z = error[3:6].tolist()
    if not math.isfinite(x + y + z):
        return nav
    before = nav.body_velocity(base)
    vx, vy, vz = nav.velocity
    nav = nav._replace(velocity=(vx + x, vy + y, vz + z))
    a, b, c = nav.rolled
    dx, dy, dz = (seconds * (new - old) for new, old in zip(nav.body_velocity(base), before, strict=True))
    return nav._replace(rolled=(a + dx, b + dy, c + dz))


def refused(utime: int, source: str, seq: int, kind: str, reason: str) -> Decision:
    """Return the word for a sample that was refused before it could be compared."""
    return Decision(utime, source, seq, kind, Verdict.REJECTED, reason)


def plausible(nav: Nav, settings: FilterSettings) -> bool:
    """Return whether place and speed are numbers of a vehicle: the cheap part of `sound`, for every sample."""
    # a comparison with nan is false
    return math.isfinite(sum(nav.position)) and math.hypot(*nav.velocity) <= 2.0 * settings.maximum_speed


def sound(nav: Nav, settings: FilterSettings) -> bool:
    """Return whether a state is finite and within what a vehicle can be: else the filter has diverged."""
    P = nav.covariance
    diagonal = np.diagonal(P)
    if not (np.isfinite(P).all() and (diagonal >= 0.0).all()):
        return False
    numbers = (*nav.position, *nav.velocity, *nav.gyro_bias, *nav.accelerometer_bias, *nav.extras)
    if not all(map(math.isfinite, numbers)):
        return False
    return (
        math.hypot(*nav.velocity) <= 2.0 * settings.maximum_speed
        and math.hypot(*nav.gyro_bias) <= 20.0 * settings.gyro_bias_sigma
        and math.hypot(*nav.accelerometer_bias) <= 20.0 * settings.accelerometer_bias_sigma
    )

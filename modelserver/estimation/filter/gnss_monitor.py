"""GNSS monitor: errors of fixes that the Gauss-Markov model does not have.

Jumps. A fix beyond its gate is rejected, and stored beside the path. Rejected fixes that have agreed with dead
reckoning over `recovery_distance` and `recovery_time` are right, and the state is wrong: its position is reset to them
(`fit_rejected`). A fix that lies where the one before and the path since lead to did not jump but drifted there: the
time-correlated error is inflated until the fix passes (`gnss_step`).

Drift. The NIS of a fix should be its degrees of freedom on average. `noise_inflation` tracks by how much larger it is,
and multiplies the process noise of the time-correlated error (adaptive estimation: Groves 2013, 3.4.4).

Outliers. One outlier just within the gate moves the position by at most the gain times the gate's radius; that is the
`outlier_allowance`, added to the horizontal protection level. It decreases as newer fixes correct the outlier. Without
a measured speed it is also the distance of fixes that are rejected again and again: a ferry leaves as smoothly as a
vehicle stays.

Output offset. The published pose is the position that the receiver would report, because way points are surveyed with
it: the estimate plus the time-correlated error, followed at no more than `position_slew_rate`.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from modelserver.estimation.filter import heading_alignment
from modelserver.estimation.filter.error_layout import ErrorLayout
from modelserver.estimation.filter.eskf import ZERO, Innovation, NavState
from modelserver.estimation.filter.heading_alignment import PathFit, PathFix
from modelserver.estimation.filter.measurements.gnss import CORRELATED_ERROR
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filter.turn_monitor import CONFIRMATIONS
from modelserver.messages import Decision
from modelserver.transforms.so3 import Vector3

AIDED_TIME: Final = 10.0
"""Seconds after another source has measured the position for which the pose does not follow the fixes."""

FADE_DELAY: Final = 3.0
"""Seconds without a fix after which the output offset of a moving vehicle decays."""

CONFLICT_TIME: Final = 20.0
"""Seconds after a fix from beyond its gate was used for which the outlier allowance does not decrease."""

MOVING_TIME: Final = 3.0
"""Seconds of fixes that show whether the vehicle moves, if wheels do not."""

MAX_CONFIRMED: Final = 1000


class OutputOffset(NamedTuple):
    """How far the published position follows the time-correlated error of fixes.

    Attributes
    ----------
    value: along N, m.
    variance: what following adds to the variance of the position, m2.
    aided_utimes: when another source last measured the position along each axis.
    """

    value: Vector3 = ZERO
    variance: Vector3 = ZERO
    aided_utimes: tuple[int, int, int] = (0, 0, 0)

    def update(
        self,
        nav: NavState,
        sigma: Vector3,
        seconds: float,
        axes: slice,
        layout: ErrorLayout,
        settings: FilterSettings,
    ) -> OutputOffset:
        """Return the offset after a fix with time-correlated standard deviation `sigma`, `seconds` after the last one.

        The variance is sigma^2 minus what is still unknown, plus the square of what is left to follow. If another
        source measures the position, the target is 0.
        """
        most = settings.position_slew_rate * min(seconds, 2.0)
        at, first = layout.extra_index(CORRELATED_ERROR[0]), layout.index(CORRELATED_ERROR[0])
        value, variance = list(self.value), list(self.variance)
        for axis in range(3)[axes]:
            is_aided = (nav.utime - self.aided_utimes[axis]) * 1e-6 < AIDED_TIME
            distance = (0.0 if is_aided else sigma[axis] * nav.extras[at + axis]) - value[axis]
            step = max(-most, min(distance, most))
            value[axis] += step
            unknown = float(nav.covariance[first + axis, first + axis])
            estimated = 0.0 if is_aided else sigma[axis] ** 2 * max(1.0 - unknown, 0.0)
            variance[axis] = estimated + (distance - step) ** 2
        return OutputOffset((value[0], value[1], value[2]), (variance[0], variance[1], variance[2]), self.aided_utimes)

    def decay(self, seconds: float, settings: FilterSettings) -> tuple[Vector3, Vector3]:
        """Return value and variance after `seconds` without a fix on the move: they decay as the error itself does.

        The estimate of the error is independent of the position's error, as an optimal estimate is of its own error;
        so adding it adds its variance.
        """
        fade = math.exp(-(seconds - FADE_DELAY) / settings.gps_correlation_time) if seconds > FADE_DELAY else 1.0
        x, y, z = self.value
        a, b, c = self.variance
        return (x * fade, y * fade, z * fade), (a * fade * fade, b * fade * fade, c * fade * fade)


class GnssMonitor(NamedTuple):
    """What is known about fixes while the filter is aligned.

    Attributes
    ----------
    last_fix: the newest fix beside the path.
    used_utime: the last fix that was used or confirmed.
    num_confirmed: fixes that were used.
    rejected: fixes rejected in a row, beside the path.
    num_rejected: how many.
    noise_inflation: factor of the process noise of the time-correlated error, at least 1.
    offset: of the published position.
    outlier_allowance: what one outlier within the gate may have moved the position by, or the distance of fixes that
        nothing but accelerations contradicts, m.
    conflict_utime: when a fix from beyond its gate was last used.
    """

    last_fix: PathFix | None = None
    used_utime: int = 0
    num_confirmed: int = 0
    rejected: tuple[PathFix, ...] = ()
    num_rejected: int = 0
    noise_inflation: float = 1.0
    offset: OutputOffset = OutputOffset()
    outlier_allowance: float = 0.0
    conflict_utime: int = 0

    def confirm(self, utime: int) -> GnssMonitor:
        """Return the monitor after a fix that was used, or that a stationary vehicle agrees with."""
        return self._replace(
            used_utime=utime,
            num_confirmed=min(self.num_confirmed + 1, MAX_CONFIRMED),
            rejected=(),
            num_rejected=0,
        )

    def reject(self, fix: PathFix, settings: FilterSettings, *, is_speed_measured: bool) -> GnssMonitor:
        """Return the monitor after a rejected fix; `is_speed_measured`: whether wheels measure the path beside it."""
        allowance = self.outlier_allowance
        if not is_speed_measured and self.num_rejected + 1 >= CONFIRMATIONS:
            # they are no outliers, and accelerations alone do not contradict them: the bound covers both
            allowance = max(allowance, abs(fix.position - fix.path))
        return self._replace(
            outlier_allowance=allowance,
            rejected=heading_alignment.append_fix(self.rejected, fix, 2.0 * settings.recovery_time),
            num_rejected=self.num_rejected + 1,
        )

    def restart(self, utime: int) -> GnssMonitor:
        """Return the monitor of fixes that are trusted again from `utime` on."""
        return self._replace(rejected=(), num_rejected=0, used_utime=utime)

    def place(self, utime: int) -> GnssMonitor:
        """Return the monitor after the position was set at `utime`: the offset was that of the former one."""
        return self.restart(utime)._replace(offset=OutputOffset())

    def learn_inflation(self, decision: Decision, seconds: float, settings: FilterSettings) -> GnssMonitor:
        """Return the monitor with the noise inflation after a fix, `seconds` after the last one."""
        if not decision.dof or not math.isfinite(decision.statistic):
            return self
        gain = min(seconds, 2.0) / settings.gps_inflation_time
        ratio = min(decision.statistic / decision.dof, 20.0)
        inflation = min(max(self.noise_inflation * (1.0 + gain * (ratio - 1.0)), 1.0), settings.gps_inflation_limit)
        return self._replace(noise_inflation=inflation)

    def allow_outlier(self, before: NavState, innovation: Innovation, decision: Decision) -> GnssMonitor:
        """Return the monitor with the outlier allowance after a used fix; `before` is the state before it.

        The gain's horizontal rows times the gate's radius. For a fix from beyond the gate it is the whole residual:
        either the fix is wrong or the state was.
        """
        H, m = innovation.jacobian, len(innovation.residual)
        S = np.array(decision.innovation_covariance).reshape(m, m)
        gain = np.linalg.solve(S, H @ before.covariance[:, 0:2]).T
        radius = math.sqrt(decision.limit * float(np.trace(S)) / m)
        size = float(np.sqrt((gain * gain).sum()))
        one = size * radius
        weight = 1.0 - min(size, 1.0)
        if decision.reason:
            one = max(one, float(np.linalg.norm(innovation.residual)))
        since = (before.utime - self.conflict_utime) * 1e-6
        if decision.reason or since < CONFLICT_TIME:
            weight = 1.0
        return self._replace(
            outlier_allowance=max(one, weight * self.outlier_allowance),
            conflict_utime=before.utime if decision.reason else self.conflict_utime,
        )

    def fit_rejected(self, nav: NavState, settings: FilterSettings) -> PathFit | None:
        """Return the fit of the path to the rejected fixes once they have agreed with it for long enough."""
        rejected = self.rejected
        if len(rejected) < settings.recovery_fixes:
            return None
        seconds = (rejected[-1].utime - rejected[0].utime) * 1e-6
        if seconds < settings.recovery_time:
            return None
        rate_sigma = math.sqrt(nav.covariance[11, 11])
        fit = heading_alignment.fit_path(rejected, settings, is_unit_path=False, rate_sigma=rate_sigma)
        if fit is None or fit.distance < settings.recovery_distance:
            return None
        if not heading_alignment.is_consistent(fit, rejected[-1]):
            return None
        if not 0.7 < fit.factor < 1.4 or fit.rotation.sigma > settings.align_sigma:
            return None
        return fit


def inflate_correlated_error(
    nav: NavState, inflation: float, seconds: float, layout: ErrorLayout, settings: FilterSettings
) -> NavState:
    """Return the state with the process noise of the time-correlated error multiplied for the last `seconds`."""
    if inflation <= 1.0 or seconds <= 0.0:
        return nav
    at = layout.index(CORRELATED_ERROR[0])
    more = (inflation - 1.0) * 2.0 * min(seconds, 2.0) / settings.gps_correlation_time
    return nav.widen({at: more, at + 1: more, at + 2: more})


def is_continuous(before: PathFix | None, newest: PathFix, settings: FilterSettings) -> bool:
    """Return whether a fix lies where the last one and the path since lead to: a drifting one does, a jump does not."""
    if before is None:
        return True
    seconds = (newest.utime - before.utime) * 1e-6
    distance = abs((newest.position - before.position) - (newest.path - before.path))
    drift = newest.correlated * math.sqrt(2.0 * seconds / settings.gps_correlation_time)
    return distance <= 5.0 * math.hypot(1.5 * newest.white, drift)


def shows_motion(before: PathFix | None, newest: PathFix, settings: FilterSettings) -> bool:
    """Return whether two fixes are farther apart than they can drift in the time between."""
    if before is None:
        return False
    dt = (newest.utime - before.utime) * 1e-6
    if dt <= 0.0:
        return False
    drift = newest.correlated * math.sqrt(2.0 * (1.0 - math.exp(-dt / settings.gps_correlation_time)))
    return abs(newest.position - before.position) > 4.0 * math.hypot(1.5 * newest.white, drift) + 0.1

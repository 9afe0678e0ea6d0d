"""Hypothesis bank: what may be wrong with fixes, gyro and wheels, as planar Kalman filters beside each other.

Dead reckoning (`DeadReckoning`) is by wheels and gyro alone: turn and path since the start, which no fix and no
hypothesis has corrected. The turn theta is the integral of the rate about the vertical, with the gyro's bias; the path
u that of the wheels' way along the heading theta, with the error of their scale, and m = int (t - t0) du its moment.
Over a step from a to b (`Increment`, in the heading at a):

    u_ab = e^{-i theta_a} (u_b - u_a),   m_ab = e^{-i theta_a} (m_b - m_a - (t_a - t0) (u_b - u_a))

Each hypothesis has its own estimate of the vehicle's place and heading, and a posterior probability (multiple model
estimation: Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, 11.6). All
share the increments of dead reckoning since the last step: theta, u and m, in the heading of the first instant. They
differ in what was opened and when.

State of a hypothesis, 19: place p and heading psi of the rolling frame; bias b and scale g of the yaw gyro, scale s of
the wheels; latency l of fixes; error a of the antenna's lever arm; ordinary error w of fixes and its rate v; offset o
and drift d of faulty fixes; jump j. With the turn theta' = (1 - g) theta - b T:

    p' = p + e^{i psi} ((1 - s) u - i b m - i g theta u / 2),   psi' = psi + theta'                               (1)
    w' = e^{-T/tau_w} w + T v,  v' = e^{-T/tau_v} v,   o' = e^{-T/tau_o} o + T d,  d' = e^{-T/tau_d} d            (2)
    z = p + e^{i psi} (lever + a) + w + o + j - l v_a + l^2 a_a / 2 + white noise                                 (3)

Noise classes are no faults: the ordinary error of fixes wanders with the stated sigma, or with a rate v of 0.4 or 0.8
of it a second, bounded. Faults are those of `Fault`, and jumps. At each step the likeliest hypotheses have children in
which one of them begins or ends, with the rate of `FAULTS` as prior. The weight of each is multiplied by the likelihood
of the fix, with shares of outliers and of fixes that show nothing, so that no single fix settles a cause. Hypotheses of
one kind that began at about the same time are merged by their moments.

Dead reckoning may have been lost itself, in an outage or by a turn that no gyro measured: where fixes are off, other
hypotheses begin at their place, in all directions (`suspect_path`).

One of them is published: the likeliest, once those near it weigh `CERTAIN` together. The error of a pose is then the
mixture sum_h w_h N(p_h - p, P_h): its tails are the levels, and the risk of a limit (`compute_bounds`). The protection
level covers each hypothesis at an equal share of the risk, so also a fault that cannot be seen yet.

Limits: fixes that drift slower than wheels and gyro are known (2 % of the speed) are found in turns only. Without
wheels or a gyro there is no bank.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from modelserver.estimation.filter.protection_levels import (
    HEADING_FLOOR,
    LEVEL_RISK,
    Bounds,
    compute_factors,
)
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.transforms.so3 import Array


class Increment(NamedTuple):
    """Dead reckoning over a step.

    `seconds`; `turn` (rad); `path` and `moment` (m, m s), forward + i left in the heading at its begin; `driven` (m);
    `turn_variance` and `path_variance`, of what gyro and wheels have missed (rad2, m2); `is_stationary`, and
    whether the wheels are.
    """

    seconds: float
    turn: float
    path: complex
    moment: complex
    driven: float
    turn_variance: float = 0.0
    path_variance: float = 0.0
    is_stationary: bool = False
    are_wheels_stationary: bool = False


class DeadReckoning(NamedTuple):
    """Turn and path at `utime`, the last wheel sample that was compared; 0: none yet.

    Attributes
    ----------
    heading: the turn at that instant, rad.
    path, moment, driven: see the module's theory; m, m s, m.
    path_variance: of what wheels have missed, m2.
    gyro_utime, rate, turn, turn_variance: the last sample of the gyro, its rate about the vertical (rad/s), the turn
        until then (rad), and the variance of what it has missed (rad2).
    begin: when the path began, the t0 of the moment.
    """

    utime: int = 0
    heading: float = 0.0
    path: complex = 0j
    moment: complex = 0j
    driven: float = 0.0
    path_variance: float = 0.0
    gyro_utime: int = 0
    rate: float = 0.0
    turn: float = 0.0
    turn_variance: float = 0.0
    begin: int = 0

    def follow_gyro(self, utime: int, rate: float, variance: float) -> DeadReckoning:
        """Return dead reckoning after a sample of the gyro; `variance` is that of the turn since the last one, rad2."""
        if not self.gyro_utime:
            return self._replace(gyro_utime=utime, rate=rate)
        turn = self.turn + 0.5e-6 * (self.rate + rate) * (utime - self.gyro_utime)
        return DeadReckoning(*self[:6], utime, rate, turn, self.turn_variance + variance, self.begin)

    def predict_turn(self, utime: int) -> float:
        """Return the turn until an instant, at the last rate, rad."""
        return self.turn + 1e-6 * self.rate * (utime - self.gyro_utime)

    def drive(self, utime: int, distance: float, variance: float = 0.0) -> DeadReckoning:
        """Return dead reckoning after `distance` (m) driven since the last wheel sample, with its variance, m2."""
        heading = self.predict_turn(utime)
        if not self.utime:
            return self._replace(utime=utime, heading=heading, begin=utime)
        half = 0.5 * (heading - self.heading)
        # the chord of an arc
        chord = cmath.rect(distance * (math.sin(half) / half if half else 1.0), self.heading + half)
        middle = (0.5 * (utime + self.utime) - self.begin) * 1e-6
        return self._replace(
            utime=utime,
            heading=heading,
            path=self.path + chord,
            moment=self.moment + middle * chord,
            driven=self.driven + abs(distance),
            path_variance=self.path_variance + variance,
        )

    def since(self, start: DeadReckoning, *, is_stationary: bool, are_wheels_stationary: bool) -> Increment:
        """Return the step from an earlier instant."""
        spin = cmath.rect(1.0, -start.heading)
        path = self.path - start.path
        moment = self.moment - start.moment - (start.utime - self.begin) * 1e-6 * path
        return Increment(
            (self.utime - start.utime) * 1e-6,
            self.heading - start.heading,
            spin * path,
            spin * moment,
            max(self.driven - start.driven, 0.0),
            self.turn_variance - start.turn_variance,
            max(self.path_variance - start.path_variance, 0.0),
            is_stationary,
            are_wheels_stationary,
        )


# --- hypotheses ---------------------------------------------------------------------------------------------

Labels = npt.NDArray[np.int64]

EAST, NORTH, HEADING, BIAS, WHEEL_SCALE, DELAY, ARM, GYRO_SCALE = 0, 1, 2, 3, 4, 5, 6, 8
ERROR, ERROR_RATE, OFFSET, DRIFT, JUMP, SIZE = 9, 11, 13, 15, 17, 19
"""Indices of the states; those of ARM and from ERROR on have two numbers, along the vehicle or east and north."""


class Fault(IntEnum):
    """What lasts until it is corrected or ends. SPOOFING is a drift at a constant rate, without bound."""

    NONE = 0
    DRIFT = 1
    SPOOFING = 2
    GYRO = 3
    WHEELS = 4
    LATENCY = 5


class NoiseClass(NamedTuple):
    """How the ordinary error of fixes wanders: rate of change in sigmas a second, its time and that of the error (s),
    and how often an hour it begins.
    """

    rate: float
    rate_time: float
    time: float
    per_hour: float


NOISE_CLASSES: Final = (
    NoiseClass(0.0, 1.0, 60.0, 10.0),
    NoiseClass(0.4, 5.0, 10.0, 30.0),
    NoiseClass(0.8, 5.0, 10.0, 10.0),
)
"""The first is the stated error (time of the setting `gps_correlation_time`); the others are those of receivers that
state half or a quarter of what they wander by."""

LARGEST_JUMP: Final = 1e4
"""Largest standard deviation of a jump, m: a variance of 1e8 m2 leaves 1e-8 m2 of sixteen digits."""

DRIFT_RATE: Final = 0.3
JUMP_SIZE: Final = 20.0
"""Standard deviations of a drift of fixes (m/s) and of a jump (m): reflections at buildings."""

FAULTS: Final[dict[Fault, tuple[float, tuple[tuple[int, float], ...]]]] = {
    Fault.DRIFT: (0.5, ((DRIFT, DRIFT_RATE), (DRIFT + 1, DRIFT_RATE))),
    Fault.SPOOFING: (0.1, ((DRIFT, DRIFT_RATE), (DRIFT + 1, DRIFT_RATE))),
    Fault.GYRO: (0.1, ()),
    Fault.WHEELS: (0.1, ((WHEEL_SCALE, 0.05),)),
    Fault.LATENCY: (0.01, ((DELAY, 0.3),)),
}
"""How often an hour each begins, and the standard deviations that it opens; the gyro's is half of `gyro_bias_step`."""

JUMPS_PER_HOUR: Final = 1.0
JUMP_ENDS_PER_HOUR: Final = 60.0
DRIFT_ENDS_PER_HOUR: Final = 6.0
"""Jumps last a minute, drifts ten."""

DRIFT_TIME, DRIFT_OFFSET_TIME, SPOOFING_TIME = 30.0, 100.0, 1e4
"""Seconds in which the rate and the offset of a drift decay, and the rate of spoofed fixes."""

OUTLIER_SHARE, OUTLIER_SIGMA = 0.01, 10.0
"""Share of fixes that are off by meters for themselves, and their standard deviation, m."""

VOID_SHARE: Final = 0.02
"""Share of fixes, and of mean rates at rest, that show nothing: by so much one of them may lower a weight."""

OUTLIER_NIS: Final = 13.8
"""NIS of two numbers beyond which the gain is reduced: 0.1 % of a normal error."""

ARM_SIGMA_LEAST: Final = 0.3
"""Least standard deviation of the antenna's place here, m: a wrong one has been entered, or another antenna mounted."""

RATE_FLOOR: Final = 3e-4
"""Sigma of a mean rate at rest beside its noise, rad/s: an idling engine, and what a vehicle sways."""

START_BIAS: Final = 0.003
"""Standard deviation of the bias of a gyro beside what alignment has shown, rad/s: what it changes by while warming up.
"""

REST_TURN_TIME: Final = 60.0
"""Seconds in which a turn at rest fades: that of a bias off by RATE_FLOOR stays below 0.02 rad, a fifth of a turn that
shows a carrier."""

TURNING_RATE: Final = 0.03
CONSTANT_RATE: Final = 0.005
"""Rate of a vehicle that begins to turn, rad/s, and by what that of one at rest differs from step to step: the noise of
half a second, three times."""

LATENCY_SIGMA: Final = 0.1
LATENCY_WALK: Final = 0.002
"""Standard deviation of a latency that is not stated, s (Groves 2013, 10.3), and its walk, s per root of a second."""

TURN_NOISE: Final = 0.003
"""Noise of a turn beside the gyro's scale, as a share of it: cross-coupling of axes in hills."""

SLIP_IN_TURN: Final = 0.03
"""Error along the path by a turn, m per rad."""

AGES_US: Final = np.array((2.0, 5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0)) * 1e6
"""Ages up to which hypotheses of one kind are merged."""

MOST_HYPOTHESES: Final = 40
LEAST_WEIGHT: Final = 1e-10
CERTAIN: Final = 0.9
SETTLED: Final = 0.999
"""Weights from which on a hypothesis is published, and is no longer a fault but a corrected state."""

SHARE_OF_LIMIT: Final = 0.2
"""Share of a limit that matters: fixes that are off by less cost less than dead reckoning does."""

PLACE_SIGMA: Final = 0.1
"""Sigma of the place of the rolling frame beside the states, m."""

LOST_SHARE: Final = 0.1
"""Probability that dead reckoning was lost where fixes are off after an outage: gyro and wheels fail at a tenth of the
rate at which fixes jump (`FAULTS`)."""

TURNS: Final = 8
"""Directions in which dead reckoning that was lost may go on: 22.5 degrees either way, equation (3) is a line."""

OWN_WAY, DRIFT_SIGMAS = 20.0, 5.0
"""Meters that a vehicle has driven by itself, four lengths of a car, and standard deviations of a rate at which
fixes go on to drift then (6e-7 by chance), so that it is not transported."""

NEVER: Final = np.iinfo(np.int64).min // 2
GRID: Final = np.linspace(0.0, 1.0, 33)[:, None, None]

LONGEST_STEP: Final = 5.0
"""Seconds of a step in which something may begin, at most."""


class PlanarFix(NamedTuple):
    """A fix east + i north (m) and its sigma; `lever` from the rolling frame to the antenna, forward + i left (m);
    `velocity` of the antenna in the same axes (m/s), `turn_rate` (rad/s).
    """

    position: complex
    sigma: float
    lever: complex
    velocity: complex
    turn_rate: float


class HypothesisBank(NamedTuple):
    """Hypotheses at `utime`; arrays have one entry for each of k.

    Attributes
    ----------
    means (k, 19), covariances (k, 19, 19), weights (k): the estimates and their posterior probabilities.
    faults, jumped, noises, onsets (k): what each assumes, and since when (utime, NEVER).
    published: index of the one that is published.
    inflation: of the white noise of fixes, learned, 1 to 4.
    rest_rate: mean turn rate of the step before, rad/s, of a vehicle at rest; nan: it was not.
    rest_bias, rest_turn: of a vehicle whose wheels are at rest, the gyro's bias when that began, rad/s, and the turn
        of the last minute since, rad; nan: they are not, and the vehicle has `driven` some m since.
    sigma: of the last fix, m.
    settled: the fault that has become certain in the last step: from then on it is a corrected state, and no fault.
    excludes_fixes: whether fixes are not used, since they are off by the published hypothesis.
    may_be_transported: whether that began while the vehicle was at rest: a ferry or a trailer may move it.
    reckoning: dead reckoning at `utime`.
    """

    utime: int
    means: Array
    covariances: Array
    weights: Array
    faults: Labels
    jumped: Labels
    noises: Labels
    onsets: Labels
    published: int = 0
    inflation: float = 1.0
    rest_rate: float = math.nan
    rest_bias: float = math.nan
    rest_turn: float = 0.0
    driven: float = 0.0
    sigma: float = 1.0
    settled: Fault = Fault.NONE
    excludes_fixes: bool = False
    may_be_transported: bool = False
    reckoning: DeadReckoning = DeadReckoning()

    @property
    def pose(self) -> tuple[float, float, float]:
        """East, north (m) and heading (rad) of the published hypothesis."""
        x, y, heading = self.means[self.published, :3].tolist()
        return x, y, heading

    @property
    def fault(self) -> Fault:
        return Fault(int(self.faults[self.published]))

    @property
    def is_suspect(self) -> bool:
        """Whether something seems to be wrong with fixes, gyro or wheels, or may be."""
        n = self.published
        return bool(self.faults[n] or self.jumped[n] or not self.weights[n] > CERTAIN)

    def judge_fixes(self, limit: float, *, least: float = SETTLED) -> HypothesisBank:
        """Return the bank with the decision whether fixes are used; `limit` is that of the position, m.

        They are not once they are certain to be off (with a weight of `least`), by a share of the limit that matters;
        that lasts as long as the published hypothesis has them off.
        """
        off = (self.jumped > 0) | (self.faults == Fault.DRIFT) | (self.faults == Fault.SPOOFING)
        excludes = bool(off[self.published])
        if excludes and not self.excludes_fixes:
            is_far = abs(self.offset) > SHARE_OF_LIMIT * limit
            excludes = is_far and bool(self.weights[off].sum() > least)
        is_at_rest = not math.isnan(self.rest_bias)
        begins_at_rest = not self.excludes_fixes and is_at_rest and not self.jumped[self.published]
        may_be_transported = excludes and (self.may_be_transported or begins_at_rest)
        if self.fault is Fault.SPOOFING and self.driven > OWN_WAY:
            x, P = self.means[self.published], self.covariances[self.published]
            variance = max(P[DRIFT, DRIFT], P[DRIFT + 1, DRIFT + 1])
            may_be_transported &= math.hypot(x[DRIFT], x[DRIFT + 1]) < DRIFT_SIGMAS * math.sqrt(variance)
        return self._replace(excludes_fixes=excludes, may_be_transported=may_be_transported)

    def suspect_path(self, utime: int, fix: PlanarFix, settings: FilterSettings) -> HypothesisBank:
        """Return the bank beside the hypothesis that dead reckoning was lost, and that fixes which are off are right.

        The vehicle is where `fix` is, in one of TURNS directions. It is for the first fixes after an outage: those that
        were dragged away and then stay look like a lost place too.
        """
        means = np.repeat(self.means[self.published][None], TURNS, axis=0)
        means[:, HEADING] += np.arange(TURNS) * math.tau / TURNS
        place = fix.position - np.exp(1j * means[:, HEADING]) * fix.lever
        means[:, EAST], means[:, NORTH], means[:, ERROR:] = place.real, place.imag, 0.0
        variances = np.diagonal(self.covariances[self.published]).copy()
        variances[[EAST, NORTH, ERROR, ERROR + 1]] = self.sigma**2
        variances[HEADING] = (math.pi / TURNS) ** 2
        variances[BIAS] += (0.5 * settings.gyro_bias_step) ** 2
        variances[ERROR_RATE:] = 0.0
        bank = self._replace(weights=self.weights * (1.0 - LOST_SHARE))
        labels, onsets = np.array(((Fault.GYRO, 0, 0),) * TURNS), np.full(TURNS, utime)
        covariances = np.repeat(np.diag(variances)[None], TURNS, axis=0)
        return bank._append(means, covariances, np.full(TURNS, LOST_SHARE / TURNS), labels, onsets)

    @property
    def offset(self) -> complex:
        """How far fixes are off by the published hypothesis, east + i north, m."""
        x = self.means[self.published]
        return complex(x[OFFSET] + x[JUMP], x[OFFSET + 1] + x[JUMP + 1])

    def advance(
        self, utime: int, step: Increment, fix: PlanarFix | None, settings: FilterSettings, slip: float
    ) -> HypothesisBank:
        """Return the bank at a later instant, after dead reckoning and, if there is one, a fix."""
        seconds = step.seconds
        rate = step.turn / seconds
        bias = self.means[self.published, BIAS]
        # it begins to turn before wheels and accelerations show it, and a bias that has changed is constant
        is_constant = abs(rate - self.rest_rate) < CONSTANT_RATE
        rests = step.is_stationary
        is_stationary = rests and (is_constant or abs(rate - bias) < TURNING_RATE)
        step = step._replace(is_stationary=is_stationary)
        bank = self if fix is None else self._replace(sigma=fix.sigma)
        bank = bank._predict(step, settings, slip)
        if is_stationary and not math.isnan(bank.rest_rate):
            # the mean ended a step ago: the vehicle is at rest since
            bank = bank._measure_rest(bank.rest_rate, seconds, settings)
        bank = bank._spawn(utime, min(seconds, LONGEST_STEP), fix, settings)
        if fix is not None:
            bank, nis = bank._fuse(fix, settings)
            if bank.weights[bank.published] > CERTAIN:
                change = min(seconds, 2.0) / 30.0 * (min(0.5 * nis, 9.0) - 1.0)
                bank = bank._replace(inflation=min(max(bank.inflation * (1.0 + change), 1.0), 4.0))
        rest_bias, rest_turn, driven = math.nan, 0.0, self.driven + step.driven
        if step.are_wheels_stationary:
            rest_bias = bias if math.isnan(self.rest_bias) else self.rest_bias
            faded = math.exp(-seconds / REST_TURN_TIME) * self.rest_turn
            rest_turn, driven = faded + step.turn - rest_bias * seconds, 0.0
        rest_rate = rate if rests else math.nan
        bank = bank._reduce(utime)
        return bank._replace(rest_rate=rest_rate, rest_bias=rest_bias, rest_turn=rest_turn, driven=driven)

    def _predict(self, step: Increment, settings: FilterSettings, slip: float) -> HypothesisBank:
        """Return the bank after dead reckoning, equations (1) and (2)."""
        X, T, theta = self.means.copy(), step.seconds, step.turn
        k = len(X)
        F = np.zeros((k, SIZE, SIZE))
        F.reshape(k, -1)[:, :: SIZE + 1] = 1.0
        if not step.is_stationary:
            spin = np.exp(1j * X[:, HEADING])
            u, half = step.path, 0.5j * theta * step.path
            way = spin * ((1.0 - X[:, WHEEL_SCALE]) * u - 1j * X[:, BIAS] * step.moment - X[:, GYRO_SCALE] * half)
            columns = (
                (HEADING, 1j * way),
                (WHEEL_SCALE, -spin * u),
                (BIAS, -1j * spin * step.moment),
                (GYRO_SCALE, -spin * half),
            )
            for at, column in columns:
                F[:, EAST, at], F[:, NORTH, at] = column.real, column.imag
            F[:, HEADING, BIAS], F[:, HEADING, GYRO_SCALE] = -T, -theta
            X[:, EAST] += way.real
            X[:, NORTH] += way.imag
            X[:, HEADING] += theta - X[:, BIAS] * T - X[:, GYRO_SCALE] * theta
        noise = _NOISES[self.noises]
        times = np.where(self.noises == 0, settings.gps_correlation_time, noise[:, 2])
        drifts = self.faults == Fault.DRIFT
        fades = (
            (ERROR, ERROR_RATE, np.exp(-T / times), np.exp(-T / noise[:, 1])),
            (
                OFFSET,
                DRIFT,
                np.where(drifts, math.exp(-T / DRIFT_OFFSET_TIME), 1.0),
                np.where(drifts, math.exp(-T / DRIFT_TIME), math.exp(-T / SPOOFING_TIME)),
            ),
        )
        for at, rate_at, fade, rate_fade in fades:
            for axis in (0, 1):
                F[:, at + axis, at + axis], F[:, rate_at + axis, rate_at + axis] = fade, rate_fade
                F[:, at + axis, rate_at + axis] = T
            X[:, at : at + 2] = fade[:, None] * X[:, at : at + 2] + T * X[:, rate_at : rate_at + 2]
            X[:, rate_at : rate_at + 2] *= rate_fade[:, None]
        P = F @ self.covariances @ F.transpose(0, 2, 1)
        diagonal = P.reshape(k, -1)[:, :: SIZE + 1]
        if not step.is_stationary:
            self._add_path_noise(P, step, settings, slip)
            turned = settings.gyro_noise**2 * T + (TURN_NOISE * theta) ** 2 + step.turn_variance
            diagonal[:, HEADING] += turned
        diagonal[:, BIAS] += settings.gyro_bias_walk**2 * T
        diagonal[:, WHEEL_SCALE] += settings.wheel_scale_walk**2 * T
        diagonal[:, DELAY] += LATENCY_WALK**2 * T
        correlated = (1.0 - settings.gps_white_share**2) * self.sigma**2
        steady = correlated * (1.0 - math.exp(-2.0 * T / settings.gps_correlation_time))
        rates = (self.sigma * noise[:, 0]) ** 2 * (1.0 - fades[0][3] ** 2)
        drifting = DRIFT_RATE**2 * (1.0 - fades[1][3] ** 2) * (drifts | (self.faults == Fault.SPOOFING))
        for axis in (0, 1):
            diagonal[:, ERROR + axis] += steady
            diagonal[:, ERROR_RATE + axis] += rates
            diagonal[:, DRIFT + axis] += drifting
        return self._replace(means=X, covariances=P)

    def _add_path_noise(self, P: Array, step: Increment, settings: FilterSettings, slip: float) -> None:
        """Add the variance of the path along and across the heading: slip of wheels, sideways slip, roll point."""
        T, theta = step.seconds, step.turn
        lateral = abs(theta / T) * step.driven / T
        along = settings.slip_time * (slip * step.driven) ** 2 / T + (SLIP_IN_TURN * theta) ** 2
        across = (
            settings.slip_time * settings.side_sigma**2 * T
            + (settings.roll_point_sigma * theta) ** 2
            + (settings.side_slip * lateral * step.driven) ** 2 * max(settings.slip_time / T, 1.0)
        )
        along, across = along + step.path_variance, across + step.path_variance
        middle = self.means[:, HEADING] + 0.5 * theta
        c, s = np.cos(middle), np.sin(middle)
        P[:, EAST, EAST] += along * c * c + across * s * s
        P[:, NORTH, NORTH] += along * s * s + across * c * c
        cross = (along - across) * c * s
        P[:, EAST, NORTH] += cross
        P[:, NORTH, EAST] += cross

    def _measure_rest(self, mean: float, seconds: float, settings: FilterSettings) -> HypothesisBank:
        """Return the bank after the mean turn rate of a vehicle at rest, which is the bias."""
        X, P = self.means, self.covariances
        residual = mean - X[:, BIAS]
        S = P[:, BIAS, BIAS] + settings.gyro_noise**2 / seconds + RATE_FLOOR**2
        gain = P[:, :, BIAS] / S[:, None]
        weights = self._weigh(-0.5 * (residual**2 / S + np.log(S)))
        covariances = P - gain[:, :, None] * P[:, None, BIAS, :]
        return self._replace(means=X + gain * residual[:, None], covariances=covariances, weights=weights)

    def _fuse(self, fix: PlanarFix, settings: FilterSettings) -> tuple[HypothesisBank, float]:
        """Return the bank after a fix, equation (3), and the NIS of the published hypothesis."""
        X, P = self.means, self.covariances
        k = len(X)
        spin = np.exp(1j * X[:, HEADING])
        arm, velocity = spin * (fix.lever + X[:, ARM] + 1j * X[:, ARM + 1]), spin * fix.velocity
        acceleration, latency = 1j * fix.turn_rate * velocity, X[:, DELAY]
        antenna = X[:, EAST] + 1j * X[:, NORTH] + arm + (0.5 * latency * acceleration - velocity) * latency
        errors = X[:, ERROR] + X[:, OFFSET] + X[:, JUMP] + 1j * (X[:, ERROR + 1] + X[:, OFFSET + 1] + X[:, JUMP + 1])
        residual = fix.position - antenna - errors
        y = np.stack((residual.real, residual.imag), axis=1)
        H = np.zeros((k, 2, len(_FIX_STATES)))
        H[:, 0, 0] = H[:, 1, 1] = 1.0
        H[:, (0, 0, 0), (6, 8, 10)] = H[:, (1, 1, 1), (7, 9, 11)] = 1.0
        turned, later = 1j * (arm - latency * velocity), latency * acceleration - velocity
        for at, column in ((2, turned), (3, later), (4, spin), (5, 1j * spin)):
            H[:, 0, at], H[:, 1, at] = column.real, column.imag
        PH = P[:, :, _FIX_STATES] @ H.transpose(0, 2, 1)
        S = H @ PH[:, _FIX_STATES, :]
        white = (settings.gps_white_share * fix.sigma) ** 2 * self.inflation
        a, b, c = S[:, 0, 0] + white, S[:, 0, 1], S[:, 1, 1] + white
        det = a * c - b * b
        inverse = np.stack((c, -b, -b, a), axis=1).reshape(k, 2, 2) / det[:, None, None]
        scaled = (inverse @ y[:, :, None])[:, :, 0]
        nis = (y * scaled).sum(axis=1)
        likely = -0.5 * (nis + np.log(det)) + math.log1p(-OUTLIER_SHARE)
        outlier = math.log(OUTLIER_SHARE) - 0.5 * (y * y).sum(axis=1) / OUTLIER_SIGMA**2 - 2.0 * math.log(OUTLIER_SIGMA)
        weights = self._weigh(np.logaddexp(likely, outlier))
        gain = PH @ (inverse / np.maximum(nis / OUTLIER_NIS, 1.0)[:, None, None])
        covariances = P - gain @ PH.transpose(0, 2, 1)
        means = X + (gain @ y[:, :, None])[:, :, 0]
        return self._replace(means=means, covariances=covariances, weights=weights), float(nis[self.published])

    def _weigh(self, log_likelihood: Array) -> Array:
        """Return the weights after a measurement that shows nothing with a probability of VOID_SHARE."""
        likelihood = np.exp(log_likelihood - log_likelihood.max())
        weights: Array = self.weights * ((1.0 - VOID_SHARE) * likelihood + VOID_SHARE)
        weights /= weights.sum()
        return weights

    def _spawn(self, utime: int, seconds: float, fix: PlanarFix | None, settings: FilterSettings) -> HypothesisBank:
        """Return the bank with the children of the likeliest hypotheses, in which something begins or ends.

        A jump that begins may be as large as the fix shows.
        """
        jump = JUMP_SIZE
        if fix is not None:
            x, y, heading = self.pose
            jump = max(jump, abs(fix.position - complex(x, y) - cmath.rect(1.0, heading) * fix.lever))
            jump = min(jump, LARGEST_JUMP)
        order = np.argsort(-self.weights, kind="stable")[:8].tolist()
        children: list[tuple[int, float, int, int, int, int]] = []
        opened: list[Sequence[tuple[int, float]]] = []
        closed: list[slice | None] = []

        def add(
            parent: int,
            per_hour: float,
            kind: tuple[int, int, int],
            opens: Sequence[tuple[int, float]] = (),
            closes: slice | None = None,
            onset: int | None = None,
        ) -> None:
            since = int(self.onsets[parent]) if onset is None else onset
            children.append((parent, per_hour, *kind, since))
            opened.append(opens)
            closed.append(closes)

        seen: set[tuple[int, int]] = set()
        for parent in order:
            fault, jumped, noise = int(self.faults[parent]), int(self.jumped[parent]), int(self.noises[parent])
            if (fault, jumped) in seen or len(seen) >= 3:
                continue
            seen.add((fault, jumped))
            if jumped:
                add(parent, JUMP_ENDS_PER_HOUR, (fault, 0, noise), closes=slice(JUMP, SIZE))
            else:
                add(parent, JUMPS_PER_HOUR, (fault, 1, noise), ((JUMP, jump), (JUMP + 1, jump)))
            if fault in (Fault.DRIFT, Fault.SPOOFING):
                add(parent, DRIFT_ENDS_PER_HOUR, (0, jumped, noise), closes=slice(OFFSET, JUMP), onset=NEVER)
            if noise:
                add(parent, NOISE_CLASSES[0].per_hour, (fault, jumped, 0), closes=slice(ERROR_RATE, OFFSET))
                continue
            for number, each in enumerate(NOISE_CLASSES[1:], start=1):
                rate = self.sigma * each.rate
                add(parent, each.per_hour, (fault, jumped, number), ((ERROR_RATE, rate), (ERROR_RATE + 1, rate)))
        best = order[0]
        if self.faults[best] not in (Fault.DRIFT, Fault.SPOOFING):
            for new, (per_hour, opened_by) in FAULTS.items():
                if new is Fault.GYRO:
                    opened_by = ((BIAS, 0.5 * settings.gyro_bias_step),)
                add(best, per_hour, (new, int(self.jumped[best]), int(self.noises[best])), opened_by, onset=utime)
        parents = np.array([each[0] for each in children])
        means, covariances = self.means[parents], self.covariances[parents]
        for n, (opens, closes) in enumerate(zip(opened, closed, strict=True)):
            if closes is not None:
                means[n, closes] = 0.0
                covariances[n, closes, :] = 0.0
                covariances[n, :, closes] = 0.0
            for at, sigma in opens:
                covariances[n, at, at] += sigma * sigma
        weights = self.weights[parents] * np.array([each[1] for each in children]) * (seconds / 3600.0)
        labels = np.array([each[2:5] for each in children])
        return self._append(means, covariances, weights, labels, np.array([each[5] for each in children], np.int64))

    def _append(
        self, means: Array, covariances: Array, weights: Array, labels: Labels, onsets: Labels
    ) -> HypothesisBank:
        """Return the bank with m hypotheses more; `labels` (m, 3) are fault, jump and noise class of each."""
        return self._replace(
            means=np.concatenate((self.means, means)),
            covariances=np.concatenate((self.covariances, covariances)),
            weights=np.concatenate((self.weights, weights)),
            faults=np.concatenate((self.faults, labels[:, 0])),
            jumped=np.concatenate((self.jumped, labels[:, 1])),
            noises=np.concatenate((self.noises, labels[:, 2])),
            onsets=np.concatenate((self.onsets, onsets)),
        )

    def _reduce(self, utime: int) -> HypothesisBank:
        """Return the bank with like hypotheses merged, the unlikely ones removed, and the one to publish."""
        weights = self.weights / self.weights.sum()
        bins = np.where(self.onsets == NEVER, -1, np.searchsorted(AGES_US, utime - self.onsets, side="right"))
        turned = self.means[:, HEADING] - self.means[self.published, HEADING]
        octants = np.round(turned * TURNS / math.tau).astype(np.int64) % TURNS
        kinds = ((self.faults * 2 + self.jumped) * len(NOISE_CLASSES) + self.noises) * TURNS + octants
        keys = kinds * (len(AGES_US) + 2) + bins + 1
        stays = weights >= LEAST_WEIGHT
        stays[self.published] = True
        left = np.flatnonzero(stays)
        _, group = np.unique(keys[left], return_inverse=True)
        sums = np.bincount(group, weights[left])
        if len(sums) > MOST_HYPOTHESES:
            ranked = sums.copy()
            ranked[group[np.searchsorted(left, self.published)]] += 1.0
            best = np.argsort(-ranked, kind="stable")[:MOST_HYPOTHESES]
            number = np.full(len(sums), -1)
            number[best] = np.arange(len(best))
            inside = number[group] >= 0
            left, group, sums = left[inside], number[group[inside]], sums[best]
        shares = np.zeros((len(sums), len(left)))
        shares[group, np.arange(len(left))] = weights[left] / np.maximum(sums[group], 1e-300)
        means = shares @ self.means[left]
        apart = self.means[left] - means[group]
        spread = self.covariances[left] + apart[:, :, None] * apart[:, None, :]
        covariances = (shares @ spread.reshape(len(left), -1)).reshape(len(sums), SIZE, SIZE)
        first = left[np.argmax(shares, axis=1)]
        bank = self._replace(
            utime=utime,
            means=means,
            covariances=0.5 * (covariances + covariances.transpose(0, 2, 1)),
            weights=sums / sums.sum(),
            faults=self.faults[first],
            jumped=self.jumped[first],
            noises=self.noises[first],
            onsets=self.onsets[first],
            published=int(group[np.searchsorted(left, self.published)]),
            settled=Fault.NONE,
        )
        return bank._select()

    def _select(self) -> HypothesisBank:
        """Return the bank with the likeliest hypothesis published, if those near it are certain together."""
        weights, published = self.weights, self.published
        best = int(np.argmax(weights))
        if best != published:
            sigma, heading_sigma = self._get_sigmas()
            horizontal, heading = compute_factors(LEVEL_RISK)
            separation, turned = self._separate(self.means[best, :3])
            near = (separation < 0.5 * (horizontal * sigma[best] + 1.0)) & (
                turned < 0.5 * heading * heading_sigma[best]
            )
            if weights[near].sum() > CERTAIN and not (near[published] and weights[best] < 0.5):
                published = best
        faults = self.faults
        fault = Fault(int(faults[published]))
        is_own = fault in (Fault.GYRO, Fault.WHEELS, Fault.LATENCY)
        if is_own and weights[published] > SETTLED and not self.jumped[published]:
            faults, onsets = faults.copy(), self.onsets.copy()
            faults[published], onsets[published] = Fault.NONE, NEVER
            return self._replace(published=published, faults=faults, onsets=onsets, settled=fault)
        return self._replace(published=published)

    def _get_sigmas(self) -> tuple[Array, Array]:
        """Return the standard deviations along the longest axis (k), m, and of the heading (k), rad."""
        P = self.covariances
        a, b, c = P[:, EAST, EAST], P[:, NORTH, NORTH], P[:, EAST, NORTH]
        longest = 0.5 * (a + b) + np.hypot(0.5 * (a - b), c)
        return np.sqrt(longest + PLACE_SIGMA**2), np.sqrt(P[:, HEADING, HEADING] + HEADING_FLOOR**2)

    def _separate(self, pose: Array | tuple[float, float, float]) -> tuple[Array, Array]:
        """Return how far each hypothesis is from a pose: distance (k), m, and angle (k), rad."""
        apart = self.means[:, :3] - np.asarray(pose)
        turned = np.abs(np.remainder(apart[:, 2] + math.pi, math.tau) - math.pi)
        return np.hypot(apart[:, 0], apart[:, 1]), turned

    def compute_bounds(
        self,
        pose: tuple[float, float, float],
        limits: tuple[float, float],
        settings: FilterSettings,
        variances: tuple[float, float] = (0.0, 0.0),
    ) -> Bounds:
        """Return what is known of the error of a pose: east, north (m), heading (rad).

        `limits` are those of the position and the heading, m and rad.
        """
        weights = self.weights
        distances, sigmas = np.array(self._separate(pose)), np.array(self._get_sigmas())
        tail = _compute_tails(np.array(limits)[None, :, None], distances, sigmas) @ weights
        levels = _find_level(weights, distances, sigmas, LEVEL_RISK)
        risk = settings.risk_per_hour * settings.gps_correlation_time / 3600.0
        share = np.minimum(risk / (len(weights) * np.maximum(weights, 1e-30)), 1.0)
        factor = -2.0 * np.log(share)
        # the heading is one number: the tail of a normal distribution is that of a circle by 1 / k at least
        factors = np.sqrt(np.stack((factor, np.maximum(factor - np.log(np.maximum(factor, 1.0)), 0.0))))
        protection = np.where(share < 1.0, distances + factors * sigmas, 0.0).max(axis=1)
        return Bounds(
            float(levels[0]),
            min(float(levels[1]), math.pi),
            float(protection[0]),
            min(float(protection[1]), math.pi),
            float(tail[0, 0]),
            float(tail[0, 1]),
            variances,
        )


_NOISES: Final = np.array([each[:3] for each in NOISE_CLASSES])
_FIX_STATES: Final = np.array(
    (EAST, NORTH, HEADING, DELAY, ARM, ARM + 1, ERROR, ERROR + 1, OFFSET, OFFSET + 1, JUMP, JUMP + 1)
)


def _compute_tails(limits: Array, distances: Array, sigmas: Array) -> Array:
    """Return the probabilities (n, 2, k) that the error of a pose is beyond limits (n, 2, 1), by each hypothesis."""
    tails: Array = np.exp(-0.5 * (np.maximum(limits - distances, 0.0) / sigmas) ** 2)
    return tails


def _find_level(weights: Array, distances: Array, sigmas: Array, risk: float) -> Array:
    """Return the least levels (2) that the error of a pose exceeds with a probability of `risk` at most.

    By two grids, the second within one step of the first: to a thousandth of the largest.
    """
    low, width = np.zeros(2), (distances + 8.0 * sigmas).max(axis=1)
    for _ in range(2):
        grid = low[None, :, None] + width[None, :, None] * GRID
        beyond = _compute_tails(grid, distances, sigmas) @ weights > risk
        steps = beyond.sum(axis=0)
        width = width / (len(GRID) - 1)
        low += np.maximum(steps - 1, 0) * width
    low += width
    return low


SHARED: Final = (EAST, NORTH, HEADING, BIAS, WHEEL_SCALE, DELAY, ERROR, ERROR + 1)
"""States of a hypothesis that the filter has too."""


def start_bank(utime: int, sigma: float, settings: FilterSettings, values: Array, covariance: Array) -> HypothesisBank:
    """Return a bank of one hypothesis, before a vehicle drives.

    `sigma` is that of a fix, m; `values` (8) and `covariance` (8, 8) are those of the states SHARED, beside which gyro,
    latency and lever arm have a variance that no fix has shown yet.
    """
    X, P = np.zeros((1, SIZE)), np.zeros((1, SIZE, SIZE))
    arm = max(settings.lever_arm_sigma, ARM_SIGMA_LEAST)
    sigmas = {BIAS: START_BIAS, DELAY: LATENCY_SIGMA, GYRO_SCALE: settings.gyro_scale_sigma, ARM: arm, ARM + 1: arm}
    for at, each in sigmas.items():
        P[0, at, at] = each**2
    X[0, SHARED] = values
    P[0][np.ix_(SHARED, SHARED)] += covariance
    none = np.zeros(1, np.int64)
    return HypothesisBank(utime, X, P, np.ones(1), none, none, none, np.full(1, NEVER), sigma=sigma)

"""Monitors of fixes: what those so far show of the receiver, of turns, and of errors that no model has.

Receiver monitor: which fields of its fixes a receiver fills, and of which class it is.

A field that a publisher never fills is 0 in a message of lcm-gen, and 0 is also a value. Two such fields matter:

- Velocity. That of a moving antenna is never exactly 0 along all three axes. A receiver that reported no other velocity
  so far measures none: its zeros are not used, and counted while the vehicle moves by the state.
- Fix type. 0 is "no fix". A receiver that stated no other type so far leaves it out: then a fix with a covariance is
  used by that. After the first type the receiver is taken at its word.

The class of a receiver is the best type that CLASS_FIXES of its fixes had in a row. It determines how large the
protection level of a valid pose may be, unless that is configured: a limit that suits centimeters would stop a vehicle
whose receiver has no corrections, and a limit that suits meters is meaningless to one that has them.

Turn monitor: what fixes turn the heading by beside the gyro, where no wheels measure the path.

Without wheels dead reckoning follows the fixes, so they cannot be judged by it (`hypothesis_bank` does with wheels).
But the heading must turn as the gyro does: from a node k to a fix, with the gyro's turn theta and its bias b,

    turn = psi - psi_k - (theta - theta_k - b_k T),   variance = P_psi + q_psi T + P_b T^2 + q_b T^3 / 3 + s_c^2     (1)

with the variances of heading and bias at the node and the sigma s_c of the course beside the heading. Beyond THRESHOLD
the vehicle moves beside its own axis: a ferry, a trailer. Its heading is not valid until the course turns as the gyro
does, quicker than a ship (`find_own_course`): then the vehicle drives by itself.

What is unexplained below the threshold widens the protection level of the heading (`allowance`).

GNSS monitor: errors of fixes that the Gauss-Markov model does not have.

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

import cmath
import math
from typing import Final, NamedTuple

import numpy as np

from modelserver.estimation.filter import heading_alignment
from modelserver.estimation.filter.eskf import ZERO, ErrorLayout, Innovation, NavState
from modelserver.estimation.filter.heading_alignment import PathFit, PathFix
from modelserver.estimation.filter.measurements.gnss import CORRELATED_ERROR
from modelserver.estimation.filter.measurements.measurement import wrap_angle
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.messages import Decision, FixType, GpsSample
from modelserver.transforms.so3 import Vector3

CLASS_FIXES: Final = 100
"""Fixes in a row of a type that make the receiver one of its class: 10 s at 10 Hz, 100 s at 1 Hz."""

PLAIN_LIMIT: Final = 36.0
"""Horizontal protection level, m, of the least valid pose with a receiver without corrections: twice that of one of its
fixes at the default range error, HDOP 1.5 and the default risk."""

CORRECTED_LIMIT: Final = 20.0
"""The same with code corrections: their fixes are better, but how far dead reckoning leads without them is not."""

CARRIER_LIMIT: Final = 10.0
"""The same with carrier corrections (RTK), floating or fixed."""

MIN_UNFILLED: Final = 5
"""Velocities of 0 while the vehicle moves before that is reported: a second of a receiver at 5 Hz."""


class ReceiverMonitor(NamedTuple):
    """What the fixes so far have stated.

    Attributes
    ----------
    states_type: whether one stated a fix type.
    states_velocity: whether one stated a velocity other than 0.
    num_unfilled: velocities of 0 while the vehicle moved, before that; at most MIN_UNFILLED.
    num_corrected, num_carrier: fixes in a row with code corrections or better, and with carrier corrections;
        CLASS_FIXES, once there were as many.
    """

    states_type: bool = False
    states_velocity: bool = False
    num_unfilled: int = 0
    num_corrected: int = 0
    num_carrier: int = 0

    def update(self, sample: GpsSample) -> ReceiverMonitor:
        """Return the monitor after a fix: itself, if the fix states nothing new."""
        states_type = self.states_type or sample.fix_type is not FixType.NONE
        states_velocity = self.states_velocity or (sample.velocity is not None and any(sample.velocity))
        corrected = _count(self.num_corrected, FixType.DIFFERENTIAL <= sample.fix_type <= FixType.RTK_FIXED)
        carrier = _count(self.num_carrier, FixType.RTK_FLOAT <= sample.fix_type <= FixType.RTK_FIXED)
        updated = ReceiverMonitor(
            states_type, states_velocity, 0 if states_velocity else self.num_unfilled, corrected, carrier
        )
        return self if updated == self else updated

    def may_use(self, sample: GpsSample) -> bool:
        """Return whether the type of a fix permits its use: one without a type only while none was stated."""
        return sample.fix_type is not FixType.NONE or not self.states_type

    def is_unfilled(self, sample: GpsSample) -> bool:
        """Return whether the velocity of a fix is one that nobody filled."""
        return sample.velocity is not None and not any(sample.velocity) and not self.states_velocity

    def count_unfilled(self) -> ReceiverMonitor:
        """Return the monitor after an unfilled velocity of a moving vehicle."""
        return self._replace(num_unfilled=min(self.num_unfilled + 1, MIN_UNFILLED))

    @property
    def horizontal_limit(self) -> float:
        """The horizontal protection level of the least valid pose with a receiver of this class, m."""
        if self.num_carrier == CLASS_FIXES:
            return CARRIER_LIMIT
        return CORRECTED_LIMIT if self.num_corrected == CLASS_FIXES else PLAIN_LIMIT

    @property
    def lacks_velocity(self) -> bool:
        """Whether the velocity is unfilled beyond chance."""
        return self.num_unfilled >= MIN_UNFILLED


def _count(number: int, is_one: bool) -> int:
    """Return the number of fixes in a row after the next, which is one or is not."""
    if number == CLASS_FIXES:
        return number
    return number + 1 if is_one else 0


# --- turns without wheels -----------------------------------------------------------------------------------

COURSE_FLOOR: Final = 0.03
"""Standard deviation of the course beside the heading, rad, where only fixes show how the vehicle moves: it slips
sideways in turns and crabs in wind and on slopes."""

SPACING_US: Final = 900_000
NEWEST_US: Final = 20_000_000
OLDER_SPACING_US: Final = 4_500_000
LONGEST_US: Final = 180_000_000
"""Microseconds between two nodes of the newest part, that part, between two of the older part, and all."""

MAX_GAP_US: Final = 5_000_000
"""Microseconds between two fixes beyond which the nodes begin again."""

THRESHOLD: Final = 4.5
"""Standard deviations of (1) of a vehicle that is transported: 7e-6 of a normal error."""

CONFIRMATIONS: Final = 3
"""Fixes in a row beyond it."""

AGREEMENT_US: Final = 20_000_000
"""Microseconds for which the heading must have been that of the gyro again for the vehicle to drive by itself."""

ALLOWED: Final = 1.5
"""Standard deviations that are taken for the error that is modeled: what is beyond widens the level."""

ALLOWANCE_TIME: Final = 10.0
ALLOWANCE_PATH: Final = 10.0
"""Seconds in which, and meters along which an allowance decays: about a turn, or as many fixes as show a heading."""

START_ERROR: Final = 3.0
UNMEASURED_START_ERROR: Final = 6.0
"""Standard deviations by which multipath may displace one end of the first path beside the other: with a measured
speed, whose length they agree with, and without."""

OWN_TURN: Final = 1.5
SLOWEST_TURN: Final = 0.06
"""Radians that a vehicle turns by, while its course follows the gyro, that drives by itself; and the turn rate, rad/s,
at least, of turns that count: twice that of a ship."""

OWN_TURN_US: Final = 45_000_000
LARGEST_SLIP: Final = 0.15
FEWEST_COURSES: Final = 6
"""Microseconds within which it does, standard deviation of the course beside the gyro, rad, at most, and how many
courses show it, at least."""

MIN_WAY: Final = 3.0
COURSE_SIGMAS: Final = 5.0
LONGEST_WAY_US: Final = 6_000_000
"""Length of a way between two fixes that shows a course: m, and beside their white errors; and its longest time."""


class TurnNode(NamedTuple):
    """A fix beside heading and gyro.

    `fix` (east + i north, m) and its `white` error (m); `heading`, `turn` of the gyro with its bias (rad), `bias`
    (rad/s); `heading_variance`, `bias_variance`, and `lost`, the variance of the turn that the gyro has missed (rad2).
    """

    utime: int
    fix: complex
    white: float
    heading: float
    turn: float
    bias: float
    heading_variance: float
    bias_variance: float
    lost: float


class TurnMonitor(NamedTuple):
    """Headings and turns at fixes.

    Attributes
    ----------
    older, newest: nodes, the oldest first.
    num_exceeded: fixes in a row beyond the threshold.
    suspect: the last node before the vehicle was transported; None: it is not.
    agreed_utime: since when the heading has been that of the gyro from there again; 0: it is not.
    allowance: what is unexplained of the heading, rad, as of `compared_utime`.
    """

    older: tuple[TurnNode, ...] = ()
    newest: tuple[TurnNode, ...] = ()
    num_exceeded: int = 0
    suspect: TurnNode | None = None
    agreed_utime: int = 0
    allowance: float = 0.0
    compared_utime: int = 0

    @property
    def is_transported(self) -> bool:
        """Whether the vehicle moves beside its own axis, so that fixes do not show its heading."""
        return self.suspect is not None

    def start_heading(self, fix_sigma: float, distance: float, *, is_measured: bool) -> TurnMonitor:
        """Return the monitor after fixes along a first path of some `distance`, m, have shown the heading.

        `fix_sigma`: standard deviation of such a fix, m; `is_measured`: whether wheels measured the path's length.
        Further fixes confirm it, and the allowance decays.
        """
        error = START_ERROR if is_measured else UNMEASURED_START_ERROR
        return self._replace(allowance=max(self.allowance, math.atan2(error * fix_sigma, distance)))

    def compare(
        self, node: TurnNode, heading_noise: float, bias_noise: float, speed: float, *, is_at_rest: bool = False
    ) -> TurnMonitor:
        """Return the monitor after a fix.

        The densities of the random walks are those of the heading, rad2/s, and of the yaw gyro's bias, rad2/s3; `speed`
        is the vehicle's, m/s. `is_at_rest`: its wheels are, so what transports it has not ended.
        """
        last = self.newest[-1] if self.newest else None
        if last is not None and node.utime - last.utime > MAX_GAP_US and self.suspect is None:
            self = self._replace(older=(), newest=(), num_exceeded=0)
        largest = unexplained = 0.0
        worst = None
        for each in _select_windows((*self.older, *self.newest), node):
            turned = abs(find_turn(each, node))
            sigma = _get_turn_sigma(each, node, heading_noise, bias_noise)
            unexplained = max(unexplained, turned - ALLOWED * sigma)
            if turned > largest * sigma:
                largest, worst = turned / sigma, each
        num_exceeded = self.num_exceeded + 1 if largest > THRESHOLD else 0
        agreed_utime = 0
        if self.suspect is not None:
            unexplained = abs(find_turn(self.suspect, node))
            if unexplained < ALLOWED * _get_turn_sigma(self.suspect, node, heading_noise, bias_noise):
                agreed_utime = self.agreed_utime or node.utime
            if agreed_utime and node.utime - agreed_utime > AGREEMENT_US and not is_at_rest:
                return TurnMonitor(newest=(node,), allowance=unexplained, compared_utime=node.utime)
        elif 0 < num_exceeded < CONFIRMATIONS:
            return self._replace(num_exceeded=num_exceeded)  # outliers do not widen the level
        suspect = worst if self.suspect is None and num_exceeded >= CONFIRMATIONS else self.suspect
        seconds = (node.utime - self.compared_utime) * 1e-6
        fade = math.exp(-min(seconds / ALLOWANCE_TIME, speed * seconds / ALLOWANCE_PATH))
        return self._replace(
            num_exceeded=num_exceeded,
            suspect=suspect,
            agreed_utime=agreed_utime,
            allowance=max(min(unexplained, math.pi), fade * self.allowance),
            compared_utime=node.utime,
        ).append(node)

    def append(self, node: TurnNode) -> TurnMonitor:
        """Return the monitor with a node more, if the last one is old enough."""
        newest, older = self.newest, self.older
        if newest and node.utime - newest[-1].utime < SPACING_US:
            return self
        while newest and node.utime - newest[0].utime > NEWEST_US:
            if not older or newest[0].utime - older[-1].utime >= OLDER_SPACING_US:
                older = (*older, newest[0])
            newest = newest[1:]
        while older and node.utime - older[0].utime > LONGEST_US:
            older = older[1:]
        return self._replace(older=older, newest=(*newest, node))

    def transport(self) -> TurnMonitor:
        """Return the monitor of a vehicle that is transported, as rejected fixes show."""
        if self.suspect is not None or not self.newest:
            return self
        return self._replace(suspect=self.newest[-1], num_exceeded=0)

    def find_own_course(self) -> tuple[float, float] | None:
        """Return the heading of a vehicle that drives by itself, by its courses, and its sigma, rad.

        None: the courses do not turn as the gyro does, or it has not turned enough.
        """
        if not self.newest:
            return None
        last = self.newest[-1]
        nodes = [each for each in (*self.older, *self.newest) if last.utime - each.utime <= OWN_TURN_US]
        own = [each.turn - last.turn + last.bias * (last.utime - each.utime) * 1e-6 for each in nodes]
        turned, beside, begin = 0.0, [], 0
        for n in range(1, len(nodes)):
            a, b, start = nodes[n - 1], nodes[n], nodes[begin]
            turn = abs(own[n] - own[n - 1])
            turned += turn if turn > SLOWEST_TURN * (b.utime - a.utime) * 1e-6 else 0.0
            way = b.fix - start.fix
            if abs(way) > COURSE_SIGMAS * math.hypot(start.white, b.white) + MIN_WAY:
                ahead = sum(cmath.rect(1.0, each) for each in own[begin : n + 1])
                beside.append(cmath.rect(1.0, cmath.phase(way / ahead)))
                begin = n
            elif b.utime - start.utime > LONGEST_WAY_US:
                begin = n
        if turned < OWN_TURN or len(beside) < FEWEST_COURSES:
            return None
        mean = sum(beside)
        slip = math.sqrt(sum(cmath.phase(each / mean) ** 2 for each in beside) / len(beside))
        return None if slip > LARGEST_SLIP else (cmath.phase(mean), math.hypot(slip, COURSE_FLOOR))


def find_turn(start: TurnNode, end: TurnNode) -> float:
    """Return by which fixes have turned the heading between two nodes, equation (1), rad."""
    seconds = (end.utime - start.utime) * 1e-6
    return wrap_angle(end.heading - start.heading - (end.turn - start.turn - start.bias * seconds))


def _get_turn_sigma(start: TurnNode, end: TurnNode, heading_noise: float, bias_noise: float) -> float:
    seconds = (end.utime - start.utime) * 1e-6
    variance = start.heading_variance + heading_noise * seconds
    variance += start.bias_variance * seconds**2 + bias_noise * seconds**3 / 3.0
    return math.sqrt(variance + end.lost - start.lost + COURSE_FLOOR**2)


def _select_windows(nodes: tuple[TurnNode, ...], node: TurnNode) -> list[TurnNode]:
    """Return the starts of windows of about 1, 2, 4, 8 ... seconds: each is half of the next."""
    found, seconds = [], 1.0
    for each in reversed(nodes):
        age = (node.utime - each.utime) * 1e-6
        if age >= seconds or each is nodes[0]:
            found.append(each)
            seconds = 1.41 * age
    return found


# --- fixes --------------------------------------------------------------------------------------------------

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

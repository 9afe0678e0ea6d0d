"""Consistency monitor: fixes against the path of dead reckoning, over windows from seconds to minutes.

The gate compares one fix with the state, which has followed the fixes before it. An error that grows slowly passes it:
the state follows. So fixes are compared with what did not follow, the path of dead reckoning (solution separation, as
in ARAIM: J. Blanch et al., "Baseline advanced RAIM user algorithm", IEEE Trans. AES, 2015). With z_k the fix at the
start of a window, o the path in its own axes, which no fix corrects, and R_k its rotation to N at that time,

    e = (z - z_k) - R_k (o - o_k),      cov(e) = 2 s_c^2 (1 - exp(-T / tau)) I + white noise + sum u u'              (1)

over a window of T seconds. The vectors u are what one standard deviation of each parameter of dead reckoning at the
start of the window adds: with d = R_k (o - o_k) as a complex number, i d s_heading, d s_scale, i m s_rate with the
moment m = integral of (t - t_k) dd, and the noise of slip and of the gyros.

Below the threshold, what is unexplained widens the protection levels: the position may have followed e, and the
heading turned to explain it (`horizontal_allowance`, `heading_allowance`). Above it, one of the two is wrong, and the
fits over all windows show which (`Cause`). A gyro whose bias has changed bends the path, e_j = i b m_j; wheels that
slip scale it, e_j = s d_j; a latency that has changed displaces it, e_j = -l (v_j - v_k); an antenna that is elsewhere
turns with the vehicle, e_j = (exp(i psi_j) - exp(i psi_k)) a. None explains fixes that drift, e_j = v (t_j - t_k), in
turns and changes of speed, or that jump. Each fit has the covariance of (1) over the window and the errors u of the
state as parameters with their sigmas; what it explains is its evidence, so a cause with more parameters does not win by
that. The path is replayed with bias and scale as they were (`replay_path`), since a state that follows the fixes hides
what has changed.

What is corrected leaves an allowance that decays. Fixes that jump are not used, and dead reckoning is right for a
while. Fixes that drift are used on, since the fault may be that of the heading: the allowances are then all of e and of
the turn since the window's start, and the pose is invalid only where they are too large. Fixes are trusted again when
they agree with the path from there, or when they have moved as the path for two minutes: a fit of a drift beside an
offset, a rotation, a scale and a turn rate shows it to be small, which takes turns, and leaves no more than the noise
of fixes (`fit_drift`).

A gyro whose bias has changed turns the heading before fixes show it, most at a walk: by b T while b |m| is within their
noise, over the longest such window. The bound of the heading is never below that angle for b = `gyro_bias_step`
(`hidden`); where wheels stop measuring the path it decays.

Without a measured speed the path follows the fixes. Then only the heading is compared: what fixes turn it by beside the
gyro, as on a ferry (`Cause.HEADING`). It is trusted again when it agrees with the gyro of before (`find_turn`), while
that is known well enough to contradict it.

Limits: a drift slower than the path is known (2 % of the speed with wheels, for minutes) is found in turns only.
"""

from __future__ import annotations

import cmath
import itertools
import math
from collections.abc import Sequence
from enum import Enum
from types import MappingProxyType
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from modelserver.estimation.filter.measurements.measurement import wrap_angle
from modelserver.estimation.filter.protection_levels import compute_longest_axis
from modelserver.estimation.filter.settings import FilterSettings

Vector: TypeAlias = npt.NDArray[Any]

SPACING_US: Final = 900_000
"""Microseconds between two nodes of the newest part of the path."""

NEWEST_US: Final = 20_000_000
"""Microseconds of that part."""

OLDER_SPACING_US: Final = 4_500_000
"""Microseconds between two nodes of the older part."""

LONGEST_US: Final = 180_000_000
"""Microseconds of the longest window."""

MAX_GAP: Final = 5.0
"""Seconds between two fixes beyond which the path starts again: its shape in between is not stored."""

THRESHOLD: Final = 4.5
"""Standard deviations of (1) beyond which path and fixes are inconsistent: 4e-5 of a normal error in the plane."""

ALLOWED: Final = 1.25
ALLOWED_TURN: Final = 1.5
"""Standard deviations of (1), and of the turn that would explain it, that are taken for the error that is modeled: what
is beyond widens the bounds."""

ALLOWANCE_TIME: Final = 10.0
ALLOWANCE_PATH: Final = 10.0
"""Seconds in which, and meters along which an allowance decays: about a turn, or as many fixes as show a heading."""

SHRINK_TIME: Final = 5.0
SHRINK_PATH: Final = 5.0
"""Seconds in which, and meters along which the bound of the heading shrinks, at least: a single fix after an outage may
err otherwise than modeled, and at rest fixes show no heading."""

SUSPICION_TIME: Final = 60.0
"""Seconds in which the suspicion decays about an error of gyro or wheels, which may have been one of the fixes, or that
wheels no longer show."""

STRAIGHT: Final = 0.9
"""Length of a path between its ends, relative to that along it, which shows a course."""

START_ERROR: Final = 3.0
UNMEASURED_START_ERROR: Final = 6.0
"""Standard deviations by which multipath may displace one end of the first path beside the other: with a measured
speed, whose length they agree with, and without."""

FEWEST_NODES: Final = 2
"""Nodes that show the cause; until then the gate is enough."""

PATH_SIGMAS: Final = 2.0
"""Standard deviations of dead reckoning that the bound has beside the distance of suspect fixes from it."""

JUMP_SIGMAS: Final = 9.0
"""Standard deviations of (1) from one fix to the next that are a jump: a drift is slower."""

LEAST_JUMP: Final = 6.0
"""Standard deviations of a fix that a jump has, at least, for which fixes are not used: a bound covers less."""

CONFIRMATIONS: Final = 3
"""Fixes in a row beyond the threshold that are no outliers."""

HEADING_FLOOR: Final = 0.01
"""Standard deviation of the course, rad, beside the heading: no vehicle drives straighter."""

COURSE_FLOOR: Final = 0.03
"""The same where only fixes show how the vehicle moves: it slips sideways in turns and crabs in wind and on slopes."""

MIN_TURN_PATH: Final = 3.0
"""Meters of a path, at least, that fixes show a heading along."""

LEAST_MOVED: Final = 0.5
"""Way of the fixes relative to that of the path, at least, whose direction shows the heading."""

AGREEMENT: Final = 2.45
"""Standard deviations of (1) within which a fix agrees: 95 % of good ones."""

AGREEMENT_TIME: Final = 10.0
JUMP_AGREEMENT_TIME: Final = 3.0
"""Seconds for which fixes that drifted, or jumped, must agree with dead reckoning to be trusted again."""

KNOWN_AGAIN: Final = 2.0
"""Standard deviation of dead reckoning, relative to that of a fix, up to which fixes continue to agree; it is less than
1 when they begin to."""

KNOWN_HEADING: Final = 0.1
"""Standard deviation of the gyro's heading, rad, with which a heading must agree to be trusted again, at most."""

NEW_TRUST_TIME: Final = 120.0
NEW_TRUST_DISTANCE: Final = 20.0
"""Seconds, and meters, for which fixes must move as dead reckoning does to be trusted again wherever they are."""

LARGEST_UNMEASURED: Final = 1.0
"""Meters of that distance that wheels need not have measured."""

LARGEST_LOST: Final = 0.05
"""Standard deviation of the heading, rad, that gaps of the IMU may have cost in that time, and one of them in any
window: the path turns there, and what it misses then is not an error of the fixes."""

OWN_TURNS: Final = 3.0
"""Radians that a vehicle turns by, while its heading follows the gyro, that drives by itself again."""

STEADY_SIGMA: Final = 0.03
"""Largest standard deviation of the drift of fixes, m/s, that are trusted again wherever they are."""

EXCLUDING_SIGMAS: Final = 3.0
"""Standard deviations by which the drift of fixes that are trusted again is less than the one that was found."""

LARGEST_REST: Final = 2.0
"""Mean square, over each axis, that a cause may leave unexplained, relative to the variance of the fixes, and so may a
drift, of those that are trusted again."""

MODEL_ERROR: Final = 0.05
"""Meters that no cause explains, as slip that comes and goes: with fixes of centimeters."""

LARGEST_TURN_SIGMA: Final = 0.2
"""Standard deviation of the path's turn since the start of a window, rad, beyond which a fit is no longer linear."""

DECISION_TIME: Final = 90.0
REPEAT: Final = 4
"""Seconds for which the causes are compared again, and fixes from one comparison to the next."""

MAX_INFLATION: Final = 4.0
"""Largest inflation, in variance, of the error of fixes here: a drift must not excuse itself."""


class Cause(Enum):
    """What explains fixes that do not agree with the path."""

    GNSS = "gnss"
    HEADING = "heading"
    GYRO = "gyro"
    WHEELS = "wheels"
    LATENCY = "latency"
    LEVER_ARM = "lever_arm"


MARGIN: Final = MappingProxyType({Cause.GYRO: 8.0, Cause.WHEELS: 8.0, Cause.LATENCY: 5.0, Cause.LEVER_ARM: 5.0})
"""Evidence by which an error must exceed any other cause to be corrected."""

LARGEST_MARGIN: Final = max(MARGIN.values()) + 1e-6
"""The largest of them, and what rounding may change of one."""

TYPICAL_CHANGE: Final = MappingProxyType({Cause.GYRO: 0.01, Cause.WHEELS: 0.1, Cause.LATENCY: 0.4})
"""Sigma of a change of the gyro's bias (rad/s), of the wheels' scale, and of the latency (s), that is a fault."""


HIDDEN_SIGMAS: Final = 3.0
"""Standard deviations of fixes within which they hide a turn by a gyro whose bias has changed."""

HIDDEN_LEVEL: Final = 0.4
"""Share of the covariance's level, beside that turn: about two standard deviations."""

LARGEST_HIDDEN: Final = 0.5
"""Largest bound of the heading by both, rad: within the usual limit of a vehicle with wheels."""

LARGEST_FIX_SIGMA: Final = 0.2
"""Standard deviation of fixes, m, that show an error of the lever arm."""

TYPICAL_DRIFT: Final = 0.3
TYPICAL_JUMP: Final = 10.0
TYPICAL_LEVER_ARM: Final = 0.5
"""Sigma of a drift of fixes, m/s, of a jump, m, and of an error of the lever arm, m, that are a fault."""


class PathNoise(NamedTuple):
    """Noise along the path: density of the heading's random walk, rad2/s, and inflation of the fixes' errors."""

    heading: float
    inflation: float


class PathNode(NamedTuple):
    """Fix, path and state at an instant; vectors of the plane are complex, meters.

    Attributes
    ----------
    fix, antenna: the antenna by the fix at its stamp, and by the state after it, along N.
    velocity, turn_rate: of the antenna along N, m/s, and of the vehicle, rad/s.
    path: the antenna by dead reckoning, along the path's own axes.
    moment: integral of time along the path, m s, and `seconds` the time, both since the start of the path.
    rotation: yaw from the path's axes to N, rad.
    distance: travelled, m.
    rate_bias, scale: of the yaw gyro, rad/s, and of the wheels, by the state.
    heading_variance, rate_variance, scale_variance: of the heading (rad2), and of those.
    has_gyro, is_measured: whether a gyro measures the turns, and wheels the path too.
    own_heading: by the gyro alone, along the path's axes, rad.
    bias_turn: integral of `rate_bias` since the start of the path, rad.
    latency, latency_variance: of fixes, s and s2; `shows_latency`: whether fixes separate it from the heading.
    lost: variance of the heading that was lost in gaps of the IMU since the start of the path, rad2.
    unmeasured: the part of `distance` whose length nothing measured, m.
    white, correlated: standard deviations of the two errors of the fix, m.
    position_covariance: of the state's position: east, north, cross, m2.
    """

    utime: int
    fix: complex
    antenna: complex
    velocity: complex
    turn_rate: float
    path: complex
    moment: complex
    seconds: float
    rotation: float
    distance: float
    rate_bias: float
    scale: float
    heading_variance: float
    rate_variance: float
    scale_variance: float
    has_gyro: bool
    is_measured: bool
    own_heading: float
    bias_turn: float
    latency: float
    latency_variance: float
    shows_latency: bool
    lost: float
    unmeasured: float
    white: float
    correlated: float
    position_covariance: tuple[float, float, float]


class Discrepancy(NamedTuple):
    """The newest fix against the path since a node.

    Attributes
    ----------
    node: the start of the window.
    error: e of (1) along N, m.
    sigmas: its size in standard deviations.
    sigma: standard deviation of e along its longest axis, m.
    displacement: of the antenna by dead reckoning, along N, m.
    covariance: of dead reckoning alone: east, north, cross, m2.
    turn, turn_sigma: angle from the path to the way of the fixes, which the heading would explain, and its standard
        deviation, rad.
    """

    node: PathNode
    error: complex
    sigmas: float
    sigma: float
    displacement: complex
    covariance: tuple[float, float, float]
    turn: float
    turn_sigma: float


class Inconsistency(NamedTuple):
    """What explains fixes that do not agree with the path, over the window with the largest discrepancy.

    `change` is that of the heading (rad), of the gyro's bias (rad/s), of the wheels' scale, of the latency (s), or the
    drift (m/s); `explained` is twice the logarithm of its evidence beside that of no cause. `turned`: by which the
    state has turned beside a gyro of the former bias, rad. `is_jump`: the fixes left the path at once, as no error of
    dead reckoning does. `lever_arm`: the antenna beside its place in the geometry, forward + i left, m.
    """

    cause: Cause
    discrepancy: Discrepancy
    change: float = 0.0
    explained: float = 0.0
    turned: float = 0.0
    lever_arm: complex = 0j
    is_jump: bool = False


class ConsistencyMonitor(NamedTuple):
    """The path of dead reckoning with its fixes.

    Attributes
    ----------
    utime: of the anchor; 0: the path has not begun.
    anchor: the antenna by the state at the last fix and after what corrected it since, along N, m.
    begin: start of the path.
    path, moment, rotation, distance, lost, unmeasured, bias_turn: as in `PathNode`.
    older, newest: the nodes, the oldest first.
    num_exceeded: fixes in a row beyond the threshold.
    compared_utime, compared_distance: of the last fix within it, and `distance` then.
    last: the last fix; `has_jumped`: whether one of those fixes jumped away from the one before.
    moved_since: since when no window has exceeded it.
    cause: of an inconsistency that lasts, since `since`; None: fixes and path agree.
    suspect: the last node before it, while fixes are not trusted; `is_jump`: whether they have jumped then.
    drift_rate: at which they drifted away from the path until then, m/s; 0 for a jump.
    largest: discrepancy of the fixes since then, m.
    agreed_since: since when the fixes have agreed with the path from there again; 0: they do not.
    horizontal_allowance, heading_allowance: what is unexplained, m and rad.
    hidden: angle by which a gyro whose bias has changed may have turned the heading while fixes do not show it, rad.
    held: bound of the heading before the last fix, rad, at `held_utime` and `held_distance`.
    lever_arm: the antenna beside its place in the geometry, as fixes show it, forward + i left, m.
    suspicion: what was taken for an error of gyro or wheels, and may have been one of the fixes, m.
    """

    utime: int = 0
    anchor: complex = 0j
    begin: int = 0
    path: complex = 0j
    moment: complex = 0j
    rotation: float = 0.0
    distance: float = 0.0
    lost: float = 0.0
    unmeasured: float = 0.0
    bias_turn: float = 0.0
    older: tuple[PathNode, ...] = ()
    newest: tuple[PathNode, ...] = ()
    num_exceeded: int = 0
    compared_utime: int = 0
    compared_distance: float = 0.0
    last: PathNode | None = None
    has_jumped: bool = False
    moved_since: int = 0
    cause: Cause | None = None
    since: int = 0
    suspect: PathNode | None = None
    is_jump: bool = False
    drift_rate: float = 0.0
    largest: float = 0.0
    agreed_since: int = 0
    horizontal_allowance: float = 0.0
    heading_allowance: float = 0.0
    hidden: float = 0.0
    held: float = 0.0
    held_utime: int = 0
    held_distance: float = 0.0
    lever_arm: complex = 0j
    suspicion: float = 0.0

    @property
    def excludes_fixes(self) -> bool:
        """Whether fixes are not used: they have jumped away from dead reckoning."""
        return self.suspect is not None and self.is_jump

    @property
    def may_reset(self) -> bool:
        """Whether rejected fixes may show where the vehicle is: they are not suspect themselves."""
        return self.suspect is None or self.cause is Cause.HEADING

    def resolve(self, found: Inconsistency, utime: int) -> ConsistencyMonitor:
        """Return the monitor after an inconsistency was found at `utime`: what is corrected begins again."""
        if found.cause not in (Cause.GNSS, Cause.HEADING):
            # the uncertainty of a latency that was corrected covers what is left
            cause = None if found.cause in (Cause.LATENCY, Cause.LEVER_ARM) else found.cause
            suspicion = max(self.suspicion, abs(found.discrepancy.error))
            path = self._replace(older=(), newest=(), num_exceeded=0, suspect=None)
            if found.cause is Cause.LEVER_ARM:
                path = path._replace(lever_arm=self.lever_arm + found.lever_arm)
            return path._replace(cause=cause, since=utime, suspicion=suspicion, horizontal_allowance=suspicion)
        suspect = found.discrepancy.node
        drifts = found.cause is Cause.GNSS and not found.is_jump
        return self._replace(
            num_exceeded=0,
            cause=found.cause,
            since=utime,
            suspect=suspect,
            is_jump=found.is_jump,
            drift_rate=abs(found.discrepancy.error) / ((utime - suspect.utime) * 1e-6) if drifts else 0.0,
            largest=0.0,
            agreed_since=0,
        )

    def extend(self, utime: int, antenna: complex, rate_bias: float, *, is_measured: bool) -> ConsistencyMonitor:
        """Return the monitor with the path continued to the antenna by the state (along N, m) before a fix.

        `rate_bias`: of the yaw gyro, rad/s; `is_measured`: whether wheels measure the speed.
        """
        gap = (utime - self.utime) * 1e-6
        if not self.utime or (gap > MAX_GAP and self.suspect is None):
            return self.restart()._replace(
                utime=utime,
                anchor=antenna,
                begin=utime,
                cause=self.cause,
                since=self.since,
                compared_utime=utime,
                horizontal_allowance=self.horizontal_allowance,
                heading_allowance=self.heading_allowance,
                suspicion=self.suspicion,
            )
        step = (antenna - self.anchor) * cmath.rect(1.0, -self.rotation)
        seconds = (0.5 * (utime + self.utime) - self.begin) * 1e-6
        return self._replace(
            utime=utime,
            anchor=antenna,
            path=self.path + step,
            moment=self.moment + seconds * step,
            distance=self.distance + abs(step),
            unmeasured=self.unmeasured + (0.0 if is_measured else abs(step)),
            bias_turn=self.bias_turn + rate_bias * gap,
        )

    def restart(self) -> ConsistencyMonitor:
        """Return the monitor before a new path, with what lasts."""
        return ConsistencyMonitor(
            held=self.held,
            held_utime=self.held_utime,
            held_distance=self.held_distance - self.distance,
            lever_arm=self.lever_arm,
        )

    def trust(self) -> ConsistencyMonitor:
        """Return the monitor after fixes have agreed with the path since the suspect node again: it continues."""
        assert self.suspect is not None
        since = self.suspect.utime
        return self._replace(
            older=tuple(each for each in self.older if each.utime <= since),
            newest=tuple(each for each in self.newest if each.utime <= since),
            num_exceeded=0,
            cause=None,
            suspect=None,
            is_jump=False,
            agreed_since=0,
        )

    def start_heading(self, fix_sigma: float, distance: float, *, is_measured: bool) -> ConsistencyMonitor:
        """Return the monitor after fixes along a first path of some `distance`, m, have shown the heading.

        `fix_sigma`: standard deviation of such a fix, m; `is_measured`: whether wheels measured the path's length.
        Further fixes confirm it, and the allowance decays.
        """
        error = START_ERROR if is_measured else UNMEASURED_START_ERROR
        allowance = math.atan2(error * fix_sigma, distance)
        return self._replace(heading_allowance=max(self.heading_allowance, allowance))

    def relearn(self, change: float, utime: int) -> ConsistencyMonitor:
        """Return the monitor after a stationary vehicle has shown that the gyro's bias has changed, rad/s.

        Fixes that did not agree with the path since may have been right.
        """
        if self.suspect is not None and abs(change) < 0.5 * TYPICAL_CHANGE[Cause.GYRO]:
            return self
        path = self._replace(older=(), newest=(), last=None, num_exceeded=0, has_jumped=False)
        return path._replace(cause=Cause.GYRO, since=utime, suspect=None, is_jump=False)

    def correct(self, shift: complex, turn: float) -> ConsistencyMonitor:
        """Return the monitor after a fix moved the state by `shift`, m, and turned it by `turn`, rad: not the path."""
        return self._replace(anchor=self.anchor + shift, rotation=self.rotation + turn)

    def hold_heading(self, level: float, utime: int) -> ConsistencyMonitor:
        """Return the monitor with the bound of the heading before a fix; `level`: the covariance's, rad."""
        return self._replace(held=self.bound_heading(level, utime), held_utime=utime, held_distance=self.distance)

    def bound_heading(self, level: float, utime: int) -> float:
        """Return the bound of the heading, rad, with what is unexplained; `level`: the covariance's."""
        held = self.held * math.exp(
            -min(
                max(utime - self.held_utime, 0) * 1e-6 / SHRINK_TIME, (self.distance - self.held_distance) / SHRINK_PATH
            )
        )
        hidden = min(self.hidden + HIDDEN_LEVEL * level, LARGEST_HIDDEN) if self.hidden else 0.0
        return min(max(level + self.heading_allowance, held, hidden), math.pi)

    def lose(self, heading: float, distance: float) -> ConsistencyMonitor:
        """Return the monitor after a gap of the IMU, with what the path lost: variance, rad2, and distance, m."""
        after = self._replace(lost=self.lost + heading, unmeasured=self.unmeasured + distance)
        if self.suspect is None and (heading > LARGEST_LOST**2 or distance > LARGEST_UNMEASURED):
            return after._replace(older=(), newest=(), last=None, num_exceeded=0)
        return after

    def end_exclusion(self) -> ConsistencyMonitor:
        """Return the monitor after the state was set to fixes that have jumped, and are not trusted."""
        return self._replace(is_jump=False, horizontal_allowance=self.largest, heading_allowance=math.pi)

    def append(self, node: PathNode) -> ConsistencyMonitor:
        """Return the monitor with a node more, if the last one is old enough, and the fix no outlier."""
        newest, older = self.newest, self.older
        if newest and node.utime - newest[-1].utime < SPACING_US:
            return self
        if self.num_exceeded and self.suspect is None:
            return self
        if node.heading_variance > LARGEST_TURN_SIGMA**2:
            return self  # the path has no direction yet
        while newest and node.utime - newest[0].utime > NEWEST_US:
            if not older or newest[0].utime - older[-1].utime >= OLDER_SPACING_US:
                older = (*older, newest[0])
            newest = newest[1:]
        while older and node.utime - older[0].utime > LONGEST_US:
            older = older[1:]
        return self._replace(older=older, newest=(*newest, node))

    def compare(self, node: PathNode, noise: PathNoise, settings: FilterSettings) -> ConsistencyMonitor:
        """Return the monitor after the comparison of a fix with the windows."""
        worst = latest = horizontal = heading = 0.0
        suspect = None if self.is_jump else self.suspect
        if suspect is not None:
            # the state has followed all of it, or the path has gone wrong by it
            if self.cause is Cause.HEADING:
                heading = abs(find_turn(suspect, node))
            else:
                heading = abs(wrap_angle(self.rotation - suspect.rotation))
                found = compare_window(suspect, node, noise, settings)
                # the fixes are as far off as they seem, and as dead reckoning may be
                horizontal = abs(found.error) + PATH_SIGMAS * math.sqrt(compute_longest_axis(*found.covariance))
                heading = max(heading, abs(found.turn))
        windows = self._compare_windows(node, noise, settings)
        for each in windows:
            if not each.node.is_measured:
                # without a measured speed the path follows the fixes, but the heading must not
                sigmas = 0.0
                if each.node.has_gyro and node.has_gyro:
                    turned = abs(wrap_angle(self.rotation - each.node.rotation))
                    sigma = get_turn_sigma(each.node, node, noise)
                    sigmas = turned / sigma
                    heading = max(heading, turned - ALLOWED_TURN * sigma, _compare_course(each, node, noise, settings))
                worst = max(worst, sigmas)
                if each.node.utime >= self.moved_since:
                    latest = max(latest, sigmas)
                continue
            worst = max(worst, each.sigmas)
            if each.node.utime >= self.moved_since:
                latest = max(latest, each.sigmas)
            if each.sigmas > ALLOWED:
                horizontal = max(horizontal, abs(each.error) * (1.0 - ALLOWED / each.sigmas))
            # the heading has changed during the window by twice the mean that the fixes show
            if each.turn_sigma:
                heading = max(heading, 2.0 * (abs(each.turn) - ALLOWED_TURN * each.turn_sigma))
        moved_since = node.utime if latest > THRESHOLD else self.moved_since
        if worst > THRESHOLD and suspect is None and self.num_exceeded < CONFIRMATIONS:
            # outliers do not widen the bounds
            step = 0.0
            if self.last is not None and self.last.is_measured:
                step = compare_window(self.last, node, noise, settings).sigmas
            return self._replace(
                last=node,
                moved_since=moved_since,
                num_exceeded=self.num_exceeded + 1,
                has_jumped=self.has_jumped or step > JUMP_SIGMAS,
            )
        # noise of single fixes comes and goes, what is unexplained does not
        seconds = (node.utime - self.compared_utime) * 1e-6
        driven = node.distance - self.compared_distance
        fade = math.exp(-seconds / ALLOWANCE_TIME)
        heading_fade = math.exp(-min(seconds / ALLOWANCE_TIME, driven / ALLOWANCE_PATH))
        if self.is_jump:
            # what is not used moves nothing, and shows nothing
            horizontal = heading = 0.0
            fade = heading_fade = 1.0
        suspicion_fade = math.exp(-seconds / SUSPICION_TIME)
        suspicion = suspicion_fade * self.suspicion
        return self._replace(
            last=node,
            suspicion=suspicion,
            has_jumped=self.has_jumped and worst > THRESHOLD,
            num_exceeded=self.num_exceeded + 1 if worst > THRESHOLD else 0,
            compared_utime=node.utime,
            compared_distance=node.distance,
            horizontal_allowance=max(horizontal, suspicion, fade * self.horizontal_allowance),
            heading_allowance=max(min(heading, math.pi), heading_fade * self.heading_allowance),
            hidden=max(
                _find_hidden_turn(windows, node, noise, settings),
                0.0 if node.is_measured else suspicion_fade * self.hidden,
            ),
        )

    def _compare_windows(self, node: PathNode, noise: PathNoise, settings: FilterSettings) -> list[Discrepancy]:
        nodes = (*self.older, *self.newest)
        # windows of about 1, 2, 4, 8 ... seconds are enough: each is half of the next
        found, seconds = [], 1.0
        for each in reversed(nodes):
            age = (node.utime - each.utime) * 1e-6
            if age >= seconds or each is nodes[0]:
                found.append(compare_window(each, node, noise, settings))
                seconds = 1.41 * age
        return found

    def check_trust(
        self, node: PathNode, noise: PathNoise, settings: FilterSettings
    ) -> tuple[ConsistencyMonitor, bool]:
        """Return the monitor after a fix that is not trusted, and whether fixes agree with dead reckoning again."""
        assert self.suspect is not None
        is_known = is_vague = False
        if self.cause is Cause.HEADING:
            size = abs(find_turn(self.suspect, node))
            sigma = get_turn_sigma(self.suspect, node, noise)
            sigmas = size / sigma
            is_vague = sigma > KNOWN_HEADING
        else:
            found = compare_window(self.suspect, node, noise, settings)
            size, sigma, sigmas = abs(found.error), found.sigma, found.sigmas
            known = KNOWN_AGAIN if self.agreed_since else 1.0
            is_known = compute_longest_axis(*found.covariance) < known**2 * (node.white**2 + node.correlated**2)
        largest = max(self.largest, size)
        # where dead reckoning has become so uncertain that it would not contradict them any more, that is no agreement
        agrees = sigmas <= AGREEMENT and not is_vague and (is_known or largest > THRESHOLD * sigma)
        since = (self.agreed_since or node.utime) if agrees else 0
        needed = JUMP_AGREEMENT_TIME if self.is_jump else AGREEMENT_TIME
        return self._replace(agreed_since=since, largest=largest), agrees and (node.utime - since) * 1e-6 >= needed

    def select_moved_alike(self, node: PathNode) -> tuple[PathNode, ...]:
        """Return the nodes since which fixes, wherever they are, have moved as dead reckoning does; empty: too few."""
        nodes = tuple(
            each
            for each in (*self.older, *self.newest)
            if each.utime >= self.moved_since
            and node.unmeasured - each.unmeasured < LARGEST_UNMEASURED
            and node.lost - each.lost < LARGEST_LOST**2
        )
        if not nodes or node.seconds - nodes[0].seconds < NEW_TRUST_TIME:
            return ()
        return nodes if node.distance - nodes[0].distance > NEW_TRUST_DISTANCE else ()

    @property
    def has_turned(self) -> bool:
        """Whether the vehicle has turned, since the heading has followed the gyro again, as one that drives does."""
        own = [each.own_heading for each in (*self.older, *self.newest) if each.utime >= self.moved_since]
        return sum(abs(wrap_angle(b - a)) for a, b in itertools.pairwise(own)) > OWN_TURNS

    def find_cause(self, node: PathNode, noise: PathNoise, settings: FilterSettings) -> Inconsistency | None:
        """Return what explains the discrepancies best, once enough fixes have exceeded the threshold.

        That is the cause with the largest evidence over some window: a test of the likelihood ratio over cause and time
        (GLR: M. Basseville and I. Nikiforov, "Detection of Abrupt Changes", 1993, 2.4.3), with priors. An error of the
        fixes is assumed where no other cause explains clearly more; within DECISION_TIME one may still turn out to.
        """
        if self.num_exceeded < CONFIRMATIONS or (self.num_exceeded - CONFIRMATIONS) % REPEAT:
            return None
        if self.suspect is not None and (node.utime - self.since) * 1e-6 > DECISION_TIME:
            return None
        nodes = [each for each in (*self.older, *self.newest) if each.is_measured]
        if not nodes:
            return self._find_turned(node, noise, settings) if self.suspect is None else None
        if len(nodes) < FEWEST_NODES:
            return None
        worst = max((compare_window(each, node, noise, settings) for each in nodes), key=lambda each: each.sigmas)
        explained = {Cause.GNSS: Inconsistency(Cause.GNSS, worst)}
        for k, start in enumerate(nodes):
            turn = start.heading_variance + start.rate_variance * (node.seconds - start.seconds) ** 2
            if turn > LARGEST_TURN_SIGMA**2:
                continue
            # a window that could explain no more than this changes neither the best cause nor its margin
            least = max(each.explained for each in explained.values()) - LARGEST_MARGIN
            for each in _explain(start, (*nodes[k + 1 :], node), noise, settings, least):
                if each.cause not in explained or each.explained > explained[each.cause].explained:
                    explained[each.cause] = each
        best = max(explained.values(), key=lambda each: each.explained)
        rest = max((each.explained for each in explained.values() if each is not best), default=0.0)
        if best.cause is not Cause.GNSS and best.explained > rest + MARGIN[best.cause]:
            return best
        if self.suspect is not None:
            return None
        is_jump = self.has_jumped and abs(worst.error) > LEAST_JUMP * math.hypot(node.white, node.correlated)
        return explained[Cause.GNSS]._replace(discrepancy=worst, is_jump=is_jump)

    def _find_turned(self, node: PathNode, noise: PathNoise, settings: FilterSettings) -> Inconsistency | None:
        """Return the window in which the heading has been turned most beside the gyro."""
        nodes = [each for each in (*self.older, *self.newest) if each.has_gyro]
        if not nodes:
            return None

        def count_sigmas(each: PathNode) -> float:
            return abs(find_turn(each, node)) / get_turn_sigma(each, node, noise)

        worst = max(nodes, key=count_sigmas)
        change = find_turn(worst, node)
        return Inconsistency(Cause.HEADING, compare_window(worst, node, noise, settings), change)


def find_turn(start: PathNode, end: PathNode) -> float:
    """Return by which fixes have turned the heading between two nodes, rad.

    That is beside a gyro with the bias of the start: a state that follows the fixes changes the bias too.
    """
    bias = end.bias_turn - start.bias_turn - start.rate_bias * (end.seconds - start.seconds)
    return wrap_angle(end.rotation - start.rotation - bias)


def get_turn_sigma(start: PathNode, end: PathNode, noise: PathNoise) -> float:
    """Return the standard deviation of what fixes may turn the heading by between two nodes, rad."""
    seconds = end.seconds - start.seconds
    variance = start.heading_variance + noise.heading * seconds + start.rate_variance * seconds**2
    return math.sqrt(variance + end.lost - start.lost + COURSE_FLOOR**2)


def _explain(
    start: PathNode, window: tuple[PathNode, ...], noise: PathNoise, settings: FilterSettings, least: float = -math.inf
) -> list[Inconsistency]:
    """Return each cause of the discrepancies since a node, with the squares that it explains.

    Nothing where none could explain more than `least`: parameters do not lower the determinant of the information, so
    a cause explains no more than the squares that remain without one.
    """
    replayed = replay_path(start, window)
    # error, displacement and moment of each node as `compare_window` has them; it would compute much more
    turned = cmath.rect(1.0, start.rotation)
    displacements = [turned * (each.path - start.path) for each in replayed]
    begin = _shift_fix(start, start.latency)
    errors = np.array(
        [_shift_fix(each, start.latency) - begin - d for each, d in zip(window, displacements, strict=True)]
    )
    paths = np.array(displacements)
    seconds = np.array([each.seconds - start.seconds for each in window])
    even = np.ones(len(window), dtype=complex)
    moments = np.array(
        [turned * (each.moment - start.moment - start.seconds * (each.path - start.path)) for each in replayed]
    )
    velocities = np.array([each.velocity for each in window])
    whiten = np.linalg.inv(np.linalg.cholesky(_get_window_covariance(start, window, noise, settings)))
    # the errors of the path as the state knows them
    usual = (
        (1j * paths, math.sqrt(start.heading_variance)),
        (paths, math.sqrt(start.scale_variance)),
        (1j * moments, math.sqrt(start.rate_variance)),
    )
    fit = _WindowFit(whiten, errors, usual)
    ((_, squares, none),) = fit.solve(((),))
    if squares < least:
        return []
    end = replayed[-1]
    last = window[-1]._replace(path=end.path, moment=end.moment, rotation=end.rotation, latency=start.latency)
    newest = compare_window(start, last, noise, settings)
    yaws = np.array(
        [
            start.rotation + start.own_heading,
            *(r.rotation + w.own_heading for r, w in zip(replayed, window, strict=True)),
        ]
    )
    turns = np.exp(1j * yaws[1:]) - cmath.rect(1.0, yaws[0])
    planar = [(Cause.GNSS, seconds, TYPICAL_DRIFT), (Cause.GNSS, even, TYPICAL_JUMP)]
    if start.correlated < LARGEST_FIX_SIGMA:
        # other fixes err by more than any lever arm
        planar.append((Cause.LEVER_ARM, turns, TYPICAL_LEVER_ARM))
    largest = 2.0 * len(window) * LARGEST_REST
    found = []
    fits = fit.solve([((model, sigma), (1j * model, sigma)) for _, model, sigma in planar])
    for (cause, _, _), ((a, b), left, evidence) in zip(planar, fits, strict=True):
        if cause is Cause.GNSS or left <= largest:
            found.append(Inconsistency(cause, newest, math.hypot(a, b), none - evidence, lever_arm=complex(a, b)))
    single = [(Cause.GYRO, 1j * moments), (Cause.WHEELS, paths)]
    if window[-1].shows_latency:
        # before the window too, and from its start on
        single += [(Cause.LATENCY, start.velocity - velocities), (Cause.LATENCY, -velocities)]
    fits = fit.solve([((model, TYPICAL_CHANGE[cause]),) for cause, model in single])
    for (cause, _), ((factor,), left, evidence) in zip(single, fits, strict=True):
        if left <= largest:
            found.append(Inconsistency(cause, newest, factor, none - evidence, turned=end.rotation - start.rotation))
    return found


Column: TypeAlias = tuple[Vector, float]
"""Errors (n) that one unit of a parameter adds along the window, complex, and the parameter's standard deviation."""


class _WindowFit:
    """Least squares of the errors of a window (n) by its usual parameters and one cause, each with its sigma.

    The fits of causes with equally many parameters are solved together: numpy's overhead is most of the work.
    """

    def __init__(self, whiten: Vector, errors: Vector, usual: Sequence[Column]):
        e = whiten @ errors
        self._whiten = whiten.astype(complex)
        self._measured = np.concatenate((e.real, e.imag))
        self._usual = usual

    def solve(self, causes: Sequence[Sequence[Column]]) -> list[tuple[list[float], float, float]]:
        """Return for each cause its factors, the squares that remain, and -2 log of the evidence.

        `causes` are the columns of each, equally many.
        """
        fits = [(*self._usual, *columns) for columns in causes]
        m, k, n = len(fits), len(fits[0]), len(self._whiten)
        columns = np.array([[vector for vector, _ in fit] for fit in fits], dtype=complex)
        A = self._whiten @ np.ascontiguousarray(columns.transpose(0, 2, 1))
        full = np.zeros((m, 2 * n + k, k))
        full[:, :n], full[:, n : 2 * n] = A.real, A.imag
        b = np.zeros(2 * n + k)
        b[: 2 * n] = self._measured
        for each, fit in zip(full, fits, strict=True):
            each[2 * n :].flat[:: k + 1] = [1.0 / sigma for _, sigma in fit]
        transposed = full.transpose(0, 2, 1)
        information = transposed @ full
        x = np.linalg.solve(information, (transposed @ b)[..., None])
        rest = b - (full @ x)[..., 0]
        sizes = np.linalg.slogdet(information)[1].tolist()
        solutions = []
        for fit, factors, row, size in zip(fits, x[:, len(self._usual) :, 0].tolist(), rest, sizes, strict=True):
            left = float(row @ row)
            size += 2.0 * sum(math.log(sigma) for _, sigma in fit)
            solutions.append((factors, left, left + size))
        return solutions


def _get_window_covariance(
    start: PathNode, window: tuple[PathNode, ...], noise: PathNoise, settings: FilterSettings
) -> Vector:
    """Return the covariance of the discrepancies since a node along one axis, m2: of the fixes and of slip."""
    t = np.array([each.seconds - start.seconds for each in window])
    tau = settings.gps_correlation_time
    near = np.exp(-np.abs(t[:, None] - t) / tau)
    first = np.exp(-t / tau)
    correlated = min(noise.inflation, MAX_INFLATION) * start.correlated * window[-1].correlated
    C = correlated * (near - first[:, None] - first + 1.0) + start.white**2
    speed = (window[-1].distance - start.distance) / t[-1]
    slip = settings.slip_time * ((settings.slip_ratio * speed) ** 2 + settings.side_sigma**2)
    C += slip * np.minimum(t[:, None], t)
    unmeasured = np.array([each.unmeasured - start.unmeasured for each in window])
    C += np.outer(unmeasured, unmeasured)
    return np.asarray(C + np.diag([each.white**2 + MODEL_ERROR**2 for each in window]))


class ReplayedNode(NamedTuple):
    """Path, moment and rotation of a node (see `PathNode`), replayed."""

    path: complex
    moment: complex
    rotation: float


def replay_path(start: PathNode, window: tuple[PathNode, ...]) -> list[ReplayedNode]:
    """Return the nodes of a window as they are with the gyro's bias and the wheels' scale of its start.

    A state that follows the fixes changes both, and so hides what has changed.
    """
    found, before, turned = [], start, 0.0
    path, moment = start.path, start.moment
    for each in window:
        seconds = each.seconds - before.seconds
        turn = (0.5 * (each.rate_bias + before.rate_bias) - start.rate_bias) * seconds
        factor = cmath.rect(1.0 + 0.5 * (each.scale + before.scale) - start.scale, turned + 0.5 * turn)
        turned += turn
        path += factor * (each.path - before.path)
        moment += factor * (each.moment - before.moment)
        found.append(ReplayedNode(path, moment, each.rotation - turned))
        before = each
    return found


def compare_window(start: PathNode, end: PathNode, noise: PathNoise, settings: FilterSettings) -> Discrepancy:
    """Return the discrepancy (1) between two nodes."""
    seconds = end.seconds - start.seconds
    d = cmath.rect(1.0, start.rotation) * (end.path - start.path)
    error = _shift_fix(end, end.latency) - _shift_fix(start, end.latency) - d
    m = _get_moment(start, end)
    driven = end.distance - start.distance
    square = abs(d) ** 2
    # white noises: slip and side slip that last slip_time, the gyros'
    even = settings.slip_time * (
        (settings.slip_ratio * driven) ** 2 / max(seconds, 1e-3) + settings.side_sigma**2 * seconds
    )
    even += (end.unmeasured - start.unmeasured) ** 2
    across = start.heading_variance + noise.heading * seconds / 3.0 + end.lost - start.lost
    # a turn shortens the path along itself: to the second order, E (1 - cos)^2
    along = start.scale_variance + 0.75 * across * across
    x, y = d.real, d.imag
    east = even + across * y * y + along * x * x + start.rate_variance * m.imag**2
    north = even + across * x * x + along * y * y + start.rate_variance * m.real**2
    cross = (along - across) * x * y - start.rate_variance * m.real * m.imag
    fixes = _get_fix_variance(start, end, noise, settings)
    fixes += end.latency_variance * abs(end.velocity - start.velocity) ** 2
    a, b = east + fixes, north + fixes
    ex, ey = error.real, error.imag
    square_sum = (b * ex * ex - 2.0 * cross * ex * ey + a * ey * ey) / (a * b - cross * cross)
    turn = turn_sigma = 0.0
    if square > MIN_TURN_PATH**2:
        # the fixes moved by d + e; where they hardly moved, their direction means nothing
        moved = 1.0 + error * d.conjugate() / square
        turn = cmath.phase(moved) if abs(moved) > LEAST_MOVED else moved.imag
        side = (a * y * y - 2.0 * cross * x * y + b * x * x) / square
        turn_sigma = math.sqrt(side / square) / min(max(abs(moved), LEAST_MOVED), 1.0)
    longest = math.sqrt(compute_longest_axis(a, b, cross))
    return Discrepancy(
        start, error, math.sqrt(max(square_sum, 0.0)), longest, d, (east, north, cross), turn, turn_sigma
    )


def _find_hidden_turn(windows: list[Discrepancy], end: PathNode, noise: PathNoise, settings: FilterSettings) -> float:
    """Return the angle by which a gyro whose bias has changed may have turned the heading unseen, rad.

    A change by b = `gyro_bias_step` at the start of a window has turned it by b T, and the path has left the fixes by
    b |m|. `windows`: the shortest first; only wheels show by their path what fixes have not turned.
    """
    hidden = 0.0
    for each in windows:
        start = each.node
        if not (start.is_measured and start.has_gyro and end.has_gyro):
            break
        turn = settings.gyro_bias_step * (end.seconds - start.seconds)
        off = settings.gyro_bias_step * abs(_get_moment(start, end))
        within = HIDDEN_SIGMAS * math.sqrt(_get_fix_variance(start, end, noise, settings))
        if off > within:
            # the moment grows with the square of time
            return max(hidden, turn * math.sqrt(within / off))
        hidden = turn
    return hidden


def _compare_course(found: Discrepancy, end: PathNode, noise: PathNoise, settings: FilterSettings) -> float:
    """Return the angle from the path to the course of the fixes, beyond what is allowed, rad; 0 where none is shown."""
    start, path, course = found.node, found.displacement, found.displacement + found.error
    # only its direction means something, and only while it is straight
    if not STRAIGHT * (end.distance - start.distance) < abs(path) or min(abs(path), abs(course)) < MIN_TURN_PATH:
        return 0.0
    fixes = math.sqrt(_get_fix_variance(start, end, noise, settings)) / abs(course)
    sigma = math.hypot(get_turn_sigma(start, end, noise), fixes)
    return abs(cmath.phase(course / path)) - ALLOWED_TURN * sigma


class DriftFit(NamedTuple):
    """How fixes have moved beside dead reckoning.

    Attributes
    ----------
    turn, turn_sigma: rotation of the path to the fixes, rad.
    drift, drift_sigma: of the fixes from the first to the last, and its largest standard deviation, m.
    tolerance: standard deviation of the difference of two fixes at that interval, m.
    seconds: from the first to the last.
    rest: mean square that the fit leaves, over each axis, relative to the variance of the fixes.
    """

    turn: float
    turn_sigma: float
    drift: float
    drift_sigma: float
    tolerance: float
    seconds: float
    rest: float

    @property
    def largest(self) -> float:
        """Largest drift that is not excluded by the noise, m."""
        return 2.0 * math.hypot(self.tolerance, self.drift_sigma)

    @property
    def is_steady(self) -> bool:
        """Whether fixes are known to have moved as the path, whatever its heading, all the time."""
        is_known = self.drift_sigma <= STEADY_SIGMA * self.seconds
        return is_known and self.drift <= self.largest and self.rest <= LARGEST_REST

    def excludes(self, rate: float) -> bool:
        """Return whether fixes are known not to drift at a rate any more, m/s; 0 needs no proof."""
        sigma = math.hypot(self.tolerance, self.drift_sigma)
        return not rate or rate * self.seconds - self.drift > EXCLUDING_SIGMAS * sigma


def fit_drift(nodes: tuple[PathNode, ...], rotation: float, noise: PathNoise, settings: FilterSettings) -> DriftFit:
    """Fit an offset, a drift, a rotation, a scale and a turn rate to the fixes of some nodes.

    `rotation` is that from the path's axes to N now. A path that is straight does not show a drift: its standard
    deviation is large then.
    """
    first, last = nodes[0], nodes[-1]
    seconds = last.seconds - first.seconds
    t = np.array([each.seconds - first.seconds for each in nodes]) / seconds
    begin = _shift_fix(first, last.latency)
    fixes = np.array([_shift_fix(each, last.latency) - begin for each in nodes])
    paths = cmath.rect(1.0, rotation) * np.array([each.path - first.path for each in nodes])
    moments = cmath.rect(1.0, rotation) * np.array(
        [each.moment - first.moment - first.seconds * (each.path - first.path) for each in nodes]
    )
    # neighboring fixes share their time-correlated error
    share = min((seconds / settings.gps_correlation_time + 1.0) / len(nodes), 1.0)
    weights = np.sqrt([share / (each.white**2 + each.correlated**2) for each in nodes])
    turn = cmath.phase(complex(np.vdot(paths - paths.mean(), fixes - fixes.mean())))
    for _ in range(3):
        spin = cmath.rect(1.0, turn)
        columns = (np.ones(len(nodes)), 1j * np.ones(len(nodes)), t, 1j * t, 1j * spin * paths)
        A = np.column_stack((*columns, spin * paths, 1j * spin * moments)) * weights[:, None]
        b = (fixes - spin * paths) * weights
        prior = np.diag((0.0, 0.0, 0.0, 0.0, 0.0, 1.0 / first.scale_variance, 1.0 / first.rate_variance))
        information = (A.conj().T @ A).real + prior
        x = np.linalg.solve(information, (A.conj().T @ b).real)
        turn += float(x[4])
    P = np.linalg.inv(information)
    rest = float(np.mean(np.abs(b - A @ x) ** 2)) / (2.0 * share)
    longest = 0.5 * (P[2, 2] + P[3, 3]) + math.hypot(0.5 * (P[2, 2] - P[3, 3]), P[2, 3])
    tolerance = math.sqrt(_get_fix_variance(first, last, noise._replace(inflation=1.0), settings))
    return DriftFit(turn, math.sqrt(P[4, 4]), math.hypot(x[2], x[3]), math.sqrt(longest), tolerance, seconds, rest)


def _shift_fix(node: PathNode, latency: float) -> complex:
    """Return the antenna by a fix of some latency at its stamp, along N, m: to the second order in turns."""
    return node.fix + latency * node.velocity * (1.0 - 0.5j * latency * node.turn_rate)


def _get_moment(start: PathNode, end: PathNode) -> complex:
    """Return the integral of the time since a node along the path from there, along N, m s."""
    turned = cmath.rect(1.0, start.rotation)
    return turned * (end.moment - start.moment - start.seconds * (end.path - start.path))


def _get_fix_variance(start: PathNode, end: PathNode, noise: PathNoise, settings: FilterSettings) -> float:
    """Return the variance, along each axis, of the difference of two fixes, m2."""
    seconds = end.seconds - start.seconds
    changed = 2.0 * (1.0 - math.exp(-seconds / settings.gps_correlation_time))
    variance = min(noise.inflation, MAX_INFLATION) * changed * start.correlated * end.correlated
    return variance + start.white**2 + end.white**2

"""Consistency monitor: fixes against the path of dead reckoning, over windows from seconds to minutes.

The gate compares one fix with the state, which has followed the fixes before it. An error that grows slowly passes it:
the state follows. So fixes are compared with what did not follow, the path of dead reckoning (solution separation, as
in ARAIM: J. Blanch et al., "Baseline advanced RAIM user algorithm", IEEE Trans. AES, 2015): `path_windows` has the
discrepancy e of a window and its covariance (1).

Below the threshold, what is unexplained widens the protection levels: the position may have followed e, and the
heading turned to explain it (`horizontal_allowance`, `heading_allowance`). Above it, one of the two is wrong, and the
fits over all windows show which (`find_causes` in `path_fits`).

What is corrected leaves an allowance that decays (`suspicion`), beside what windows show since: if the fixes drifted
after all, the path has begun again beside them. An antenna that is elsewhere is reported, and the state goes on to
follow it: in turns it shows a way and a heading that are not the vehicle's (`lever_arm`). Fixes that jump are not used,
and dead reckoning is right for a while, but for what its heading may be off since before the jump (`_find_stray`).
Fixes that drift are used on, since the fault may be that of the heading: the allowances are then all of e and of the
turn since the window's start, and the pose is invalid only where they are too large. Fixes are trusted again when they
agree with the path from there, or when they have moved as the path for two minutes: a fit of a drift beside an
offset, a rotation, a scale and a turn rate shows it to be small, which takes turns, and leaves no more than the noise
of fixes (`fit_drift`).

A gyro whose bias has changed turns the heading before fixes show it, most at a walk: by b T while b |m| is within their
noise, over the longest such window. The bound of the heading is never below that angle for b = `gyro_bias_step`
(`hidden`); where wheels stop measuring the path, or it begins again, that angle decays.

The receiver's velocity moves the state's, and may drift with the fixes: the path is then that of wheels and gyro, the
state's and what they measure beside it (`follow_wheels`).

Without a measured speed the path follows the fixes. Then only the heading is compared: what fixes turn it by beside the
gyro with its bias of before (`find_turn`), as on a ferry (`Cause.HEADING`). It is found again when the course turns as
the gyro does, quicker than a ship (`find_own_course`): then the vehicle drives by itself.

Limits: a drift slower than the path is known (2 % of the speed with wheels, for minutes) is found in turns only.
"""

from __future__ import annotations

import cmath
import math
from types import MappingProxyType
from typing import Final, NamedTuple

from modelserver.estimation.filter.measurements.measurement import wrap_angle
from modelserver.estimation.filter.path_fits import (
    TYPICAL_CHANGE,
    Cause,
    Inconsistency,
    find_causes,
)
from modelserver.estimation.filter.path_windows import (
    COURSE_FLOOR,
    MIN_TURN_PATH,
    Discrepancy,
    PathNode,
    PathNoise,
    compare_window,
    find_turn,
    get_fix_variance,
    get_moment,
    get_turn_sigma,
    is_direction_known,
)
from modelserver.estimation.filter.protection_levels import compute_longest_axis
from modelserver.estimation.filter.settings import FilterSettings

VELOCITY_TIME: Final = 2.0
"""Seconds in which wheels and constraint return the state's velocity to theirs, after one of the receiver."""

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
"""Seconds in which the suspicion decays about fixes that are trusted, and about a turn that no path shows any more."""

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

AGREEMENT: Final = 2.45
"""Standard deviations of (1) within which a fix agrees: 95 % of good ones."""

AGREEMENT_TIME: Final = 10.0
JUMP_AGREEMENT_TIME: Final = 3.0
"""Seconds for which fixes that drifted, or jumped, must agree with dead reckoning to be trusted again."""

KNOWN_AGAIN: Final = 2.0
"""Standard deviation of dead reckoning, relative to that of a fix, up to which fixes continue to agree; it is less than
1 when they begin to."""

NEW_TRUST_TIME: Final = 120.0
NEW_TRUST_DISTANCE: Final = 20.0
"""Seconds, and meters, for which fixes must move as dead reckoning does to be trusted again wherever they are."""

LARGEST_UNMEASURED: Final = 1.0
"""Meters of that distance that wheels need not have measured."""

LARGEST_LOST: Final = 0.05
"""Standard deviation of the heading, rad, that gaps of the IMU may have cost in that time, and one of them in any
window: the path turns there, and what it misses then is not an error of the fixes."""

OWN_TURN: Final = 1.5
SLOWEST_TURN: Final = 0.06
"""Radians that a vehicle turns by, while its course follows the gyro, that drives by itself; and the turn rate, rad/s,
at least, of turns that count: twice that of a ship."""

OWN_TURN_US: Final = 45_000_000
LARGEST_SLIP: Final = 0.15
FEWEST_COURSES: Final = 6
"""Microseconds within which it does, standard deviation of the course beside the gyro, rad, at most, and how many
courses show it, at least."""

COURSE_SIGMAS: Final = 5.0
LONGEST_WAY: Final = 6.0
"""Length of a way between two fixes, relative to their white error, that shows a course, and its longest duration, s.
"""

DECISION_TIME: Final = 90.0
REPEAT: Final = 4
"""Seconds for which the causes are compared again, and fixes from one comparison to the next."""

MARGIN: Final = MappingProxyType({Cause.GYRO: 8.0, Cause.WHEELS: 8.0, Cause.LATENCY: 5.0, Cause.LEVER_ARM: 5.0})
"""Evidence by which an error must exceed any other cause to be corrected."""

KNOWN_BIAS: Final = 3.0
"""Standard deviations by which the bias of a gyro is another one than before fixes became suspect, at least."""

HIDDEN_SIGMAS: Final = 3.0
"""Standard deviations of fixes within which they hide a turn by a gyro whose bias has changed."""

HIDDEN_LEVEL: Final = 0.4
"""Share of the covariance's level, beside that turn: about two standard deviations."""

LARGEST_HIDDEN: Final = 0.5
"""Largest bound of the heading by both, rad: within the usual limit of a vehicle with wheels."""


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
    drift_rate: at which they drifted away from the path until then, at least, m/s; 0 for a jump.
    largest: discrepancy of the fixes since then, m.
    agreed_since: since when the fixes have agreed with the path from there again; 0: they do not.
    horizontal_allowance, heading_allowance: what is unexplained, m and rad.
    hidden: angle by which a gyro whose bias has changed may have turned the heading while fixes do not show it, rad.
    held: bound of the heading before the last fix, rad, at `held_utime` and `held_distance`.
    lever_arm: the antenna beside its place in the geometry, as fixes show it, forward + i left, m.
    suspicion: what was taken for an error of gyro or wheels, or for agreement, and may have been one of the fixes, m.
    velocity_utime: of the last velocity of the receiver that the state has followed.
    offset: how far the state may be off, m: by what windows leave unexplained; once there is a suspect node, by how far
        fixes or the state are off the path since then, unless the state is at the path.
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
    velocity_utime: int = 0
    offset: float = 0.0

    @property
    def excludes_fixes(self) -> bool:
        """Whether fixes are not used: they have jumped away from dead reckoning."""
        return self.suspect is not None and self.is_jump

    @property
    def allowance(self) -> float:
        """How far the state may be off by what the monitor knows, m, beside its covariance."""
        return abs(self.lever_arm) + (self.offset if self.suspect is not None else max(self.offset, self.suspicion))

    @property
    def is_transported(self) -> bool:
        """Whether the vehicle moves beside its own axis, so that fixes do not show its heading."""
        return self.suspect is not None and self.cause is Cause.HEADING

    @property
    def _excluded(self) -> float:
        """How far fixes that are not used have been off, m: they may have jumped, whatever is found after."""
        return self.largest if self.excludes_fixes else 0.0

    @property
    def may_reset(self) -> bool:
        """Whether rejected fixes may show where the vehicle is: they are not suspect themselves."""
        return self.suspect is None or self.cause is Cause.HEADING

    def resolve(self, found: Inconsistency, utime: int) -> ConsistencyMonitor:
        """Return the monitor after an inconsistency was found at `utime`: what is corrected begins again."""
        if found.cause not in (Cause.GNSS, Cause.HEADING):
            suspicion = max(self.suspicion, abs(found.discrepancy.error), self._excluded)
            path = self._replace(older=(), newest=(), num_exceeded=0, suspect=None, is_jump=False)
            if found.cause is Cause.GYRO:
                path = path._replace(hidden=0.0)
            if found.cause is Cause.LEVER_ARM:
                path = path._replace(lever_arm=self.lever_arm + found.lever_arm)
            return path._replace(cause=None, since=utime, suspicion=suspicion, horizontal_allowance=suspicion)
        suspect = found.discrepancy.node
        drifts = found.cause is Cause.GNSS and not found.is_jump
        slowest = abs(found.discrepancy.error) - found.discrepancy.sigma
        after = self._replace(
            num_exceeded=0,
            cause=found.cause,
            since=utime,
            suspect=suspect,
            is_jump=found.is_jump,
            drift_rate=slowest / ((utime - suspect.utime) * 1e-6) if drifts else 0.0,
            largest=0.0,
            agreed_since=0,
        )
        if not found.is_jump:
            return after
        return after._replace(horizontal_allowance=self.horizontal_allowance + after._find_stray(self.path))

    def _find_stray(self, path: complex) -> float:
        """Return how far a heading within its allowance may have led dead reckoning since the suspect node, m."""
        start = path if self.suspect is None else self.suspect.path
        return math.sin(min(self.heading_allowance, 0.5 * math.pi)) * abs(path - start)

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

    def follow_wheels(self, shift: complex, utime: int) -> ConsistencyMonitor:
        """Return the monitor after wheels and constraint measured `shift` more than the way of the state, along N, m.

        The path is theirs where the receiver's velocity has moved the state's: fixes that drift move it alike.
        """
        if (utime - self.velocity_utime) * 1e-6 > VELOCITY_TIME:
            return self
        step = shift * cmath.rect(1.0, -self.rotation)
        seconds = (self.utime - self.begin) * 1e-6
        return self._replace(path=self.path + step, moment=self.moment + seconds * step)

    def restart(self) -> ConsistencyMonitor:
        """Return the monitor before a new path, with what lasts."""
        return ConsistencyMonitor(
            held=self.held,
            held_utime=self.held_utime,
            held_distance=self.held_distance - self.distance,
            lever_arm=self.lever_arm,
            velocity_utime=self.velocity_utime,
        )

    def trust(self, node: PathNode, noise: PathNoise, settings: FilterSettings) -> ConsistencyMonitor:
        """Return the monitor after fixes have agreed with the path since the suspect node again: it continues.

        They may be off as far as that agreement does not show.
        """
        assert self.suspect is not None
        since = self.suspect.utime
        suspicion = max(self.suspicion, _bound_error(compare_window(self.suspect, node, noise, settings)))
        return self._replace(
            older=tuple(each for each in self.older if each.utime <= since),
            newest=tuple(each for each in self.newest if each.utime <= since),
            num_exceeded=0,
            cause=None,
            suspect=None,
            is_jump=False,
            agreed_since=0,
            suspicion=suspicion,
        )

    def start_heading(self, fix_sigma: float, distance: float, *, is_measured: bool) -> ConsistencyMonitor:
        """Return the monitor after fixes along a first path of some `distance`, m, have shown the heading.

        `fix_sigma`: standard deviation of such a fix, m; `is_measured`: whether wheels measured the path's length.
        Further fixes confirm it, and the allowance decays.
        """
        error = START_ERROR if is_measured else UNMEASURED_START_ERROR
        allowance = math.atan2(error * fix_sigma, distance)
        return self._replace(heading_allowance=max(self.heading_allowance, allowance))

    def relearn(self, bias: float, utime: int) -> ConsistencyMonitor:
        """Return the monitor after a stationary vehicle has shown that the bias of the yaw gyro is another one, rad/s.

        Where it is that of before fixes became suspect, they have turned the state's; where it is not, they may have
        been right beside a path that was wrong.
        """
        if self.suspect is not None:
            change = abs(bias - self.suspect.rate_bias)
            least = max(0.5 * TYPICAL_CHANGE[Cause.GYRO], KNOWN_BIAS * math.sqrt(self.suspect.rate_variance))
            if change < least:
                return self
        suspicion = max(self.suspicion, self._excluded)
        path = self._replace(older=(), newest=(), last=None, num_exceeded=0, has_jumped=False, suspicion=suspicion)
        return path._replace(cause=None, since=utime, suspect=None, is_jump=False)

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
        return self._replace(
            is_jump=False, horizontal_allowance=self.largest, heading_allowance=math.pi, offset=self.largest
        )

    def append(self, node: PathNode) -> ConsistencyMonitor:
        """Return the monitor with a node more, if the last one is old enough, and the fix no outlier."""
        newest, older = self.newest, self.older
        if newest and node.utime - newest[-1].utime < SPACING_US:
            return self
        if self.num_exceeded and self.suspect is None:
            return self
        if not is_direction_known(node, node):
            return self  # the path has none yet
        while newest and node.utime - newest[0].utime > NEWEST_US:
            if not older or newest[0].utime - older[-1].utime >= OLDER_SPACING_US:
                older = (*older, newest[0])
            newest = newest[1:]
        while older and node.utime - older[0].utime > LONGEST_US:
            older = older[1:]
        return self._replace(older=older, newest=(*newest, node))

    def compare(self, node: PathNode, noise: PathNoise, settings: FilterSettings) -> ConsistencyMonitor:
        """Return the monitor after the comparison of a fix with the windows."""
        worst = latest = horizontal = heading = offset = 0.0
        suspect = None if self.is_jump else self.suspect
        if self.is_jump and self.last is not None:
            more = self._find_stray(node.path) - self._find_stray(self.last.path)
            self = self._replace(horizontal_allowance=self.horizontal_allowance + max(more, 0.0))
        if suspect is not None:
            # the state has followed all of it, or the path has gone wrong by it
            if self.cause is Cause.HEADING:
                heading = abs(find_turn(suspect, node))
            else:
                heading = abs(wrap_angle(self.rotation - suspect.rotation))
                found = compare_window(suspect, node, noise, settings)
                horizontal = _bound_error(found)
                heading = max(heading, abs(found.turn))
                # either the fixes are wrong or the path is: the state by as much as it has left the other one
                stray = abs(node.antenna - suspect.antenna - found.displacement)
                offset = max(abs(found.error), stray)
        windows = self._compare_windows(node, noise, settings)
        for each in windows:
            if not each.node.is_measured:
                # without a measured speed the path follows the fixes, but the heading must not
                sigmas = 0.0
                if each.node.has_gyro and node.has_gyro:
                    turned = abs(find_turn(each.node, node))
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
                if self.lever_arm:
                    beside = self.lever_arm * (cmath.rect(1.0, node.own_heading - each.node.own_heading) - 1.0)
                    heading = max(heading, math.atan2(abs(beside), abs(each.displacement)))
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
        if self.suspect is None:
            offset = horizontal
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
        hidden, is_limited = _find_hidden_turn(windows, node, noise, settings)
        if not is_limited:
            hidden = max(hidden, suspicion_fade * self.hidden)
        return self._replace(
            last=node,
            suspicion=suspicion,
            has_jumped=self.has_jumped and worst > THRESHOLD,
            num_exceeded=self.num_exceeded + 1 if worst > THRESHOLD else 0,
            compared_utime=node.utime,
            compared_distance=node.distance,
            horizontal_allowance=max(horizontal + suspicion, fade * self.horizontal_allowance),
            heading_allowance=max(min(heading, math.pi), heading_fade * self.heading_allowance),
            hidden=hidden,
            offset=offset,
        )

    def _compare_windows(self, node: PathNode, noise: PathNoise, settings: FilterSettings) -> list[Discrepancy]:
        nodes = [each for each in (*self.older, *self.newest) if not each.is_measured or is_direction_known(each, node)]
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
        found = compare_window(self.suspect, node, noise, settings)
        known = KNOWN_AGAIN if self.agreed_since else 1.0
        is_known = compute_longest_axis(*found.covariance) < known**2 * (node.white**2 + node.correlated**2)
        largest = max(self.largest, abs(found.error))
        # where dead reckoning has become so uncertain that it would not contradict them any more, that is no agreement
        agrees = found.sigmas <= AGREEMENT and (is_known or largest > THRESHOLD * found.sigma)
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

    def find_own_course(self) -> tuple[float, float] | None:
        """Return the rotation of the path to the courses of a vehicle that drives by itself, and its sigma, rad.

        None: the courses do not turn as the gyro does, or it has not turned enough.
        """
        last = self.last
        if last is None:
            return None
        nodes = [each for each in (*self.older, *self.newest) if last.utime - each.utime <= OWN_TURN_US]
        turned, beside = 0.0, []
        begin = 0
        for n in range(1, len(nodes)):
            a, b = nodes[n - 1 : n + 1]
            turn, seconds = wrap_angle(b.own_heading - a.own_heading), b.seconds - a.seconds
            turned += abs(turn) if abs(turn) > SLOWEST_TURN * seconds else 0.0
            start = nodes[begin]
            way = b.fix - start.fix
            if abs(way) > COURSE_SIGMAS * math.hypot(start.white, b.white) + MIN_TURN_PATH:
                ahead = sum(cmath.rect(1.0, each.own_heading) for each in nodes[begin : n + 1])
                beside.append(cmath.rect(1.0, cmath.phase(way / ahead)))
                begin = n
            elif b.seconds - start.seconds > LONGEST_WAY:
                begin = n
        if turned < OWN_TURN or len(beside) < FEWEST_COURSES:
            return None
        mean = sum(beside)
        slip = math.sqrt(sum(cmath.phase(each / mean) ** 2 for each in beside) / len(beside))
        if slip > LARGEST_SLIP:
            return None
        return cmath.phase(mean), math.hypot(slip, COURSE_FLOOR)

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
        causes = sorted(find_causes(nodes, node, noise, settings).values(), key=lambda each: -each.explained)
        if causes and causes[0].cause is not Cause.GNSS:
            best, rest = causes[0], max([0.0, *(each.explained for each in causes[1:])])
            if best.explained > rest + MARGIN[best.cause]:
                return best
        if self.suspect is not None:
            return None
        worst = max((compare_window(each, node, noise, settings) for each in nodes), key=lambda each: each.sigmas)
        is_jump = self.has_jumped and abs(worst.error) > LEAST_JUMP * math.hypot(node.white, node.correlated)
        return Inconsistency(Cause.GNSS, worst, is_jump=is_jump)

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


def _bound_error(found: Discrepancy) -> float:
    """Return how far fixes may be off, m: as far as they seem, and as dead reckoning may be."""
    return abs(found.error) + PATH_SIGMAS * math.sqrt(compute_longest_axis(*found.covariance))


def _find_hidden_turn(
    windows: list[Discrepancy], end: PathNode, noise: PathNoise, settings: FilterSettings
) -> tuple[float, bool]:
    """Return the angle by which a gyro whose bias has changed may have turned the heading unseen, rad; and whether more
    would be seen.

    A change by b = `gyro_bias_step` at the start of a window has turned it by b T, and the path has left the fixes by
    b |m|. `windows`: the shortest first; only wheels show by their path what fixes have not turned.
    """
    hidden = 0.0
    for each in windows:
        start = each.node
        if not (start.is_measured and start.has_gyro and end.has_gyro):
            break
        turn = settings.gyro_bias_step * (end.seconds - start.seconds)
        off = settings.gyro_bias_step * abs(get_moment(start, end))
        within = HIDDEN_SIGMAS * math.sqrt(get_fix_variance(start, end, noise, settings))
        if off > within:
            # the moment grows with the square of time
            return max(hidden, turn * math.sqrt(within / off)), True
        hidden = turn
    return hidden, False


def _compare_course(found: Discrepancy, end: PathNode, noise: PathNoise, settings: FilterSettings) -> float:
    """Return the angle from the path to the course of the fixes, beyond what is allowed, rad; 0 where none is shown."""
    start, path, course = found.node, found.displacement, found.displacement + found.error
    # only its direction means something, and only while it is straight
    if not STRAIGHT * (end.distance - start.distance) < abs(path) or min(abs(path), abs(course)) < MIN_TURN_PATH:
        return 0.0
    fixes = math.sqrt(get_fix_variance(start, end, noise, settings)) / abs(course)
    sigma = math.hypot(get_turn_sigma(start, end, noise), fixes)
    return abs(cmath.phase(course / path)) - ALLOWED_TURN * sigma

"""Turn monitor: what fixes turn the heading by beside the gyro, where no wheels measure the path.

Without wheels dead reckoning follows the fixes, so they cannot be judged by it (`hypothesis_bank` does with wheels).
But the heading must turn as the gyro does: from a node k to a fix, with the gyro's turn theta and its bias b,

    turn = psi - psi_k - (theta - theta_k - b_k T),   variance = P_psi + q_psi T + P_b T^2 + q_b T^3 / 3 + s_c^2     (1)

with the variances of heading and bias at the node and the sigma s_c of the course beside the heading. Beyond THRESHOLD
the vehicle moves beside its own axis: a ferry, a trailer. Its heading is not valid until the course turns as the gyro
does, quicker than a ship (`find_own_course`): then the vehicle drives by itself.

What is unexplained below the threshold widens the protection level of the heading (`allowance`).
"""

from __future__ import annotations

import cmath
import math
from typing import Final, NamedTuple

from modelserver.estimation.filter.measurements.measurement import wrap_angle

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

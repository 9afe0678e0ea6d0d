"""Paths of dead reckoning and what fits over their windows show, with fixes that are made here."""

from __future__ import annotations

import cmath
import copy
import math
import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from modelserver.estimation.filter.consistency_monitor import (
    LONGEST_US,
    ConsistencyMonitor,
)
from modelserver.estimation.filter.path_fits import (
    LARGEST_REST,
    Cause,
    DriftFit,
    find_causes,
    fit_drift,
    replay_paths,
)
from modelserver.estimation.filter.path_windows import PathNode, PathNoise, compare_window, find_turn
from modelserver.estimation.filter.settings import FilterSettings

SETTINGS = FilterSettings()
NOISE = PathNoise(SETTINGS.gyro_noise**2, SETTINGS.gyro_bias_walk**2, 1.0)
PERIOD = 0.5
WHITE, CORRELATED = 0.13, 0.9
FRESH = ConsistencyMonitor()


class Fault(NamedTuple):
    """What is wrong from `begin` to `end`, seconds."""

    begin: float = math.inf
    end: float = math.inf
    drift: complex = 0j
    rate: float = 0.0


class Step(NamedTuple):
    """A fix in a drive."""

    t: float
    node: PathNode
    monitor: ConsistencyMonitor


@dataclass
class Vehicle:
    """A vehicle at 2 to 6 m/s that turns now and then, and whose fixes no state follows."""

    noise: random.Random
    monitor: ConsistencyMonitor
    correlated: float
    truth: complex = 0j
    antenna: complex = 0j
    wander: complex = 0j
    shift: complex = 0j
    yaw: float = 0.0
    error: float = 0.0

    def copy(self) -> Vehicle:
        return replace(self, noise=copy.copy(self.noise))

    def advance(self, n: int, fault: Fault) -> Step:
        """Return the fix at an instant, and drive on to the next one."""
        t, noise = n * PERIOD, self.noise
        is_wrong = fault.begin <= t < fault.end
        speed = 4.0 + 2.0 * math.sin(t / 7.0)
        velocity = cmath.rect(speed, self.yaw)
        if is_wrong:
            self.shift += fault.drift * PERIOD
            self.error -= fault.rate * PERIOD
        elif t >= fault.end:
            self.shift = 0j
        keep = math.exp(-PERIOD / SETTINGS.gps_correlation_time)
        walk = complex(noise.gauss(0.0, 1.0), noise.gauss(0.0, 1.0))
        self.wander = keep * self.wander + self.correlated * math.sqrt(1.0 - keep**2) * walk
        white = WHITE / CORRELATED * self.correlated * complex(noise.gauss(0.0, 1.0), noise.gauss(0.0, 1.0))
        fix = self.truth + self.wander + white + self.shift
        utime = 1_000_000 + round(t * 1e6)
        monitor = self.monitor.extend(utime, self.antenna, 0.0, is_measured=True)
        node = PathNode(
            utime=utime,
            fix=fix,
            antenna=self.antenna,
            velocity=velocity,
            turn_rate=0.0,
            path=monitor.path,
            moment=monitor.moment,
            seconds=(utime - monitor.begin) * 1e-6,
            rotation=monitor.rotation,
            distance=monitor.distance,
            rate_bias=0.0,
            scale=0.0,
            heading_variance=0.01**2,
            rate_variance=0.0003**2,
            scale_variance=0.003**2,
            has_gyro=True,
            is_measured=True,
            own_heading=self.yaw + self.error,
            bias_turn=monitor.bias_turn,
            latency=0.0,
            latency_variance=0.02**2,
            shows_latency=True,
            lost=monitor.lost,
            unmeasured=monitor.unmeasured,
            white=WHITE / CORRELATED * self.correlated,
            correlated=self.correlated,
            position_covariance=(0.5, 0.5, 0.0),
        )
        monitor = monitor.compare(node, NOISE, SETTINGS)
        found = monitor.find_cause(node, NOISE, SETTINGS)
        monitor = monitor.append(node)
        self.monitor = monitor if found is None else monitor.resolve(found, utime)
        self.truth += velocity * PERIOD
        self.antenna += velocity * cmath.rect(PERIOD, self.error)
        self.yaw += PERIOD * (0.2 if math.sin(t / 15.0) > 0.5 else 0.0)
        return Step(t, node, monitor)


@cache
def drive_before(num_fixes: int, seed: int, correlated: float) -> tuple[Vehicle, tuple[Step, ...]]:
    """Return the vehicle and its fixes before a fault, which all faults that begin there share."""
    vehicle = Vehicle(random.Random(seed), FRESH, correlated)
    return vehicle, tuple(vehicle.advance(n, Fault()) for n in range(num_fixes))


def drive(seconds: float, fault: Fault, seed: int = 1, *, correlated: float = CORRELATED) -> Iterator[Step]:
    """Yield the fixes of a vehicle with a fault."""
    first = math.ceil(min(fault.begin, seconds) / PERIOD)
    before, steps = drive_before(first, seed, correlated)
    yield from steps
    vehicle = before.copy()
    for n in range(first, round(seconds / PERIOD)):
        yield vehicle.advance(n, fault)


@pytest.mark.parametrize("rate", [0.02, -0.03])
def test_given_a_gyro_that_has_turned_the_path_by_a_radian_then_its_change_is_found_and_no_drift(rate: float) -> None:
    steps = [each for each in drive(260.0, Fault(200.0, rate=rate)) if each.t >= 180.0]
    found = find_causes([each.node for each in steps[:-1:4]], steps[-1].node, NOISE, SETTINGS)
    assert found[Cause.GYRO].change == pytest.approx(rate, rel=0.12)
    # fixes that began to drift later leave the turn before unexplained
    rest = [each.explained for cause, each in found.items() if cause is not Cause.GYRO]
    assert max(rest) < 0.75 * found[Cause.GYRO].explained


def test_given_a_bias_that_the_state_has_followed_then_the_replayed_path_is_that_of_the_former_bias() -> None:
    template = next(drive(1.0, Fault())).node
    path = moment = 0j
    turned = bias = 0.0
    nodes = [template._replace(path=0j, moment=0j, seconds=0.0, rate_bias=0.0)]
    for n in range(1, 301):
        # straight ahead at 4 m/s, while the bias of the state rises to 0.02 rad/s
        bias = 0.02 * n / 300
        turned -= bias * 0.1
        path += cmath.rect(0.4, turned)
        moment += n * 0.1 * cmath.rect(0.4, turned)
        if not n % 10:
            nodes.append(template._replace(path=path, moment=moment, seconds=0.1 * n, rate_bias=bias))
    assert abs(path - 120.0) > 10.0
    windows = replay_paths(nodes, np.array([0, 15]))
    replayed, moved, turned_back = windows.get_last(0)
    assert abs(replayed - 120.0) < 0.5
    assert abs(moved - 4.0 * 0.5 * 30.0**2) < 20.0
    # by which the state has turned beside the former bias
    assert turned_back == pytest.approx(-turned, abs=0.005)
    # half-way the state had half of the new bias, and the heading of then
    shorter, _, turned_back = windows.get_last(1)
    assert abs(shorter) == pytest.approx(60.0, abs=0.5)
    assert cmath.phase(shorter) == pytest.approx(cmath.phase(nodes[-1].path - nodes[15].path) + 0.05, abs=0.05)
    assert turned_back == pytest.approx(0.5 * 0.01 * 15.0, abs=0.005)


@pytest.mark.parametrize("rate", [0.3, 0.5])
def test_given_fixes_that_drifted_at_a_rate_then_a_fit_excludes_it_only_where_it_could_show_it(rate: float) -> None:
    fit = DriftFit(
        turn=0.0, turn_sigma=0.01, drift=0.0, drift_sigma=0.01 * 120.0, tolerance=1.0, seconds=120.0, rest=1.0
    )
    assert fit.excludes(rate)
    # the same again, or what cannot be separated from it
    assert not fit._replace(drift=120.0 * rate).excludes(rate)
    assert not fit._replace(drift_sigma=60.0 * rate).excludes(rate)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_given_fixes_that_begin_to_drift_then_three_minutes_on_average_do_not_excuse_them(seed: int) -> None:
    fits = []
    for drift in (0j, 0.5j):
        *_, last = drive(300.0, Fault(270.0, drift=drift), seed)
        nodes = (*last.monitor.older, *last.monitor.newest)
        fits.append(fit_drift(nodes, last.monitor.rotation, NOISE, SETTINGS))
    usual, drifting = fits
    assert usual.rest < 0.5 * LARGEST_REST
    assert drifting.rest > LARGEST_REST
    steady = usual._replace(drift=0.0, drift_sigma=1.0)
    assert steady.is_steady
    assert not steady._replace(rest=drifting.rest).is_steady


@pytest.mark.parametrize(
    ("bias", "rate_sigma", "is_found"), [(0.0, 0.0003, False), (0.004, 0.0003, True), (0.004, 0.004, False)]
)
def test_given_fixes_that_turn_the_heading_by_the_bias_then_the_gyro_of_before_shows_it_where_it_was_known(
    bias: float, rate_sigma: float, is_found: bool
) -> None:
    # the heading is what the gyro with its present bias has; with that of before it is 14 deg off after a minute
    first = next(iter(drive(1.0, Fault()))).node
    start = first._replace(rate_variance=rate_sigma**2, is_measured=False, has_gyro=True)
    monitor, causes, end = FRESH, set(), start
    for n in range(61):
        t = float(n)
        end = start._replace(
            utime=start.utime + round(t * 1e6), seconds=start.seconds + t, bias_turn=bias * t, rate_bias=bias * (n > 0)
        )
        monitor = monitor.compare(end, NOISE, SETTINGS)
        found = monitor.find_cause(end, NOISE, SETTINGS)
        causes |= set() if found is None else {found.cause}
        monitor = monitor.append(end)
    assert abs(find_turn(start, end)) == pytest.approx(60.0 * bias)
    assert causes == ({Cause.HEADING} if is_found else set())


def test_given_hours_of_driving_then_the_nodes_are_few_and_none_is_too_old() -> None:
    *_, last = drive(400.0, Fault())
    nodes = (*last.monitor.older, *last.monitor.newest)
    assert len(nodes) < 70
    assert last.node.utime - nodes[0].utime <= LONGEST_US
    assert [each.utime for each in nodes] == sorted(each.utime for each in nodes)


def test_given_a_correction_by_a_fix_then_the_path_does_not_move() -> None:
    monitor = (
        ConsistencyMonitor()
        .extend(1_000_000, 0j, 0.0, is_measured=True)
        .extend(2_000_000, 3 + 0j, 0.0, is_measured=True)
    )
    moved = monitor.correct(5 - 2j, 0.5).extend(3_000_000, 8 - 2j + cmath.rect(2.0, 0.5), 0.0, is_measured=True)
    assert moved.path == pytest.approx(3 + 2 + 0j)
    assert moved.distance == pytest.approx(5.0)


def test_given_a_gap_in_the_fixes_then_the_path_begins_again() -> None:
    monitor = (
        ConsistencyMonitor()
        .extend(1_000_000, 0j, 0.0, is_measured=True)
        .extend(2_000_000, 3 + 0j, 0.0, is_measured=True)
        .extend(9_000_000, 50 + 0j, 0.0, is_measured=True)
    )
    assert monitor.begin == 9_000_000
    assert monitor.path == 0j


@pytest.mark.parametrize("turned", [0.1, 1.0, 2.0, 3.0, math.pi, -3.0, -0.5])
def test_given_a_path_that_is_turned_by_any_angle_then_that_angle_is_shown(turned: float) -> None:
    *_, end = drive(20.0, Fault())
    start = end.monitor.newest[0]
    way = cmath.rect(abs(end.node.path - start.path), turned) * cmath.rect(1.0, cmath.phase(end.node.path - start.path))
    fix = start.fix + cmath.rect(1.0, start.rotation) * way
    found = compare_window(start._replace(latency=0.0), end.node._replace(fix=fix, latency=0.0), NOISE, SETTINGS)
    assert math.remainder(found.turn - turned, math.tau) == pytest.approx(0.0, abs=1e-9)
    assert 0.0 < found.turn_sigma < 0.2


def test_given_a_heading_that_walks_then_its_path_is_uncertain_across_itself_by_the_mean_of_the_walk() -> None:
    *_, end = drive(20.0, Fault())
    start = end.monitor.newest[0]._replace(heading_variance=0.0, rate_variance=0.0, scale_variance=0.0)
    none, walking = (
        compare_window(start, end.node, NOISE._replace(heading=density), SETTINGS) for density in (0.0, 1e-8)
    )
    way, seconds = none.displacement, end.node.seconds - start.seconds
    east, north, _ = (b - a for a, b in zip(none.covariance, walking.covariance, strict=True))
    # the integral of (t / T)^2 along a straight way
    assert east + north == pytest.approx(1e-8 * seconds / 3.0 * abs(way) ** 2, rel=1e-3)


def test_given_wheels_that_slip_then_the_path_is_uncertain_by_its_length_and_by_its_time() -> None:
    *_, end = drive(20.0, Fault())
    start = end.monitor.newest[0]._replace(heading_variance=0.0, rate_variance=0.0, scale_variance=0.0)
    end_node = end.node._replace(lost=start.lost, unmeasured=start.unmeasured)
    found = compare_window(start, end_node, NOISE._replace(heading=0.0), SETTINGS)
    seconds, driven = end_node.seconds - start.seconds, end_node.distance - start.distance
    # white noises that last slip_time: one of the way, one of the time
    along = SETTINGS.slip_ratio**2 * driven**2 * SETTINGS.slip_time / seconds
    aside = SETTINGS.side_sigma**2 * SETTINGS.slip_time * seconds
    assert found.covariance == pytest.approx((along + aside, along + aside, 0.0))


def test_given_fixes_that_hardly_move_then_their_direction_shows_no_heading() -> None:
    *_, end = drive(20.0, Fault())
    start = end.monitor.newest[0]
    unmoved = compare_window(
        start._replace(latency=0.0), end.node._replace(fix=start.fix + 0.01j, latency=0.0), NOISE, SETTINGS
    )
    assert abs(unmoved.turn) < 0.01


def test_given_windows_that_are_fitted_together_then_each_cause_is_the_best_of_those_fitted_alone() -> None:
    *_, last = drive(60.0, Fault(50.0, rate=0.002), correlated=0.1)
    # as those of a state that has followed the fixes
    nodes = [
        each._replace(rate_bias=1e-4 * n, scale=1e-4 * n, rotation=1e-3 * n, unmeasured=0.01 * n)
        for n, each in enumerate((*last.monitor.older, *last.monitor.newest))
    ]
    together = find_causes(nodes, last.node, NOISE, SETTINGS)
    assert set(together) == {Cause.GNSS, Cause.GYRO, Cause.WHEELS, Cause.LATENCY, Cause.LEVER_ARM}
    alone = []
    for k in range(len(nodes)):
        # no window begins where the heading is not known
        others = [each if n == k else each._replace(heading_variance=1.0) for n, each in enumerate(nodes)]
        alone.append(find_causes(others, last.node, NOISE, SETTINGS))
    for cause, best in together.items():
        same = max((each[cause] for each in alone if cause in each), key=lambda each: each.explained)
        assert same.explained == pytest.approx(best.explained)
        assert same.change == pytest.approx(best.change)
        assert same.discrepancy.error == pytest.approx(best.discrepancy.error)
    assert find_causes([each._replace(heading_variance=1.0) for each in nodes], last.node, NOISE, SETTINGS) == {}

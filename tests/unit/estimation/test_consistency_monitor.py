"""Consistency monitor: which fault it finds, and what it leaves alone, on paths with fixes that are made here."""

from __future__ import annotations

import cmath
import copy
import itertools
import math
import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from modelserver.estimation.filter import protection_levels
from modelserver.estimation.filter.consistency_monitor import (
    AGREEMENT_TIME,
    LARGEST_HIDDEN,
    LONGEST_US,
    ConsistencyMonitor,
)
from modelserver.estimation.filter.path_fits import (
    LARGEST_REST,
    Cause,
    DriftFit,
    Inconsistency,
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
    jump: complex = 0j
    rate: float = 0.0
    scale: float = 0.0
    latency: float = 0.0
    shows_latency: bool = True
    lever_arm: complex = 0j


class Step(NamedTuple):
    """A fix in a drive."""

    t: float
    node: PathNode
    monitor: ConsistencyMonitor
    found: Inconsistency | None


@dataclass
class Vehicle:
    """A vehicle at 2 to 6 m/s that turns now and then, and whose fixes no state follows."""

    noise: random.Random
    monitor: ConsistencyMonitor
    is_measured: bool
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
        late = fault.latency * velocity if is_wrong else 0j
        arm = fault.lever_arm * cmath.rect(1.0, self.yaw) if is_wrong else 0j
        fix = self.truth + arm + self.wander + white + self.shift - late + (fault.jump if is_wrong else 0j)
        utime = 1_000_000 + round(t * 1e6)
        monitor = self.monitor.extend(utime, self.antenna, 0.0, is_measured=self.is_measured)
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
            is_measured=self.is_measured,
            own_heading=self.yaw + self.error,
            bias_turn=monitor.bias_turn,
            latency=0.0,
            latency_variance=0.02**2,
            shows_latency=fault.shows_latency,
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
        lost = fault.scale if is_wrong else 0.0
        self.antenna += velocity * cmath.rect(PERIOD * (1.0 - lost), self.error)
        self.yaw += PERIOD * (0.2 if math.sin(t / 15.0) > 0.5 else 0.0)
        return Step(t, node, monitor, found)


@cache
def drive_before(
    num_fixes: int, seed: int, is_measured: bool, correlated: float, shows_latency: bool
) -> tuple[Vehicle, tuple[Step, ...]]:
    """Return the vehicle and its fixes before a fault, which all faults that begin there share."""
    vehicle = Vehicle(random.Random(seed), FRESH, is_measured, correlated)
    none = Fault(shows_latency=shows_latency)
    return vehicle, tuple(vehicle.advance(n, none) for n in range(num_fixes))


def drive(
    seconds: float,
    fault: Fault,
    seed: int = 1,
    *,
    is_measured: bool = True,
    correlated: float = CORRELATED,
    start: ConsistencyMonitor = FRESH,
) -> Iterator[Step]:
    """Yield the fixes of a vehicle with a fault."""
    first = math.ceil(min(fault.begin, seconds) / PERIOD) if start is FRESH else 0
    before, steps = drive_before(first, seed, is_measured, correlated, fault.shows_latency)
    yield from steps
    vehicle = before.copy()
    if not first:
        vehicle.monitor = start
    for n in range(first, round(seconds / PERIOD)):
        yield vehicle.advance(n, fault)


def find(fault: Fault, seed: int = 1) -> Step:
    """Return where an inconsistency is found, and its cause decided."""
    found = list(itertools.islice((each for each in drive(fault.begin + 120.0, fault, seed) if each.found), 2))
    return next((each for each in found if each.found and each.found.cause is not Cause.GNSS), found[0])


@pytest.mark.parametrize("seed", range(6))
def test_given_fixes_as_the_model_has_them_then_nothing_is_found_and_the_bounds_hardly_grow(seed: int) -> None:
    steps = list(drive(600.0, Fault(), seed))
    assert all(each.found is None for each in steps)
    allowances = sorted(each.monitor.horizontal_allowance for each in steps)
    assert allowances[len(allowances) // 2] < CORRELATED


@pytest.mark.parametrize("drift", [0.3, 0.5j, -1.0, 3.0j])
@pytest.mark.parametrize("seed", range(3))
def test_given_fixes_that_drift_then_gnss_is_the_cause_before_the_bound_is_exceeded(drift: complex, seed: int) -> None:
    fault = Fault(200.0, drift=drift)
    last = None
    for each in drive(320.0, fault, seed):
        if each.found is not None:
            break
        last = each
    assert last is not None
    assert each.found is not None
    assert each.found.cause is Cause.GNSS
    drifted = abs(drift) * (each.t - fault.begin)
    # 5.6 sigma of a fix, and what the monitor allows for
    assert drifted < 5.6 * CORRELATED + last.monitor.horizontal_allowance + 2.0 * abs(drift)


@pytest.mark.parametrize("jump", [8.0, -30.0 + 40.0j])
def test_given_fixes_that_jump_then_it_is_a_jump_of_gnss_within_seconds(jump: complex) -> None:
    found = find(Fault(200.0, jump=jump))
    assert found.found is not None
    assert found.found.cause is Cause.GNSS
    assert found.found.is_jump
    assert found.t < 203.0
    # dead reckoning goes on from before it
    assert found.found.discrepancy.node.utime < 1_000_000 + 200_000_000


@pytest.mark.parametrize("rate", [0.02, -0.02])
def test_given_a_gyro_whose_bias_steps_then_it_is_found_to_be_the_cause_with_about_that_step(rate: float) -> None:
    steps = [find(Fault(200.0, rate=rate), seed) for seed in range(12)]
    assert all(each.t < 223.0 for each in steps)
    assert all(each.found and each.found.cause is Cause.GYRO for each in steps)
    assert all(each.found.change == pytest.approx(rate, rel=0.4) for each in steps if each.found)


@pytest.mark.parametrize("rate", [0.02, -0.03])
def test_given_a_gyro_that_has_turned_the_path_by_a_radian_then_its_change_is_found_and_no_drift(rate: float) -> None:
    steps = [each for each in drive(260.0, Fault(200.0, rate=rate)) if each.t >= 180.0]
    found = find_causes([each.node for each in steps[:-1:4]], steps[-1].node, NOISE, SETTINGS)
    assert found[Cause.GYRO].change == pytest.approx(rate, rel=0.12)
    # fixes that began to drift later leave the turn before unexplained
    rest = [each.explained for cause, each in found.items() if cause is not Cause.GYRO]
    assert max(rest) < 0.75 * found[Cause.GYRO].explained


@pytest.mark.parametrize("seed", range(6))
def test_given_a_gyro_whose_bias_steps_then_the_bound_covers_the_turn_until_it_is_found(seed: int) -> None:
    hidden, num_outside = [], 0
    for each in drive(120.0, Fault(60.0, rate=0.02 if seed % 2 else -0.02), seed):
        if each.t < 60.0:
            hidden.append(each.monitor.hidden)
            continue
        if each.found is not None:
            break
        level = protection_levels.compute_heading(each.node.heading_variance, SETTINGS)
        num_outside += 0.02 * (each.t - 60.0) > each.monitor.bound_heading(level, each.node.utime)
    else:
        pytest.fail("it was not found")
    assert num_outside <= 2  # 1 s
    # at 4 m/s a change is hidden for 8 s: 4 t^2 / 2 * 0.02 is three times 0.9 m then
    assert 0.1 < max(hidden) < 0.3
    assert hidden[0] == 0.0


def test_given_a_turn_that_may_be_hidden_then_it_alone_makes_no_pose_with_wheels_invalid() -> None:
    slow = FRESH._replace(hidden=2.0)

    assert slow.bound_heading(0.1, 0) == LARGEST_HIDDEN < 0.6
    assert slow.bound_heading(0.55, 0) == 0.55
    assert FRESH.bound_heading(0.1, 0) == 0.1


def test_given_wheels_that_no_longer_measure_then_a_turn_that_may_be_hidden_decays_instead_of_being_forgotten() -> None:
    *_, last = drive(60.0, Fault())
    hidden = last.monitor.hidden
    assert hidden > 0.05

    def find_hidden(monitor: ConsistencyMonitor, seconds: float) -> float:
        node = last.node._replace(
            utime=last.node.utime + round(seconds * 1e6), seconds=last.node.seconds + seconds, is_measured=False
        )
        return monitor._replace(older=(), newest=()).compare(node, NOISE, SETTINGS).hidden

    assert 0.97 * hidden < find_hidden(last.monitor, 1.0) < hidden
    assert find_hidden(last.monitor, 60.0) == pytest.approx(hidden / math.e, rel=0.05)
    assert find_hidden(last.monitor._replace(hidden=0.0), 1.0) == 0.0


@pytest.mark.parametrize(("cause", "lasts"), [(Cause.WHEELS, True), (Cause.GYRO, False)])
def test_given_a_path_that_begins_again_then_a_turn_that_may_be_hidden_lasts_unless_the_gyro_was_corrected(
    cause: Cause, lasts: bool
) -> None:
    *_, last = drive(60.0, Fault())
    hidden = last.monitor.hidden
    assert hidden > 0.05
    found = Inconsistency(cause, compare_window(last.monitor.newest[-2], last.node, NOISE, SETTINGS))
    after = last.monitor.resolve(found, last.node.utime).compare(last.node, NOISE, SETTINGS)
    assert after.hidden == pytest.approx(hidden if lasts else 0.0)
    # until the new path shows it
    known = last.monitor._replace(hidden=1.0).compare(last.node, NOISE, SETTINGS)
    assert known.hidden == pytest.approx(hidden, rel=0.1)


@pytest.mark.parametrize("scale", [0.15, -0.1])
def test_given_wheels_that_slip_then_they_are_the_cause(scale: float) -> None:
    found = find(Fault(200.0, scale=scale))
    assert found.found is not None
    assert found.found.cause is Cause.WHEELS
    assert found.found.change == pytest.approx(scale, rel=0.4)


def test_given_an_antenna_that_is_elsewhere_then_precise_fixes_show_where() -> None:
    fault = Fault(0.0, lever_arm=-0.4 + 0.3j)
    steps = [each for each in drive(300.0, fault, correlated=0.03) if each.found is not None]
    assert steps[0].found is not None
    assert steps[0].found.cause is Cause.LEVER_ARM
    assert abs(steps[0].found.lever_arm - fault.lever_arm) < 0.15
    assert all(each.found.cause is Cause.LEVER_ARM for each in steps if each.found)


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


def test_given_a_bound_that_shrinks_at_a_fix_then_it_takes_seconds_and_meters() -> None:
    monitor = ConsistencyMonitor().hold_heading(0.5, 1_000_000)
    driven = monitor._replace(distance=100.0)
    assert driven.bound_heading(0.1, 1_000_000) == pytest.approx(0.5)
    assert 0.1 < driven.bound_heading(0.1, 3_000_000) < 0.5
    assert driven.bound_heading(0.1, 60_000_000) == pytest.approx(0.1)
    # at rest fixes show no heading
    assert monitor.bound_heading(0.1, 60_000_000) == pytest.approx(0.5)
    assert 0.1 < monitor._replace(distance=2.0).bound_heading(0.1, 60_000_000) < 0.5
    # a clock that was set back
    assert driven.bound_heading(0.1, 0) == pytest.approx(0.5)


def test_given_a_speed_that_nothing_measures_then_the_bound_covers_the_course_of_fixes_beside_the_heading() -> None:
    # within a second the heading turns by 60 deg, and the vehicle does not
    steps = list(drive(200.0, Fault(100.0, 101.0, rate=1.0), is_measured=False))
    assert all(each.monitor.heading_allowance < 0.2 for each in steps if each.t < 100.0)
    straight = [each.monitor.heading_allowance for each in steps if 110.0 < each.t < 120.0]
    assert min(straight) > 0.5


def test_given_a_first_path_then_its_heading_is_confirmed_by_the_next_meters() -> None:
    first = ConsistencyMonitor().start_heading(CORRELATED, 4.0, is_measured=True)
    unmeasured = ConsistencyMonitor().start_heading(CORRELATED, 4.0, is_measured=False)
    assert math.radians(30.0) < first.heading_allowance < unmeasured.heading_allowance < math.radians(60.0)
    precise = ConsistencyMonitor().start_heading(0.02, 4.0, is_measured=False)
    assert precise.heading_allowance < math.radians(2.0)
    # at rest nothing confirms it
    assert first.extend(1_000_000, 0j, 0.0, is_measured=True).heading_allowance == first.heading_allowance
    driven = list(drive(60.0, Fault(), start=first))
    assert driven[1].monitor.heading_allowance > 0.9 * first.heading_allowance
    assert driven[-1].monitor.heading_allowance < 0.1


@pytest.mark.parametrize("drift", [0.3, 0.5j])
def test_given_fixes_that_drifted_then_they_are_trusted_where_they_are_only_if_that_drift_is_excluded(
    drift: complex,
) -> None:
    found = find(Fault(200.0, drift=drift))
    assert found.found is not None
    rate = found.monitor.resolve(found.found, found.node.utime).drift_rate
    assert 0.5 * abs(drift) < rate < 2.0 * abs(drift)
    fit = DriftFit(
        turn=0.0, turn_sigma=0.01, drift=0.0, drift_sigma=0.01 * 120.0, tolerance=1.0, seconds=120.0, rest=1.0
    )
    assert fit.excludes(rate)
    # the same again, or what cannot be separated from it
    assert not fit._replace(drift=120.0 * rate).excludes(rate)
    assert not fit._replace(drift_sigma=60.0 * rate).excludes(rate)


@pytest.mark.parametrize("seed", range(4))
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


def test_given_fixes_that_jumped_then_no_drift_has_to_be_excluded() -> None:
    found = find(Fault(200.0, jump=20.0))
    assert found.found is not None
    monitor = found.monitor.resolve(found.found, found.node.utime)
    assert monitor.is_jump
    assert monitor.drift_rate == 0.0


def test_given_a_gyro_that_has_changed_at_rest_then_fixes_that_contradicted_its_path_are_not_suspect() -> None:
    found = find(Fault(200.0, drift=1.0))
    assert found.found is not None
    suspect = found.monitor.resolve(found.found, found.node.utime)
    assert suspect.suspect is not None
    relearned = suspect.relearn(0.02, found.node.utime)
    assert relearned.suspect is None
    assert relearned.cause is Cause.GYRO
    # what drifts in its temperature does not explain it
    assert suspect.relearn(0.001, found.node.utime) is suspect


def test_given_fixes_that_jump_then_what_is_not_used_widens_no_bound() -> None:
    fault = Fault(200.0, 230.0, jump=40.0)
    found = next(each for each in drive(230.0, fault) if each.found is not None)
    assert found.found is not None
    monitor = found.monitor.resolve(found.found, found.node.utime)
    assert monitor.excludes_fixes
    later = monitor.compare(found.node._replace(utime=found.node.utime + 500_000), NOISE, SETTINGS)
    assert later.horizontal_allowance == monitor.horizontal_allowance
    assert later.heading_allowance == monitor.heading_allowance


def test_given_fixes_that_jump_then_the_bound_covers_how_far_a_heading_that_may_be_off_leads() -> None:
    found = next(each for each in drive(230.0, Fault(200.0, 230.0, jump=40.0)) if each.found is not None)
    assert found.found is not None
    before = found.monitor._replace(heading_allowance=0.5, horizontal_allowance=1.0)
    start = found.found.discrepancy.node.path
    monitor = before.resolve(found.found, found.node.utime)
    assert monitor.horizontal_allowance == pytest.approx(1.0 + math.sin(0.5) * abs(found.node.path - start))
    for n in range(1, 11):
        path = found.node.path + 2.0 * n * (found.node.path - start) / abs(found.node.path - start)
        node = found.node._replace(utime=found.node.utime + 500_000 * n, path=path)
        monitor = monitor.compare(node, NOISE, SETTINGS)
    assert monitor.heading_allowance == 0.5
    assert monitor.horizontal_allowance == pytest.approx(1.0 + math.sin(0.5) * abs(node.path - start))


@pytest.mark.parametrize("cause", [Cause.GYRO, Cause.WHEELS, Cause.LATENCY, Cause.LEVER_ARM])
def test_given_fixes_that_jumped_then_another_cause_that_is_corrected_ends_their_exclusion(cause: Cause) -> None:
    found = next(each for each in drive(230.0, Fault(200.0, 230.0, jump=40.0)) if each.found is not None)
    assert found.found is not None
    monitor = found.monitor.resolve(found.found, found.node.utime)._replace(largest=55.0)
    assert monitor.excludes_fixes
    corrected = monitor.resolve(found.found._replace(cause=cause), found.node.utime)
    assert not corrected.excludes_fixes
    # they may have jumped after all
    assert corrected.horizontal_allowance >= 55.0
    assert monitor.relearn(1.0, found.node.utime).suspicion >= 55.0
    # allowances fade again
    later = found.node._replace(utime=found.node.utime + 20_000_000)
    assert 0.0 < corrected.compare(later, NOISE, SETTINGS).horizontal_allowance < 0.75 * corrected.horizontal_allowance


def test_given_a_gyro_that_was_corrected_then_what_windows_show_since_widens_the_bound_beside_the_suspicion() -> None:
    *_, last = drive(60.0, Fault(40.0, drift=0.4))
    shown, both = (
        last.monitor._replace(suspicion=suspicion, horizontal_allowance=0.0, compared_utime=last.node.utime).compare(
            last.node, NOISE, SETTINGS
        )
        for suspicion in (0.0, 5.0)
    )
    assert shown.horizontal_allowance > 1.0
    assert both.horizontal_allowance == pytest.approx(shown.horizontal_allowance + 5.0)


def test_given_an_antenna_that_was_found_elsewhere_then_the_bound_of_the_heading_covers_how_it_moves_in_turns() -> None:
    *_, last = drive(60.0, Fault(), correlated=0.03)
    straight = last.monitor.compare(last.node, NOISE, SETTINGS)._replace(heading_allowance=0.0)
    turning = last.node._replace(own_heading=last.node.own_heading + 0.4)
    none, half, one = (
        straight._replace(lever_arm=arm).compare(turning, NOISE, SETTINGS).heading_allowance for arm in (0j, 0.5j, -1.0)
    )
    assert none < 0.01
    # 0.2 m beside the way of seconds
    assert 0.015 < half < 0.1
    assert one == pytest.approx(2.0 * half, rel=0.01)


def test_given_fixes_that_were_off_for_seconds_then_they_are_trusted_again_soon() -> None:
    fault = Fault(200.0, 203.0, jump=4.0)
    steps = drive(260.0, fault)
    found = next(each for each in steps if each.found is not None)
    assert found.found is not None
    assert found.found.cause is Cause.GNSS
    assert not found.found.is_jump
    monitor = found.monitor.resolve(found.found, found.node.utime)
    for each in drive(260.0, fault):
        if each.t > found.t:
            monitor, agrees = monitor.check_trust(each.node, NOISE, SETTINGS)
            if agrees:
                break
    assert agrees
    assert each.t < 203.0 + AGREEMENT_TIME + 5.0
    # what that agreement does not show is allowed for, and decays in a minute
    trusting = monitor._replace(compared_utime=each.node.utime).trust(each.node, NOISE, SETTINGS)
    assert monitor.suspect is not None
    assert trusting.suspicion > abs(compare_window(monitor.suspect, each.node, NOISE, SETTINGS).error)
    later = each.node._replace(utime=each.node.utime + 60_000_000)
    assert trusting.compare(later, NOISE, SETTINGS).suspicion == pytest.approx(trusting.suspicion / math.e, rel=0.01)


def test_given_a_path_that_becomes_vague_while_fixes_agree_then_they_are_trusted_and_else_not() -> None:
    fault = Fault(200.0, 203.0, jump=4.0)
    steps = drive(260.0, fault)
    found = next(each for each in steps if each.found is not None)
    assert found.found is not None
    resolved = found.monitor.resolve(found.found, found.node.utime)
    fix_sigma = math.hypot(found.node.white, found.node.correlated)

    def trusts(share: float, begin: float) -> bool:
        """Return whether they are trusted while the path's error is `share` of that of a fix from `begin` on, s."""
        monitor, agrees = resolved, False
        for each in drive(260.0, fault):
            if each.t > found.t and not agrees:
                assert monitor.suspect is not None
                driven = abs(each.node.path - monitor.suspect.path)
                sigma = share * fix_sigma / driven if each.t >= begin and driven > 1.0 else 1e-4
                vague = monitor.suspect._replace(heading_variance=sigma**2, scale_variance=sigma**2, rate_variance=0.0)
                monitor, agrees = monitor._replace(suspect=vague).check_trust(each.node, NOISE, SETTINGS)
        return agrees

    assert trusts(1.5, 207.0)
    assert not trusts(1.5, 203.0)
    assert not trusts(4.0, 207.0)


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


def test_given_one_outlier_then_nothing_is_found() -> None:
    fault = Fault(200.0, 200.9, jump=25.0)
    assert all(each.found is None for each in drive(260.0, fault))


def test_given_a_speed_that_nothing_measures_then_nothing_is_compared() -> None:
    steps = list(drive(300.0, Fault(100.0, drift=1.0), is_measured=False))
    assert all(each.found is None and each.monitor.horizontal_allowance == 0.0 for each in steps)


def test_given_fixes_that_come_back_after_a_drift_then_they_are_trusted_after_the_time_of_agreement() -> None:
    fault = Fault(200.0, 260.0, drift=0.5)
    steps = iter(drive(330.0, fault))
    found = next(each for each in steps if each.found is not None)
    assert found.found is not None
    trusted, since, largest = None, 0, 0.0
    for each in steps:
        monitor = each.monitor._replace(agreed_since=since, largest=largest)
        monitor, agrees = monitor.check_trust(each.node, NOISE, SETTINGS)
        since, largest = monitor.agreed_since, monitor.largest
        if agrees:
            trusted = each.t
            break
    assert trusted is not None
    assert fault.end + AGREEMENT_TIME <= trusted < fault.end + 3.0 * AGREEMENT_TIME


def test_given_hours_of_driving_then_the_nodes_are_few_and_none_is_too_old() -> None:
    *_, last = drive(1200.0, Fault())
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


def test_given_a_velocity_of_the_receiver_then_the_path_follows_the_wheels_for_a_while_and_else_the_state() -> None:
    *_, last = drive(60.0, Fault())
    monitor = last.monitor._replace(rotation=0.5, velocity_utime=last.node.utime)
    shift = cmath.rect(3.0, 0.5)
    longer = monitor.follow_wheels(shift, last.node.utime + 400_000)
    assert longer.path - monitor.path == pytest.approx(3.0)
    assert longer.moment - monitor.moment == pytest.approx(3.0 * last.node.seconds)
    # the fixes have not moved by it
    assert longer.anchor == monitor.anchor
    assert monitor.follow_wheels(shift, last.node.utime + 3_000_000) is monitor
    assert longer.restart().velocity_utime == last.node.utime


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


def test_given_fixes_that_hardly_move_then_their_direction_shows_no_heading() -> None:
    *_, end = drive(20.0, Fault())
    start = end.monitor.newest[0]
    unmoved = compare_window(
        start._replace(latency=0.0), end.node._replace(fix=start.fix + 0.01j, latency=0.0), NOISE, SETTINGS
    )
    assert abs(unmoved.turn) < 0.01


def test_given_a_latency_that_changes_then_it_is_the_cause_only_where_fixes_separate_it_from_the_heading() -> None:
    found = find(Fault(200.0, latency=0.6)).found
    assert found is not None
    assert found.cause is Cause.LATENCY
    assert found.change == pytest.approx(0.6, abs=0.2)
    hidden = [each.found for each in drive(320.0, Fault(200.0, latency=0.6, shows_latency=False)) if each.found]
    assert hidden
    assert all(each.cause is not Cause.LATENCY for each in hidden)


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

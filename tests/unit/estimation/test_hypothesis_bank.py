"""Dead reckoning and the hypothesis bank by themselves: increments, levels of the mixture, and what fixes settle."""

from __future__ import annotations

import cmath
import math
from itertools import pairwise

import numpy as np
import pytest

from modelserver.estimation.filter.hypothesis_bank import (
    DeadReckoning,
    Fault,
    HypothesisBank,
    Increment,
    PlanarFix,
    start_bank,
)
from modelserver.estimation.filter.protection_levels import LEVEL_RISK
from modelserver.estimation.filter.settings import FilterSettings

SETTINGS = FilterSettings()
SIGMA, SLIP, SPEED = 1.0, 0.01, 3.0
LIMITS = (36.0, 0.6)


def turn_on_circle(rate: float, seconds: float, bias: float = 0.0) -> list[DeadReckoning]:
    """Return dead reckoning each second of a circle at SPEED, with a gyro at 100 Hz and wheels at 5 Hz."""
    found, reckoning = [], DeadReckoning()
    for n in range(round(seconds * 100) + 1):
        utime = 1_000_000 + n * 10_000
        reckoning = reckoning.follow_gyro(utime, rate + bias, 0.0)
        if n % 20 == 0:
            reckoning = reckoning.drive(utime, SPEED * 0.2)
        if n % 100 == 0:
            found.append(reckoning)
    return found


@pytest.mark.parametrize("rate", [0.0, 0.3, -1.0])
def test_given_a_circle_then_increments_are_its_chords_in_their_own_heading(rate: float) -> None:
    for start, end in pairwise(turn_on_circle(rate, 20.0)):
        step = end.since(start, is_stationary=False, are_wheels_stationary=False)
        chord = SPEED * (1.0 if rate == 0.0 else (cmath.exp(1j * rate) - 1.0) / (1j * rate))
        assert (step.seconds, step.turn) == pytest.approx((1.0, rate))
        assert abs(step.path - chord) < 1e-6
        # the moment is the path's, half a second after its begin on the mean
        assert abs(step.moment - 0.5 * chord) < 0.1 * SPEED * abs(rate) + 1e-6
        assert step.driven == pytest.approx(SPEED)


def test_given_a_bias_then_the_moment_has_the_path_that_it_bends() -> None:
    bias = 0.01
    right, wrong = turn_on_circle(0.4, 20.0), turn_on_circle(0.4, 20.0, bias)
    for (a, b), (c, d) in zip(pairwise(right), pairwise(wrong), strict=True):
        true, bent = (
            b.since(a, is_stationary=False, are_wheels_stationary=False),
            d.since(c, is_stationary=False, are_wheels_stationary=False),
        )
        assert abs(bent.path - 1j * bias * bent.moment - true.path) < 1e-3


def start(heading_sigma: float = 0.05) -> HypothesisBank:
    """Return a bank at the origin, heading east."""
    variances = (SIGMA**2, SIGMA**2, heading_sigma**2, 0.0, 0.0, 0.0, SIGMA**2, SIGMA**2)
    return start_bank(0, SIGMA, SETTINGS, np.zeros(8), np.diag(variances))


def drive(bank: HypothesisBank, seconds: int, shift: complex = 0j, turn: float = 0.0) -> HypothesisBank:
    """Return the bank after a drive east with a fix each second, off by `shift`; the gyro errs by `turn`, rad/s."""
    noise = np.random.default_rng(1)
    begin = round(bank.utime * 1e-6)
    for t in range(begin + 1, begin + seconds + 1):
        step = Increment(1.0, turn, complex(SPEED), complex(0.5 * SPEED), SPEED)
        x, y = (0.15 * SIGMA * noise.standard_normal(2)).tolist()
        fix = PlanarFix(complex(SPEED * t + x, y) + shift, SIGMA, 0j, complex(SPEED), 0.0)
        bank = bank.advance(t * 1_000_000, step, fix, SETTINGS, SLIP).judge_fixes(LIMITS[0])
    return bank


def test_given_good_fixes_then_nothing_is_suspected_and_the_pose_is_theirs() -> None:
    bank = drive(start(), 60)
    assert not bank.is_suspect
    assert not bank.excludes_fixes
    x, y, heading = bank.pose
    assert math.hypot(x - 60.0 * SPEED, y) < 1.0
    assert abs(heading) < 0.02
    bounds = bank.compute_bounds(bank.pose, LIMITS, SETTINGS)
    assert bounds.horizontal_level < 5.0 * SIGMA
    assert bounds.horizontal_level < bounds.horizontal_protection
    assert bounds.risk < 1e-6


def test_given_fixes_that_jump_then_they_are_excluded_and_used_again_once_they_are_back() -> None:
    good = drive(start(), 60)
    jumped = drive(good, 10, shift=30j)
    assert jumped.excludes_fixes
    assert abs(jumped.offset - 30j) < 3.0
    assert math.hypot(jumped.pose[0] - 70.0 * SPEED, jumped.pose[1]) < 2.0
    back = drive(jumped, 5)
    assert not back.excludes_fixes
    # one fix settles nothing
    once = drive(good, 1, shift=30j)
    assert not once.excludes_fixes
    assert once.pose[1] == pytest.approx(good.pose[1], abs=0.5)


def rest(bank: HypothesisBank, seconds: int, speed: float, turn: float = 0.0) -> HypothesisBank:
    """Return the bank after seconds with wheels at rest, while fixes move north and the gyro turns, rad/s."""
    begin = round(bank.utime * 1e-6)
    for t in range(begin + 1, begin + seconds + 1):
        step = Increment(1.0, turn, 0j, 0j, 0.0, are_wheels_stationary=True)
        fix = PlanarFix(complex(begin * SPEED, speed * (t - begin)), SIGMA, 0j, 0j, 0.0)
        bank = bank.advance(t * 1_000_000, step, fix, SETTINGS, SLIP).judge_fixes(LIMITS[0])
    return bank


@pytest.mark.parametrize("turn", [0.0, 0.02])
def test_given_fixes_that_move_away_from_wheels_at_rest_then_the_vehicle_may_be_transported(turn):
    bank = rest(drive(start(), 60), 40, 1.0, turn)

    assert bank.excludes_fixes
    assert bank.may_be_transported
    # of the last minute
    assert bank.rest_turn == pytest.approx(60.0 * turn * (1.0 - math.exp(-40.0 / 60.0)), abs=0.1)


def test_given_fixes_that_drift_on_while_it_drives_then_the_vehicle_is_not_transported():
    parked = rest(drive(start(), 60), 40, 1.0)
    bank = parked
    for n in range(60):
        bank = drive(bank, 1, shift=complex(-40.0 * SPEED, 41.0 + n))

    assert bank.excludes_fixes
    assert not bank.may_be_transported


def test_given_a_gyro_that_errs_then_it_is_named_once_it_is_certain_and_the_heading_is_right() -> None:
    bank = drive(start(), 60)
    faults = []
    for _ in range(60):
        bank = drive(bank, 1, turn=0.02)
        faults.append(bank.settled)
    assert {each for each in faults if each} <= {Fault.GYRO}
    assert bank.means[bank.published, 3] == pytest.approx(0.02, abs=0.004)
    assert abs(bank.pose[2]) < 0.05


def test_given_a_mixture_then_levels_and_risks_are_its_tails() -> None:
    bank = start()
    weights = np.array((0.9, 0.099, 0.001))
    means = np.repeat(bank.means, 3, axis=0)
    means[1, 0], means[2, 0] = 3.0, 30.0
    labels = np.zeros(3, np.int64)
    covariances = np.repeat(bank.covariances, 3, axis=0)
    mixture = bank._replace(means=means, covariances=covariances, weights=weights, faults=labels, jumped=labels)
    bounds = mixture.compute_bounds((0.0, 0.0, 0.0), (20.0, 0.6), SETTINGS)
    rng = np.random.default_rng(1)
    size = 2_000_000
    sigma = math.hypot(SIGMA, 0.1)
    offset = rng.choice((0.0, 3.0, 30.0), size, p=weights)
    errors = np.abs(offset + sigma * (rng.standard_normal(size) + 1j * rng.standard_normal(size)))
    # the bound of a tail is that along the worst direction
    assert 0.0 < np.mean(errors > bounds.horizontal_level) <= 1.1 * LEVEL_RISK
    assert np.mean(errors > 20.0) <= bounds.horizontal_risk < 1.2e-3
    assert bounds.horizontal_level > 30.0


def test_given_the_same_samples_then_the_same_bits() -> None:
    one, other = drive(start(), 80, shift=2 + 1j), drive(start(), 80, shift=2 + 1j)
    assert one.means.tobytes() == other.means.tobytes()
    assert one.weights.tobytes() == other.weights.tobytes()


def test_given_extreme_fixes_then_the_weights_remain_finite() -> None:
    bank = drive(start(), 20)
    for shift in (1e9 + 0j, 1e-9j, -1e6j):
        bank = drive(bank, 2, shift=shift)
        assert np.isfinite(bank.means).all()
        assert np.isfinite(bank.covariances).all()
        assert bank.weights.sum() == pytest.approx(1.0)
    x, y, _ = drive(bank, 30).pose
    assert math.hypot(x - 56.0 * SPEED, y) < 3.0


@pytest.mark.parametrize("off", [0.5, 1.0, -2.6, 3.1, -1.2])
def test_given_dead_reckoning_that_was_lost_then_the_hypothesis_that_fixes_are_right_wins(off: float):
    """A heading that is off on a circle after an outage with a wrong gyro."""
    noise = np.random.default_rng(2)
    rate, chord = 0.1, SPEED * cmath.rect(1.0, 0.05)
    step = Increment(1.0, rate, chord, 0.5 * chord, SPEED)
    bank, place = start(0.001), 0j
    for t in range(1, 91):
        heading = off + rate * t
        place += chord * cmath.rect(1.0, heading - rate)
        x, y = (0.15 * SIGMA * noise.standard_normal(2)).tolist()
        fix = PlanarFix(place + complex(x, y), SIGMA, 0j, complex(SPEED), rate)
        before = bank
        bank = bank.advance(t * 1_000_000, step, fix, SETTINGS, SLIP).judge_fixes(LIMITS[0])
        if bank.excludes_fixes and not before.excludes_fixes:
            bank = bank.suspect_path(t * 1_000_000, fix, SETTINGS)

    assert not bank.excludes_fixes
    x, y, heading = bank.pose
    assert abs(complex(x, y) - place) < 3.0
    assert math.remainder(heading - off - 90 * rate, math.tau) == pytest.approx(0.0, abs=0.1)

"""Noise parameters from stationary IMUs, against simulated noise of known strength."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import lfilter

from mstools.calibration import CalibrationError, find_gap_free_ranges, find_stationary_ranges, median_period
from mstools.calibration.allan import (
    INSTABILITY_FLOOR,
    AllanCurve,
    NoiseParameters,
    allan_deviation,
    cluster_sizes,
    fit_noise_parameters,
)

Series = npt.NDArray[np.float64]

WHITE, WALK, RATE = 1e-3, 3.5e-5, 20.0


def simulate_series(seconds: float, seed: int, white: float = WHITE, walk: float = WALK, ramp: float = 0.0) -> Series:
    """Return white noise N, a random walk K and a ramp, about a bias of 0.01, sampled at RATE."""
    chance = np.random.default_rng(seed)
    count = round(seconds * RATE)
    series: Series = chance.normal(0.01, white * math.sqrt(RATE), count)
    series += np.cumsum(chance.normal(0.0, walk / math.sqrt(RATE), count)) + ramp * np.arange(count) / RATE
    return series


def fit_simulated_series(seconds: float, seed: int, **noise: float) -> NoiseParameters:
    return fit_noise_parameters(allan_deviation(simulate_series(seconds, seed, **noise), RATE))


# --- the deviation itself -----------------------------------------------------------------------------------


def test_given_ten_samples_when_worked_out_by_hand_then_the_same() -> None:
    # one sample a cluster: half the mean squared step. Steps 1, -3, 4, -2, 0, 1, -1, 2, -2: squares sum to 40
    values = [1.0, 2.0, -1.0, 3.0, 1.0, 1.0, 2.0, 1.0, 3.0, 1.0]
    curve = allan_deviation(values, 2.0)
    assert curve.taus == (0.5, 1.0)
    assert curve.deviations[0] == pytest.approx(math.sqrt(40.0 / 9.0 / 2.0), rel=1e-12)
    # two samples a cluster, overlapping: means 1.5 .5 1 2 1 1.5 1.5 2 2, two apart -.5 1.5 0 -.5 .5 .5 .5
    assert curve.deviations[1] == pytest.approx(math.sqrt(3.5 / 7.0 / 2.0), rel=1e-12)
    assert curve.clusters == (10.0, 5.0)
    assert curve.relative_errors[1] == pytest.approx(1.0 / math.sqrt(2.0 * 4.0))  # IEEE 952 C.1
    assert curve.seconds == 5.0


def test_given_a_large_bias_when_worked_out_then_it_counts_for_nothing() -> None:
    series = simulate_series(60.0, 1)
    assert allan_deviation(series + 1e6, RATE).deviations == pytest.approx(
        allan_deviation(series, RATE).deviations, rel=1e-5
    )


def test_given_a_long_series_then_averaging_times_are_even_in_the_logarithm() -> None:
    sizes = cluster_sizes(100_000)
    assert sizes[0] == 1
    assert sizes[-1] <= 20_000
    assert len(sizes) == len(set(sizes)) <= 44
    assert cluster_sizes(10) == [1, 2]


@pytest.mark.parametrize("values", [[], [1.0] * 9, [1.0, math.nan] * 10, [1.0, math.inf] * 10])
def test_given_too_little_or_no_numbers_when_worked_out_then_refused(values: list[float]) -> None:
    with pytest.raises(CalibrationError, match=r"record longer|remove missing"):
        allan_deviation(values, RATE)


# --- figures ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_given_simulated_noise_when_read_then_white_noise_and_walk_are_found_within_their_errors() -> None:
    pulls: dict[str, list[float]] = {"white": [], "walk": []}
    for seed in range(20):
        found = fit_simulated_series(3600.0, seed)
        assert found.white is not None
        pulls["white"].append((found.white.value - WHITE) / found.white.sigma)
        if found.random_walk is not None:
            pulls["walk"].append((found.random_walk.value - WALK) / found.random_walk.sigma)
    assert len(pulls["walk"]) >= 19
    for each in pulls.values():
        # the mean square of deviations in units of their error is 1, give or take a third for 20 of them
        assert 0.4 < float(np.mean(np.square(each))) < 2.2
        assert abs(float(np.mean(each))) < 0.8


def test_given_a_minute_when_read_then_white_noise_alone() -> None:
    for seed in range(10):
        found = fit_simulated_series(60.0, seed)
        assert found.white is not None
        assert found.white.value == pytest.approx(WHITE, rel=0.1)
        assert (found.random_walk, found.instability) == (None, None)
        assert len(found.missing) == 2
        assert all("record 10 minutes or more while stationary" in each for each in found.missing)


@pytest.mark.slow
def test_given_flicker_when_read_then_the_floor_gives_the_instability() -> None:
    # flicker, 1/f: walks that forget, one for each factor of 4 in time, all equally strong
    instabilities = []
    for seed in range(10):
        series = simulate_series(3600.0, seed, walk=0.0)
        chance = np.random.default_rng(100 + seed)
        for exponent in range(10):
            memory = math.exp(-1.0 / (4.0**exponent * RATE / 4.0))
            pushes = chance.normal(0.0, 4e-4 * math.sqrt(1.0 - memory**2), series.size)
            series += lfilter([1.0], [1.0, -memory], pushes)
        found = fit_noise_parameters(allan_deviation(series, RATE))
        if found.instability is not None:
            instabilities.append(found.instability.value * INSTABILITY_FLOOR / 4e-4)
    # the sum of these walks has a floor of their strength, within a tenth; a minimum is somewhat below it
    assert len(instabilities) >= 6
    assert float(np.mean(instabilities)) == pytest.approx(0.9, abs=0.2)


@pytest.mark.slow
def test_given_a_warming_unit_when_read_then_a_ramp_is_not_called_a_walk() -> None:
    for seed in range(5):
        found = fit_simulated_series(3600.0, seed, walk=0.0, ramp=3e-6)
        assert found.random_walk is None
        assert "ramps" in found.missing[-1]
        assert "warm up" in found.missing[-1]


def test_given_a_frozen_imu_then_no_parameter_is_found() -> None:
    found = fit_noise_parameters(allan_deviation([0.25] * 1000, RATE))
    assert (found.white, found.instability, found.random_walk) == (None, None, None)
    assert "frozen" in found.missing[0]


def test_given_coarse_steps_over_the_noise_when_read_then_no_white_noise_is_invented() -> None:
    # a vibration at 0.8 s in place of noise: the deviation falls and rises, never as white noise does
    times = np.arange(12_000) / RATE
    found = fit_noise_parameters(allan_deviation(np.sin(2 * np.pi * times / 0.8), RATE))
    assert found.white is None
    assert "vibration" in found.missing[0]


def test_given_a_curve_by_hand_when_read_then_the_values_of_the_lines() -> None:
    taus = tuple(10.0 ** (n / 10.0) for n in range(-10, 31))
    deviations = tuple(math.sqrt(WHITE**2 / tau + WALK**2 * tau / 3.0) for tau in taus)
    curve = AllanCurve(taus, deviations, tuple(1e4 / tau for tau in taus), 1e4)
    found = fit_noise_parameters(curve)
    assert found.white is not None
    assert found.random_walk is not None
    assert found.white.value == pytest.approx(WHITE, rel=1e-3)
    assert found.random_walk.value == pytest.approx(WALK, rel=1e-3)


# --- stretches ----------------------------------------------------------------------------------------------


def stamps_of(*pieces: tuple[float, float]) -> npt.NDArray[np.int64]:
    return np.concatenate([np.arange(round(a * 1e6), round(b * 1e6), 20_000) for a, b in pieces])


def test_given_gaps_and_a_clock_set_back_when_split_then_the_stretches_between() -> None:
    stamps = stamps_of((0.0, 10.0), (10.5, 40.0), (30.0, 35.0))
    found = find_gap_free_ranges(stamps)
    assert [(each.stop - each.start) for each in found] == [500, 1475, 250]
    assert found[1].rate_hz == pytest.approx(50.0)
    # a single lost sample is no gap
    assert len(find_gap_free_ranges(np.delete(stamps_of((0.0, 10.0)), 100))) == 1


def test_given_stamps_that_do_not_advance_then_they_are_rejected() -> None:
    for stamps in ([5, 5, 5], [1], []):
        with pytest.raises(CalibrationError, match="clock"):
            median_period(stamps)


def test_given_a_drive_between_two_stops_then_both_stops_are_found_and_nothing_else() -> None:
    chance = np.random.default_rng(2)
    stamps = stamps_of((0.0, 120.0))
    rates = chance.normal(0.003, 5e-3, (6000, 3))
    forces = chance.normal((0.0, 9.8, 0.0), 0.02, (6000, 3))
    moving = slice(round(40.3 * 50), round(70.7 * 50))
    forces[moving] += chance.normal(0.0, 0.5, forces[moving].shape)
    first, second = find_stationary_ranges(stamps, rates, forces)
    assert (first.start, first.stop) == (0, 40 * 50)
    assert (second.start, second.stop) == (71 * 50, 6000)


def test_given_a_steady_turn_then_the_vehicle_is_not_stationary() -> None:
    chance = np.random.default_rng(2)
    stamps = stamps_of((0.0, 60.0))
    rates, forces = chance.normal(0.0, 5e-3, (3000, 3)), chance.normal(0.0, 0.02, (3000, 3))
    assert len(find_stationary_ranges(stamps, rates, forces)) == 1
    rates[:, 2] += 0.2
    assert find_stationary_ranges(stamps, rates, forces) == ()
    rates[:1500, 2] -= 0.2 - 0.03  # a slow turn, then a fast one: only the former might be a bias
    assert [each.stop for each in find_stationary_ranges(stamps, rates, forces)] == [1500]


def test_given_half_a_second_then_no_stationary_range_is_found() -> None:
    assert find_stationary_ranges(stamps_of((0.0, 0.5)), np.zeros((25, 3)), np.zeros((25, 3))) == ()

"""Hard and soft iron from simulated turns."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest

from modelserver.transforms import so3
from mstools.calibration import CalibrationError
from mstools.calibration.ellipsoid import MagnetometerFit, fit_level, project_to_level

Fields = npt.NDArray[np.float64]

HORIZONTAL, VERTICAL = 19.8e-6, -48e-6
STRENGTH = math.hypot(HORIZONTAL, VERTICAL)
HARD = np.array([5e-6, -8e-6, 3e-6])
SOFT = np.array([[1.1, 0.05, 0.0], [0.05, 0.92, 0.0], [0.0, 0.0, 1.0]])
NOISE = 1e-7
UP = (0.0, 0.0, 9.8)


def on_circle(turns: float, count: int = 2000, seed: int = 0, noise: float = NOISE) -> tuple[Fields, Fields]:
    """Return what a unit feels on a vehicle that turns on the level, and the earth's field along its axes."""
    yaw = np.linspace(0.0, 2.0 * np.pi * turns, count)
    field = np.column_stack((HORIZONTAL * np.cos(yaw), -HORIZONTAL * np.sin(yaw), np.full(count, VERTICAL)))
    return field @ SOFT.T + HARD + np.random.default_rng(seed).normal(0.0, noise, field.shape), field


def heading_error(found: MagnetometerFit, felt: Fields, true: Fields) -> Fields:
    """Return how far the calibrated field's directions in the level are off, radians."""
    got = found.apply(felt)
    off = np.arctan2(got[:, 1], got[:, 0]) - np.arctan2(true[:, 1], true[:, 0])
    wrapped: Fields = np.remainder(off + np.pi, 2.0 * np.pi) - np.pi
    return wrapped


def soft(found: MagnetometerFit) -> Fields:
    return np.array(found.soft_iron).reshape(3, 3)


# --- a vehicle that turns on the level ----------------------------------------------------------------------


def test_given_two_full_turns_when_fitted_then_hard_and_soft_iron_are_found() -> None:
    felt, true = on_circle(2.0)
    found = fit_level(felt, UP, HORIZONTAL, VERTICAL)
    assert found.hard_iron == pytest.approx(HARD, abs=1.5e-8)
    assert soft(found) @ SOFT == pytest.approx(np.eye(3), abs=2e-3)
    assert soft(found) == pytest.approx(soft(found).T, abs=0.0)
    assert found.sectors == (True,) * 12
    assert (found.samples, found.outliers, found.is_strength_known) == (2000, 0, True)
    assert found.rms == pytest.approx(NOISE, rel=0.1)
    errors = heading_error(found, felt, true)
    assert float(np.std(errors)) == pytest.approx(found.heading_rms, rel=0.3)
    assert abs(float(np.mean(errors))) < 1e-3
    assert np.linalg.norm(found.apply(felt), axis=1) == pytest.approx(STRENGTH, rel=0.02)


def test_given_samples_without_noise_when_fitted_then_exact() -> None:
    felt, _ = on_circle(1.5, noise=0.0)
    found = fit_level(felt, UP, HORIZONTAL, VERTICAL)
    assert found.hard_iron == pytest.approx(HARD, abs=1e-14)
    assert soft(found) @ SOFT == pytest.approx(np.eye(3), abs=1e-8)


def test_given_a_unit_mounted_askew_when_fitted_then_as_if_upright() -> None:
    felt, true = on_circle(2.0)
    R = np.array(so3.matrix_rows(so3.from_rpy(1.2, 0.3, -0.8)))  # the unit's axes from the upright ones
    found = fit_level(felt @ R.T, tuple(R @ (0.0, 0.0, 9.8)), HORIZONTAL, VERTICAL)
    assert found.hard_iron == pytest.approx(R @ HARD, abs=1.5e-8)
    assert R.T @ soft(found) @ R @ SOFT == pytest.approx(np.eye(3), abs=2e-3)
    assert np.linalg.norm(project_to_level(found.apply(felt @ R.T), tuple(R @ UP)), axis=1) == pytest.approx(
        HORIZONTAL, abs=6 * NOISE
    )
    assert len(true) == 2000


def test_given_no_place_when_fitted_then_the_mean_radius_and_no_vertical_iron() -> None:
    felt, true = on_circle(2.0)
    found = fit_level(felt, UP)
    assert not found.is_strength_known
    assert found.strength == pytest.approx(HORIZONTAL * math.sqrt(float(np.linalg.det(SOFT))), rel=1e-3)
    assert np.linalg.det(soft(found)) == pytest.approx(1.0)
    assert found.hard_iron[2] == 0.0
    assert float(np.abs(heading_error(found, felt, true)).max()) < 0.03


def test_given_a_truck_that_passes_and_missing_samples_when_fitted_then_they_count_for_nothing() -> None:
    felt, _ = on_circle(2.0, seed=3)
    felt[300:520] += (15e-6, 10e-6, 0.0)
    felt[700:720, 1] = math.nan
    felt[900] = math.inf
    found = fit_level(felt, UP, HORIZONTAL, VERTICAL)
    assert found.hard_iron == pytest.approx(HARD, abs=2.5e-8)
    assert 190 <= found.outliers <= 230
    assert found.samples == 2000 - 21


def test_given_a_long_stop_before_the_turn_when_fitted_then_it_does_not_outweigh_the_turn() -> None:
    felt, true = on_circle(2.0, seed=4)
    # while it is stationary, a generator nearby shifts the field a little
    stationary = np.tile(felt[0] + (0.4e-6, 0.0, 0.0), (20_000, 1)) + np.random.default_rng(9).normal(
        0, 2e-8, (20_000, 3)
    )
    found = fit_level(np.concatenate((stationary, felt)), UP, HORIZONTAL, VERTICAL)
    assert float(np.abs(heading_error(found, felt, true)).mean()) < 0.02
    assert found.outliers < 200


@pytest.mark.parametrize("turns", [0.25, 0.5, 0.7])
def test_given_part_of_a_circle_when_fitted_then_the_error_has_what_to_do(turns: float) -> None:
    felt, _ = on_circle(turns, seed=5)
    with pytest.raises(CalibrationError, match="full circle"):
        fit_level(felt, UP, HORIZONTAL, VERTICAL)


def test_given_most_of_a_circle_when_fitted_then_it_is_enough() -> None:
    felt, _ = on_circle(0.85, seed=5)
    found = fit_level(felt, UP, HORIZONTAL, VERTICAL)
    assert sum(found.sectors) in (10, 11)
    assert found.hard_iron == pytest.approx(HARD, abs=5e-8)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("known", [True, False])
def test_given_a_stationary_vehicle_when_fitted_then_its_noise_is_not_taken_for_a_circle(
    seed: int, known: bool
) -> None:
    felt, _ = on_circle(0.0, seed=seed)
    with pytest.raises(CalibrationError, match="turn"):
        fit_level(felt, UP, HORIZONTAL if known else math.nan, VERTICAL)


@pytest.mark.parametrize(
    ("felt", "words"),
    [
        (np.zeros((0, 3)), "too few"),
        (np.full((500, 3), math.nan), "0 samples are too few"),
        (np.full((500, 3), 2e-5), "frozen"),
        (on_circle(2.0)[0] * 1e4, "gauss"),
        (np.outer(np.linspace(-1e-5, 1e-5, 500), (1.0, 1.0, 1.0)), "no ellipse"),
    ],
)
def test_given_samples_of_no_turn_when_fitted_then_they_are_rejected_with_one_clear_reason(
    felt: Fields, words: str
) -> None:
    with pytest.raises(CalibrationError, match=words):
        fit_level(felt, UP, HORIZONTAL, VERTICAL)


@pytest.mark.parametrize("up", [(0.0, 0.0, 0.0), (math.nan, 0.0, 9.8)])
def test_given_no_gravity_when_fitted_then_a_direction_of_up_is_required(up: tuple[float, float, float]) -> None:
    with pytest.raises(CalibrationError, match="up must be a direction"):
        fit_level(on_circle(2.0)[0], up)

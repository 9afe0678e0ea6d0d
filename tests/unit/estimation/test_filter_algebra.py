"""ErrorLayout of the error state, the filter's algebra against plain numpy, and its gate against scipy."""

from __future__ import annotations

import inspect
import math
import sys

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy import stats
from support_cart import rig, some_nav

from modelserver.estimation.filter import eskf, protection_levels
from modelserver.estimation.filter.eskf import STRAPDOWN, ErrorLayout, ErrorState
from modelserver.estimation.filter.measurements import Innovation
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filter.state import Setup
from modelserver.estimation.filterpy_import import import_kalman_filter
from modelserver.messages import Verdict

SETTINGS = FilterSettings()
SETUP = Setup(rig())


# --- layout -------------------------------------------------------------------------------------------------


def test_given_additional_states_then_they_follow_the_strapdown_states_in_their_order():
    layout = ErrorLayout((ErrorState(("a", "b"), 2.0, time_constant=4.0), ErrorState(("c",), 0.5, walk=0.1)))
    assert (layout.size, layout.index("position_east"), layout.index("accelerometer_bias_z")) == (18, 0, 14)
    assert [layout.index(name) for name in ("a", "b", "c")] == [15, 16, 17]
    assert [layout.extra_index(name) for name in ("a", "b", "c")] == [0, 1, 2]
    assert layout.names[STRAPDOWN:] == layout.extra_names == ("a", "b", "c")
    assert layout.extra_sigmas == (2.0, 2.0, 0.5)
    assert layout.decay_rates.tolist() == [0.25, 0.25, 0.0]
    # the noise density of a Gauss-Markov process of steady variance s^2 is 2 s^2 / T, of a random walk its square
    assert layout.noise_densities == pytest.approx([2.0, 2.0, 0.01])
    assert "b" in layout
    assert "d" not in layout
    with pytest.raises(KeyError):
        layout.index("d")


def test_given_a_state_that_two_need_then_it_is_there_once_and_another_of_its_name_is_rejected():
    state = ErrorState(("a",), 1.0)
    assert ErrorLayout((state, state)).size == STRAPDOWN + 1
    with pytest.raises(ValueError, match="an error state is declared twice: a"):
        ErrorLayout((state, ErrorState(("a",), 2.0)))
    with pytest.raises(ValueError, match="gyro_bias_x"):
        ErrorLayout((ErrorState(("gyro_bias_x",), 1.0),))


def test_given_a_vehicle_without_wheels_then_its_layout_has_no_wheel_states():
    assert "wheel_scale" in SETUP.layout
    assert "wheel_scale" not in Setup(rig(wheels=())).layout


# --- algebra ------------------------------------------------------------------------------------------------


def create_covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    A = rng.normal(size=(n, n))
    return A @ A.T + 0.1 * np.eye(n)


def predict(P: np.ndarray, F: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """Return the covariance that the filter propagates with given matrices instead of those of its state."""
    nav = some_nav(SETUP, 1)._replace(covariance=P, lag=0.1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(eskf, "_transition_matrix", lambda *_: F)
        patch.setattr(eskf, "_process_noise_matrix", lambda *_: Q)
        return eskf.propagate_covariance(nav, SETUP.driving, SETUP.layout).covariance


@pytest.mark.parametrize("m", [1, 2, 3, 6])
@pytest.mark.parametrize("seed", range(5))
def test_given_any_numbers_when_corrected_then_the_result_is_that_of_the_formulas(seed, m):
    rng = np.random.default_rng(seed)
    n = 20
    P, H, R, r = create_covariance(rng, n), rng.normal(size=(m, n)), create_covariance(rng, m), rng.normal(size=m)
    unchanged = P.copy()
    error, after = eskf.correct(P, r, H, R)
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    assert error == pytest.approx(K @ r)
    assert after == pytest.approx((np.eye(n) - K @ H) @ P, abs=1e-9)
    # by information, which shares nothing with the gain
    assert np.linalg.inv(after) == pytest.approx(np.linalg.inv(P) + H.T @ np.linalg.inv(R) @ H, rel=1e-6, abs=1e-6)
    assert (after == after.T).all()
    assert np.linalg.eigvalsh(after)[0] > 0.0
    assert (unchanged == P).all()
    assert eskf.innovation_covariance(P, H, R) == pytest.approx(S)
    assert eskf.normalized_innovation_squared(r, S) == pytest.approx(float(r @ np.linalg.inv(S) @ r))


def test_given_any_numbers_when_propagated_then_the_covariance_is_that_of_the_formula():
    rng = np.random.default_rng(7)
    n = SETUP.layout.size
    P, F, Q = create_covariance(rng, n), rng.normal(size=(n, n)), create_covariance(rng, n)
    unchanged = P.copy()
    assert predict(P, F, Q) == pytest.approx(F @ P @ F.T + Q)
    assert (unchanged == P).all()


def test_given_the_filter_is_loaded_then_all_of_filterpy_can_be_imported_and_its_class_is_the_same_code():
    assert "filterpy.stats" in sys.modules
    assert sys.modules["filterpy.stats"].logpdf is not None
    assert inspect.getsource(eskf.KalmanFilter) == inspect.getsource(KalmanFilter)
    assert import_kalman_filter() is not KalmanFilter
    assert sys.modules["filterpy.kalman"].KalmanFilter is KalmanFilter


@pytest.mark.parametrize("m", [1, 2, 3, 6])
@pytest.mark.parametrize("seed", range(5))
def test_given_any_numbers_then_filterpy_computes_the_same_to_the_bit(seed, m):
    rng = np.random.default_rng(seed)
    n = SETUP.layout.size
    P, F, Q = create_covariance(rng, n), rng.normal(size=(n, n)), create_covariance(rng, n)
    H, R, residual = rng.normal(size=(m, n)), create_covariance(rng, m), rng.normal(size=m)
    oracle = KalmanFilter(dim_x=n, dim_z=m)
    oracle.x, oracle.P = np.zeros(n), P
    oracle.predict(F=F, Q=Q)
    predicted = predict(P, F, Q)
    assert predicted.tolist() == oracle.P.tolist()
    oracle.update(residual, R=R, H=H)
    error, after = eskf.correct(predicted, residual, H, R)
    assert error.tolist() == oracle.x.tolist()
    assert after.tolist() == (0.5 * (oracle.P + oracle.P.T)).tolist()


def test_given_calls_of_the_same_size_between_then_they_do_not_affect_each_other():
    rng = np.random.default_rng(1)
    n = SETUP.layout.size
    P, H, R, r = create_covariance(rng, n), rng.normal(size=(2, n)), create_covariance(rng, 2), rng.normal(size=2)
    first = eskf.correct(P, r, H, R)
    eskf.correct(create_covariance(rng, n), 1e3 * r, rng.normal(size=(2, n)), create_covariance(rng, 2))
    predict(P, rng.normal(size=(n, n)), create_covariance(rng, n))
    again = eskf.correct(P, r, H, R)
    assert (first[0] == again[0]).all()
    assert (first[1] == again[1]).all()


@pytest.mark.parametrize("dof", [1, 2, 3, 4, 6])
@pytest.mark.parametrize("risk", [1e-2, 1e-4, 1e-6])
def test_given_a_risk_then_the_gate_is_the_chi_square_quantile(dof, risk):
    assert eskf.chi_square_gate(dof, risk) == pytest.approx(stats.chi2.isf(risk, dof), rel=1e-9)


def test_given_a_singular_covariance_then_the_nis_is_infinite():
    assert eskf.normalized_innovation_squared(np.array((1.0, 2.0)), np.zeros((2, 2))) == math.inf
    assert eskf.normalized_innovation_squared(np.array((1.0,)), np.zeros((1, 1))) == math.inf


def test_given_sigmas_then_levels_and_the_risk_of_a_limit_are_those_of_drawn_errors():
    draws = np.random.default_rng(1).normal(size=(1_000_000, 3))
    radius, heading = 2.0 * np.hypot(draws[:, 0], draws[:, 1]), 0.1 * np.abs(draws[:, 2])
    level, heading_level = protection_levels.compute_level(2.0, 0.5, 0.1)
    # beside the allowance
    assert np.mean(radius > level - 0.5) == pytest.approx(1e-4, rel=0.3)
    assert np.mean(heading > heading_level) == pytest.approx(1e-4, rel=0.3)
    risks = protection_levels.compute_limit_risks(2.0, 0.1, 6.0, 0.25)
    assert risks == pytest.approx((np.mean(radius > 6.0), np.mean(heading > 0.25)), rel=0.05)
    assert protection_levels.compute_limit_risks(2.0, 0.1, -0.5, 0.0) == (1.0, 1.0)
    assert protection_levels.compute_limit_risks(0.0, 0.0, 1.0, 0.1) == (0.0, 0.0)
    assert protection_levels.compute_limit_risks(math.inf, math.inf, 1.0, 0.1) == (1.0, 1.0)
    assert protection_levels.compute_level(1.0, 0.0, math.inf)[1] == math.pi


def test_given_a_risk_per_hour_then_the_protection_levels_are_its_quantiles():
    horizontal, heading = protection_levels.get_factors(1e-5, 60.0)
    risk = 1e-5 * 60.0 / 3600.0
    assert horizontal == pytest.approx(stats.rayleigh.isf(risk))
    assert heading == pytest.approx(stats.norm.isf(0.5 * risk))
    P = np.zeros((6, 6))
    P[:2, :2] = [[4.0, 1.5], [1.5, 1.0]]
    assert protection_levels.compute_longest_variance(P) == pytest.approx(np.linalg.eigvalsh(P[:2, :2])[1])
    assert protection_levels.compute_heading(1e9, SETTINGS) == math.pi


# --- update ------------------------------------------------------------------------------------------------


def fuse(residual: list[float], sigma: list[float], **more: object):
    nav = some_nav(SETUP, 1)
    H = np.zeros((len(residual), SETUP.layout.size))
    for row in range(len(residual)):
        H[row, row] = 1.0
    innovation = Innovation(np.array(residual), H, np.diag(np.square(sigma)), **more)
    return nav, *eskf.update(nav, innovation, SETTINGS, 5, "gps", 7, "kind")


def test_given_an_innovation_within_its_gate_then_the_state_moves_by_the_gain_and_the_ledger_has_all():
    nav, after, decision = fuse([0.1], [0.1])
    p = nav.covariance[0, 0]
    assert after.position[0] - nav.position[0] == pytest.approx(0.1 * p / (p + 0.01))
    assert after.covariance[0, 0] == pytest.approx(p * 0.01 / (p + 0.01))
    assert (decision.utime, decision.source, decision.seq, decision.kind) == (5, "gps", 7, "kind")
    assert (decision.verdict, decision.reason, decision.dof) == (Verdict.USED, "", 1)
    assert decision.innovation_covariance == pytest.approx((p + 0.01,))
    assert decision.noise == pytest.approx((0.01,))
    assert decision.statistic == pytest.approx(0.01 / (p + 0.01))
    assert decision.limit == pytest.approx(stats.chi2.isf(SETTINGS.gate_risk, 1))


def test_given_an_innovation_beyond_its_gate_or_monitored_then_the_state_does_not_change():
    nav, after, decision = fuse([5.0], [0.1])
    assert after is nav
    assert (decision.verdict, decision.reason) == (Verdict.REJECTED, "gate")
    nav, after, decision = fuse([math.nan], [0.1])
    assert after is nav
    assert (decision.verdict, decision.reason) == (Verdict.REJECTED, "nan")
    nav, after, decision = fuse([0.1], [0.1], monitored="on_purpose")
    assert after is nav
    assert (decision.verdict, decision.reason) == (Verdict.MONITORED, "on_purpose")


def test_given_one_of_two_components_beyond_its_gate_then_the_other_is_used_if_they_are_separable():
    nav, after, decision = fuse([0.05, 9.0], [0.1, 0.1], is_separable=True)
    assert (decision.verdict, decision.reason) == (Verdict.USED, "part")
    assert after.position[0] != nav.position[0]
    assert after.position[1] == nav.position[1]
    nav, after, decision = fuse([0.05, 9.0], [0.1, 0.1])
    assert after is nav
    assert decision.verdict is Verdict.REJECTED


@pytest.mark.parametrize(
    "wrong",
    [{"position": (math.nan, 0.0, 0.0)}, {"velocity": (0.0, 1e3, 0.0)}, {"gyro_bias": (9.0, 0.0, 0.0)},
     {"accelerometer_bias": (0.0, 0.0, 99.0)}, {"extras": (math.inf,)},
     {"covariance": np.full((20, 20), math.nan)}, {"covariance": -np.eye(20)}],
)  # fmt: skip
def test_given_a_state_beyond_the_limits_of_a_vehicle_then_it_is_not_sound(wrong):
    nav = some_nav(SETUP, 1)
    assert eskf.is_sound(nav, SETTINGS)
    assert not eskf.is_sound(nav._replace(**wrong), SETTINGS)

"""The filter's vector of errors, its algebra against plain numpy, and its gate against scipy."""

from __future__ import annotations

import inspect
import math
import sys

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy import stats
from support_cart import rig, some_nav

from modelserver.estimation.filter import bounds, kalman, updates
from modelserver.estimation.filter.error_layout import STRAPDOWN, ErrorState, Layout
from modelserver.estimation.filter.measurements import Innovation
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filterpy_import import import_kalman_filter
from modelserver.messages import Verdict

SETTINGS = FilterSettings()
SETUP = Setup(rig())


# --- layout -------------------------------------------------------------------------------------------------


def test_given_further_states_then_they_follow_the_strapdowns_in_their_order():
    layout = Layout((ErrorState(("a", "b"), 2.0, time_constant=4.0), ErrorState(("c",), 0.5, walk=0.1)))
    assert (layout.size, layout.index("position_east"), layout.index("accelerometer_bias_z")) == (18, 0, 14)
    assert [layout.index(name) for name in ("a", "b", "c")] == [15, 16, 17]
    assert [layout.extra(name) for name in ("a", "b", "c")] == [0, 1, 2]
    assert layout.names[STRAPDOWN:] == layout.extra_names == ("a", "b", "c")
    assert layout.extra_sigmas == (2.0, 2.0, 0.5)
    assert layout.decays.tolist() == [0.25, 0.25, 0.0]
    # a Gauss-Markov process of steady variance s^2 is driven by 2 s^2 / T, a walk by its square
    assert layout.drives == pytest.approx([2.0, 2.0, 0.01])
    assert "b" in layout
    assert "d" not in layout
    with pytest.raises(KeyError):
        layout.index("d")


def test_given_one_state_wanted_by_two_then_it_is_there_once_and_another_of_its_name_is_refused():
    state = ErrorState(("a",), 1.0)
    assert Layout((state, state)).size == STRAPDOWN + 1
    with pytest.raises(ValueError, match="an error state is declared twice: a"):
        Layout((state, ErrorState(("a",), 2.0)))
    with pytest.raises(ValueError, match="gyro_bias_x"):
        Layout((ErrorState(("gyro_bias_x",), 1.0),))


def test_given_a_vehicle_without_wheels_then_its_layout_has_no_states_of_them():
    assert "wheel_scale" in SETUP.layout
    assert "wheel_scale" not in Setup(rig(wheels=())).layout


# --- algebra ------------------------------------------------------------------------------------------------


def spread(rng: np.random.Generator, n: int) -> np.ndarray:
    A = rng.normal(size=(n, n))
    return A @ A.T + 0.1 * np.eye(n)


@pytest.mark.parametrize("m", [1, 2, 3, 6])
@pytest.mark.parametrize("seed", range(5))
def test_given_any_numbers_when_corrected_then_it_is_what_the_formulas_say(seed, m):
    rng = np.random.default_rng(seed)
    n = 20
    P, H, R, r = spread(rng, n), rng.normal(size=(m, n)), spread(rng, m), rng.normal(size=m)
    kept = P.copy()
    error, after = kalman.corrected(P, r, H, R)
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    assert error == pytest.approx(K @ r)
    assert after == pytest.approx((np.eye(n) - K @ H) @ P, abs=1e-9)
    # by information, which split_variance nothing with the gain
    assert np.linalg.inv(after) == pytest.approx(np.linalg.inv(P) + H.T @ np.linalg.inv(R) @ H, rel=1e-6, abs=1e-6)
    assert (after == after.T).all()
    assert np.linalg.eigvalsh(after)[0] > 0.0
    assert (kept == P).all()
    assert kalman.innovation(P, H, R) == pytest.approx(S)
    assert kalman.statistic(r, S) == pytest.approx(float(r @ np.linalg.inv(S) @ r))


def test_given_any_numbers_when_predicted_then_it_is_what_the_formula_says():
    rng = np.random.default_rng(7)
    P, F, Q = spread(rng, 18), rng.normal(size=(18, 18)), spread(rng, 18)
    kept = P.copy()
    assert kalman.predicted(P, F, Q) == pytest.approx(F @ P @ F.T + Q)
    assert (kept == P).all()


def test_given_the_filter_is_loaded_then_all_of_filterpy_can_be_imported_and_its_class_is_the_same_code():
    assert "filterpy.stats" in sys.modules
    assert sys.modules["filterpy.stats"].logpdf is not None
    assert inspect.getsource(kalman.KalmanFilter) == inspect.getsource(KalmanFilter)
    assert import_kalman_filter() is not KalmanFilter
    assert sys.modules["filterpy.kalman"].KalmanFilter is KalmanFilter


@pytest.mark.parametrize("m", [1, 2, 3, 6])
@pytest.mark.parametrize("seed", range(5))
def test_given_any_numbers_then_filterpy_computes_the_same_to_the_bit(seed, m):
    rng = np.random.default_rng(seed)
    n = 20
    P, F, Q = spread(rng, n), rng.normal(size=(n, n)), spread(rng, n)
    H, R, residual = rng.normal(size=(m, n)), spread(rng, m), rng.normal(size=m)
    oracle = KalmanFilter(dim_x=n, dim_z=m)
    oracle.x, oracle.P = np.zeros(n), P
    oracle.predict(F=F, Q=Q)
    predicted = kalman.predicted(P, F, Q)
    assert predicted.tolist() == oracle.P.tolist()
    oracle.update(residual, R=R, H=H)
    error, after = kalman.corrected(predicted, residual, H, R)
    assert error.tolist() == oracle.x.tolist()
    assert after.tolist() == (0.5 * (oracle.P + oracle.P.T)).tolist()


def test_given_calls_of_one_size_between_then_nothing_is_carried_from_one_to_the_other():
    rng = np.random.default_rng(1)
    P, H, R, r = spread(rng, 20), rng.normal(size=(2, 20)), spread(rng, 2), rng.normal(size=2)
    first = kalman.corrected(P, r, H, R)
    kalman.corrected(spread(rng, 20), 1e3 * r, rng.normal(size=(2, 20)), spread(rng, 2))
    kalman.predicted(P, rng.normal(size=(20, 20)), spread(rng, 20))
    again = kalman.corrected(P, r, H, R)
    assert (first[0] == again[0]).all()
    assert (first[1] == again[1]).all()


@pytest.mark.parametrize("dof", [1, 2, 3, 4, 6])
@pytest.mark.parametrize("risk", [1e-2, 1e-4, 1e-6])
def test_given_a_risk_then_the_gate_is_the_chi_square_quantile(dof, risk):
    assert kalman.gate_limit(dof, risk) == pytest.approx(stats.chi2.isf(risk, dof), rel=1e-9)


def test_given_a_covariance_that_cannot_be_inverted_then_its_statistic_is_infinite():
    assert kalman.statistic(np.array((1.0, 2.0)), np.zeros((2, 2))) == math.inf
    assert kalman.statistic(np.array((1.0,)), np.zeros((1, 1))) == math.inf


def test_given_a_risk_an_hour_then_the_bounds_are_its_quantiles():
    horizontal, heading = bounds.factors(1e-5, 60.0)
    risk = 1e-5 * 60.0 / 3600.0
    assert horizontal == pytest.approx(stats.rayleigh.isf(risk))
    assert heading == pytest.approx(stats.norm.isf(0.5 * risk))
    P = np.zeros((6, 6))
    P[:2, :2] = [[4.0, 1.5], [1.5, 1.0]]
    assert bounds.longest(P) == pytest.approx(np.linalg.eigvalsh(P[:2, :2])[1])
    assert bounds.heading(1e9, SETTINGS) == math.pi


# --- a comparison put into the state ------------------------------------------------------------------------


def put(residual: list[float], sigma: list[float], **more: object):
    nav = some_nav(SETUP, 1)
    H = np.zeros((len(residual), SETUP.layout.size))
    for row in range(len(residual)):
        H[row, row] = 1.0
    compared = Innovation(np.array(residual), H, np.diag(np.square(sigma)), **more)
    return nav, *updates.used(nav, compared, SETTINGS, 5, "gps", 7, "kind")


def test_given_a_comparison_that_fits_when_put_then_the_state_moves_by_its_share_and_the_ledger_has_all():
    nav, after, decision = put([0.1], [0.1])
    p = nav.covariance[0, 0]
    assert after.position[0] - nav.position[0] == pytest.approx(0.1 * p / (p + 0.01))
    assert after.covariance[0, 0] == pytest.approx(p * 0.01 / (p + 0.01))
    assert (decision.utime, decision.source, decision.seq, decision.kind) == (5, "gps", 7, "kind")
    assert (decision.verdict, decision.reason, decision.dof) == (Verdict.USED, "", 1)
    assert decision.innovation_covariance == pytest.approx((p + 0.01,))
    assert decision.noise == pytest.approx((0.01,))
    assert decision.statistic == pytest.approx(0.01 / (p + 0.01))
    assert decision.limit == pytest.approx(stats.chi2.isf(SETTINGS.gate_risk, 1))


def test_given_a_comparison_that_cannot_be_when_put_then_the_state_stays():
    nav, after, decision = put([5.0], [0.1])
    assert after is nav
    assert (decision.verdict, decision.reason) == (Verdict.REJECTED, "gate")
    nav, after, decision = put([math.nan], [0.1])
    assert after is nav
    assert (decision.verdict, decision.reason) == (Verdict.REJECTED, "nan")
    nav, after, decision = put([0.1], [0.1], monitored="on_purpose")
    assert after is nav
    assert (decision.verdict, decision.reason) == (Verdict.MONITORED, "on_purpose")


def test_given_one_of_two_that_cannot_be_when_put_then_the_other_counts_where_they_are_separable():
    nav, after, decision = put([0.05, 9.0], [0.1, 0.1], separable=True)
    assert (decision.verdict, decision.reason) == (Verdict.USED, "part")
    assert after.position[0] != nav.position[0]
    assert after.position[1] == nav.position[1]
    nav, after, decision = put([0.05, 9.0], [0.1, 0.1])
    assert after is nav
    assert decision.verdict is Verdict.REJECTED


@pytest.mark.parametrize(
    "wrong",
    [{"position": (math.nan, 0.0, 0.0)}, {"velocity": (0.0, 1e3, 0.0)}, {"gyro_bias": (9.0, 0.0, 0.0)},
     {"accelerometer_bias": (0.0, 0.0, 99.0)}, {"extras": (math.inf,)},
     {"covariance": np.full((20, 20), math.nan)}, {"covariance": -np.eye(20)}],
)  # fmt: skip
def test_given_a_state_that_no_vehicle_has_then_it_is_not_sound(wrong):
    nav = some_nav(SETUP, 1)
    assert updates.sound(nav, SETTINGS)
    assert not updates.sound(nav._replace(**wrong), SETTINGS)

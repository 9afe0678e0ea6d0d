"""The verdict on an answer: its tails against drawn errors, each bit, the vehicle's levels, ages, hostile numbers."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support_filter import drive, simulation
from support_moving import BASE, ODOM, SCAN, T0, UTM, S, view

from modelserver.estimation.filter import output, protection_levels
from modelserver.estimation.filter.state import Aligned
from modelserver.estimation.history import History
from modelserver.messages import (
    MET,
    NAN,
    VALID,
    Estimate,
    GetHTransform,
    GetStateVector,
    GetTransformation,
    Invalid,
    Policy,
    PoseAnswer,
    PoseDemand,
    RequestHeader,
    StateVectorReply,
    TimeQuery,
    TransformReply,
    Unmet,
)
from modelserver.query.answers import check_demand, compute_replies, effort_of, find_unmet
from modelserver.query.view import PlatformView
from modelserver.simulation import figure_eight
from modelserver.transforms import Pose, Transformation
from modelserver.transforms.so3 import Array

NOW = T0 + 4 * S
LATEST = TimeQuery()
EIGHT = figure_eight(speed=3.0, radius=8.0, stationary=4.0, laps=3)
ALLOWANCE, LEVER_ARM, LIMIT, HEADING_LIMIT = 0.3, 0.1, 1.0, 0.05


def answer(covariance: Array | None, invalid: Invalid = VALID) -> PoseAnswer:
    return PoseAnswer(Transformation(BASE, UTM, Pose(), covariance, NOW, int(invalid)))


def diagonal(horizontal: float, heading: float) -> Array:
    return np.diag([horizontal**2, horizontal**2, 1.0, 1.0, 1.0, heading**2])


GOOD = answer(diagonal(0.1, 0.01))


def add_levels(estimate: Estimate) -> Estimate:
    """Return an estimate with the levels of its covariance, of a lever arm, mounts and an allowance."""
    assert estimate.covariance is not None
    P = np.array(estimate.covariance).reshape(6, 6)
    sigma = math.hypot(math.sqrt(protection_levels.compute_longest_variance(P)), LEVER_ARM)
    heading_sigma = math.hypot(math.sqrt(P[5, 5]), protection_levels.HEADING_FLOOR)
    level, heading_level = protection_levels.compute_level(sigma, ALLOWANCE, heading_sigma)
    risks = protection_levels.compute_limit_risks(sigma, heading_sigma, LIMIT - ALLOWANCE, HEADING_LIMIT)
    return replace(
        estimate,
        horizontal_level=level,
        heading_level=heading_level,
        limit_risk=sum(risks),
        horizontal_allowance=ALLOWANCE,
    )


class Localizer:
    """A localizer whose sensors are all fresh."""

    def __init__(self, invalid: Invalid = VALID) -> None:
        self.invalid = invalid

    def find_stale_sensors(self, utime: int) -> Invalid:
        return self.invalid

    def estimate(self, utime: int) -> Estimate:
        return replace(LEVELS.history.newest, utime=utime)


def with_levels(plain: PlatformView) -> PlatformView:
    history = History(60.0)
    for n in range(-200, 1):
        history = history.append(add_levels(plain.history.at(NOW + n * 10_000)))
    return plain._replace(history=history, localizer=Localizer())  # type: ignore[arg-type]


LEVELS = with_levels(view(4.0))


def judge(
    demand: PoseDemand,
    interest: str = BASE,
    reference: str = UTM,
    time: TimeQuery = LATEST,
    now: int = NOW,
    platform: PlatformView = LEVELS,
) -> tuple[Unmet, str]:
    return check_demand(platform, platform.transformation(interest, reference, time, now), demand, time, now)


# --- tails --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrity", [0.5, 0.9, 0.99, 0.999])
def test_given_drawn_errors_then_the_verdict_turns_at_their_quantile(integrity: float) -> None:
    rng = np.random.default_rng(7)
    errors = rng.normal(size=(400_000, 3)) * (2.0, 2.0, 0.1)
    radius = float(np.quantile(np.hypot(errors[:, 0], errors[:, 1]), integrity)) + ALLOWANCE
    heading = float(np.quantile(np.abs(errors[:, 2]), integrity))
    found = answer(diagonal(2.0, 0.1))
    assert find_unmet(found, PoseDemand(1.01 * radius, 1.01 * heading, 0.0, integrity), ALLOWANCE) == (MET, "")
    unmet, _ = find_unmet(found, PoseDemand(0.99 * radius, 0.99 * heading, 0.0, integrity), ALLOWANCE)
    assert unmet is Unmet.HORIZONTAL | Unmet.HEADING


def test_given_an_error_ellipse_then_its_longest_axis_counts_whatever_its_direction() -> None:
    R = np.array([[math.cos(0.7), -math.sin(0.7)], [math.sin(0.7), math.cos(0.7)]])
    P = diagonal(1.0, 0.1)
    P[:2, :2] = R @ np.diag([4.0, 0.25]) @ R.T
    bound = 2.0 * math.sqrt(-2.0 * math.log(0.01))
    assert find_unmet(answer(P), PoseDemand(1.0001 * bound))[0] is MET
    assert find_unmet(answer(P), PoseDemand(0.9999 * bound))[0] is Unmet.HORIZONTAL


@pytest.mark.parametrize("risk", [0.1, 0.01, 1e-6, 1e-12])
def test_given_a_limit_below_the_allowance_then_no_integrity_is_met(risk: float) -> None:
    demand = PoseDemand(0.2, min_integrity=1.0 - risk)
    assert find_unmet(answer(np.zeros((6, 6))), demand, 0.3)[0] is Unmet.HORIZONTAL
    assert find_unmet(answer(np.zeros((6, 6))), demand, 0.19)[0] is MET


# --- bits and reasons ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("demand", "more", "bit", "reason"),
    [
        (
            PoseDemand(max_horizontal=0.2),
            {},
            Unmet.HORIZONTAL,
            "the horizontal error is up to 0.3035 m at integrity 0.99, asked for: 0.2 m",
        ),
        (
            PoseDemand(max_heading=math.radians(1.0)),
            {},
            Unmet.HEADING,
            "the heading error is up to 1.476 deg at integrity 0.99, asked for: 1 deg",
        ),
        (PoseDemand(max_age=0.5), {"age": 0.6}, Unmet.AGE, "the newest data are 0.6 s old, asked for: at most 0.5 s"),
        (
            PoseDemand(max_age=0.5),
            {"age": math.inf},
            Unmet.AGE,
            "a joint on the path has no data, asked for: at most 0.5 s",
        ),
        (
            PoseDemand(min_integrity=0.999),
            {"limit_risk": 0.002},
            Unmet.NOT_VALID,
            "the probability of an error beyond the configured limits is 0.002, asked for: at most 0.001",
        ),
        (
            PoseDemand(min_integrity=0.5),
            {"limit_risk": NAN},
            Unmet.NOT_VALID,
            "the probability of an error beyond the configured limits is not known",
        ),
    ],
)
def test_given_a_demand_that_is_unmet_then_its_bit_and_the_reason_come(
    demand: PoseDemand, more: dict[str, Any], bit: Unmet, reason: str
) -> None:
    assert find_unmet(GOOD, demand, **more) == (bit, reason)


def test_given_what_is_just_good_enough_then_nothing_is_unmet() -> None:
    demand = PoseDemand(0.304, math.radians(1.48), 0.6, 0.99)
    assert find_unmet(GOOD, demand, age=0.6, limit_risk=1e-3) == (MET, "")
    # the limits of the request count, not the configured ones
    assert find_unmet(GOOD, demand, age=0.6, limit_risk=0.9) == (MET, "")


def test_given_an_invalid_pose_then_only_a_stated_integrity_needs_validity() -> None:
    stale = answer(diagonal(0.1, 0.01), Invalid.STALE_GPS)
    assert find_unmet(stale, PoseDemand(0.4)) == (MET, "")
    unmet, reason = find_unmet(stale, PoseDemand(0.4, min_integrity=0.99))
    assert unmet is Unmet.NOT_VALID
    assert reason == "the pose is not valid: the last usable GPS fix is too old"


def test_given_several_unmet_then_all_bits_and_reasons_come() -> None:
    stale = answer(diagonal(0.1, 0.01), Invalid.STALE_GPS)
    unmet, reason = find_unmet(stale, PoseDemand(0.01, 0.001, 0.1, 0.999), age=2.0)
    assert unmet is Unmet.HORIZONTAL | Unmet.HEADING | Unmet.AGE | Unmet.NOT_VALID
    assert reason.count("; ") == 3


# --- hostile numbers ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("covariance", [None, np.full((6, 6), math.nan), np.full((6, 6), math.inf)])
def test_given_a_covariance_that_is_not_known_then_no_limit_is_met(covariance: Array | None) -> None:
    unmet, _ = find_unmet(answer(covariance), PoseDemand(1e11, 3.0))
    assert unmet is Unmet.HORIZONTAL | Unmet.HEADING


def test_given_no_level_then_the_reason_is_that_nothing_is_known() -> None:
    assert find_unmet(GOOD, PoseDemand(9.0), NAN) == (
        Unmet.HORIZONTAL,
        "the horizontal error is not known, asked for: at most 9 m",
    )


@pytest.mark.parametrize("integrity", [5e-324, 1e-17, 0.5, math.nextafter(1.0, 0.0)])
@pytest.mark.parametrize("limit", [5e-324, 1e-9, 1.0, 9e11])
def test_given_the_least_and_the_largest_numbers_then_there_is_a_verdict(integrity: float, limit: float) -> None:
    for P in (diagonal(0.0, 0.0), diagonal(1e-200, 1e-200), diagonal(1e9, 1e3)):
        unmet, reason = find_unmet(answer(P), PoseDemand(limit, min(limit, 3.14), limit, integrity), 1e12, 1.0, limit)
        # every error is met with a probability of 0
        assert (Unmet.HORIZONTAL in unmet) is (1.0 - integrity < 1.0)
        assert "nan" not in reason


# --- the vehicle's pose -------------------------------------------------------------------------------------


def test_given_the_configured_limits_then_the_verdict_is_that_of_limit_risk() -> None:
    estimate = LEVELS.history.newest
    risk, heading_risk = (
        estimate.limit_risk - each
        for each in protection_levels.compute_limit_risks(
            math.hypot(0.05, LEVER_ARM), math.hypot(0.01, 0.01), LIMIT - ALLOWANCE, HEADING_LIMIT
        )[::-1]
    )
    for demand, expected in (
        (PoseDemand(max_horizontal=LIMIT), risk),
        (PoseDemand(max_heading=HEADING_LIMIT), heading_risk),
    ):
        assert judge(demand._replace(min_integrity=1.0 - 1.001 * expected))[0] is MET
        assert judge(demand._replace(min_integrity=1.0 - 0.999 * expected))[0] is not MET
    assert judge(PoseDemand(min_integrity=1.0 - 1.001 * estimate.limit_risk))[0] is MET
    assert judge(PoseDemand(min_integrity=1.0 - 0.999 * estimate.limit_risk))[0] is Unmet.NOT_VALID


def test_given_the_filters_estimate_then_the_risk_of_its_limits_is_its_own() -> None:
    localizer = drive(simulation(EIGHT), 30.0).localizer
    state = localizer.head
    assert isinstance(state, Aligned)
    P = state.nav.covariance.copy()
    P[8, 8] = math.radians(9.0) ** 2
    vague = state._replace(nav=state.nav._replace(covariance=P), bank=None, bounds=None)
    estimate = output.estimate(localizer.setup, vague, localizer.odom, localizer.utime, localizer.utime)
    limit, heading_limit = output.get_limits(localizer.setup, vague)
    # all of it is the heading's
    assert 1e-5 < estimate.limit_risk < 1e-2
    platform = LEVELS._replace(history=History(1.0).append(estimate))
    for factor, expected in ((1.001, MET), (0.999, Unmet.HEADING)):
        demand = PoseDemand(limit, heading_limit, 0.0, 1.0 - factor * estimate.limit_risk)
        assert judge(demand, now=estimate.utime, platform=platform)[0] is expected


def test_given_a_frame_on_a_mount_then_the_heading_error_moves_it() -> None:
    mast, k = "Rover:Mast", math.sqrt(-2.0 * math.log(0.01))
    heading_sigma = math.hypot(0.01, protection_levels.HEADING_FLOOR)
    # across the lever arm of 0.8 m and 0.1 m; its tilts move it by 1.2 m times theirs
    sigma = math.sqrt(0.05**2 + LEVER_ARM**2 + 0.65 * heading_sigma**2 + (1.2 * 0.01) ** 2 + 0.002**2)
    assert judge(PoseDemand(ALLOWANCE + 1.01 * k * sigma), mast)[0] is MET
    assert judge(PoseDemand(ALLOWANCE + 0.99 * k * sigma), mast)[0] is Unmet.HORIZONTAL
    far = PoseDemand(ALLOWANCE + 1.5 * k * sigma)
    # the world seen from the vehicle is at the end of a longer one
    assert judge(far, mast)[0] is MET
    assert judge(far, UTM, mast)[0] is Unmet.HORIZONTAL


@pytest.mark.parametrize("ends", [(BASE, UTM), ("Rover:Mast", UTM), (SCAN, UTM), (UTM, BASE)])
def test_given_no_levels_then_the_error_is_not_known(ends: tuple[str, str]) -> None:
    plain = view(1.0)._replace(localizer=Localizer())  # type: ignore[arg-type]
    unmet, reason = judge(PoseDemand(100.0, 3.0, 0.0, 0.5), *ends, now=T0 + S, platform=plain)
    assert unmet is Unmet.HORIZONTAL | Unmet.HEADING | Unmet.NOT_VALID
    assert reason.count("not known") == 3


def test_given_sensors_that_timed_out_then_the_pose_is_not_valid() -> None:
    silent = LEVELS._replace(localizer=Localizer(Invalid.STALE_GPS))  # type: ignore[arg-type]
    demand = PoseDemand(min_integrity=0.9)
    assert judge(demand, now=NOW + 1)[0] is MET
    assert judge(demand, now=NOW + 1, platform=silent)[0] is Unmet.NOT_VALID


def test_given_odom_then_neither_allowance_nor_limits_of_the_world_count() -> None:
    # it has drifted by 4 cm
    assert judge(PoseDemand(0.2, 0.05, 0.0, 0.99), reference=ODOM) == (MET, "")
    assert judge(PoseDemand(0.2), reference=UTM)[0] is Unmet.HORIZONTAL


def test_given_two_world_frames_then_the_error_between_them_is_not_known() -> None:
    assert judge(PoseDemand(10.0), UTM, ODOM)[0] is Unmet.HORIZONTAL
    assert judge(PoseDemand(1e-6, 1e-6, 1e-6, 0.99), UTM, UTM) == (MET, "")


# --- within the vehicle -------------------------------------------------------------------------------------


def test_given_frames_of_the_vehicle_then_their_own_covariance_counts() -> None:
    invalid = LEVELS._replace(localizer=None, history=History(1.0))
    k = math.sqrt(-2.0 * math.log(0.01))
    for limit, expected in ((1.01 * k * 0.002, MET), (0.99 * k * 0.002, Unmet.HORIZONTAL)):
        assert judge(PoseDemand(limit, max_age=1e-6), "Rover:Mast", BASE, platform=invalid)[0] is expected
    unstated = view(1.0, sigma=None)
    assert judge(PoseDemand(1.0), "Rover:Mast", BASE, platform=unstated)[0] is Unmet.HORIZONTAL


# --- age ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("time", "age"),
    [
        (LATEST, 0.05),
        (TimeQuery(NOW - S), 1.05),
        # its data are the estimates before and after
        (TimeQuery(NOW - S + 4_000), 1.04),
        (TimeQuery(NOW + 30_000, Policy.HELD), 0.05),
        (TimeQuery(NOW + 2 * S, Policy.PREDICTED), 0.05),
    ],
)
def test_given_a_time_then_the_age_is_that_of_the_newest_data_in_the_answer(time: TimeQuery, age: float) -> None:
    now = NOW + 50_000
    assert judge(PoseDemand(max_age=age + 1e-6), time=time, now=now) == (MET, "")
    unmet, reason = judge(PoseDemand(max_age=age - 1e-6), time=time, now=now)
    assert unmet is Unmet.AGE
    assert f"{age:.4g} s old" in reason


def test_given_joints_then_the_oldest_of_them_and_the_vehicle_counts() -> None:
    later = LEVELS._replace(history=LEVELS.history.append(replace(LEVELS.history.newest, utime=NOW + S)))
    joints = TimeQuery(NOW + S, Policy.HELD)
    assert judge(PoseDemand(max_age=0.5), BASE, UTM, joints, NOW + S, later)[0] is MET
    assert judge(PoseDemand(max_age=0.5), SCAN, UTM, joints, NOW + S, later)[0] is Unmet.AGE
    assert judge(PoseDemand(max_age=1.001), SCAN, UTM, joints, NOW + S, later)[0] is MET


def test_given_a_joint_at_its_default_then_it_has_no_age() -> None:
    model = LEVELS.model
    silent = LEVELS._replace(joints=type(LEVELS.joints)(model.joints.values(), 60.0))
    unmet, reason = judge(PoseDemand(max_age=1e9), SCAN, BASE, platform=silent)
    assert (unmet, reason.partition(",")[0]) == (Unmet.AGE, "a joint on the path has no data")


# --- requests -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "request_",
    [
        GetTransformation(RequestHeader(1, "REPLY_ME"), BASE, UTM),
        GetStateVector(RequestHeader(1, "REPLY_ME")),
        GetHTransform(RequestHeader(1, "REPLY_ME")),
    ],
)
def test_given_a_request_with_a_demand_then_the_reply_has_answer_and_verdict(
    request_: GetTransformation | GetStateVector | GetHTransform,
) -> None:
    for demand in (PoseDemand(), PoseDemand(2.0, 0.5, 1.0, 0.99), PoseDemand(0.31), PoseDemand(0.31, 1e-3, 1e-3, 0.9)):
        (reply,) = compute_replies(LEVELS, request_._replace(demand=demand), NOW + 10_000)
        assert isinstance(reply, TransformReply | StateVectorReply)
        assert reply.answer is not None
        assert reply.answer.transformation.utime == NOW
        assert (reply.unmet, reply.unmet_reason) == judge(demand, now=NOW + 10_000)
    assert reply.unmet is Unmet.HORIZONTAL | Unmet.HEADING | Unmet.AGE
    assert effort_of(request_) == 1.0 < effort_of(request_._replace(demand=demand))

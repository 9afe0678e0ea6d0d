"""History of joints: storage, positions at an instant, and rejected samples."""

from __future__ import annotations

import math
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from support_moving import BASE, DEEP, SCAN, T0, UTM, S, joints_at, rover, view

from modelserver.errors import TooNewError, TooOldError
from modelserver.estimation.history import History
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import Joint, JointType
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Constraint
from modelserver.joints import MAX_CLOCK_LEAD_S, MAX_PLAUSIBLE, MAX_SUGGESTIONS, JointHistory
from modelserver.joints.track import (
    BLOCK_SIZE,
    MAX_GAP_S,
    MAX_READINGS,
    MIN_ACCELERATION,
    PREDICTION_LIMIT_S,
    JointTrack,
    Provenance,
)
from modelserver.messages import NAN, Invalid, JointSample, JointsSample, Policy, Quality, SensorHeader, TimeQuery
from modelserver.query.batch import lookup_batch
from modelserver.query.path import compute_motion
from modelserver.query.view import PlatformView, complete


def at(seconds: float) -> int:
    return T0 + round(seconds * S)


def track(*readings: tuple[float, ...], horizon: float = 60.0) -> JointTrack:
    """Return a track of readings: seconds, position, and as many of sigma, rate and its sigma as are given."""
    held = JointTrack(horizon)
    for seconds, *values in readings:
        position, sigma, rate, rate_sigma = (*values, NAN, NAN, NAN)[:4]
        held = held.insert(at(seconds), (position, sigma, rate, rate_sigma))
    return held


def sample(seconds: float, *joints: JointSample) -> JointsSample:
    return JointsSample(SensorHeader(at(seconds), "arm"), joints)


def constraints() -> list[Constraint]:
    return list(rover().joints.values())


def update(
    joints: JointHistory, seconds: float, *readings: JointSample, now: float | None = None
) -> tuple[JointHistory, tuple[str, ...]]:
    return joints.update(sample(seconds, *readings), at(seconds if now is None else now))


# --- a track ------------------------------------------------------------------------------------------------


def test_given_two_readings_then_between_them_position_and_rate_are_linear_and_sigmas_the_worse() -> None:
    found = track((0, 1.0, 0.1, 2.0, 0.3), (1, 2.0, 0.2, 4.0, 0.1)).interpolate(at(0.25))
    assert found[1:5] == pytest.approx((1.25, 0.2, 2.5, 0.3))
    assert (found.provenance, found.stamp, found.gap) == (Provenance.INTERPOLATED, at(1), 1.0)


def test_given_no_rates_then_the_rate_is_the_slope() -> None:
    assert track((0, 1.0), (0.5, 2.0)).interpolate(at(0.1)).rate == pytest.approx(2.0)


def test_given_a_time_of_a_reading_then_it_is_measured() -> None:
    held = track((0, 1.0), (1, 2.0), (2, 4.0))
    for seconds, position in ((0, 1.0), (1, 2.0), (2, 4.0)):
        found = held.interpolate(at(seconds))
        assert (found.provenance, found.position, found.stamp) == (Provenance.MEASURED, position, at(seconds))


@pytest.mark.parametrize(("seconds", "kind", "side"), [(-0.5, TooOldError, "before"), (2.5, TooNewError, "after")])
def test_given_a_time_that_is_not_held_then_the_error_states_it_and_the_time_covered(
    seconds: float, kind: type[Exception], side: str
) -> None:
    held = track((0, 1.0), (2, 2.0))
    with pytest.raises(kind, match=rf"{at(seconds)} is 0.500 s {side} the time covered: {at(0)} to {at(2)} \(2.0 s\)"):
        held.interpolate(at(seconds))


def test_given_a_route_then_the_error_names_the_joint() -> None:
    with pytest.raises(TooNewError, match="joint Nod: "):
        view(1.0).transformation(SCAN, BASE, TimeQuery(at(2.0)))


def test_given_policy_held_then_the_newest_reading_before_is_held_with_its_age() -> None:
    held = track((0, 1.0, 0.1, 2.0, 0.3), (1, 2.0))
    found = held.hold(at(0.75))
    assert (found.position, found.provenance, found.gap, found.stamp) == (1.0, Provenance.HELD, 0.75, at(0))
    assert held.hold(at(1)).provenance is Provenance.MEASURED
    with pytest.raises(TooOldError):
        held.hold(at(-1))


@pytest.mark.parametrize("limit", [1.5, math.inf])
def test_given_policy_predicted_then_the_rate_carries_on_and_it_is_ever_less_sure(limit: float) -> None:
    held = track((0, 1.0, 0.01, 0.5, 0.02))
    found = [held.predict(at(ahead), limit) for ahead in (0.0, 0.1, 0.5, 1.0)]
    assert [each.position for each in found] == pytest.approx([1.0, 1.05, 1.25, 1.5])
    assert [each.sigma for each in found] == sorted({each.sigma for each in found})
    assert [each.rate_sigma for each in found] == sorted({each.rate_sigma for each in found})
    change = limit if math.isfinite(limit) else 1.0
    assert found[-1].sigma == pytest.approx(math.hypot(0.01, 0.02, 0.5 * change))


def test_given_a_time_too_far_ahead_then_it_is_not_predicted() -> None:
    with pytest.raises(TooNewError, match=f"predicted {PREDICTION_LIMIT_S:g} s at most"):
        track((0, 1.0)).predict(at(PREDICTION_LIMIT_S + 0.1), 1.0)


def test_given_one_reading_without_a_rate_then_only_a_limit_gives_a_sigma_of_its_prediction() -> None:
    held = track((0, 1.0, 0.01))
    assert math.isnan(held.predict(at(0.5), math.inf).sigma)
    assert held.predict(at(0.5), 2.0).sigma == pytest.approx(math.hypot(0.01, 1.0, 0.25))


def test_given_readings_without_rates_then_they_are_extrapolated_by_their_slope() -> None:
    assert track((0, 1.0), (0.1, 1.1)).predict(at(0.2), math.inf).position == pytest.approx(1.2)


def test_given_an_old_track_that_is_extended_again_then_both_successors_and_it_stay_what_they_were() -> None:
    old = track((0, 0.0), (1, 1.0))
    first = old.insert(at(2), (2.0, NAN, NAN, NAN))
    second = old.insert(at(2), (-2.0, NAN, NAN, NAN))
    third = old.insert(at(0.5), (9.0, NAN, NAN, NAN))
    assert [len(each) for each in (old, first, second, third)] == [2, 3, 3, 3]
    assert (old.last, old.newest.position) == (at(1), 1.0)
    assert (first.newest.position, second.newest.position) == (2.0, -2.0)
    assert (first.interpolate(at(0.5)).position, third.interpolate(at(0.5)).position) == (0.5, 9.0)
    longer = first.insert(at(3), (3.0, NAN, NAN, NAN))
    assert (first.last, longer.last) == (at(2), at(3))


def test_given_a_reading_older_than_what_may_be_held_then_the_track_is_the_same() -> None:
    held = track((0, 0.0), (10, 1.0), horizon=10.0)
    assert held.insert(at(-0.1), (5.0, NAN, NAN, NAN)) is held


def test_given_two_readings_of_one_instant_then_the_surer_counts() -> None:
    for readings in (((0, 1.0, 0.1), (0, 2.0, 0.2)), ((0, 2.0, 0.2), (0, 1.0, 0.1)), ((0, 2.0), (0, 1.0, 0.1))):
        assert track(*readings).newest.position == 1.0


def test_given_a_horizon_then_what_is_older_is_forgotten_and_the_memory_bounded() -> None:
    held = JointTrack(2.0)
    for n in range(50_000):
        held = held.insert(T0 + n * 10_000, (float(n), NAN, NAN, NAN))
        assert len(held) <= 201
    assert held.first == held.last - 2 * S
    assert sum(len(block.times) for block in held._blocks) <= 201 + BLOCK_SIZE


def test_given_a_flood_then_the_time_held_is_shorter_and_not_the_memory_larger() -> None:
    held = JointTrack(3600.0)
    for n in range(3 * MAX_READINGS):
        held = held.insert(T0 + n, (float(n), NAN, NAN, NAN))
    assert len(held) == MAX_READINGS
    assert sum(len(block.times) for block in held._blocks) <= MAX_READINGS + BLOCK_SIZE
    assert held.interpolate(held.first).position == 2 * MAX_READINGS


# --- all joints ---------------------------------------------------------------------------------------------


def test_given_joints_then_those_that_follow_are_not_driven() -> None:
    names = JointHistory(constraints(), 60.0).names
    assert {"Nod", "Slide", "Ball.rx", "Table.turn"} < set(names)
    assert "Finger" not in names


@pytest.mark.parametrize(
    ("joint", "why"),
    [
        (JointSample("Nodd", 0.1), "unknown joint 'Nodd'; nearest Nod"),
        (JointSample("Finger", 0.1), "unknown joint 'Finger'"),
        (JointSample("", 0.1), "unknown joint"),
        (JointSample("\x1b[2J" * 100, 0.1), "unknown joint"),
        (JointSample("Nod", math.inf), "implausible position of Nod"),
        (JointSample("Nod", -MAX_PLAUSIBLE), "implausible position of Nod"),
        (JointSample("Nod", 0.1, -0.1), "invalid sigma of Nod"),
        (JointSample("Nod", 0.1, math.inf), "invalid sigma of Nod"),
        (JointSample("Nod", 0.1, 1e200), "invalid sigma of Nod"),
        (JointSample("Nod", 0.1, 0.1, math.inf), "invalid rate of Nod"),
        (JointSample("Nod", 0.1, 0.1, -1e300), "invalid rate of Nod"),
        (JointSample("Nod", 0.1, 0.1, 0.1, -1.0), "invalid rate of Nod"),
        (JointSample("Nod", 0.1, 0.1, 0.1, 1e300), "invalid rate of Nod"),
    ],
)
def test_given_invalid_readings_then_they_are_rejected_with_reasons_and_the_others_used(
    joint: JointSample, why: str
) -> None:
    known, rejected = update(JointHistory(constraints(), 60.0), 0.0, joint, JointSample("Slide", 0.2))
    assert len(rejected) == 1
    assert rejected[0].startswith(why)
    assert len(rejected[0]) < 200
    assert rejected[0].isprintable()
    assert list(known.tracks) == ["Slide"]


def test_given_what_was_not_measured_then_nothing_is_reported() -> None:
    before = JointHistory(constraints(), 60.0)
    assert update(before, 0.0, JointSample("Nod", NAN, 0.1)) == (before, ())


def test_given_no_sigma_then_that_of_the_geometry_holds() -> None:
    known, _ = update(JointHistory(constraints(), 60.0), 0.0, JointSample("Nod", 0.1), JointSample("Ball.ry", 0.1))
    assert known.tracks["Nod"].newest.sigma == 0.001
    assert known.tracks["Ball.ry"].newest.sigma == 0.002


def test_given_a_late_reading_then_it_is_rejected_as_late() -> None:
    known, _ = update(JointHistory(constraints(), 10.0), 20.0, JointSample("Nod", 0.1))
    assert update(known, 5.0, JointSample("Nod", 0.2), now=20.0) == (known, ("too_old",))


def test_given_a_clock_set_back_by_an_hour_then_nothing_of_the_two_times_is_mixed() -> None:
    known = JointHistory(constraints(), 7200.0)
    for n in range(10):
        known, _ = known.update(joints_at(3600.0 + n * 0.1), at(3600.0 + n * 0.1))
    before = known
    known, rejected = update(known, 0.5, JointSample("Nod", 0.1))
    assert rejected == ()
    # readings of the others are of the other time scale, too
    assert list(known.tracks) == ["Nod"]
    assert (known.tracks["Nod"].first, len(known.tracks["Nod"])) == (at(0.5), 1)
    assert len(before.tracks) == len(before.names)


def test_given_a_clock_set_forward_by_an_hour_then_only_readings_since_are_stored() -> None:
    known, _ = update(JointHistory(constraints(), 60.0), 0.0, JointSample("Nod", 0.1))
    known, _ = update(known, 3600.0, JointSample("Nod", 0.2))
    assert len(known.tracks["Nod"]) == 1


def test_given_another_model_then_common_joints_are_retained() -> None:
    known, _ = JointHistory(constraints(), 60.0).update(joints_at(0.0), T0)
    assert set(known.for_model(rover()).tracks) == set(known.names)


# --- positions -----------------------------------------------------------------------------------


def test_given_a_joint_beyond_its_limits_then_the_answer_is_flagged() -> None:
    platform = view(1.0)
    joints, _ = update(platform.joints, 1.1, JointSample("Nod", 0.61))
    answer = platform._replace(joints=joints).transformation(SCAN, BASE, TimeQuery(), at(1.1))
    assert Quality.OUT_OF_LIMITS in answer.quality
    assert answer.transformation.is_valid


def test_given_a_joint_that_was_silent_then_the_answer_around_it_may_not_be_used() -> None:
    platform = view(1.0)
    joints, _ = update(platform.joints, 1.5 + MAX_GAP_S, JointSample("Nod", 0.1))
    platform = platform._replace(joints=joints)
    now = at(1.5 + MAX_GAP_S)
    inside = platform.transformation(SCAN, BASE, TimeQuery(at(1.2)), now).transformation
    assert Invalid(inside.invalid_reasons) == Invalid.STALE_JOINT
    assert platform.transformation(SCAN, BASE, TimeQuery(at(0.9)), now).transformation.is_valid
    held = platform.transformation(SCAN, BASE, TimeQuery(at(1.2), Policy.HELD), now)
    assert held.transformation.is_valid
    assert Quality.HELD in held.quality


def test_given_a_joint_silent_up_to_now_then_the_latest_common_time_is_its_last_and_stale() -> None:
    platform = view(3.0)
    joints = JointHistory(constraints(), 60.0)
    for n in range(151):
        message = joints_at(n * 0.02)
        some = tuple(each for each in message.joints if each.name != "Nod" or n <= 50)
        joints, _ = joints.update(replace(message, joints=some), at(n * 0.02))
    platform = platform._replace(joints=joints)
    for pair in ((SCAN, BASE), (SCAN, UTM), (DEEP, SCAN)):
        answer = platform.transformation(*pair, TimeQuery(), at(3.0))
        assert answer.transformation.utime == at(1.0)
        assert Invalid.STALE_JOINT in Invalid(answer.transformation.invalid_reasons)
    assert platform.transformation(DEEP, BASE, TimeQuery(), at(3.0)).transformation.utime == at(3.0)


def test_given_a_joint_silent_for_so_long_that_nothing_common_is_held_then_the_error_names_it() -> None:
    platform = view(1.0)
    joints = JointHistory(constraints(), 10.0)
    joints, _ = joints.update(joints_at(0.0), T0)
    message = joints_at(100.0)
    for n in range(3):
        some = tuple(each for each in message.joints if each.name != "Nod")
        joints, _ = joints.update(JointsSample(SensorHeader(at(100.0 + n), "arm"), some), at(100.0 + n))
    with pytest.raises(TooOldError, match="joint Nod was received last at"):
        platform._replace(joints=joints).transformation(DEEP, SCAN, TimeQuery(), at(102.0))


def test_given_joints_never_received_then_they_are_at_defaults_and_only_a_default_makes_that_valid() -> None:
    platform = view(1.0)._replace(joints=JointHistory(constraints(), 60.0))
    nod = platform.transformation(SCAN, BASE, TimeQuery(at(0.5)))
    assert Invalid(nod.transformation.invalid_reasons) == Invalid.JOINT_UNKNOWN
    assert Quality.JOINT_DEFAULT in nod.quality
    slide = platform.transformation("Upper:Root", BASE, TimeQuery(at(0.5)))
    assert slide.transformation.is_valid
    assert Quality.JOINT_DEFAULT in slide.quality


def test_given_a_joint_without_limits_whose_angle_wraps_then_it_takes_the_shorter_arc():
    builder = ModelBuilder()
    builder.add_body("Rover").add_frame("Mast")
    builder.add_body("Head").add_frame("Root")
    builder.add_constraint("Pan", "Rover:Mast", "Head:Root", joint=Joint(JointType.REVOLUTE))
    for begin, end, middle, rate in ((3.1, -3.1, math.pi, 0.0832), (6.2, 0.1, 6.2916, 0.1832), (12.5, 6.1, 9.3, -6.4)):
        joints = JointHistory(builder.build().joints.values(), 60.0)
        for second, angle in enumerate((begin, end)):
            sample = JointsSample(SensorHeader(1 + second * S, "pan"), (JointSample("Pan", angle),))
            joints, rejected = joints.update(sample, 1 + second * S)
            assert not rejected
        track = joints.tracks["Pan"]
        found = track.interpolate(1 + S // 2)
        assert math.isclose(math.remainder(found.position - middle, math.tau), 0.0, abs_tol=1e-3)
        assert math.isclose(found.rate, rate, abs_tol=1e-3)
        assert math.isclose(track.interpolate_batch(np.array([1 + S // 2]))[0][0], found.position, abs_tol=1e-12)
        assert math.isclose(track.predict(1 + S + S // 2, math.inf).rate, rate, abs_tol=1e-3)


# --- continuous angles --------------------------------------------------------------------------------------


def model_with(joint: Joint) -> Model:
    builder = ModelBuilder()
    builder.add_body("Rover").add_frame("Mast")
    builder.add_body("Head").add_frame("Root")
    builder.add_constraint("J", "Rover:Mast", "Head:Root", joint=joint)
    return builder.build()


def view_of(model: Model, *readings: tuple[float, dict[str, float]], rate: float = NAN) -> PlatformView:
    """Return a view of a model with readings: seconds, positions."""
    joints = JointHistory(model.joints.values(), 60.0)
    for seconds, positions in readings:
        some = tuple(JointSample(name, value, 0.001, rate) for name, value in positions.items())
        joints, rejected = joints.update(sample(seconds, *some), at(seconds))
        assert not rejected
    return PlatformView(model, "Rover:Mast", None, History(60.0), joints=joints)


def ball(degrees: float) -> dict[str, float]:
    return {"J.rx": 0.0, "J.ry": 0.0, "J.rz": math.radians(degrees)}


def yaw(view: PlatformView, query: TimeQuery, now: float = 1.0) -> float:
    pose = view.transformation("Head:Root", "Rover:Mast", query, at(now)).transformation.pose
    return math.degrees(pose.rpy[2])


@pytest.mark.parametrize("kind", [JointType.SPHERICAL, JointType.FLOATING])
def test_given_a_rotation_vector_that_wraps_then_it_takes_the_shorter_arc(kind: JointType) -> None:
    place = {"J.x": 1.0, "J.y": 2.0, "J.z": 3.0} if kind is JointType.FLOATING else {}
    platform = view_of(model_with(Joint(kind)), (0.0, {**place, **ball(179)}), (0.1, {**place, **ball(-179)}))
    for seconds, degrees in ((0.0, 179.0), (0.025, 179.5), (0.05, 180.0), (0.075, 180.5), (0.1, 181.0)):
        found = yaw(platform, TimeQuery(at(seconds)))
        assert math.remainder(found - degrees, 360.0) == pytest.approx(0.0, abs=1e-9)
        column = complete(lookup_batch(platform, "Head:Root", "Rover:Mast", np.array([at(seconds)]))).vectors[0]
        assert 2.0 * abs(math.degrees(math.atan2(column[6], column[3]))) == pytest.approx(
            degrees if column[3] * column[6] > 0 or degrees <= 180 else 360 - degrees, abs=1e-9
        )
        moved = compute_motion(platform, "Head:Root", "Rover:Mast", "", TimeQuery(at(seconds)), at(1.0))
        assert moved.angular_velocity == pytest.approx((0.0, 0.0, math.radians(20.0)))
    predicted = yaw(platform, TimeQuery(at(0.2), Policy.PREDICTED))
    assert math.remainder(predicted - 183.0, 360.0) == pytest.approx(0.0, abs=1e-9)


def test_given_a_ball_with_rates_then_its_angular_velocity_and_its_change_are_interpolated() -> None:
    joints = JointHistory(model_with(Joint(JointType.SPHERICAL)).joints.values(), 60.0)
    for seconds, degrees, rate in ((0.0, 179, 1.0), (0.1, -179, 2.0)):
        some = (JointSample("J.rx", 0.0, NAN, 0.0), JointSample("J.ry", 0.0, NAN, 0.0))
        some += (JointSample("J.rz", math.radians(degrees), NAN, rate),)
        joints, _ = update(joints, seconds, *some)
    platform = view_of(model_with(Joint(JointType.SPHERICAL)))._replace(joints=joints)
    moved = compute_motion(platform, "Head:Root", "Rover:Mast", "", TimeQuery(at(0.05)), at(1.0))
    assert moved.angular_velocity == pytest.approx((0.0, 0.0, 1.5))
    assert moved.angular_acceleration == pytest.approx((0.0, 0.0, 10.0))


def test_given_a_ball_whose_coordinates_have_different_times_then_each_is_interpolated_by_itself() -> None:
    model = model_with(Joint(JointType.SPHERICAL))
    platform = view_of(model, (0.0, ball(10)), (0.1, {"J.rx": 0.0, "J.ry": 0.0}), (0.2, {"J.rz": math.radians(20)}))
    platform = platform._replace(joints=update(platform.joints, 0.2, JointSample("J.rx", 0.0))[0])
    platform = platform._replace(joints=update(platform.joints, 0.2, JointSample("J.ry", 0.0))[0])
    assert yaw(platform, TimeQuery(at(0.05))) == pytest.approx(12.5)
    column = complete(lookup_batch(platform, "Head:Root", "Rover:Mast", np.array([at(0.05)]))).vectors[0]
    assert math.degrees(2.0 * math.atan2(column[6], column[3])) == pytest.approx(12.5)


def test_given_a_planar_joint_with_limits_in_the_plane_only_then_it_turns() -> None:
    joint = Joint(JointType.PLANAR, lower=(-2.0, -math.inf, -math.inf), upper=(2.0, math.inf, math.inf))
    ways = ((0.0, 179.0), (0.1, -179.0))
    readings = [(t, {"J.x": 0.0, "J.y": 0.0, "J.turn": math.radians(degrees)}) for t, degrees in ways]
    assert abs(yaw(view_of(model_with(joint), *readings), TimeQuery(at(0.05)))) == pytest.approx(180.0)


def test_given_rates_then_a_joint_without_limits_is_unwrapped_by_them() -> None:
    platform = view_of(model_with(Joint(JointType.REVOLUTE)), (0.0, {"J": 0.0}), (1.0, {"J": 4.0}), rate=4.0)
    track = platform.joints.tracks["J"]
    assert track.interpolate(at(0.5)).position == pytest.approx(2.0)
    assert track.interpolate_batch(np.array([at(0.5)]))[0][0] == pytest.approx(2.0)


# --- slopes and predictions ---------------------------------------------------------------------------------


def test_given_readings_too_near_each_other_then_their_slope_is_no_rate() -> None:
    held = track((0, 1.0), (1, 1.0), (1.000_002, 1.002))
    assert math.isnan(held.interpolate(at(1.000_001)).rate)
    assert math.isnan(held.estimate_derivatives(held.interpolate(at(1.000_001)))[0])
    assert held.predict(at(1.1), math.inf).rate == pytest.approx(0.002, abs=1e-4)


def test_given_a_slope_beyond_the_rate_limit_then_it_is_extrapolated_by_the_limit() -> None:
    assert track((0, 0.0), (0.01, 1.0)).predict(at(0.11), 2.0).position == pytest.approx(1.2)


@pytest.mark.parametrize("rates", [(0.0, NAN), (NAN, NAN), (0.0, 0.0)])
def test_given_a_stationary_joint_then_the_sigma_of_its_prediction_grows(rates: tuple[float, float]) -> None:
    held = track((0, 1.0, 0.01, *rates), (0.1, 1.0, 0.01, *rates))
    found = [held.predict(at(0.1 + ahead), math.inf) for ahead in (0.0, 0.5, 1.0)]
    assert [each.position for each in found] == [1.0, 1.0, 1.0]
    assert found[-1].sigma == pytest.approx(math.hypot(0.01, 0.5 * MIN_ACCELERATION))
    assert found[0].sigma < found[1].sigma < found[2].sigma
    assert found[-1].rate_sigma == pytest.approx(MIN_ACCELERATION)


# --- clocks, reloads and what comes late --------------------------------------------------------------------


def test_given_a_sample_of_the_future_then_it_is_rejected_and_nothing_forgotten() -> None:
    known, _ = update(JointHistory(constraints(), 60.0), 0.0, JointSample("Nod", 0.1))
    assert update(known, 2.0 + MAX_CLOCK_LEAD_S + 0.01, JointSample("Nod", 0.2), now=2.0) == (known, ("future",))
    assert update(known, 2.0 + MAX_CLOCK_LEAD_S - 0.01, JointSample("Nod", 0.2), now=2.0)[1] == ()


def test_given_a_clock_set_back_by_less_than_a_second_then_two_times_are_not_mixed() -> None:
    known = JointHistory(constraints(), 60.0)
    for n in range(50):
        known, _ = update(known, n * 0.02, JointSample("Nod", 1.0))
    known, _ = update(known, 0.18, JointSample("Nod", -1.0))
    assert (len(known.tracks["Nod"]), known.tracks["Nod"].newest.position) == (1, -1.0)


def test_given_a_clock_set_back_and_a_joint_not_received_since_then_the_latest_is_stale() -> None:
    platform = view_of(model_with(Joint(JointType.REVOLUTE)), (100.0, {"J": 1.0}))
    for now, reason in ((50.0, Invalid.STALE_JOINT), (99.8, Invalid.STALE_JOINT), (99.95, Invalid(0))):
        answer = platform.transformation("Head:Root", "Rover:Mast", TimeQuery(), at(now))
        assert Invalid(answer.transformation.invalid_reasons) == reason


def test_given_a_joint_of_another_type_after_a_reload_then_nothing_is_known_of_it() -> None:
    known = view_of(model_with(Joint(JointType.REVOLUTE)), (0.0, {"J": 1.5})).joints
    other = known.for_model(model_with(Joint(JointType.PRISMATIC, axis=(1.0, 0.0, 0.0))))
    assert dict(other.tracks) == {}


def test_given_a_joint_that_lost_its_limits_in_a_reload_then_it_goes_round() -> None:
    limited = model_with(Joint(JointType.REVOLUTE, lower=(-7.0,), upper=(7.0,)))
    known = view_of(limited, (0.0, {"J": 3.1}), (0.1, {"J": -3.1})).joints
    free = known.for_model(model_with(Joint(JointType.REVOLUTE)))
    assert known.tracks["J"].interpolate(at(0.05)).position == pytest.approx(0.0)
    assert free.tracks["J"].interpolate(at(0.05)).position == pytest.approx(math.pi)


def test_given_a_name_twice_in_a_message_then_the_first_counts() -> None:
    known, rejected = update(JointHistory(constraints(), 60.0), 0.0, JointSample("Nod", 0.1), JointSample("Nod", 0.2))
    assert rejected == ("duplicate Nod",)
    assert known.tracks["Nod"].newest.position == 0.1


def test_given_a_message_that_comes_again_then_nothing_changes_and_nothing_is_rejected() -> None:
    known, _ = JointHistory(constraints(), 60.0).update(joints_at(0.0), T0)
    assert known.update(joints_at(0.0), T0) == (known, ())


def test_given_a_late_reading_then_no_more_than_a_block_is_copied() -> None:
    held = JointTrack(60.0)
    for n in range(10 * BLOCK_SIZE):
        held = held.insert(T0 + 2 * n, (float(n), NAN, NAN, NAN))
    late = held.insert(T0 + 5 * BLOCK_SIZE, (0.25, NAN, NAN, NAN)).insert(T0 + 5 * BLOCK_SIZE + 1, (0.5, NAN, NAN, NAN))
    assert len(late) == len(held) + 1
    fresh = [block for block in late._blocks if all(block is not each for each in held._blocks)]
    assert len(fresh) == 1
    assert len(fresh[0].times) == BLOCK_SIZE + 1
    assert late.hold(T0 + 5 * BLOCK_SIZE + 1).position == 0.5


def test_given_a_query_of_a_moment_then_only_the_readings_around_it_are_copied() -> None:
    held = JointTrack(60.0)
    for n in range(5 * BLOCK_SIZE):
        held = held.insert(T0 + n * 1000, (float(n), NAN, NAN, NAN))
    with mock.patch.object(np, "frombuffer", wraps=np.frombuffer) as copied:
        held.interpolate_batch(np.array([T0 + 1_000_500, T0 + 1_010_500]))
    assert 12 <= len(copied.call_args_list[0].args[0]) <= 13


@pytest.mark.parametrize(
    ("utime", "why"), [(T0 // S, "seconds"), (T0 // 1000, "milliseconds"), (T0 - 61 * S, "too_old")]
)
def test_given_a_stamp_older_than_what_is_held_then_also_the_first_is_rejected_with_the_unit(utime: int, why: str):
    joints, rejected = JointHistory(constraints(), 60.0).update(
        JointsSample(SensorHeader(utime, "arm"), (JointSample("Nod", 0.1),)), T0
    )
    assert not joints.tracks
    assert why in rejected[0]


def test_given_a_thousand_unknown_joints_in_one_message_then_the_nearest_name_of_a_few_is_searched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    searched: list[str] = []
    monkeypatch.setattr("modelserver.joints.find_nearest_names", lambda name, known: searched.append(name) or [])
    unknown = [JointSample(f"x{n}", 0.1) for n in range(1024)]
    _, rejected = JointHistory(constraints(), 60.0).update(sample(1.0, *unknown), at(1.0))
    assert len(rejected) == 1024
    assert len(searched) == MAX_SUGGESTIONS
    assert rejected[-1] == "unknown joint"

"""PlatformView: every pair of frames, with every time policy, and every error."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from support_samples import ORIGIN, START, ScriptedLocalizer, cart

from modelserver.errors import (
    LimitError,
    MalformedRequestError,
    NoPoseError,
    NotConnectedError,
    QueryError,
    TooNewError,
    TooOldError,
    UnknownBodyError,
    UnknownFrameError,
)
from modelserver.estimation.history import History
from modelserver.geometry import names
from modelserver.messages import Invalid, Policy, PoseAnswer, Quality, TimeQuery
from modelserver.query.view import HISTORY_LIMIT, PREDICTION_LIMIT_S, PlatformView, complete
from modelserver.transforms import Pose, so3

S = 1_000_000
NOW = TimeQuery()
BASE, MAST, CAMERA = "Cart:Base", "Cart:Mast", "Camera:Origin"
UTM, ENU, ODOM = names.WORLD_UTM, names.WORLD_ENU, names.ODOM
FRAMES = (BASE, MAST, CAMERA, UTM, ENU, ODOM)
WORLDS = (UTM, ENU, ODOM)


def view(
    seconds: int = 10, localizer: ScriptedLocalizer | None = None, sigma: bool = False, horizon: float = 60.0
) -> PlatformView:
    """The platform after `seconds` with a sample in each."""
    localizer = localizer or ScriptedLocalizer()
    held = History(horizon)
    for n in range(seconds + 1):
        localizer = ScriptedLocalizer(
            START + n * S, n + 1, localizer.origin, localizer.epoch, localizer.stale_s, localizer.invalid
        )
        held = held.append(localizer.estimate(localizer.utime))
    return PlatformView(cart(sigma), BASE, localizer, held)


def ask(platform: PlatformView, interest: str, reference: str, time: TimeQuery = NOW) -> PoseAnswer:
    return platform.transformation(interest, reference, time)


# --- pairs --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("interest", "reference"), list(itertools.product(FRAMES, FRAMES)))
def test_given_any_pair_then_the_reverse_is_its_inverse_in_pose_covariance_and_validity(
    interest: str, reference: str
) -> None:
    platform = view(localizer=ScriptedLocalizer(invalid=Invalid.STALE_GPS | Invalid.NOT_MOVED_YET), sigma=True)
    there, back = ask(platform, interest, reference), ask(platform, reference, interest)
    assert there.transformation.frame_of_interest == interest
    assert there.transformation.frame_of_reference == reference
    assert (there.transformation.pose @ back.transformation.pose).is_close(Pose.identity(), 1e-9, 1e-12)
    assert there.transformation.invalid_reasons == back.transformation.invalid_reasons
    assert there.transformation.utime == back.transformation.utime
    forth, inverted = there.transformation.covariance, back.transformation.inverse().covariance
    assert (forth is None) == (inverted is None)
    if forth is not None and inverted is not None:
        # `inverse` is of first order; the large-angle lever-arm error differs by the square of the angle
        off = float(np.trace(forth[3:, 3:])) * float(np.linalg.norm(there.transformation.pose.position))
        assert np.allclose(forth, inverted, rtol=0.0, atol=1e-12 + 2.0 * off * max(off, 0.1))
        assert np.allclose(forth[3:, 3:], inverted[3:, 3:], atol=1e-12)


@pytest.mark.parametrize(
    ("a", "b", "c"), [(CAMERA, MAST, UTM), (CAMERA, BASE, ODOM), (MAST, UTM, ODOM), (BASE, UTM, ENU)]
)
def test_given_three_frames_then_the_poses_chain(a: str, b: str, c: str) -> None:
    platform = view()
    X_CB, X_BA = ask(platform, b, c).transformation.pose, ask(platform, a, b).transformation.pose
    assert (X_CB @ X_BA).is_close(ask(platform, a, c).transformation.pose, 1e-9, 1e-12)


@pytest.mark.parametrize(("interest", "reference"), list(itertools.product((BASE, MAST, CAMERA), repeat=2)))
def test_given_frames_of_the_vehicle_then_the_answer_is_static_and_needs_no_pose(interest: str, reference: str) -> None:
    platform = PlatformView(cart(), BASE, None, History(1.0))
    answer = ask(platform, interest, reference)
    assert answer.transformation.pose == cart().get_transformation(interest, reference).pose
    assert (answer.transformation.utime, answer.transformation.origin_id, answer.origin) == (0, 0, None)
    assert answer.transformation.is_valid


def test_given_the_base_frame_then_its_world_pose_is_the_localizers_own() -> None:
    platform = view(10)
    estimate = platform.history.newest
    for world, pose in ((UTM, estimate.utm), (ENU, estimate.enu), (ODOM, estimate.odom)):
        answer = ask(platform, BASE, world)
        assert answer.transformation.pose == pose
        assert answer.transformation.utime == START + 10 * S
        assert answer.transformation.model_revision == platform.model.revision
        # Odom has no place on earth
        assert answer.origin == (None if world == ODOM else ORIGIN)
        assert answer.transformation.origin_id == (0 if world == ODOM else ORIGIN.origin_id)


def test_given_two_world_frames_then_their_relation_is_that_at_the_vehicle() -> None:
    platform = view()
    estimate = platform.history.newest
    assert estimate.utm is not None
    assert estimate.enu is not None
    assert ask(platform, ENU, UTM).transformation.pose.is_close(estimate.utm @ estimate.enu.inverse())


@pytest.mark.parametrize("world", WORLDS)
def test_given_a_frame_in_itself_then_it_is_exact_even_without_a_pose(world: str) -> None:
    platform = PlatformView(cart(), BASE, None, History(1.0))
    answer = ask(platform, world, world)
    assert answer.transformation.pose == Pose.identity()
    assert answer.transformation.is_valid
    covariance = answer.transformation.covariance
    assert covariance is not None
    assert not covariance.any()


@pytest.mark.parametrize("world", WORLDS)
def test_given_a_rolling_frame_then_the_estimates_are_of_it_and_the_base_frame_is_mounted_on_it(world: str) -> None:
    plain = view()
    platform = PlatformView(plain.model, BASE, plain.localizer, plain.history, MAST)
    rolling, base = ask(platform, MAST, world), ask(platform, BASE, world)
    assert rolling.transformation.pose == ask(plain, BASE, world).transformation.pose
    mounted = cart().get_transformation(BASE, MAST).pose
    assert base.transformation.pose.is_close(rolling.transformation.pose @ mounted)
    published = platform.get_published_pose(platform.history.newest, world)
    assert published.transformation.frame_of_interest == BASE
    assert published.transformation.pose == base.transformation.pose
    covariance = published.transformation.covariance
    assert covariance is not None
    assert np.array_equal(covariance, base.transformation.covariance)


def test_given_bounds_then_they_stand_beside_the_base_frame_in_the_world_alone() -> None:
    platform = view()
    for pair in ((BASE, UTM), (ENU, BASE)):
        answer = ask(platform, *pair)
        assert (answer.horizontal_protection_level, answer.heading_protection_level) == (1.5, 0.1)
    for pair in ((CAMERA, UTM), (BASE, ODOM), (ODOM, BASE), (ENU, UTM), (CAMERA, BASE)):
        answer = ask(platform, *pair)
        assert math.isnan(answer.horizontal_protection_level)
        assert math.isnan(answer.heading_protection_level)
    # a heading error moves the base frame about the rolling frame
    moved = ask(PlatformView(platform.model, BASE, platform.localizer, platform.history, MAST), BASE, UTM)
    assert 1.5 < moved.horizontal_protection_level <= 1.5 + 0.1 * 1.2
    assert moved.heading_protection_level == 0.1


# --- covariance ---------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("world", [UTM, ODOM])
@pytest.mark.parametrize("inverse", [False, True])
def test_given_a_mounted_frame_then_its_covariance_agrees_with_monte_carlo(world: str, inverse: bool) -> None:
    platform = view()
    answer = ask(platform, world, CAMERA) if inverse else ask(platform, CAMERA, world)
    found = answer.transformation.covariance
    assert found is not None

    rng = np.random.default_rng(5)
    estimate = platform.history.newest
    X_WB = estimate.utm if world == UTM else estimate.odom
    numbers = estimate.covariance if world == UTM else estimate.odom_covariance
    assert X_WB is not None
    X_BC = cart().get_transformation(CAMERA, BASE).pose
    exact = answer.transformation.pose
    errors = []
    for d in rng.multivariate_normal(np.zeros(6), np.array(numbers).reshape(6, 6), 20_000):
        turned = so3.normalize(so3.multiply(so3.exponential(tuple(d[3:])), X_WB.wxyz))
        pose = Pose(np.add(X_WB.xyz, d[:3]), turned) @ X_BC
        pose = pose.inverse() if inverse else pose
        turn = so3.logarithm(so3.normalize(so3.multiply(pose.wxyz, so3.conjugate(exact.wxyz))))
        errors.append([*np.subtract(pose.xyz, exact.xyz), *turn])
    sampled = np.cov(np.array(errors).T)
    scale = np.sqrt(np.outer(np.diag(found), np.diag(found)))
    # second-order terms: with 0.03 rad at 100 m they are meters times 5e-4
    assert np.max(np.abs(sampled - found) / scale) < (0.06 if inverse else 0.04)


def test_given_no_covariance_then_none_is_made_up() -> None:
    localizer = ScriptedLocalizer(START, 1)
    bare = localizer.estimate(START)
    held = History(60.0).append(type(bare)(START, bare.odom, bare.enu, bare.utm, origin=ORIGIN))
    platform = PlatformView(cart(), BASE, localizer, held)
    for interest, reference in ((BASE, UTM), (CAMERA, UTM), (UTM, CAMERA), (CAMERA, ODOM)):
        assert ask(platform, interest, reference).transformation.covariance is None


def test_given_a_surveyed_mount_then_its_sigmas_add_to_the_vehicles() -> None:
    bare, surveyed = (ask(view(sigma=sigma), CAMERA, UTM).transformation.covariance for sigma in (False, True))
    assert bare is not None
    assert surveyed is not None
    assert np.all(np.diag(surveyed) > np.diag(bare))


# --- validity -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("invalid", "odom"),
    [
        (Invalid.NO_FIX | Invalid.NO_ORIGIN, Invalid(0)),
        (Invalid.STALE_GPS | Invalid.GPS_REJECTED, Invalid(0)),
        (Invalid.NOT_MOVED_YET | Invalid.STATIONARY_HEADING | Invalid.LIMIT_EXCEEDED, Invalid(0)),
        (Invalid.STALE_IMU | Invalid.STALE_GPS, Invalid.STALE_IMU),
        (Invalid.CLOCK_STEPPED, Invalid.CLOCK_STEPPED),
    ],
)
def test_given_reasons_that_touch_only_the_world_then_odom_stays_valid_both_ways(
    invalid: Invalid, odom: Invalid
) -> None:
    platform = view(localizer=ScriptedLocalizer(invalid=invalid))
    for frame in (BASE, CAMERA):
        assert ask(platform, frame, ODOM).transformation.invalid_reasons == odom
        assert ask(platform, ODOM, frame).transformation.invalid_reasons == odom
        assert ask(platform, frame, UTM).transformation.invalid_reasons == invalid
        assert ask(platform, UTM, frame).transformation.invalid_reasons == invalid
    # between Odom and the earth both count
    assert ask(platform, ODOM, UTM).transformation.invalid_reasons == invalid
    assert ask(platform, ENU, ODOM).transformation.invalid_reasons == invalid
    assert platform.get_published_pose(platform.history.newest, ODOM).transformation.invalid_reasons == odom


def test_given_no_sensors_then_world_frames_report_that_the_vehicle_file_names_none() -> None:
    platform = PlatformView(cart(), BASE, None, History(1.0))
    for interest, reference in ((CAMERA, UTM), (ENU, CAMERA), (BASE, ODOM), (UTM, ENU)):
        with pytest.raises(NoPoseError, match="names no GPS and IMU"):
            ask(platform, interest, reference)
    with pytest.raises(NoPoseError, match="names no GPS and IMU"):
        complete(platform.vehicle_history(START, START + S, 1.0))


def test_given_no_sample_yet_then_there_is_no_pose_and_the_reasons_are_reported() -> None:
    platform = PlatformView(cart(), BASE, ScriptedLocalizer(), History(1.0))
    for time in (NOW, TimeQuery(START), TimeQuery(START, Policy.PREDICTED), TimeQuery(START, Policy.HELD)):
        with pytest.raises(NoPoseError, match="no usable GPS fix yet; no inertial sample yet"):
            ask(platform, CAMERA, UTM, time)
    with pytest.raises(NoPoseError, match="no usable GPS fix yet"):
        complete(platform.vehicle_history(START, START + S, 1.0))


def test_given_no_origin_yet_then_odom_answers_and_the_world_does_not() -> None:
    platform = view(localizer=ScriptedLocalizer(origin=None))
    assert ask(platform, CAMERA, ODOM).transformation.is_valid
    assert ask(platform, CAMERA, ODOM).origin is None
    for pair in ((CAMERA, UTM), (ENU, CAMERA), (UTM, ENU), (ODOM, UTM)):
        with pytest.raises(NoPoseError, match="the origin is not set yet"):
            ask(platform, *pair)
    broadcast = platform.get_published_pose(platform.history.newest, UTM)
    assert not broadcast.transformation.is_valid
    assert broadcast.transformation.covariance is None


# --- names --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "error", "near"),
    [
        ("World:UTN", UnknownFrameError, "World:UTM"),
        ("World:utm", UnknownFrameError, "World:UTM"),
        ("World", UnknownFrameError, "World:ENU"),
        ("Odom:Orgin", UnknownFrameError, "Odom:Origin"),
        ("Odom:", UnknownFrameError, "Odom:Origin"),
        ("Camera:Orgin", UnknownFrameError, "Camera:Origin"),
        ("Camrea:Origin", UnknownBodyError, "Camera:Origin"),
        ("Camrea", UnknownBodyError, "Camera:Origin"),
        ("", UnknownFrameError, ""),
    ],
)
@pytest.mark.parametrize("other", [BASE, UTM])
@pytest.mark.parametrize("turned", [False, True])
def test_given_a_mistyped_name_then_the_nearest_is_offered(
    frame: str, error: type[QueryError], near: str, other: str, turned: bool
) -> None:
    with pytest.raises(error) as caught:
        ask(view(), *((other, frame) if turned else (frame, other)))
    if near:
        assert near in caught.value.nearest


def test_given_both_names_mistyped_then_it_is_an_error_even_without_a_pose() -> None:
    platform = PlatformView(cart(), BASE, None, History(1.0))
    with pytest.raises(UnknownFrameError):
        ask(platform, "World:UTN", "World:ENV")
    with pytest.raises(UnknownFrameError):
        ask(platform, "World:UTN", "World:UTN")


def test_given_a_frame_that_nothing_joins_to_the_base_then_the_world_is_not_connected() -> None:
    platform = view()
    assert ask(platform, "Lamp:Origin", "Lamp:Origin").transformation.is_valid
    with pytest.raises(NotConnectedError, match="the world is known at Cart:Base only"):
        ask(platform, "Lamp:Origin", UTM)
    with pytest.raises(NotConnectedError, match="the world is known at Cart:Base only"):
        ask(platform, ODOM, "Lamp:Origin")
    with pytest.raises(NotConnectedError):
        ask(platform, "Lamp:Origin", BASE)


# --- times --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", list(Policy))
def test_given_a_time_that_is_held_then_every_policy_but_latest_answers_for_it(policy: Policy) -> None:
    answer = ask(view(10), BASE, UTM, TimeQuery(START + 4 * S, policy))
    latest = policy is Policy.LATEST
    assert answer.transformation.utime == START + (10 if latest else 4) * S
    assert answer.quality == Quality(0)


def test_given_a_time_between_two_samples_then_policies_interpolate_or_hold() -> None:
    at = START + 4 * S + S // 4
    platform = view(10)
    for policy in (Policy.INTERPOLATED, Policy.PREDICTED):
        answer = ask(platform, BASE, ODOM, TimeQuery(at, policy))
        assert answer.transformation.pose.xyz[0] == pytest.approx(4.25)
        assert answer.quality == Quality.INTERPOLATED
    answer = ask(platform, BASE, ODOM, TimeQuery(at, Policy.HELD))
    assert answer.transformation.pose.xyz[0] == pytest.approx(4.0)
    assert answer.quality == Quality.HELD
    assert answer.transformation.utime == at


def test_given_a_time_past_the_newest_then_policies_reject_predict_or_hold() -> None:
    at = START + 11 * S + S // 2
    platform = view(10)
    with pytest.raises(TooNewError, match=r"1\.500 s after"):
        ask(platform, BASE, UTM, TimeQuery(at))
    predicted = ask(platform, BASE, ODOM, TimeQuery(at, Policy.PREDICTED))
    assert predicted.transformation.pose.xyz[0] == pytest.approx(11.5)
    assert predicted.quality == Quality.PREDICTED
    assert not predicted.transformation.is_valid
    assert ask(platform, BASE, UTM, TimeQuery(at, Policy.LATEST)).transformation.utime == START + 10 * S


def test_given_a_pose_held_past_the_newest_sample_then_silence_makes_it_invalid() -> None:
    platform = view(10)
    soon = ask(platform, BASE, UTM, TimeQuery(START + 10 * S + S // 2, Policy.HELD))
    late = ask(platform, BASE, UTM, TimeQuery(START + 3600 * S, Policy.HELD))
    assert soon.transformation.is_valid
    assert Invalid.STALE_GPS & late.transformation.invalid_reasons
    assert late.transformation.pose == soon.transformation.pose


@pytest.mark.parametrize("policy", [Policy.INTERPOLATED, Policy.HELD, Policy.PREDICTED])
def test_given_a_time_before_all_then_it_is_too_old(policy: Policy) -> None:
    with pytest.raises(TooOldError, match="before the time covered"):
        ask(view(10), BASE, UTM, TimeQuery(START - 1, policy))


def test_given_a_prediction_at_its_limit_then_beyond_is_too_new() -> None:
    platform = view(10)
    limit = START + 10 * S + round(PREDICTION_LIMIT_S * S)
    assert ask(platform, BASE, UTM, TimeQuery(limit, Policy.PREDICTED)).transformation.utime == limit
    for at in (limit + 1, (1 << 61) - 1):
        with pytest.raises(TooNewError, match="5 s ahead at most"):
            ask(platform, BASE, UTM, TimeQuery(at, Policy.PREDICTED))


def test_given_static_frames_then_the_time_asked_plays_no_part() -> None:
    assert ask(view(10), CAMERA, BASE, TimeQuery(1)).transformation.utime == 0


def test_given_times_then_coverage_is_reported() -> None:
    platform = view(10)
    assert platform.is_covered(START + 10 * S)
    assert platform.is_covered(START - S)
    assert not platform.is_covered(START + 10 * S + 1)
    assert not PlatformView(cart(), BASE, ScriptedLocalizer(), History(1.0)).is_covered(START)


# --- history ------------------------------------------------------------------------------------------------


def test_given_a_range_and_a_rate_then_the_times_are_even_and_only_held_ones_come() -> None:
    answers = complete(view(10).vehicle_history(START + 8 * S, START + 12 * S, 4.0))
    assert [(each.transformation.utime - START) / S for each in answers] == [8 + n / 4 for n in range(9)]
    assert all(each.transformation.frame_of_reference == UTM for each in answers)
    assert all(each.transformation.frame_of_interest == BASE for each in answers)


def test_given_a_range_of_one_instant_then_one_pose_comes() -> None:
    assert len(complete(view(10).vehicle_history(START + S, START + S, 50.0))) == 1


def test_given_a_rate_that_divides_no_microsecond_then_the_times_do_not_drift() -> None:
    answers = complete(view(10).vehicle_history(START, START + 9 * S, 30.0))
    assert len(answers) == 271
    assert answers[-1].transformation.utime == START + 9 * S
    assert answers[200].transformation.utime == START + round(200e6 / 30)


def test_given_a_range_outside_what_is_held_then_nothing_comes() -> None:
    assert complete(view(10).vehicle_history(1, 1000, 1.0)) == ()


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf"), 1e6, -float("inf")])
def test_given_a_rate_that_cannot_be_then_the_request_is_malformed(rate: float) -> None:
    with pytest.raises(MalformedRequestError, match="rate_hz"):
        complete(view().vehicle_history(START, START + S, rate))


def test_given_a_range_that_ends_before_it_starts_then_the_request_is_malformed() -> None:
    with pytest.raises(MalformedRequestError, match="before it starts"):
        complete(view().vehicle_history(START + 1, START, 1.0))


def test_given_more_poses_than_go_in_a_reply_then_the_limit_is_named() -> None:
    platform = view()
    assert complete(platform.vehicle_history(START, START + (HISTORY_LIMIT - 1) * 1000, 1000.0))
    for end in (START + HISTORY_LIMIT * 1000, (1 << 61) - 1):
        with pytest.raises(LimitError, match="at most 1000"):
            complete(platform.vehicle_history(START, end, 1000.0))


def test_given_sensors_that_went_silent_then_the_latest_pose_is_not_valid_any_more() -> None:
    platform = view(10)
    newest = START + 10 * S
    soon = platform.transformation(BASE, UTM, NOW, newest + 100_000)
    assert soon.transformation.is_valid
    late = platform.transformation(BASE, UTM, NOW, newest + 600 * S)
    assert late.transformation.utime == newest
    assert Invalid.STALE_IMU in Invalid(late.transformation.invalid_reasons)
    assert late.transformation.pose == soon.transformation.pose
    # a query for a time does not depend on when it is made
    then = platform.transformation(BASE, UTM, TimeQuery(newest - S), newest + 600 * S)
    assert then.transformation.is_valid


def test_given_a_gap_in_the_history_then_what_is_held_in_it_is_no_better_than_what_came_after() -> None:
    good, late = ScriptedLocalizer(START, 1), ScriptedLocalizer(START + 30 * S, 2, invalid=Invalid.STALE_IMU)
    history = History(60.0).append(good.estimate(START)).append(late.estimate(START + 30 * S))
    platform = PlatformView(cart(), BASE, late, history)
    within = ask(platform, BASE, UTM, TimeQuery(START + 10 * S, Policy.HELD))
    assert Invalid.STALE_IMU in Invalid(within.transformation.invalid_reasons)
    exact = ask(platform, BASE, UTM, TimeQuery(START, Policy.HELD))
    assert exact.transformation.is_valid

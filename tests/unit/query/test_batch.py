"""Batch queries: each row equals a single query in pose, covariance, flags and status."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support_between import lookup_between
from support_moving import BASE, DEEP, ENU, ODOM, ORIGIN, SCAN, T0, UTM, S, estimate, joints_at, rover, view

from modelserver.errors import LimitError, NoPoseError, QueryError, Status, UnknownFrameError
from modelserver.estimation.history import History
from modelserver.joints import NO_JOINTS, JointHistory
from modelserver.messages import MAX_REQUEST_INSTANTS, Invalid, JointSample, PoseAnswer, Quality, TimeQuery
from modelserver.query.batch import lookup_batch
from modelserver.query.view import PlatformView, complete
from modelserver.transforms.pose import Pose

FINGER = "Finger:Tip"


@cache
def held() -> PlatformView:
    return view(2.0)


@cache
def bare() -> PlatformView:
    return view(2.0, sigma=None)


def utimes(low: float = 0.0, high: float = 2.0, count: int = 41) -> np.ndarray:
    # between samples, and among them samples themselves
    return T0 + np.round(np.linspace(low, high, count) * S).astype(np.int64)


def compare(platform: PlatformView, interest: str, reference: str, at: np.ndarray, **fixed: object) -> None:
    """Assert that every row equals a single query."""
    found = complete(lookup_batch(platform, interest, reference, at, **fixed))  # type: ignore[arg-type]
    unknown: list[bool] = []
    for row, when in enumerate(at.tolist()):
        try:
            answer = single(platform, interest, reference, when, **fixed)  # type: ignore[arg-type]
        except QueryError as error:
            status = error.status
        else:
            status = Status.OK
        assert found.status[row] == status
        if status is not Status.OK:
            assert np.isnan(found.vectors[row]).all()
            continue
        expected = answer.transformation
        moved, turned = expected.pose.distance(Pose.from_state_vector(found.vectors[row]))
        assert moved < 1e-9
        assert turned < 1e-9
        assert found.invalid[row] == expected.invalid_reasons
        assert found.quality[row] == answer.quality
        assert found.epochs[row] == expected.pose_epoch
        if answer.origin is not None:
            assert found.origin == answer.origin
        unknown.append(expected.covariance is None)
        if expected.covariance is None:
            assert found.covariances is None or np.isnan(found.covariances[row]).all()
        else:
            assert found.covariances is not None
            assert np.allclose(found.covariances[row].reshape(6, 6), expected.covariance, rtol=1e-9, atol=1e-15)
    assert all(unknown) or found.covariances is not None


def single(
    platform: PlatformView, interest: str, reference: str, at: int, fixed: str = "", reference_at: int = 0
) -> PoseAnswer:
    if fixed:
        return lookup_between(platform, interest, at, reference, reference_at, fixed)
    return platform.transformation(interest, reference, TimeQuery(at))


PAIRS = [
    (SCAN, UTM),
    (UTM, SCAN),
    (DEEP, SCAN),
    (FINGER, SCAN),
    (ODOM, DEEP),
    (SCAN, ODOM),
    (BASE, ENU),
    (UTM, ODOM),
    (UTM, UTM),
    ("Rover:Mast", BASE),
    ("Rover:Mast", UTM),
    (SCAN, SCAN),
]


@pytest.mark.parametrize(("interest", "reference"), PAIRS)
@pytest.mark.parametrize("platform", [held, bare])
def test_given_a_pair_then_rows_are_single_answers(platform: object, interest: str, reference: str) -> None:
    compare(platform(), interest, reference, utimes())  # type: ignore[operator]


@pytest.mark.parametrize("fixed", [ODOM, UTM, ENU, BASE, SCAN])
@pytest.mark.parametrize(
    ("interest", "reference"), [(SCAN, BASE), (BASE, SCAN), (DEEP, SCAN), (SCAN, UTM), (SCAN, ODOM), (UTM, BASE)]
)
def test_given_a_fixed_frame_then_rows_are_answers_between_two_times(interest: str, reference: str, fixed: str) -> None:
    compare(held(), interest, reference, utimes(count=20), fixed=fixed, reference_at=T0 + 1_503_210)


def test_given_the_time_of_reference_among_the_rows_then_the_vehicle_cancels_there() -> None:
    at = utimes(count=21)
    compare(held(), "Rover:Mast", BASE, at, fixed=UTM, reference_at=int(at[10]))
    found = complete(lookup_batch(held(), "Rover:Mast", BASE, at, int(at[10]), UTM))
    assert Quality.CORRELATION_UNKNOWN not in Quality(int(found.quality[10]))
    assert Quality.CORRELATION_UNKNOWN in Quality(int(found.quality[11]))


@pytest.mark.parametrize(("interest", "reference"), [(SCAN, UTM), (DEEP, SCAN), (BASE, ODOM)])
def test_given_instants_that_are_not_held_then_their_rows_state_it_and_the_others_are_answered(
    interest: str, reference: str
) -> None:
    at = np.concatenate((utimes(-1.0, 0.5), utimes(1.5, 3.0)))
    compare(held(), interest, reference, at)
    found = complete(lookup_batch(held(), interest, reference, at))
    assert set(found.status.tolist()) == {Status.OK, Status.TOO_OLD, Status.TOO_NEW}


def changing() -> PlatformView:
    """A platform whose pose begins at 0.5 s, with covariance from 1 s, and is reset at 1.2 s; with reasons."""
    history = History(60.0)
    for n in range(41):
        at = n * 0.05
        each = estimate(at)
        if at < 0.5:
            each = replace(each, utm=None, enu=None, origin=None, invalid=Invalid.NO_ORIGIN | Invalid.NO_IMU)
        if at < 1.0:
            each = replace(each, covariance=None)
        if at > 1.2:
            each = replace(each, pose_epoch=1, quality=Quality.REVERSING)
        if 1.5 < at < 1.6:
            each = replace(each, invalid=Invalid.STALE_GPS)
        history = history.append(each)
    return held()._replace(history=history)


@pytest.mark.parametrize(("interest", "reference"), [(SCAN, UTM), (UTM, SCAN), (SCAN, ODOM), (BASE, ENU), (UTM, ODOM)])
def test_given_a_pose_that_changes_its_epoch_then_rows_are_single_answers(interest: str, reference: str) -> None:
    compare(changing(), interest, reference, utimes(count=83))


@pytest.mark.parametrize("fixed", [UTM, ODOM])
def test_given_an_epoch_that_begins_between_then_rows_of_the_other_have_no_pose(fixed: str) -> None:
    compare(changing(), SCAN, BASE, utimes(1.01, 2.0, 60), fixed=fixed, reference_at=T0 + 1_703_210)


def test_given_an_origin_that_changes_then_only_rows_of_the_reported_one_have_a_pose() -> None:
    history = History(60.0)
    for n in range(21):
        each = estimate(n * 0.1)
        history = history.append(each if n < 10 else replace(each, origin=replace(ORIGIN, origin_id=78)))
    platform = held()._replace(history=history)
    found = complete(lookup_batch(platform, BASE, UTM, utimes()))
    assert found.origin is not None
    assert found.origin.origin_id == 78
    assert set(found.status[:20].tolist()) == {Status.NO_POSE}
    assert not found.status[21:].any()
    first = complete(lookup_batch(platform, BASE, UTM, utimes(0.0, 0.85)))
    assert first.origin == ORIGIN
    assert not first.status.any()


def test_given_joints_that_were_stale_never_received_or_beyond_their_limits_then_rows_are_flagged() -> None:
    model = rover()
    joints = JointHistory(model.joints.values(), 60.0)
    for seconds in (0.0, 0.1, 1.4, 1.5):
        sample = joints_at(seconds)
        beyond = tuple(
            replace(each, position=0.7) if each.name == "Nod" and seconds > 1 else each for each in sample.joints
        )
        some = tuple(each for each in beyond if not each.name.startswith(("Ball", "Slide")))
        joints, _ = joints.update(replace(sample, joints=some), T0 + round(seconds * S))
    platform = held()._replace(joints=joints)
    for pair in ((SCAN, UTM), (DEEP, SCAN), (FINGER, BASE)):
        compare(platform, *pair, utimes(0.0, 1.5, 60))
    found = complete(lookup_batch(platform, DEEP, SCAN, utimes(0.0, 1.5, 60)))
    assert Invalid.STALE_JOINT in Invalid(int(found.invalid[30]))
    assert Invalid.JOINT_UNKNOWN in Invalid(int(found.invalid[0]))
    assert Quality.JOINT_DEFAULT in Quality(int(found.quality[0]))
    assert Quality.OUT_OF_LIMITS in Quality(int(found.quality[-1]))


def test_given_joints_without_sigma_at_times_then_the_covariance_is_unknown_there_alone() -> None:
    model = rover()
    slide = replace(model.joints["Slide"], joint=replace(model.joints["Slide"].joint, sigma=()))
    joints = JointHistory([slide], 60.0)
    for n in range(11):
        sample = JointSample("Slide", 0.1 * n, 0.001 if n < 5 else math.nan)
        joints, _ = joints.update(replace(joints_at(n * 0.1), joints=(sample,)), T0 + n * S // 10)
    found = complete(lookup_batch(held()._replace(joints=joints), "Upper:Root", BASE, utimes(0.0, 1.0, 11)))
    assert found.covariances is not None
    assert np.isnan(found.covariances).any(axis=1).tolist() == [False] * 5 + [True] * 6


def test_given_no_covariance_wanted_then_none_is_worked_out() -> None:
    assert complete(lookup_batch(held(), SCAN, UTM, utimes(), with_covariance=False)).covariances is None


@pytest.mark.parametrize(("interest", "reference"), [(SCAN, UTM), (DEEP, SCAN), ("Rover:Mast", BASE), (UTM, UTM)])
@pytest.mark.parametrize("fixed", ["", ODOM, UTM])
def test_given_no_instants_then_the_answer_is_empty(interest: str, reference: str, fixed: str) -> None:
    found = complete(lookup_batch(held(), interest, reference, np.zeros(0, dtype=np.int64), 0, fixed))
    assert found.vectors.shape == (0, 7)
    assert found.covariances is None or found.covariances.shape == (0, 36)


def test_given_instants_in_any_order_then_rows_are_in_that_order() -> None:
    at = np.random.default_rng(1).permutation(np.concatenate((utimes(), utimes())))
    compare(held(), SCAN, UTM, at)


def test_given_too_many_instants_then_the_error_states_the_limit() -> None:
    with pytest.raises(LimitError, match=f"{MAX_REQUEST_INSTANTS + 1} instants.*at most {MAX_REQUEST_INSTANTS}.*Split"):
        complete(lookup_batch(held(), SCAN, UTM, np.zeros(MAX_REQUEST_INSTANTS + 1, dtype=np.int64)))


@pytest.mark.parametrize(
    ("interest", "reference", "fixed"), [("A:B", UTM, ""), (SCAN, "World:X", ""), (SCAN, BASE, "Odom:Orign")]
)
def test_given_a_frame_that_there_is_not_then_the_whole_query_fails(interest: str, reference: str, fixed: str) -> None:
    with pytest.raises(QueryError):
        complete(lookup_batch(held(), interest, reference, utimes(), 0, fixed))


@pytest.mark.parametrize("reference", [BASE, UTM])
def test_given_a_misspelt_fixed_frame_then_the_nearest_is_suggested(reference: str) -> None:
    with pytest.raises(UnknownFrameError) as caught:
        complete(lookup_batch(held(), SCAN, reference, utimes(), 0, "Odom:Orign"))
    assert ODOM in caught.value.nearest


def test_given_no_pose_at_all_then_the_whole_query_fails() -> None:
    with pytest.raises(NoPoseError):
        complete(lookup_batch(held()._replace(history=History(60.0)), SCAN, UTM, utimes()))


def test_given_a_clock_that_stepped_then_what_depends_on_time_is_invalid() -> None:
    stepped = held()._replace(invalid=Invalid.CLOCK_STEPPED)
    for pair in PAIRS:
        compare(stepped, *pair, utimes(count=3))
    alone = stepped._replace(joints=NO_JOINTS)
    compare(alone, "Rover:Mast", BASE, utimes(count=3))

"""Queries answered from a replica, and the errors where it is incomplete or too old."""

from __future__ import annotations

import inspect
import math
from datetime import UTC as UTC_ZONE
from datetime import datetime, timedelta

import numpy as np
import pytest
from support_mirror import FedPlatform, drive, feed_messages, joints, parts, pose, snapshot
from support_moving import BASE, DEEP, ODOM, SCAN, T0, UTM, S, estimate, truth

import modelserver as ms
from modelserver.client.mirror import LocalPlatform, PlatformMirror
from modelserver.client.mirror_state import MirrorReceiver
from modelserver.client.remote import Platform, PlatformClient
from modelserver.messages import MAX_REQUEST_INSTANTS, Policy, PoseDemand, TimeQuery, Unmet
from modelserver.query.answers import check_demand

NOW = T0 + 2 * S + 5_000
QUESTIONS = [*sorted(name for name in dir(PlatformClient) if name.startswith("get_")), "explain", "close"]


@pytest.fixture(scope="module")
def receiver() -> MirrorReceiver:
    return feed_messages(drive(2.0))


@pytest.mark.parametrize("name", QUESTIONS)
@pytest.mark.parametrize("client", [Platform, PlatformMirror])
def test_given_a_question_then_every_client_takes_it_alike(client: type, name: str) -> None:
    mine, common = (inspect.signature(getattr(each, name)) for each in (client, PlatformClient))
    assert mine.return_annotation == common.return_annotation
    assert list(mine.parameters) == list(common.parameters)
    for parameter, wanted in zip(mine.parameters.values(), common.parameters.values(), strict=True):
        assert (parameter.default, parameter.annotation) == (wanted.default, wanted.annotation)
        # what has to be named may also be given by its place: every call of the one is one of the other
        assert parameter.kind in (wanted.kind, inspect.Parameter.POSITIONAL_OR_KEYWORD)


@pytest.mark.parametrize("client", [Platform, PlatformMirror])
def test_given_a_client_then_it_has_no_question_that_the_other_lacks(client: type) -> None:
    public = {name for name in dir(client) if name.startswith(("get_", "explain"))}
    assert public == {name for name in QUESTIONS if name != "close"}


def test_given_a_time_as_a_date_then_it_is_that_of_its_microseconds(receiver: MirrorReceiver) -> None:
    answer, at = FedPlatform(receiver, NOW), T0 + S
    date = datetime(1970, 1, 1, tzinfo=UTC_ZONE) + timedelta(microseconds=at)
    by_date, by_number = (answer.get_transformation(BASE, UTM, at=each) for each in (date, at))
    assert by_date.utime == by_number.utime == at
    assert by_date.pose == by_number.pose


def test_given_what_is_known_then_every_question_has_its_answer(receiver: MirrorReceiver) -> None:
    answer, at = FedPlatform(receiver, NOW), T0 + S
    assert answer.get_body_list() == ["Rover", "Laser", "Upper", "Fore", "Deep", "Finger"]
    assert answer.get_body_frame_list("Laser") == ["Axle", "Scan"]
    X = truth(BASE, UTM, 1.0)
    assert answer.get_state_vector(at=at).pose.is_close(X)
    assert answer.get_h_transform(inverse=True, at=at).pose.is_close(X.inverse())
    assert answer.get_pose(BASE, UTM, at=at).origin is not None
    assert len(answer.get_history(at, at + S, 10.0)) == 11
    assert answer.explain(SCAN, UTM, at=at).edges[0].kind == "vehicle"
    assert answer.get_motion(SCAN, BASE, at=at).pose.transformation.pose.is_close(truth(SCAN, BASE, 1.0))


def test_given_more_instants_than_go_in_one_question_then_all_are_answered(receiver: MirrorReceiver) -> None:
    at = np.linspace(T0, T0 + 2 * S, MAX_REQUEST_INSTANTS + 7).astype(np.int64)
    scan, deep = FedPlatform(receiver, NOW).get_transformations([(SCAN, BASE), (DEEP, UTM)], at, covariance=False)
    assert len(scan.vectors) == len(deep.vectors) == MAX_REQUEST_INSTANTS + 7
    assert not scan.status.any()
    (through,) = FedPlatform(receiver, NOW).get_transformations([(SCAN, BASE)], at[:3], fixed_frame=ODOM)
    assert not through.status.any()


@pytest.mark.parametrize(
    ("ask", "error"),
    [
        (lambda p: p.get_transformation("Lasre:Scan", BASE), ms.UnknownBodyError),
        (lambda p: p.get_transformation("Laser:Scna", BASE), ms.UnknownFrameError),
        (lambda p: p.get_transformation(SCAN, "World:UTN"), ms.UnknownFrameError),
        (lambda p: p.get_body_frame_list("Lasre"), ms.UnknownBodyError),
        (lambda p: p.get_transformation(SCAN, BASE, at=-1), ms.MalformedRequestError),
        (lambda p: p.get_transformation(SCAN, BASE, at=1 << 62), ms.MalformedRequestError),
        (lambda p: p.get_transformation(SCAN, BASE, wait_ms=-1), ms.MalformedRequestError),
        (lambda p: p.get_transformation(SCAN, BASE, policy=9), ms.MalformedRequestError),
        (lambda p: p.get_history(2, 1, 1.0), ms.MalformedRequestError),
        (lambda p: p.get_history(-2, 1, 1.0), ms.MalformedRequestError),
        (lambda p: p.get_history(T0, T0 + 1000 * S, 10.0), ms.LimitError),
        (lambda p: p.get_transformations([], [T0]), ms.MalformedRequestError),
        (lambda p: p.get_transformations([(SCAN, BASE)], [-1]), ms.MalformedRequestError),
        (lambda p: p.get_state_vector(at=T0 - 1), ms.TooOldError),
        (lambda p: p.get_state_vector(at=NOW + S), ms.TooNewError),
    ],
)
def test_given_a_question_that_makes_no_sense_then_it_is_refused_as_the_service_does(
    receiver: MirrorReceiver, ask: object, error: type[Exception]
) -> None:
    with pytest.raises(error):
        ask(FedPlatform(receiver, NOW))  # type: ignore[operator]


# --- too little, too old ------------------------------------------------------------------------------------


def test_given_nothing_received_then_it_reports_what_is_missing() -> None:
    answer = FedPlatform(MirrorReceiver(), T0)
    assert answer.read_state()[0].get_ages(T0) == (math.inf, math.inf, math.inf)
    with pytest.raises(ms.OutOfDateError, match=r"no complete MODEL_SNAPSHOT.*Is the daemon running"):
        answer.get_transformation(SCAN, BASE)
    for channel, data in pose(estimate(0.0)):
        answer.receiver.feed(channel, data, T0)
    with pytest.raises(ms.NoServerError, match=r"last POSE 0\.5 s ago"):
        FedPlatform(answer.receiver, T0 + S // 2).get_body_list()


def test_given_no_pose_then_the_geometry_is_answered_and_the_world_is_not() -> None:
    receiver = MirrorReceiver()
    for channel, data in parts(snapshot()):
        receiver.feed(channel, data, T0)
    answer = FedPlatform(receiver, T0)
    assert answer.get_transformation("Rover:Mast", BASE).is_valid
    with pytest.raises(ms.NoPoseError, match="POSE_ODOM"):
        answer.get_transformation(SCAN, UTM)


def test_given_the_limit_then_what_is_older_is_refused_and_what_is_held_is_not(receiver: MirrorReceiver) -> None:
    old = FedPlatform(receiver, NOW + 10 * S)
    assert receiver.state.get_ages(old.now).geometry > 10.0
    with pytest.raises(ms.OutOfDateError, match=r"confirmed 10\.0 s ago, and the limit is 10 s"):
        old.get_transformation("Rover:Mast", BASE)
    # the service lives, and its sensors are silent
    alive = feed_messages(drive(1.0))
    for channel, data in parts(snapshot(), T0 + 12 * S):
        alive.feed(channel, data, T0 + 12 * S)
    silent = FedPlatform(alive, T0 + 12 * S)
    assert silent.get_transformation("Rover:Mast", BASE).is_valid
    with pytest.raises(ms.OutOfDateError, match=r"last POSE here is 11\.0 s old.*do its sensors publish"):
        silent.get_transformation(BASE, UTM)
    assert silent.get_transformation(BASE, UTM, at=T0 + S).is_valid


def test_given_poses_of_the_same_geometry_then_they_confirm_it_without_a_snapshot() -> None:
    receiver = MirrorReceiver()
    for at, channel, data in drive(30.0, pose_hz=10.0, joint_hz=1.0, every_s=100.0):
        receiver.feed(channel, data, at)
    now = T0 + 30 * S + 10_000
    assert receiver.state.get_ages(now).geometry < 0.1
    assert FedPlatform(receiver, now).get_transformation("Rover:Mast", BASE).is_valid


def test_given_a_moving_pair_then_it_is_never_retained_with_those_that_are_stationary() -> None:
    receiver = feed_messages(drive(1.0))
    answer = FedPlatform(receiver, T0 + S + 5_000)
    for pair in ((SCAN, BASE), (BASE, UTM), ("Rover:Mast", BASE), ("Finger:Tip", "Deep:Tip"), (UTM, UTM), (SCAN, SCAN)):
        answer.get_transformation(*pair)
    state = answer.read_state()[0]
    assert set(state.static_transforms) == set(state.static_answers) == {("Rover:Mast", BASE), (SCAN, SCAN)}
    before = answer.get_transformation(SCAN, BASE)
    receiver.feed(*joints(1.02), T0 + S + 25_000)
    assert answer.get_transformation(SCAN, BASE).pose != before.pose


def test_given_a_demand_then_the_replica_gives_the_verdict_of_the_service(receiver: MirrorReceiver) -> None:
    answer, now = FedPlatform(receiver, NOW), NOW
    for ends, demand in (((SCAN, BASE), (1e-3, 0.1, 0.001, 0.0)), ((BASE, UTM), (0.0, 0.0, 0.001, 0.9))):
        view = answer.read_state()[0].view
        assert view is not None
        asked = PoseDemand(*demand)
        found = answer.get_pose(*ends, **asked._asdict())
        assert Unmet.AGE in found.unmet
        expected = check_demand(view, view.transformation(*ends, TimeQuery(), now), asked, TimeQuery(), now)
        assert (found.unmet, found.unmet_reason) == expected
    # a static pair that was asked for before too
    plain = answer.get_pose("Rover:Mast", BASE)
    assert answer.get_pose("Rover:Mast", BASE, max_horizontal=1e-3).unmet is Unmet.HORIZONTAL
    assert answer.get_pose("Rover:Mast", BASE) == plain
    with pytest.raises(ms.MalformedRequestError, match="max_age"):
        answer.get_pose("Rover:Mast", BASE, max_age=math.inf)


def test_given_a_wait_then_what_comes_meanwhile_answers() -> None:
    events = list(drive(1.0))

    class Waiting(FedPlatform):
        """Receive one more event at each wait."""

        def wait_for(self, enough: object, seconds: float) -> bool:
            while not enough():  # type: ignore[operator]
                if not events:
                    return False
                at, channel, data = events.pop(0)
                self.receiver.feed(channel, data, at)
                self.now = at
            return True

    answer: LocalPlatform = Waiting(MirrorReceiver(), T0)
    assert answer.get_transformation("Rover:Mast", BASE, wait_ms=100).is_valid
    assert answer.get_transformation(SCAN, UTM, at=T0 + 500_000, wait_ms=100).utime == T0 + 500_000
    assert events
    with pytest.raises(ms.TooNewError):
        answer.get_transformation(SCAN, UTM, at=T0 + 9 * S, wait_ms=100)
    assert answer.get_transformation(SCAN, UTM, at=T0 + 9 * S, policy=Policy.LATEST).utime == T0 + S

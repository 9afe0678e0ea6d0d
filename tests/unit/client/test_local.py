"""Questions answered from what is known: how old it may be, what is said when it is too old or too little."""

from __future__ import annotations

import inspect
import math

import numpy as np
import pytest
from support_mirror import Told, drive, fed, joints, parts, pose, snapshot
from support_moving import BASE, DEEP, ODOM, SCAN, T0, UTM, S, estimate, truth

import modelserver as ms
from modelserver.client.interface import PlatformClient
from modelserver.client.knowledge import Knowledge
from modelserver.client.local import LocalPlatform
from modelserver.client.mirror import PlatformMirror
from modelserver.client.remote import Platform
from modelserver.messages import MOST_INSTANTS, Policy

NOW = T0 + 2 * S + 5_000
QUESTIONS = [*sorted(name for name in vars(PlatformClient) if name.startswith("get_")), "explain", "close"]


@pytest.fixture(scope="module")
def heard() -> Knowledge:
    return fed(drive(2.0))


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


def test_given_what_is_known_then_every_question_has_its_answer(heard: Knowledge) -> None:
    asked, at = Told(heard, NOW), T0 + S
    assert asked.get_body_list() == ["Rover", "Laser", "Upper", "Fore", "Deep", "Finger"]
    assert asked.get_body_frame_list("Laser") == ["Axle", "Scan"]
    X = truth(BASE, UTM, 1.0)
    assert asked.get_state_vector(at=at).pose.is_close(X)
    assert asked.get_h_transform(inverse=True, at=at).pose.is_close(X.inverse())
    assert asked.get_pose(BASE, UTM, at=at).origin is not None
    assert len(asked.get_history(at, at + S, 10.0)) == 11
    assert asked.explain(SCAN, UTM, at=at).edges[0].kind == "vehicle"
    assert asked.get_motion(SCAN, BASE, at=at).pose.transformation.pose.is_close(truth(SCAN, BASE, 1.0))


def test_given_more_instants_than_go_in_one_question_then_all_are_answered(heard: Knowledge) -> None:
    at = np.linspace(T0, T0 + 2 * S, MOST_INSTANTS + 7).astype(np.int64)
    scan, deep = Told(heard, NOW).get_transformations([(SCAN, BASE), (DEEP, UTM)], at, covariance=False)
    assert len(scan.vectors) == len(deep.vectors) == MOST_INSTANTS + 7
    assert not scan.status.any()
    (through,) = Told(heard, NOW).get_transformations([(SCAN, BASE)], at[:3], fixed_frame=ODOM)
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
    heard: Knowledge, ask: object, error: type[Exception]
) -> None:
    with pytest.raises(error):
        ask(Told(heard, NOW))  # type: ignore[operator]


# --- too little, too old ------------------------------------------------------------------------------------


def test_given_nothing_heard_then_it_says_what_is_missing() -> None:
    asked = Told(Knowledge(), T0)
    assert asked.known()[0].ages(T0) == (math.inf, math.inf, math.inf)
    with pytest.raises(ms.OutOfDateError, match=r"no whole MODEL_SNAPSHOT.*Is the daemon running"):
        asked.get_transformation(SCAN, BASE)
    for channel, data in pose(estimate(0.0)):
        asked.knowledge.feed(channel, data, T0)
    with pytest.raises(ms.NoServerError, match=r"a POSE came 0\.5 s ago"):
        Told(asked.knowledge, T0 + S // 2).get_body_list()


def test_given_no_pose_then_the_geometry_is_answered_and_the_world_is_not() -> None:
    heard = Knowledge()
    for channel, data in parts(snapshot()):
        heard.feed(channel, data, T0)
    asked = Told(heard, T0)
    assert asked.get_transformation("Rover:Mast", BASE).valid
    with pytest.raises(ms.NoPoseError, match="POSE_ODOM"):
        asked.get_transformation(SCAN, UTM)


def test_given_the_limit_then_what_is_older_is_refused_and_what_is_held_is_not(heard: Knowledge) -> None:
    old = Told(heard, NOW + 10 * S)
    assert heard.known.ages(old.now).geometry > 10.0
    with pytest.raises(ms.OutOfDateError, match=r"confirmed 10\.0 s ago, and the limit is 10 s"):
        old.get_transformation("Rover:Mast", BASE)
    # the service lives, and its sensors are silent
    alive = fed(drive(1.0))
    for channel, data in parts(snapshot(), T0 + 12 * S):
        alive.feed(channel, data, T0 + 12 * S)
    silent = Told(alive, T0 + 12 * S)
    assert silent.get_transformation("Rover:Mast", BASE).valid
    with pytest.raises(ms.OutOfDateError, match=r"last POSE here is 11\.0 s old.*do its sensors speak"):
        silent.get_transformation(BASE, UTM)
    assert silent.get_transformation(BASE, UTM, at=T0 + S).valid


def test_given_poses_of_the_same_geometry_then_they_confirm_it_without_a_snapshot() -> None:
    heard = Knowledge()
    for at, channel, data in drive(30.0, pose_hz=10.0, joint_hz=1.0, every_s=100.0):
        heard.feed(channel, data, at)
    now = T0 + 30 * S + 10_000
    assert heard.known.ages(now).geometry < 0.1
    assert Told(heard, now).get_transformation("Rover:Mast", BASE).valid


def test_given_a_moving_pair_then_it_is_never_kept_with_those_that_stand_still() -> None:
    heard = fed(drive(1.0))
    asked = Told(heard, T0 + S + 5_000)
    for pair in ((SCAN, BASE), (BASE, UTM), ("Rover:Mast", BASE), ("Finger:Tip", "Deep:Tip"), (UTM, UTM), (SCAN, SCAN)):
        asked.get_transformation(*pair)
    known = asked.known()[0]
    assert set(known.still) == set(known.answers) == {("Rover:Mast", BASE), (SCAN, SCAN)}
    before = asked.get_transformation(SCAN, BASE)
    heard.feed(*joints(1.02), T0 + S + 25_000)
    assert asked.get_transformation(SCAN, BASE).pose != before.pose


def test_given_a_wait_then_what_comes_meanwhile_answers() -> None:
    events = list(drive(1.0))

    class Waiting(Told):
        """Hears an event more each time that it has to wait."""

        def wait_for(self, enough: object, seconds: float) -> bool:
            while not enough():  # type: ignore[operator]
                if not events:
                    return False
                at, channel, data = events.pop(0)
                self.knowledge.feed(channel, data, at)
                self.now = at
            return True

    asked: LocalPlatform = Waiting(Knowledge(), T0)
    assert asked.get_transformation("Rover:Mast", BASE, wait_ms=100).valid
    assert asked.get_transformation(SCAN, UTM, at=T0 + 500_000, wait_ms=100).utime == T0 + 500_000
    assert events
    with pytest.raises(ms.TooNewError):
        asked.get_transformation(SCAN, UTM, at=T0 + 9 * S, wait_ms=100)
    assert asked.get_transformation(SCAN, UTM, at=T0 + 9 * S, policy=Policy.LATEST).utime == T0 + S

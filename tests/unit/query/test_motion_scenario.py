"""A nodding laser in a turn: where it is in the world agrees with truth at every instant, however it is asked."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from support_between import lookup_between
from support_moving import BASE, DEEP, ENU, ODOM, SCAN, T0, UTM, S, estimate, joints_at, rover, truth, view

from modelserver.core import CoreSettings, Instant, start, step
from modelserver.estimation.history import Localizer
from modelserver.messages import (
    STALE_SENSORS,
    Estimate,
    GetTransformation,
    ImuSample,
    Invalid,
    LocalizerSummary,
    Mode,
    Policy,
    Quality,
    RequestHeader,
    Sample,
    SendReply,
    SensorHeader,
    TimeQuery,
    TransformReply,
)
from modelserver.query.batch import lookup_batch
from modelserver.query.view import PlatformView, complete
from modelserver.transforms.pose import Pose

METERS, RADIANS = 0.001, math.radians(0.02)
END = 4.0


@cache
def held() -> PlatformView:
    return view(END)


def utime(seconds: float) -> int:
    return T0 + round(seconds * S)


def instants() -> list[float]:
    """Dense, at samples, at random, and both ends."""
    rng = np.random.default_rng(20)
    dense = np.arange(0.0, END, 0.0173)
    samples = np.arange(0.0, END, 0.5)
    whole = np.concatenate((dense, samples, rng.uniform(0.0, END, 200), (0.0, END)))
    return [round(each * S) / S for each in whole.tolist()]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("interest", "reference"), [(SCAN, UTM), (UTM, SCAN), (DEEP, UTM), ("Finger:Tip", UTM), (DEEP, SCAN), (SCAN, BASE)]
)
def test_given_exact_poses_and_joints_then_every_instant_agrees_with_truth(interest: str, reference: str) -> None:
    for at in instants():
        answer = held().transformation(interest, reference, TimeQuery(utime(at)), utime(END))
        moved, turned = answer.transformation.pose.distance(truth(interest, reference, at))
        # the heading error moves a world seen from the vehicle in proportion to its distance
        arm = 40.0 if interest == UTM else 0.0
        assert moved <= METERS + arm * RADIANS, (at, moved)
        assert turned <= RADIANS, (at, turned)
        assert answer.transformation.is_valid
        assert answer.transformation.utime == utime(at)


def test_given_the_same_instants_in_one_query_then_they_agree_with_truth() -> None:
    seconds = instants()
    found = complete(lookup_batch(held(), SCAN, UTM, np.array([utime(at) for at in seconds])))
    assert not found.status.any()
    assert not found.invalid.any()
    for at, vector in zip(seconds, found.vectors, strict=True):
        moved, turned = Pose.from_state_vector(vector).distance(truth(SCAN, UTM, at))
        assert moved <= METERS
        assert turned <= RADIANS


def test_given_two_times_then_the_first_in_the_second_agrees_with_truth_through_any_fixed_frame() -> None:
    rng = np.random.default_rng(21)
    for at, reference_at in rng.uniform(0.0, END, (40, 2)).tolist():
        for fixed in (ODOM, UTM, ENU):
            answer = lookup_between(held(), SCAN, utime(at), DEEP, utime(reference_at), fixed)
            moved, turned = answer.transformation.pose.distance(truth(SCAN, DEEP, at, reference_at))
            assert moved <= METERS + 15.0 * RADIANS
            assert turned <= 2.0 * RADIANS


def test_given_no_time_then_the_answer_is_of_the_latest_common_one() -> None:
    answer = held().transformation(SCAN, UTM, TimeQuery(), utime(END))
    assert answer.transformation.utime == utime(END)
    assert answer.transformation.pose.is_close(truth(SCAN, UTM, END), METERS, RADIANS)


@dataclass(frozen=True)
class ScriptedEstimates:
    """A localizer that knows the truth at the stamp of each inertial sample."""

    utime: int = 0

    def process(self, sample: Sample) -> tuple[ScriptedEstimates, tuple[()]]:
        return replace(self, utime=sample.header.utime), ()

    def estimate(self, utime: int) -> Estimate:
        return estimate((utime - T0) / S)

    def defer_estimate(self, utime: int) -> Estimate:
        return self.estimate(utime)

    def navigation(self, utime: int) -> None:
        return None

    def find_stale_sensors(self, utime: int) -> Invalid:
        return self.estimate(utime).invalid & STALE_SENSORS

    def summary(self, utime: int) -> LocalizerSummary:
        return LocalizerSummary(Mode.FULL)


def test_given_samples_through_the_core_then_replies_agree_with_truth() -> None:
    localizer: Localizer = ScriptedEstimates()  # type: ignore[assignment]
    begin = Instant(0, T0)
    state = start(CoreSettings(BASE), rover(), localizer, begin)
    nothing = (0.0, 0.0, 0.0)
    for n in range(201):
        now = Instant(n * 10_000_000, T0 + n * 10_000)
        if n % 2 == 0:
            state, _ = step(state, joints_at(n * 0.01), now)
        state, _ = step(state, ImuSample(SensorHeader(now.utime, "imu"), nothing, nothing), now)
    assert not state.rejected
    for number, at in enumerate(np.random.default_rng(22).uniform(0.0, 2.0, 60).tolist()):
        at = round(at * S) / S
        asked = GetTransformation(RequestHeader(number, "REPLY_ME"), SCAN, UTM, TimeQuery(utime(at)))
        state, (sent,) = step(state, asked, Instant(2_000_000_000, utime(2.0)))
        assert isinstance(sent, SendReply)
        reply = sent.reply
        assert isinstance(reply, TransformReply)
        assert reply.answer is not None, reply.header.message
        moved, turned = reply.answer.transformation.pose.distance(truth(SCAN, UTM, at))
        assert moved <= METERS
        assert turned <= RADIANS


def test_given_a_query_about_joints_not_yet_received_then_it_waits_for_them() -> None:
    localizer: Localizer = ScriptedEstimates()  # type: ignore[assignment]
    nothing = (0.0, 0.0, 0.0)
    state = start(CoreSettings(BASE), rover(), localizer, Instant(0, T0))
    state, _ = step(state, joints_at(0.0), Instant(0, T0))
    for n in range(20):
        now = Instant(n * 10_000_000, T0 + n * 10_000)
        state, _ = step(state, ImuSample(SensorHeader(now.utime, "imu"), nothing, nothing), now)
    asked = GetTransformation(RequestHeader(1, "REPLY_ME"), SCAN, UTM, TimeQuery(utime(0.1), Policy.INTERPOLATED, 1000))
    state, sent = step(state, asked, now)
    assert not sent
    state, (reply,) = step(state, joints_at(0.2), Instant(200_000_000, utime(0.2)))
    assert isinstance(reply, SendReply)
    assert isinstance(reply.reply, TransformReply)
    assert reply.reply.answer is not None
    assert Quality.INTERPOLATED in reply.reply.answer.quality

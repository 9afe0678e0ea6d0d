"""The loop on a fake bus and a fake clock: deadlines, order, budgets, error handling."""

from __future__ import annotations

import itertools
import logging
import math
import random
from typing import Any

import pytest
from support_samples import ME, START, ScriptedLocalizer, gps, imu, start_core

from modelserver.config.vehicle_file import LimitsConfig
from modelserver.core import Instant
from modelserver.errors import Status
from modelserver.messages import (
    CHANNEL_OF,
    MET,
    Estimate,
    GetBodyFrameList,
    GetBodyList,
    GetDynamics,
    GetExplanation,
    GetHistory,
    GetHTransform,
    GetMotion,
    GetStateVector,
    GetTransformation,
    GetTransformations,
    Health,
    Mode,
    NavigationState,
    Policy,
    PoseAnswer,
    PoseDemand,
    PublishDecisions,
    ReloadModel,
    Reply,
    RequestHeader,
    SensorHeader,
    SetFrame,
    SetHTransform,
    SetStateVector,
    StateVectorReply,
    SwitchMode,
    TimeQuery,
    TransformReply,
    Unmet,
)
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.ingress import SensorChannel
from modelserver.server.log import LOG_PERIOD_S, MAX_CAUSES, RateLimitedLog
from modelserver.server.loop import MAX_SAMPLES_NS, MIN_SAMPLES_NS, SAMPLES_PER_PASS, Hooks, Loop, LoopSettings
from modelserver.server.requests import REJECTIONS_PER_CLIENT
from modelserver.transforms.pose import Pose
from modelserver.transforms.transformation import Transformation
from modelserver.wire.channels import REQUESTS
from modelserver.wire.codec import decode, encode

S = 1_000_000
PERIOD_NS = 20_000_000
REPLY_TYPES = {
    GetTransformation: "get_transformation_reply_t",
    GetBodyList: "name_list_reply_t",
    GetBodyFrameList: "name_list_reply_t",
    GetStateVector: "get_state_vector_reply_t",
    GetHTransform: "get_transformation_reply_t",
    GetHistory: "get_history_reply_t",
}


class Rig:
    """A loop with its fakes. The clock starts at START and advances only while the loop waits."""

    def __init__(
        self,
        localizer: ScriptedLocalizer | None = ScriptedLocalizer(),  # noqa: B008
        prefix: str = "",
        latency_us: int = 0,
        **settings: Any,
    ):
        self.clock = FakeClock(START, 10_000_000_000)
        self.bus = FakeBus(self.clock)
        channels = {f"{prefix}GPS": SensorChannel("gps_t", latency_us), f"{prefix}IMU": SensorChannel("imu_t")}
        channels[f"{prefix}LOCALIZATION_MODE"] = SensorChannel("localization_mode_t")
        names = ("publish", "waiting_requests", "ticks_per_state")
        core_settings = {key: settings.pop(key) for key in names if key in settings}
        state = start_core(localizer, **core_settings)
        self.origins: list[object] = []
        self.loop = Loop(
            self.bus,
            self.clock,
            state,
            LoopSettings(PERIOD_NS, channels, prefix, **settings),
            Hooks(on_origin=self.origins.append),
        )

    def turns(self, count: int = 1) -> None:
        for _ in range(count):
            self.loop.run_once()

    def send(self, value: Any, channel: str = "") -> None:
        kinds = {"GpsSample": "GPS", "ImuSample": "IMU", "SwitchMode": "LOCALIZATION_MODE"}
        self.bus.publish(channel or CHANNEL_OF.get(type(value)) or kinds[type(value).__name__], encode(value))

    def ask(self, request: Any, turns: int = 2) -> Reply:
        """Send a request, run the loop, and return the one reply."""
        before = len(self.bus.get_published("REPLY_TEST"))
        self.send(request)
        self.turns(turns)
        (data,) = self.bus.get_published("REPLY_TEST")[before:]
        reply: Reply = decode(REPLY_TYPES[type(request)], data)
        return reply

    @property
    def poses(self) -> list[PoseAnswer]:
        return [decode("pose_transform_t", data) for data in self.bus.get_published("POSE")]

    @property
    def rejected(self) -> dict[tuple[str, str], int]:
        return dict(self.loop.state.rejected)

    @property
    def now(self) -> Instant:
        return self.clock.now()


# --- ticks --------------------------------------------------------------------------------------------------


def test_given_nothing_to_do_then_ticks_come_at_absolute_deadlines() -> None:
    rig = Rig()
    rig.turns(51)
    assert [pose.transformation.utime - START for pose in rig.poses] == [n * 20_000 for n in range(51)]
    assert [len(rig.bus.get_published(name)) for name in ("POSE", "POSE_VECTOR", "POSE_ODOM")] == [51, 51, 51]
    assert rig.loop.state.ticks_missed == 0


def test_given_a_tick_that_takes_time_then_the_next_is_due_as_if_it_had_not() -> None:
    rig = Rig()
    for _ in range(5):
        rig.turns(1)
        rig.clock.advance(0.013)
    late = [pose.transformation.utime - START - n * 20_000 for n, pose in enumerate(rig.poses)]
    # each pass waits for the deadline, so the 13 ms after it are lost and do not accumulate
    assert late == [0, 13_000, 13_000, 13_000, 13_000]


def test_given_a_long_pause_then_missed_ticks_are_counted_and_not_made_up() -> None:
    rig = Rig()
    rig.turns(3)
    rig.clock.advance(10.0)
    before = len(rig.poses)
    rig.loop.run_once()
    assert len(rig.poses) == before + 1
    assert rig.loop.state.ticks_missed == 500
    rig.turns(5)
    # and it is back on the old deadlines
    assert [(pose.transformation.utime - START) % 20_000 for pose in rig.poses] == [0] * len(rig.poses)
    assert rig.loop.state.ticks_missed == 500


@pytest.mark.parametrize("step_s", [3600.0, -3600.0, 1e9, -1.6e9])
def test_given_a_time_of_day_that_steps_then_ticks_go_on_by_monotonic_time(step_s: float) -> None:
    rig = Rig()
    rig.send(imu(START))
    rig.turns(10)
    rig.clock.step_utime(step_s)
    rig.turns(10)
    utimes = [pose.transformation.utime for pose in rig.poses]
    assert len(utimes) == 20
    assert {b - a for a, b in itertools.pairwise(utimes)} == {20_000, 20_000 + round(step_s * S)}
    assert rig.loop.state.ticks_missed == 0
    # samples of the new time are used
    rig.send(imu(rig.now.utime))
    rig.turns(1)
    assert rig.loop.state.localizer.utime == rig.loop.state.history.last  # type: ignore[union-attr]
    assert rig.ask(GetBodyList(ME)).header.status is Status.OK


def test_given_stop_then_run_returns() -> None:
    rig = Rig()
    rig.bus.sensors.subscribe("IMU", lambda *_: rig.loop.stop())
    rig.send(imu(START))
    rig.loop.run()
    rig.loop.run()
    assert rig.loop.state.history.last == START


# --- order and budgets --------------------------------------------------------------------------------------


def test_given_samples_and_requests_waiting_then_samples_are_handled_first() -> None:
    rig = Rig()
    rig.send(GetStateVector(ME))
    for n in range(50):
        rig.send(imu(START - S + n * 10_000))
    rig.turns(1)
    (data,) = rig.bus.get_published("REPLY_TEST")
    assert decode("get_state_vector_reply_t", data).answer.transformation.utime == START - S + 490_000


def test_given_more_requests_than_the_budget_then_each_pass_answers_that_many() -> None:
    rig = Rig(limits=LimitsConfig(requests_per_pass=16))
    for _ in range(40):
        rig.send(GetBodyList(ME))
    answered = []
    for _ in range(4):
        rig.loop.run_once()
        answered.append(len(rig.bus.get_published("REPLY_TEST")))
    assert answered == [16, 32, 40, 40]


def test_given_requests_in_order_then_they_are_answered_in_order() -> None:
    rig = Rig(limits=LimitsConfig(requests_per_pass=7))
    for n in range(100):
        rig.send(GetBodyList(RequestHeader(n, "REPLY_TEST")))
    rig.turns(20)
    ids = [decode("name_list_reply_t", data).header.request_id for data in rig.bus.get_published("REPLY_TEST")]
    assert ids == list(range(100))


@pytest.mark.parametrize("count", [100, 300, 1000, 5000])
def test_given_a_burst_of_requests_then_each_is_answered_or_counted_as_dropped(count: int) -> None:
    rig = Rig()
    for n in range(count):
        rig.send(GetBodyList(RequestHeader(n, "REPLY_TEST")))
    turns = 0
    while rig.bus.requests.pending or rig.loop._requests.waiting:
        rig.loop.run_once()
        turns += 1
        assert turns < count
    replies = [decode("name_list_reply_t", data) for data in rig.bus.get_published("REPLY_TEST")]
    ok = [each for each in replies if each.header.status is Status.OK]
    refused = [each for each in replies if each.header.status is Status.OVERLOADED]
    load = rig.rejected.get(("PLATFORM_GET_BODY_LIST", "overload"), 0)
    assert len(ok) + load == count
    assert len(ok) == rig.loop.state.requests_answered
    assert len(ok) + len(refused) == len(replies)
    assert len({each.header.request_id for each in replies}) == len(replies)
    assert (load > 0) == (count > 256)
    assert 0 < len(refused) <= REJECTIONS_PER_CLIENT or not load
    assert rig.ask(GetBodyList(ME)).header.status is Status.OK


def test_given_a_flood_of_requests_that_are_no_messages_then_each_is_counted_once() -> None:
    rig = Rig()
    for _ in range(1000):
        rig.bus.publish("PLATFORM_GET_BODY_LIST", b"junk")
    rig.turns(80)
    assert sum(rig.rejected.values()) == 1000
    assert set(rig.rejected) == {("PLATFORM_GET_BODY_LIST", "overload"), ("PLATFORM_GET_BODY_LIST", "fingerprint")}


def test_given_a_flood_of_samples_then_ticks_come_in_time() -> None:
    rig = Rig()
    count = SAMPLES_PER_PASS * 30
    for n in range(count):
        rig.send(imu(START - S + n))
    rig.send(GetBodyList(ME))
    rig.bus.sensors.subscribe("IMU", lambda *_: rig.clock.advance(100e-6))
    rig.turns(count * 100_000 // MAX_SAMPLES_NS + 1 + round(count * 100e-6 / 0.02))
    assert rig.loop.state.traffic["sensor:imu"].count == count
    assert len(rig.poses) >= count * 100e-6 / 0.02 - 1
    assert rig.loop.state.ticks_missed == 0
    # the pass ends where the tick begins, but for the minimum for samples
    assert max(rig.loop.state.tick_latencies) <= MIN_SAMPLES_NS * 1e-9 + 1e-9
    # requests are served in between
    assert rig.bus.get_published("REPLY_TEST")


# --- channels -----------------------------------------------------------------------------------------------


def test_given_each_request_channel_then_the_loop_answers_on_it() -> None:
    rig = Rig()
    rig.send(imu(START))
    rig.turns(1)
    for request in (
        GetTransformation(ME, "Camera:Origin", "World:UTM"),
        GetBodyList(ME),
        GetBodyFrameList(ME, "Cart"),
        GetStateVector(ME),
        GetHTransform(ME),
        GetHistory(ME, START, START, 1.0),
    ):
        reply = rig.ask(request)
        assert (reply.header.status, reply.header.request_id) == (Status.OK, 77)


def test_given_a_channel_prefix_then_everything_carries_it_but_replies() -> None:
    rig = Rig(ScriptedLocalizer(has_state=True), prefix="V1_", ticks_per_state=1)
    for channel in ("PLATFORM_GET_BODY_LIST", "V1_PLATFORM_GET_BODY_LIST", "V2_PLATFORM_GET_BODY_LIST"):
        rig.bus.publish(channel, encode(GetBodyList(ME)))
    rig.bus.publish("IMU", encode(imu(START)))
    rig.bus.publish("V1_IMU", encode(imu(START + 1, "decide:1")))
    rig.bus.published.clear()
    rig.turns(2)
    assert {channel for channel, _ in rig.bus.published} == {
        "V1_POSE", "V1_POSE_VECTOR", "V1_POSE_ODOM", "V1_MODELSERVER_HEALTH", "V1_LOCALIZATION_DECISIONS",
        "V1_LOCALIZATION_STATE", "REPLY_TEST",
    }  # fmt: skip
    assert len(rig.bus.get_published("REPLY_TEST")) == 1
    assert rig.loop.state.traffic["sensor:decide:1"].count == 1


def test_given_decisions_then_each_goes_out_once_in_messages_that_can_be_read() -> None:
    rig = Rig()
    rig.send(imu(START, "decide:2500"))
    rig.send(imu(START + 1, "decide:1"))
    rig.turns(1)
    parts: list[PublishDecisions] = [
        decode("decisions_t", data) for data in rig.bus.get_published("LOCALIZATION_DECISIONS")
    ]
    assert [len(each.decisions) for each in parts] == [1024, 1024, 452, 1]
    assert [each.kind for part in parts[:3] for each in part.decisions] == [f"speed_{n}" for n in range(2500)]
    assert rig.loop.state.handler_errors == 0


def test_given_a_filter_then_its_state_is_published_with_the_commanded_mode() -> None:
    rig = Rig(ScriptedLocalizer(has_state=True), ticks_per_state=5)
    rig.turns(1)
    rig.send(SwitchMode(SensorHeader(START + 5, "console"), Mode.DEAD_RECKONING))
    rig.turns(9)
    parts: list[NavigationState] = [
        decode("navigation_state_t", data) for data in rig.bus.get_published("LOCALIZATION_STATE")
    ]
    assert [each.mode for each in parts] == [Mode.FULL, Mode.DEAD_RECKONING]
    assert [each.utime - START for each in parts] == [0, 100_000]


def test_given_a_latency_then_the_core_gets_the_instant_of_measurement() -> None:
    rig = Rig(latency_us=120_000)
    rig.send(gps(START))
    rig.turns(1)
    assert rig.loop.state.localizer.utime == START - 120_000  # type: ignore[union-attr]
    rig.send(imu(START))
    rig.turns(1)
    assert rig.loop.state.localizer.utime == START  # type: ignore[union-attr]


def test_given_an_origin_that_is_latched_then_it_is_handed_on() -> None:
    rig = Rig(ScriptedLocalizer(origin=None))
    rig.send(gps(START, source="latch"))
    rig.turns(2)
    assert len(rig.origins) == 1


# --- bad input ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("channel", [*(each.name for each in REQUESTS), "GPS", "IMU", "LOCALIZATION_MODE"])
def test_given_random_bytes_on_any_channel_then_they_are_counted_and_the_next_good_request_is_answered(
    channel: str, caplog: pytest.LogCaptureFixture
) -> None:
    rng = random.Random(4)
    rig = Rig()
    good = {
        "GPS": encode(gps(START)),
        "IMU": encode(imu(START)),
        "LOCALIZATION_MODE": encode(SwitchMode(SensorHeader(START, "console"), Mode.RAW)),
    }.get(channel) or encode(
        next(
            kind(ME, *values)
            for kind, values in (
                (GetTransformation, ("Camera:Origin", "World:UTM")),
                (GetBodyList, ()),
                (GetBodyFrameList, ("Cart",)),
                (GetStateVector, ()),
                (GetHTransform, ()),
                (GetHistory, (START, START, 1.0)),
                (GetTransformations, ((("Camera:Origin", "Cart:Base"),), (START,))),
                (GetMotion, ("Camera:Origin", "Cart:Base")),
                (GetExplanation, ("Camera:Origin", "World:UTM")),
                (GetDynamics, ()),
                (ReloadModel, ()),
                (SetFrame, ("Camera:Marker",)),
                (SetStateVector, (PoseAnswer(Transformation("Cart:Base", "World:UTM", Pose())),)),
                (SetHTransform, (PoseAnswer(Transformation("Cart:Base", "World:UTM", Pose())),)),
            )
            if CHANNEL_OF[kind] == channel
        )
    )
    bad = [b"", b"\0", good[:8], good[:-1], good + b"\0", b"\xff" * 60_000, good[:8] + rng.randbytes(200)]
    bad += [good[: rng.randrange(len(good))] for _ in range(10)] + [
        rng.randbytes(rng.randrange(300)) for _ in range(10)
    ]
    for data in bad:
        rig.bus.publish(channel, data)
    rig.turns(5)
    assert sum(rig.rejected.values()) == len(bad)
    assert {name for name, _ in rig.rejected} == {channel}
    assert {reason for _, reason in rig.rejected} <= {"fingerprint", "truncated", "malformed"}
    assert rig.loop.state.handler_errors == 0
    assert rig.ask(GetBodyList(ME)).header.status is Status.OK
    assert all(record.getMessage().isprintable() for record in caplog.records)


@pytest.mark.parametrize(
    ("request_", "what"),
    [
        (GetTransformation(ME, "Camera:Origin", "World:UTM", TimeQuery(-1)), "at -1"),
        (GetTransformation(ME, "Camera:Origin", "World:UTM", TimeQuery(1 << 62)), "at"),
        (GetTransformation(ME, "Camera:Origin", "World:UTM", TimeQuery(1, wait_ms=-5)), "wait_ms -5"),
        (GetTransformation(ME, "Camera:Origin", "World:UTM", TimeQuery(1, 99)), "policy 99"),  # type: ignore[arg-type]
        (GetStateVector(ME, TimeQuery(-1)), "at -1"),
        (
            GetTransformation(ME, "Camera:Origin", "Cart:Base", demand=PoseDemand(-0.5)),
            "max_horizontal -0.5 is not from 0 (not asked for) to less than 1e+12",
        ),
        (GetStateVector(ME, demand=PoseDemand(max_heading=45.0)), "max_heading 45 is not from 0"),
        (GetHTransform(ME, demand=PoseDemand(max_age=math.nan)), "max_age nan is not from 0"),
        (GetStateVector(ME, demand=PoseDemand(min_integrity=1.0)), "min_integrity 1 is not from 0"),
        (GetHTransform(ME, True, TimeQuery(1, wait_ms=-5)), "wait_ms -5"),
        (GetHistory(ME, -1, START, 1.0), "start_utime"),
    ],
)
def test_given_a_malformed_request_then_the_reply_has_the_reason(request_: Any, what: str) -> None:
    rig = Rig()
    header = rig.ask(request_).header
    assert header.status is Status.MALFORMED
    assert header.request_id == 77
    assert what in header.message
    assert rig.rejected == {(CHANNEL_OF[type(request_)], "malformed"): 1}
    # but never on a channel outside the rules
    rig.send(type(request_)(RequestHeader(1, "POSE"), *list(request_)[1:]))
    rig.turns(3)
    assert all(decode("pose_transform_t", data) for data in rig.bus.get_published("POSE"))


def test_given_a_demand_then_the_reply_has_the_answer_and_what_is_unmet() -> None:
    rig = Rig()
    rig.send(imu(START))
    rig.turns(10)
    for request in (GetTransformation(ME, "Cart:Base", "World:UTM"), GetStateVector(ME), GetHTransform(ME)):
        fresh, old = (rig.ask(request._replace(demand=PoseDemand(max_age=age))) for age in (9.0, 0.1))
        for reply in (fresh, old):
            assert isinstance(reply, TransformReply | StateVectorReply)
            assert reply.header.status is Status.OK
            assert reply.answer is not None
            assert reply.answer.transformation.utime == START
        assert (fresh.unmet, fresh.unmet_reason) == (MET, "")
        assert old.unmet is Unmet.AGE
        assert old.unmet_reason.endswith("s old, asked for: at most 0.1 s")


class Breaking(ScriptedLocalizer):
    """A localizer that cannot predict."""

    def estimate(self, utime: int) -> Estimate:
        if utime == START + 3 * S:
            raise ZeroDivisionError("an error of the localizer's own:\nFORGED line \x1b[31m")
        return super().estimate(utime)


def test_given_an_internal_error_then_the_client_gets_a_reply_and_the_loop_continues(
    caplog: pytest.LogCaptureFixture,
) -> None:
    rig = Rig(Breaking())
    rig.send(gps(START))
    rig.turns(2)
    header = rig.ask(GetTransformation(ME, "Cart:Base", "World:UTM", TimeQuery(START + 3 * S, Policy.PREDICTED))).header
    assert header.status is Status.INTERNAL
    assert "its log has the traceback" in header.message
    assert rig.rejected == {("PLATFORM_GET_TRANSFORMATION", "handler"): 1}
    assert rig.loop.state.handler_errors == 1
    (record,) = caplog.records
    assert "PLATFORM_GET_TRANSFORMATION" in record.getMessage()
    assert "ZeroDivisionError" in record.getMessage()
    assert rig.ask(GetBodyList(ME)).header.status is Status.OK


def test_given_a_sample_that_breaks_the_localizer_then_it_is_counted_and_the_rest_go_on() -> None:
    rig = Rig()
    for source in ("a", "break", "b"):
        rig.send(imu(START, source))
    rig.turns(1)
    assert rig.rejected == {("IMU", "handler"): 1}
    assert rig.loop.state.localizer.count == 2  # type: ignore[union-attr]


def test_given_a_tick_that_fails_then_the_next_one_comes() -> None:
    rig = Rig(Breaking(START, 1))
    rig.clock.advance(3.0)
    rig.loop._timer.due_ns = rig.clock.monotonic_ns()
    rig.turns(3)
    assert rig.rejected == {("tick", "handler"): 1}
    assert len(rig.poses) == 2


def test_given_one_output_that_cannot_be_sent_then_the_others_are(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    publish = rig.bus.publish

    def failing(channel: str, data: bytes) -> None:
        if channel.startswith("POSE"):
            raise OSError("no route")
        publish(channel, data)

    monkeypatch.setattr(rig.bus, "publish", failing)
    rig.turns(2)
    assert rig.bus.get_published("MODELSERVER_HEALTH")
    # each of the two ticks had three messages to send
    assert rig.loop.state.handler_errors == 6
    health: Health = decode("health_t", rig.bus.get_published("MODELSERVER_HEALTH")[0])
    assert health.utime == START


# --- the log ------------------------------------------------------------------------------------------------


def test_given_a_flood_of_one_cause_then_a_line_comes_in_five_seconds_with_the_number_of_suppressed_ones(
    caplog: pytest.LogCaptureFixture,
) -> None:
    rig = Rig()
    for _ in range(100):
        rig.bus.publish("GPS", b"junk")
    rig.bus.publish("IMU", b"junk")
    rig.turns(2)
    assert [record.levelname for record in caplog.records] == ["WARNING", "WARNING"]
    rig.clock.advance(LOG_PERIOD_S)
    rig.bus.publish("GPS", b"junk")
    rig.turns(1)
    assert "99 times since the last line" in caplog.records[-1].getMessage()
    assert len(caplog.records) == 3


def test_given_endless_causes_then_the_log_distinguishes_a_bounded_number(caplog: pytest.LogCaptureFixture) -> None:
    limited = RateLimitedLog(logging.getLogger("test"), FakeClock())
    for n in range(10 * MAX_CAUSES):
        limited.warning(str(n), "cause %s", n)
    assert len(caplog.records) == MAX_CAUSES + 1


@pytest.mark.parametrize(
    "text", ["a\nERROR forged", "\r\x1b[2Jgone", "a\x00b", "\u202e", "\x85next", "\u2028x", "\ud800"]
)
def test_given_control_characters_then_they_never_reach_the_log_raw(
    text: str, caplog: pytest.LogCaptureFixture
) -> None:
    limited = RateLimitedLog(logging.getLogger("test"), FakeClock())
    limited.warning("a", "rejected a message on %s: %s", "GPS", ValueError(text))
    try:
        raise ValueError(text)
    except ValueError:
        limited.exception("b", "an error on %s", text)
    warning, error = (record.getMessage() for record in caplog.records)
    assert warning.isprintable()
    first, *rest = error.split("\n")
    assert first.isprintable()
    assert any("ValueError" in line for line in rest)
    assert all(line.startswith("    ") and line.isprintable() for line in rest)


def test_given_percent_signs_from_the_bus_then_they_are_text(caplog: pytest.LogCaptureFixture) -> None:
    RateLimitedLog(logging.getLogger("test"), FakeClock()).warning("a", "%s", "%s %d %(x)s")
    assert caplog.records[0].getMessage() == "%s %d %(x)s"


def test_given_a_rejected_sample_then_the_log_has_each_reason_once(caplog: pytest.LogCaptureFixture) -> None:
    rig = Rig()
    for n in range(3):
        rig.send(imu(START - S + n * 10_000, "refuse:range"))
    rig.turns(1)
    for _ in range(5):
        rig.clock.advance(1.0)
        rig.turns(1)
    (line,) = [each.getMessage() for each in caplog.records]
    assert "sensor:refuse:range" in line
    assert "reason: range" in line
    assert "MODELSERVER_HEALTH" in line


def test_given_the_same_request_again_then_it_is_answered_from_the_cache_and_counted() -> None:
    rig = Rig()
    question = GetTransformation(ME, "Camera:Origin", "Cart:Base")
    first = rig.ask(question)
    rig.bus.published.clear()
    rig.clock.advance(0.001)
    again = rig.ask(question)
    assert again.answer.transformation == first.answer.transformation
    assert again.header.utime > first.header.utime
    rig.clock.advance(1.0)
    rig.turns(2)
    assert rig.loop.state.requests_answered == 2


def test_given_a_bus_that_fails_then_an_answer_from_memory_leaves_no_exception(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Rig()
    question = GetTransformation(ME, "Camera:Origin", "Cart:Base")
    rig.ask(question)

    def fail(channel: str, data: bytes) -> None:
        raise OSError("network is down")

    with monkeypatch.context() as patched:
        patched.setattr(rig.bus, "publish", fail)
        rig.bus.requests.put("PLATFORM_GET_TRANSFORMATION", encode(question))
        rig.turns(1)
    assert rig.rejected["REPLY_TEST", "handler"] == 1
    assert rig.ask(question).header.status is Status.OK

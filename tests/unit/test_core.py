"""The core: outputs of each event; no event raises."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from support_samples import (
    ME,
    ORIGIN,
    START,
    ScriptedLocalizer,
    cart,
    drive,
    gps,
    imu,
    instant_at,
    make_decision,
    start_core,
)

from modelserver import core
from modelserver.core import AllOutputs, CoreSettings, CoreState, Instant, step
from modelserver.core.state import MAX_COUNTERS
from modelserver.errors import Status, UnknownBodyError, UnknownFrameError
from modelserver.estimation.history import MIN_STEP_US
from modelserver.estimation.raw.localizer import RawLocalizer
from modelserver.estimation.sensor_rig import Mounts
from modelserver.geometry import names
from modelserver.messages import (
    CHANNEL_OF,
    AbsolutePoseSample,
    Event,
    GetBodyFrameList,
    GetBodyList,
    GetExplanation,
    GetHistory,
    GetHTransform,
    GetMotion,
    GetStateVector,
    GetTransformation,
    Health,
    HealthWarning,
    HistoryReply,
    ImuSample,
    Invalid,
    JointSample,
    JointsSample,
    Mode,
    NameListReply,
    Output,
    PersistOrigin,
    Policy,
    PublishDecisions,
    PublishHealth,
    PublishNavigation,
    PublishPose,
    RangeSample,
    Rejected,
    RelativePoseSample,
    Reply,
    RequestHeader,
    SendReply,
    SensorHeader,
    StateVectorReply,
    SwitchMode,
    Tick,
    TimeQuery,
    TransformReply,
    Verdict,
    WheelsSample,
)
from modelserver.query.answers import DeferredAnswer
from modelserver.query.view import complete
from modelserver.wire.codec import encode

S = 1_000_000
REQUESTS: list[Any] = [
    GetTransformation(ME, "Camera:Origin", "Cart:Base"),
    GetTransformation(ME, "Camera:Origin", "World:UTM"),
    GetBodyList(ME),
    GetBodyFrameList(ME, "Cart"),
    GetStateVector(ME),
    GetHTransform(ME),
    GetHTransform(ME, inverse=True),
    GetHistory(ME, START, START + S, 10.0),
]
OTHERS: list[Any] = [
    WheelsSample(SensorHeader(START + 3, "wheels"), ()),
    AbsolutePoseSample(SensorHeader(START + 3, "map"), "Cart:Mast", names.WORLD_UTM, (1.0, 2.0, 3.0)),
    RelativePoseSample(SensorHeader(START + 3, "vo"), "Cart:Mast", START, (0.1, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
    RangeSample(SensorHeader(START + 3, "tag"), "Cart:Mast", "gate", (1.0, 2.0, 3.0), names.WORLD_UTM, 5.0),
]
REPLY_TYPES = [TransformReply, TransformReply, NameListReply, NameListReply, StateVectorReply, TransformReply,
               TransformReply, HistoryReply]  # fmt: skip


class Run:
    """A running core: `feed` events at times and check the outputs."""

    def __init__(self, localizer: Any = ScriptedLocalizer(), **settings: object):  # noqa: B008
        self.state: CoreState = start_core(localizer, **settings)
        self.at = START

    def feed(self, event: Event, at: float = 0.0) -> AllOutputs:
        """Handle an event `at` seconds after START."""
        self.at = START + round(at * S)
        self.state, outputs = step(self.state, event, instant_at(self.at))
        return outputs

    def samples(self, *times: float) -> None:
        for each in times:
            self.feed(imu(START + round(each * S)), each)

    def ask(self, request: Any, at: float = 0.0) -> Reply:
        (output,) = self.feed(request, at)
        if isinstance(output, DeferredAnswer):
            (reply,) = complete(output.work())
            output = SendReply(output.request.header.reply_channel, reply)
        assert isinstance(output, SendReply)
        assert output.channel == request.header.reply_channel
        assert output.reply.header.request_id == request.header.request_id
        return output.reply

    def health(self, at: float = 0.0, tick: Tick = Tick()) -> Health:  # noqa: B008
        """Return the health report of a tick at which it is due."""
        self.state = self.state._replace(health_due_ns=0)
        return next(each.health for each in self.feed(tick, at) if isinstance(each, PublishHealth))

    @property
    def rejected(self) -> dict[tuple[str, str], int]:
        return dict(self.state.rejected)


def of_type(outputs: tuple[Output, ...], kind: type) -> list[Any]:
    return [each for each in outputs if isinstance(each, kind)]


def with_reply_channel(request: Any, channel: str) -> Any:
    """The same request with another reply channel."""
    values = {name: getattr(request, name) for name in type(request).__match_args__}
    return type(request)(**values | {"header": RequestHeader(1, channel)})


def ahead(at: float, wait_ms: int = 500, policy: Policy = Policy.INTERPOLATED) -> GetTransformation:
    return GetTransformation(ME, "Cart:Base", "World:UTM", TimeQuery(START + round(at * S), policy, wait_ms))


# --- the start ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("frame", "error"), [("Cart:Bsae", UnknownFrameError), ("Crat:Base", UnknownBodyError)])
def test_given_a_base_frame_that_is_not_there_then_the_core_does_not_start(frame: str, error: type[Exception]) -> None:
    with pytest.raises(error, match=r"frame|body"):
        core.start(CoreSettings(frame), cart(), None, instant_at(START))


# --- requests -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("request_", "kind"), list(zip(REQUESTS, REPLY_TYPES, strict=True)))
def test_given_each_request_then_it_is_answered_in_its_kind(request_: Any, kind: type) -> None:
    run = Run()
    run.samples(0, 0.5, 1)
    reply = run.ask(request_, 1.25)
    assert type(reply) is kind
    assert reply.header.status is Status.OK
    assert reply.header.utime == START + round(1.25 * S)
    assert reply.header.model_revision == cart().revision
    assert run.state.requests_answered == 1


@pytest.mark.parametrize(("request_", "kind"), list(zip(REQUESTS, REPLY_TYPES, strict=True)))
def test_given_each_request_when_dropped_or_failed_then_the_reply_has_the_type_of_the_request(
    request_: Any, kind: type
) -> None:
    state = start_core()
    for outputs, status in (
        (core.reply_overloaded(state, request_, instant_at(START)), Status.OVERLOADED),
        (core.reply_internal_error(state, request_, instant_at(START)), Status.INTERNAL),
        (core.reply_error(state, type(request_), ME, Status.MALFORMED, "why", instant_at(START)), Status.MALFORMED),
    ):
        (output,) = outputs
        assert isinstance(output, SendReply)
        assert (type(output.reply), output.channel) == (kind, "REPLY_TEST")
        assert (output.reply.header.status, output.reply.header.request_id) == (status, 77)


def test_given_the_lists_then_they_hold_the_names_in_the_order_of_the_model() -> None:
    run = Run()
    bodies, frames = run.ask(GetBodyList(ME)), run.ask(GetBodyFrameList(ME, "Cart"))
    assert isinstance(bodies, NameListReply)
    assert isinstance(frames, NameListReply)
    assert bodies.names == ("Cart", "Camera", "Lamp")
    assert frames.names == ("Base", "Antenna", "Imu", "Mast")
    assert len(frames.descriptions) == 4


def test_given_the_inverse_h_transform_then_it_is_the_world_in_the_vehicle() -> None:
    run = Run()
    run.samples(0, 1)
    there, back = run.ask(GetHTransform(ME)), run.ask(GetHTransform(ME, inverse=True))
    assert isinstance(there, TransformReply)
    assert isinstance(back, TransformReply)
    assert there.answer is not None
    assert back.answer is not None
    assert there.answer.transformation.frame_of_interest == "Cart:Base"
    assert back.answer.transformation.frame_of_reference == "Cart:Base"
    assert (there.answer.transformation @ back.answer.transformation).pose.is_close(
        run.state.view.transformation("World:UTM", "World:UTM", TimeQuery()).transformation.pose, 1e-9, 1e-12
    )


@pytest.mark.parametrize(
    ("request_", "ends"),
    [
        (GetTransformation(ME, "Camera", "map"), ("Camera:Origin", "World:ENU")),
        (GetTransformation(ME, "utm", "odom"), ("World:UTM", "Odom:Origin")),
        (GetExplanation(ME, "Camera", "Cart:Base"), ("Camera:Origin", "Cart:Base")),
        (GetMotion(ME, "Camera", "Cart:Base", "Camera"), ("Camera:Origin", "Cart:Base")),
    ],
)
def test_given_frame_names_as_ros_has_them_then_the_answer_has_the_full_ones(
    request_: Any, ends: tuple[str, str]
) -> None:
    run = Run()
    run.samples(0, 1)
    reply = run.ask(request_)
    assert reply.header.status is Status.OK, reply.header.message
    answer = reply.answer
    answer = getattr(answer, "pose", None) or getattr(answer, "answer", answer)
    assert (answer.transformation.frame_of_interest, answer.transformation.frame_of_reference) == ends


@pytest.mark.parametrize(
    ("request_", "status", "near"),
    [
        (GetTransformation(ME, "Camrea:Origin", "Cart:Base"), Status.UNKNOWN_BODY, "Camera:Origin"),
        (GetTransformation(ME, "Camera:Orign", "Cart:Base"), Status.UNKNOWN_FRAME, "Camera:Origin"),
        (GetTransformation(ME, "World:UTN", "Cart:Base"), Status.UNKNOWN_FRAME, "World:UTM"),
        (GetTransformation(ME, "Lamp:Origin", "Cart:Base"), Status.NOT_CONNECTED, ""),
        (GetTransformation(ME, "x" * 60_000, "Cart:Base"), Status.UNKNOWN_BODY, ""),
        (GetTransformation(ME, "Camera:a:b", "Cart:Base"), Status.UNKNOWN_FRAME, ""),
        (GetBodyFrameList(ME, "Crat"), Status.UNKNOWN_BODY, "Cart"),
        (GetTransformation(ME, "Cart:Base", "World:UTM", TimeQuery(START - 1)), Status.TOO_OLD, ""),
        (GetTransformation(ME, "Cart:Base", "World:UTM", TimeQuery(START + 2 * S)), Status.TOO_NEW, ""),
        (GetStateVector(ME, TimeQuery(START + 9 * S, Policy.PREDICTED)), Status.TOO_NEW, ""),
        (GetHistory(ME, START, START + S, math.nan), Status.MALFORMED, ""),
        (GetHistory(ME, START, START + 3600 * S, 100.0), Status.LIMIT, ""),
    ],
)
def test_given_a_request_without_answer_then_the_reply_has_the_reason(request_: Any, status: Status, near: str) -> None:
    run = Run()
    run.samples(0, 1)
    header = run.ask(request_).header
    assert header.status is status
    assert header.message
    assert len(header.message) < 400
    assert near in ("", *header.nearest)
    assert len(encode(run.ask(request_))) < 4096
    assert run.state.requests_answered == 2


@pytest.mark.parametrize("request_", [REQUESTS[1], REQUESTS[4], REQUESTS[5], REQUESTS[7]])
@pytest.mark.parametrize("localizer", [None, ScriptedLocalizer()])
def test_given_no_sample_yet_then_there_is_no_pose(request_: Any, localizer: ScriptedLocalizer | None) -> None:
    assert Run(localizer).ask(request_).header.status is Status.NO_POSE


@pytest.mark.parametrize(
    "channel",
    ["POSE", "GPS", "REPLY_", "REPLY", "", "reply_x", "XREPLY_A", "REPLY_" + "A" * 58, "REPLY_" + "A" * 200,
     "REPLY_A B", "REPLY_A\n", "REPLY_Ä", "REPLY_.*", "REPLY_A\x00", "REPLY_A/B", "MODELSERVER_HEALTH"],
)  # fmt: skip
def test_given_a_reply_channel_outside_the_rules_then_it_is_counted_and_there_is_no_reply(channel: str) -> None:
    for request in REQUESTS:
        run = Run()
        odd = with_reply_channel(request, channel)
        assert run.feed(odd) == ()
        assert run.rejected == {(CHANNEL_OF[type(request)], "reply_channel"): 1}
        assert core.reply_overloaded(run.state, odd, instant_at(START)) == ()
        assert core.reply_internal_error(run.state, odd, instant_at(START)) == ()
        assert core.reply_error(run.state, type(odd), odd.header, Status.MALFORMED, "", instant_at(START)) == ()


@pytest.mark.parametrize("channel", ["REPLY_A", "REPLY_a_9", "REPLY_" + "A" * 57])
def test_given_a_reply_channel_within_the_rules_then_it_is_answered(channel: str) -> None:
    assert Run().ask(GetBodyList(RequestHeader(1, channel))).header.status is Status.OK


def test_given_another_reply_prefix_then_only_that_is_answered() -> None:
    run = Run(reply_prefix="ANSWER_")
    assert run.feed(GetBodyList(ME)) == ()
    assert run.ask(GetBodyList(RequestHeader(1, "ANSWER_ME"))).header.status is Status.OK


# --- waiting ------------------------------------------------------------------------------------------------


def test_given_a_time_to_come_and_a_wait_then_the_reply_comes_with_the_data() -> None:
    run = Run()
    run.samples(0, 1)
    assert run.feed(ahead(1.4), 1.1) == ()
    assert run.feed(Tick(), 1.2)[1:] == () or not of_type(run.feed(Tick(), 1.2), SendReply)
    assert not of_type(run.feed(imu(START + round(1.3 * S)), 1.3), SendReply)
    assert run.health(1.3).requests_waiting == 1
    (reply,) = of_type(run.feed(imu(START + round(1.5 * S)), 1.5), SendReply)
    assert reply.reply.header.status is Status.OK
    assert reply.reply.answer.transformation.utime == START + round(1.4 * S)
    assert run.state.waiting == ()
    assert run.state.requests_answered == 1


def test_given_a_wait_that_ends_then_the_reply_is_too_new_at_the_next_tick() -> None:
    run = Run()
    run.samples(0, 1)
    run.feed(ahead(3.0, wait_ms=500), 1.0)
    assert not of_type(run.feed(Tick(), 1.499), SendReply)
    (reply,) = of_type(run.feed(Tick(), 1.5), SendReply)
    assert reply.reply.header.status is Status.TOO_NEW


def test_given_a_wait_longer_than_allowed_then_it_is_cut() -> None:
    run = Run(wait_ms=100)
    run.samples(0, 1)
    run.feed(ahead(3.0, wait_ms=2_000_000_000), 1.0)
    assert of_type(run.feed(Tick(), 1.1), SendReply)


def test_given_a_clock_that_steps_then_waits_end_by_monotonic_time() -> None:
    run = Run()
    run.samples(0, 1)
    run.feed(ahead(3.0, wait_ms=500), 1.0)
    for utime, seconds, answered in ((START + 3600 * S, 1.4, False), (START - 3600 * S, 1.5, True)):
        instant = Instant(instant_at(START + round(seconds * S)).monotonic_ns, utime)
        run.state, outputs = step(run.state, Tick(), instant)
        assert bool(of_type(outputs, SendReply)) is answered


@pytest.mark.parametrize("wait_ms", [0, 500])
def test_given_a_request_that_needs_no_waiting_then_it_is_answered_at_once(wait_ms: int) -> None:
    run = Run()
    run.samples(0, 1)
    for question in (
        GetTransformation(ME, "Camera:Origin", "Cart:Base", TimeQuery(START + 99 * S, wait_ms=wait_ms)),
        GetTransformation(ME, "Cart:Base", "World:UTM", TimeQuery(START + S, wait_ms=wait_ms)),
        GetTransformation(ME, "Cart:Base", "World:UTM", TimeQuery(0, wait_ms=wait_ms)),
        GetTransformation(ME, "Cart:Base", "World:UTM", TimeQuery(START + 99 * S, Policy.LATEST, wait_ms)),
        GetStateVector(ME, TimeQuery(START - 5 * S, wait_ms=wait_ms)),
    ):
        assert run.ask(question, 1.0)


def test_given_no_sample_yet_and_a_wait_then_the_first_one_answers() -> None:
    run = Run()
    assert run.feed(GetHTransform(ME, time=TimeQuery(wait_ms=500))) == ()
    (reply,) = of_type(run.feed(imu(START + S // 4), 0.3), SendReply)
    assert reply.reply.header.status is Status.OK


def test_given_no_sensors_then_no_request_waits_for_a_pose() -> None:
    assert Run(None).ask(GetHTransform(ME, time=TimeQuery(wait_ms=500))).header.status is Status.NO_POSE


def test_given_as_many_waiting_as_permitted_then_one_more_is_dropped_and_counted() -> None:
    run = Run(waiting_requests=3)
    run.samples(0, 1)
    for _ in range(3):
        assert run.feed(ahead(2.0), 1.0) == ()
    reply = run.ask(ahead(2.0), 1.0)
    assert reply.header.status is Status.OVERLOADED
    assert "limits.waiting_requests" in reply.header.message
    assert run.rejected == {("PLATFORM_GET_TRANSFORMATION", "overload"): 1}
    assert run.state.requests_answered == 0
    # a request without waiting is still answered
    assert run.ask(GetBodyList(ME), 1.0).header.status is Status.OK
    assert len(of_type(run.feed(imu(START + 2 * S), 2.0), SendReply)) == 3
    assert run.state.requests_answered == 4


def test_given_no_permitted_waiting_then_a_request_that_would_wait_is_dropped() -> None:
    run = Run(waiting_requests=0)
    assert run.ask(ahead(2.0)).header.status is Status.OVERLOADED


# --- samples ------------------------------------------------------------------------------------------------


def test_given_timer_mode_then_only_ticks_publish_the_pose_of_their_instant() -> None:
    run = Run()
    assert run.feed(imu(START), 0.0) == ()
    poses = of_type(run.feed(Tick(), 0.25), PublishPose)
    assert len(poses) == 1
    assert poses[0].world.transformation.utime == START + S // 4
    assert poses[0].world.transformation.frame_of_reference == names.WORLD_UTM
    assert poses[0].odom.transformation.frame_of_reference == names.ODOM
    assert poses[0].world.origin == ORIGIN
    assert run.state.poses_published == 1


def test_given_event_mode_then_each_used_sample_publishes_its_own_instant_and_ticks_nothing() -> None:
    run = Run(publish="event")
    for n, sample in enumerate((imu(START + 5), gps(START + 10), imu(START + 15))):
        (pose,) = of_type(run.feed(sample, 1.0), PublishPose)
        assert pose.world.transformation.utime == START + 5 * (n + 1)
    assert not of_type(run.feed(Tick(), 1.0), PublishPose)


@pytest.mark.parametrize("source", ["ignore", "refuse:nan"])
def test_given_event_mode_then_an_unused_sample_publishes_nothing(source: str) -> None:
    run = Run(publish="event")
    assert run.feed(imu(START + 5, source)) == ()
    assert len(run.state.history) == 0
    run.feed(imu(START + 6))
    assert run.feed(imu(START + 7, source)) == ()
    assert run.state.history.last == START + 6


@pytest.mark.parametrize("sample", OTHERS, ids=lambda sample: type(sample).__name__)
def test_given_a_sample_of_any_kind_then_it_counts_for_what_the_localizer_makes_of_it(sample: Any) -> None:
    run = Run(publish="event")
    assert run.feed(replace(sample, header=SensorHeader(START, "ignore"))) == ()
    assert run.state.traffic["sensor:ignore"].count == 1
    assert len(run.state.history) == 0
    (pose,) = of_type(run.feed(sample), PublishPose)
    assert pose.world.transformation.utime == run.state.history.last == START + 3


def test_given_positions_of_joints_then_they_are_no_localizers_and_unknown_names_are_counted_with_the_nearest() -> None:
    run = Run(publish="event")
    positions = (JointSample("Mast", 0.5), JointSample("Pan", math.nan), JointSample("Tilt", math.inf))
    assert run.feed(JointsSample(SensorHeader(START, "arm"), positions)) == ()
    assert run.state.traffic["sensor:arm"].count == 1
    assert {reason for _, reason in run.state.rejected} == {"unknown joint 'Mast'", "unknown joint 'Tilt'"}
    assert len(run.state.history) == 0


@pytest.mark.parametrize("sample", OTHERS, ids=lambda sample: type(sample).__name__)
def test_given_raw_mode_then_wheels_joints_and_further_sources_publish_nothing(sample: Any) -> None:
    localizer = RawLocalizer.start(Mounts.from_model(cart(), "Cart:Base", "Cart:Antenna", "Cart:Imu"), None, ORIGIN)
    run = Run(localizer, publish="event")
    run.samples(0)
    held = len(run.state.history)
    assert run.feed(sample) == ()
    assert len(run.state.history) == held
    assert run.feed(SwitchMode(SensorHeader(START + 5, "me"), Mode.NO_GPS)) == ()


def test_given_a_sample_that_changes_the_newest_estimate_then_that_is_stored_and_published() -> None:
    run = Run(publish="event")
    run.samples(0.1)
    before = run.state.history.newest
    (pose,) = of_type(run.feed(gps(START, source="late"), 0.1), PublishPose)
    assert pose.world.transformation.utime == before.utime
    assert len(run.state.history) == 1
    assert run.state.history.newest is not before


# --- decisions, modes and the filter's state ----------------------------------------------------------------


def test_given_decisions_then_they_go_out_together_once_in_their_order() -> None:
    run = Run()
    (published,) = run.feed(imu(START, "decide:3"), 0.25)
    assert isinstance(published, PublishDecisions)
    assert published.utime == START + S // 4
    assert [each.kind for each in published.decisions] == ["speed_0", "speed_1", "speed_2"]
    assert run.feed(imu(START + 1)) == ()
    assert run.rejected == {}
    assert encode(published)


def test_given_unpublished_decisions_then_they_are_counted_all_the_same() -> None:
    run = Run(publish_decisions=False)
    assert run.feed(imu(START, "decide:3")) == ()
    assert run.feed(imu(START, "reject:outlier")) == ()
    assert run.rejected == {("sensor:reject:outlier", "outlier"): 1}


def test_given_a_rejecting_decision_then_it_is_counted_once_and_the_sample_publishes_no_pose() -> None:
    run = Run(publish="event")
    for count in (1, 2):
        (published,) = run.feed(gps(START, source="reject:outlier"))
        assert isinstance(published, PublishDecisions)
        assert run.rejected == {("sensor:reject:outlier", "outlier"): count}
    run.feed(gps(START, source="reject:"))
    assert run.rejected["sensor:reject:", "rejected"] == 1


class Tardy(ScriptedLocalizer):
    """A localizer that decides on a fix with the next inertial sample."""

    def process(self, sample: Any) -> Any:
        fix = gps(START, source="gps")
        taken = replace(self, newest=max(self.newest, START + 1), count=self.count + 1)
        return taken, (make_decision(fix, Verdict.REJECTED, "outlier"),) if isinstance(sample, ImuSample) else ()


def test_given_a_decision_on_an_earlier_sample_then_the_one_that_settled_it_publishes_its_pose() -> None:
    run = Run(Tardy(), publish="event")
    for sample in (gps(START), imu(START), imu(START)):
        assert len(of_type(run.feed(sample), PublishPose)) == 1
    assert run.rejected == {("sensor:gps", "outlier"): 2}


def test_given_a_mode_command_then_the_localizer_processes_it_and_it_counts_as_traffic() -> None:
    run = Run()
    run.feed(SwitchMode(SensorHeader(START, "console"), Mode.NO_GPS))
    assert run.state.localizer is not None
    assert run.state.localizer == replace(ScriptedLocalizer(), mode=Mode.NO_GPS)
    assert run.state.traffic["command:console"].count == 1
    assert [each.channel for each in run.health(1.0).channels] == ["command:console"]
    assert len(run.state.history) == 0


def test_given_mode_commands_from_the_future_then_they_are_counted_and_poses_stay_valid() -> None:
    run = Run()
    run.samples(0)
    for _ in range(4):
        assert run.feed(SwitchMode(SensorHeader(START + 10 * S, "console"), Mode.RAW)) == ()
    assert run.rejected == {("command:console", "future"): 4}
    (pose,) = of_type(run.feed(Tick(), 0.1), PublishPose)
    assert pose.world.transformation.is_valid
    assert run.state.localizer == replace(ScriptedLocalizer(), newest=START, count=1)


def test_given_no_localizer_then_a_mode_command_is_counted() -> None:
    run = Run(None)
    assert run.feed(SwitchMode(SensorHeader(START, "console"), Mode.RAW)) == ()
    assert run.state.traffic["command:console"].count == 1


@pytest.mark.parametrize("publish", ["timer", "event"])
def test_given_a_rate_of_states_then_ticks_publish_them(publish: str) -> None:
    run = Run(ScriptedLocalizer(has_state=True), ticks_per_state=10, publish=publish)
    published = [of_type(run.feed(Tick(), 0.02 * n), PublishNavigation) for n in range(25)]
    assert [n for n, each in enumerate(published) if each] == [0, 10, 20]
    (first,) = published[10]
    assert (first.state.utime, first.state.mode) == (START + 200_000, Mode.FULL)
    # of 6 missed ticks, tick 30 is one
    assert [bool(of_type(run.feed(Tick(0.0, n), 1.0), PublishNavigation)) for n in (3, 2, 0)] == [False, True, False]


@pytest.mark.parametrize(
    ("localizer", "ticks"), [(ScriptedLocalizer(), 1), (ScriptedLocalizer(has_state=True), 0), (None, 1)]
)
def test_given_no_filter_or_no_rate_then_no_state_goes_out(localizer: ScriptedLocalizer | None, ticks: int) -> None:
    run = Run(localizer, ticks_per_state=ticks)
    run.feed(imu(START))
    assert not any(of_type(run.feed(Tick(), 0.02 * n), PublishNavigation) for n in range(10))


def test_given_a_slow_pose_rate_then_ticks_in_between_serve_the_rest() -> None:
    run = Run(ticks_per_pose=5)
    run.samples(0)
    published = [n for n in range(20) if of_type(run.feed(Tick(), 0.02 * n), PublishPose)]
    assert published == [0, 5, 10, 15]
    # after 3 missed ticks
    assert [bool(of_type(run.feed(Tick(0.0, missed), 1.0), PublishPose)) for missed in (0, 3, 0)] == [True, False, True]


def test_given_an_origin_that_is_latched_then_it_goes_out_once() -> None:
    run = Run(ScriptedLocalizer(origin=None))
    assert of_type(run.feed(gps(START, source="latch")), PersistOrigin) == [PersistOrigin(ORIGIN)]
    assert run.feed(gps(START + 1)) == ()


@pytest.mark.parametrize("ahead_us", [250_001, 10**12, (1 << 61) - 1 - START])
def test_given_a_sample_from_the_future_then_it_is_counted_and_not_used(ahead_us: int) -> None:
    run = Run(publish="event")
    assert run.feed(imu(START + ahead_us)) == ()
    assert run.rejected == {("sensor:imu", "future"): 1}
    assert run.state.localizer == ScriptedLocalizer()
    assert run.feed(imu(START + 250_000)) != ()


def test_given_rejected_samples_then_each_reason_is_counted_by_source() -> None:
    run = Run()
    for reason, count in (("nan", 3), ("jump", 2)):
        for _ in range(count):
            run.feed(imu(START, f"refuse:{reason}"))
    assert run.rejected == {("sensor:refuse:nan", "nan"): 3, ("sensor:refuse:jump", "jump"): 2}


def test_given_no_localizer_then_samples_are_counted_and_ticks_publish_no_pose() -> None:
    run = Run(None)
    run.samples(0, 1)
    health = run.health(1)
    assert [each.channel for each in health.channels] == ["sensor:imu"]
    assert run.feed(Tick(), 2) == () or not of_type(run.feed(Tick(), 2), PublishPose)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300, -1e300])
def test_given_numbers_that_cannot_be_then_raw_mode_goes_on_with_the_next_good_sample(bad: float) -> None:
    localizer = RawLocalizer.start(Mounts.from_model(cart(), "Cart:Base", "Cart:Antenna", "Cart:Imu"), None, ORIGIN)
    run = Run(localizer, publish="event")
    outputs: list[Output] = []
    odd: list[Any] = [
        replace(imu(START), angular_velocity=(bad, 0.0, 0.0)),
        replace(imu(START), specific_force=(0.0, bad, 0.0)),
        replace(imu(START), orientation=(bad, 0.0, 0.0, 0.0)),
        replace(gps(START), latitude_deg=bad),
        replace(gps(START), longitude_deg=bad),
        replace(gps(START), height_ellipsoidal=bad),
        replace(gps(START), velocity=(bad, bad, bad)),
        replace(gps(START), position_covariance=(bad,) * 9),
    ]
    for n, sample in enumerate(odd):
        header = replace(sample.header, utime=START + n * 1000)
        outputs.extend(run.feed(replace(sample, header=header), n * 1e-3))
    for sample in drive(5.0, START + S):
        outputs.extend(run.feed(sample, (sample.header.utime - START) / S))
    outputs.extend(run.feed(Tick(), 6.0))
    for output in outputs:
        if isinstance(output, PublishPose):
            assert encode(output.world)
            assert encode(output.odom)
            assert output.world.transformation.utime >= START
            assert all(map(math.isfinite, output.world.transformation.pose.xyz))
    reply = run.ask(GetStateVector(ME), 6.0)
    assert reply.header.status is Status.OK


# --- health -------------------------------------------------------------------------------------------------


def test_given_the_first_tick_then_health_goes_out_and_then_once_a_period() -> None:
    run = Run(health_period_ns=1_000_000_000)
    due = [n for n in range(60) if of_type(run.feed(Tick(), n * 0.05), PublishHealth)]
    assert due == [0, 20, 40]


def test_given_a_long_pause_then_one_report_is_enough() -> None:
    run = Run()
    run.feed(Tick(), 0.0)
    reports = [len(of_type(run.feed(Tick(), 60.0 + n * 0.02), PublishHealth)) for n in range(3)]
    assert reports == [1, 0, 0]


def test_given_traffic_then_health_has_counts_rates_and_ages() -> None:
    run = Run()
    run.health(0.0)
    for n in range(50):
        run.feed(imu(START + n * 20_000), n * 0.02)
    for n in range(5):
        run.feed(gps(START + n * 200_000), n * 0.2)
    by_name = {each.channel: each for each in run.health(1.0).channels}
    assert (by_name["sensor:imu"].count, by_name["sensor:imu"].rate_hz) == (50, pytest.approx(50.0))
    assert (by_name["sensor:gps"].count, by_name["sensor:gps"].rate_hz) == (5, pytest.approx(5.0))
    assert by_name["sensor:gps"].age == pytest.approx(0.2)
    silent = {each.channel: each for each in run.health(3.0).channels}
    assert (silent["sensor:imu"].count, silent["sensor:imu"].rate_hz) == (50, 0.0)
    assert silent["sensor:imu"].age == pytest.approx(3.0 - 0.98)


def test_given_ticks_late_and_missed_then_health_reports_them_since_the_last_report() -> None:
    run = Run()
    run.health(0.0)
    for late in (0.001, 0.002, 0.100):
        run.feed(Tick(late, 2), 0.5)
    health = run.health(0.9, Tick(0.003))
    assert health.tick_latency_max == pytest.approx(0.1)
    assert health.tick_latency_p50 == pytest.approx(0.003)
    assert health.ticks_missed == 6
    again = run.health(1.8, Tick(0.004))
    assert (again.tick_latency_max, again.ticks_missed) == (pytest.approx(0.004), 6)


def test_given_a_warning_then_the_next_tick_reports_it_until_it_is_cleared() -> None:
    run = Run()
    run.health(0.0)
    run.feed(HealthWarning("journal", "the disk is full"), 0.1)
    assert run.health(0.2).warnings == (("journal", "the disk is full"),)
    run.feed(HealthWarning("journal", "the disk is full"), 0.3)
    # nothing has changed: nothing is due before the period is over
    assert not [each for each in run.feed(Tick(), 0.4) if isinstance(each, PublishHealth)]
    run.feed(HealthWarning("journal"), 0.5)
    assert run.health(0.6).warnings == ()


def test_given_some_work_then_health_has_its_counts() -> None:
    run = Run(localizer=ScriptedLocalizer(epoch=4))
    run.samples(0, 0.5)
    run.ask(GetBodyList(ME))
    run.feed(Rejected("GPS", "truncated"))
    run.feed(Rejected("GPS", "truncated"))
    run.feed(Rejected("tick", "handler"))
    health = run.health(1.0)
    assert (health.utime, health.uptime) == (START + S, pytest.approx(1.0))
    assert (health.vehicle, health.model_revision) == ("cart", cart().revision)
    assert (health.pose_epoch, health.origin_id) == (4, ORIGIN.origin_id)
    assert (health.poses_published, health.requests_answered, health.handler_errors) == (1, 1, 1)
    assert health.rejected == (("GPS", "truncated", 2), ("tick", "handler", 1))
    assert encode(health)


def test_given_poses_valid_and_not_then_the_state_goes_starting_running_degraded() -> None:
    run = Run(ScriptedLocalizer(stale_s=1.0))
    states = [run.health(0.0).state]
    run.samples(0.1)
    states += [run.health(0.2).state, run.health(9.0).state]
    run.samples(9.1)
    states.append(run.health(9.2).state)
    assert states == [core.STARTING, core.RUNNING, core.DEGRADED, core.RUNNING]
    assert run.health(30.0).invalid_reasons == Invalid.STALE_IMU | Invalid.STALE_GPS


def test_given_endless_sources_and_reasons_then_the_counters_are_bounded_and_nothing_is_lost() -> None:
    run = Run()
    for n in range(1000):
        run.feed(imu(START, f"refuse:{n}"))
    assert len(run.rejected) <= MAX_COUNTERS + 1
    assert sum(run.rejected.values()) == 1000
    assert len(run.state.traffic) <= MAX_COUNTERS
    health = run.health(1.0)
    assert sum(count for _, _, count in health.rejected) == 1000
    # one report is one LCM message of a few packets
    assert len(encode(health)) < 64_000
    # earlier causes keep their own counters
    run.feed(imu(START, "refuse:0"))
    assert run.rejected["sensor:refuse:0", "0"] == 2


# --- determinism --------------------------------------------------------------------------------------------


def journal() -> list[tuple[Event, Instant]]:
    """A drive with requests of all kinds, odd samples, and a clock that steps."""
    events: list[tuple[Event, Instant]] = []
    for n, sample in enumerate(drive(12.0)):
        at = instant_at(sample.header.utime + 1500)
        events.append((sample, at))
        if n % 6 == 0:
            events.append((Tick(1e-4, n % 5), at))
        if n % 10 == 0:
            events.append((REQUESTS[n // 10 % len(REQUESTS)], at))
        if n % 25 == 0:
            events.append((ahead((sample.header.utime - START) / S + 0.05, 300), at))
        if n % 90 == 0:
            events += [(imu(START + 7), at), (gps(START, 5e5), at), (Rejected("GPS", "truncated"), at)]
    events += [(sample, instant_at(sample.header.utime)) for sample in drive(6.0, START - 100 * S)]
    return events


def bits(events: list[tuple[Event, Instant]], publish: str) -> list[bytes]:
    mounts = Mounts.from_model(cart(), "Cart:Base", "Cart:Antenna", "Cart:Imu")
    state = start_core(RawLocalizer.start(mounts), publish=publish)  # type: ignore[arg-type]
    published: list[bytes] = []
    for event, now in events:
        state, outputs = step(state, event, now)
        for output in outputs:
            match output:
                case PublishPose(world, odom):
                    published += [encode(world), encode(world, "pose_vector_t"), encode(odom)]
                case SendReply(channel, reply):
                    published += [channel.encode(), encode(reply)]
                case DeferredAnswer():
                    published += [encode(reply) for reply in complete(output.work())]
                case PublishHealth(health):
                    published.append(encode(health))
                case PublishDecisions() as decisions:
                    published.append(encode(decisions))
                case PublishNavigation(navigation):
                    published.append(encode(navigation))
                case PersistOrigin(origin):
                    published.append(repr(origin).encode())
    return published


@pytest.mark.slow
@pytest.mark.parametrize("publish", ["timer", "event"])
def test_given_the_same_events_then_the_outputs_are_the_same_bit_for_bit(publish: str) -> None:
    events = journal()
    first = bits(events, publish)
    assert len(first) > 300
    assert bits(events, publish) == first


def test_given_an_old_state_then_it_can_be_continued_again_with_the_same_result() -> None:
    run = Run()
    run.samples(0, 1)
    old = run.state
    for _ in range(3):
        state, _ = step(old, imu(START + 2 * S), instant_at(START + 2 * S))
        state, first = step(state, GetStateVector(ME), instant_at(START + 2 * S))
        state, _ = step(old, imu(START + 3 * S), instant_at(START + 3 * S))
        assert isinstance(first[0], SendReply)
        assert isinstance(first[0].reply, StateVectorReply)
        assert first[0].reply.answer is not None
        assert first[0].reply.answer.transformation.utime == START + 2 * S
    assert old.history.last == START + S
    assert dict(old.rejected) == {}


def test_given_a_flood_of_samples_then_estimates_are_held_at_intervals() -> None:
    run = Run()
    for n in range(1000):
        run.samples(n * 0.0005)
    held = len(run.state.history)
    assert held == pytest.approx(500_000 / MIN_STEP_US, abs=1)
    assert run.state.localizer is not None
    assert run.state.localizer.utime - run.state.history.last < MIN_STEP_US


def test_given_a_host_clock_that_was_set_back_then_no_pose_is_valid_until_a_sample_fits() -> None:
    run = Run()
    run.samples(0.0, 0.1, 0.2)
    run.feed(Tick(), 0.25)
    for n in range(3):
        # the sensors' stamps go on; the host's clock was set back by 10 s
        run.feed(imu(START + round((0.3 + n / 10) * S)), -9.7 + n / 10)
    assert run.rejected["sensor:imu", "future"] == 3
    (pose,) = of_type(run.feed(Tick(), -9.0), PublishPose)
    assert Invalid(pose.world.transformation.invalid_reasons) & Invalid.CLOCK_STEPPED
    assert not pose.odom.transformation.is_valid
    report = run.health(-8.9)
    assert (report.state, report.invalid_reasons) == (core.DEGRADED, Invalid.CLOCK_STEPPED)
    run.samples(0.9)
    (pose,) = of_type(run.feed(Tick(), 0.95), PublishPose)
    assert pose.world.transformation.is_valid


@pytest.mark.parametrize("count", [1, 100])
def test_given_samples_of_the_future_then_they_are_rejected_and_poses_stay_valid(count: int) -> None:
    run = Run()
    run.samples(0.0, 0.1)
    for _ in range(count):
        run.feed(imu(START + 100 * S), 0.15)
    assert run.rejected == {("sensor:imu", "future"): count}
    (pose,) = of_type(run.feed(Tick(), 0.2), PublishPose)
    assert pose.world.transformation.is_valid


def test_given_the_time_of_day_set_back_then_poses_are_invalid_at_the_next_tick_until_a_sample_of_the_new_time() -> (
    None
):
    run = Run()

    def tick(since: float, utime: float) -> PublishPose:
        now = Instant(instant_at(START).monotonic_ns + round(since * 1e9), START + round(utime * S))
        run.state, outputs = step(run.state, Tick(), now)
        (pose,) = of_type(outputs, PublishPose)
        return pose

    run.samples(0.0, 0.1)
    assert tick(0.12, 0.12).world.transformation.is_valid
    # preempted between the readings of the two clocks: no step
    assert tick(0.14, 0.44).world.transformation.is_valid
    assert tick(0.16, 0.16).world.transformation.is_valid
    # a step ahead only increases the age of the estimate
    assert tick(0.18, 0.68).world.transformation.is_valid
    assert tick(0.20, 0.70).world.transformation.is_valid
    assert tick(0.22, 0.22).world.transformation.invalid_reasons == Invalid.CLOCK_STEPPED
    # joints do not confirm the localization's time
    joints = JointsSample(SensorHeader(START + round(0.23 * S), "arm"), ())
    run.state, _ = step(
        run.state, joints, Instant(instant_at(START).monotonic_ns + 230_000_000, START + round(0.23 * S))
    )
    assert tick(0.24, 0.24).world.transformation.invalid_reasons == Invalid.CLOCK_STEPPED
    run.state, _ = step(
        run.state, imu(START + 250_000), Instant(instant_at(START).monotonic_ns + 250_000_000, START + 250_000)
    )
    assert tick(0.26, 0.26).world.transformation.is_valid

"""The core: a deterministic state machine, `step(state, event, now) -> (state, outputs)`. Pure.

Live and replay run this same function: the same events at the same instants give the same outputs. Time enters
only with events. Nothing that comes from the bus can raise out of `step`; what cannot be used is counted by
channel and reason, and the counts go out with the health report.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Final, Literal, NamedTuple, TypeAlias

from modelserver.answers import answer, failure
from modelserver.errors import Status
from modelserver.geometry import names
from modelserver.geometry.model import Model
from modelserver.history import History
from modelserver.localization.interface import Localizer
from modelserver.messages import (
    CHANNEL_OF,
    VALID,
    AbsolutePoseSample,
    ChannelHealth,
    Decision,
    Event,
    GetBodyFrameList,
    GetBodyList,
    GetHistory,
    GetHTransform,
    GetStateVector,
    GetTransformation,
    GpsSample,
    Health,
    ImuSample,
    Invalid,
    JointsSample,
    OriginLatched,
    Output,
    Policy,
    PublishDecisions,
    PublishHealth,
    PublishNavigation,
    PublishPose,
    RangeSample,
    Rejected,
    RelativePoseSample,
    Request,
    RequestHeader,
    Sample,
    SendReply,
    SwitchMode,
    Tick,
    Verdict,
    WheelsSample,
)
from modelserver.platform import PlatformView
from modelserver.version import __version__

FUTURE_LIMIT_S: Final = 1.0
"""A sample stamped this far ahead of the host's clock is refused: one of the two clocks is wrong."""

FUTURE_SAMPLES: Final = 3
"""So many of them in a row are no strays: the host's clock was set back, and no pose is valid until one fits."""

HISTORY_STEP_US: Final = 4000
"""Microseconds between the estimates held, at least: a flood of samples must not fill the memory."""

MAX_COUNTERS: Final = 256
"""Distinct causes of rejection that are told apart; further ones are counted together."""

LATENESS_KEPT: Final = 512

STARTING, RUNNING, DEGRADED = 0, 1, 2


class Instant(NamedTuple):
    """When an event is handled: the host's monotonic clock in nanoseconds, and its time of day as utime."""

    monotonic_ns: int
    utime: int


@dataclass(frozen=True, slots=True)
class CoreSettings:
    """What does not change while the core runs; see `modelserver.config` for the meanings.

    ticks_per_pose: in timer mode POSE goes out at the first of each so many ticks; missed ones are counted too.
    ticks_per_state: the same for the filter's state; 0 = it does not go out.
    publish_decisions: whether what became of measurements goes out.
    """

    base_frame: str
    rolling_frame: str = ""
    vehicle: str = ""
    publish: Literal["timer", "event"] = "timer"
    ticks_per_pose: int = 1
    ticks_per_state: int = 0
    publish_decisions: bool = True
    health_period_ns: int = 1_000_000_000
    history_s: float = 60.0
    parked_requests: int = 64
    wait_ms: int = 2000
    reply_prefix: str = "REPLY_"


@dataclass(frozen=True, slots=True)
class Parked:
    """A request that waits for data, and is answered as best it can at `until_ns` (monotonic)."""

    request: GetTransformation | GetStateVector | GetHTransform
    until_ns: int


@dataclass(frozen=True, slots=True)
class Traffic:
    """Messages of one source: how many, the last one's arrival, and how many there were at the last report."""

    count: int = 0
    last_ns: int = 0
    reported: int = 0


class CoreState(NamedTuple):
    """All that the core knows. Make the first one with `start`.

    A NamedTuple, not a dataclass like the rest: its successor is made for every event, at a third of the cost.
    """

    settings: CoreSettings
    view: PlatformView
    started_ns: int
    parked: tuple[Parked, ...] = ()
    rejected: Mapping[tuple[str, str], int] = MappingProxyType({})
    traffic: Mapping[str, Traffic] = MappingProxyType({})
    lateness: tuple[float, ...] = ()
    health_due_ns: int = 0
    health_sent_ns: int = 0
    poses_published: int = 0
    ticks: int = 0
    ticks_missed: int = 0
    handler_errors: int = 0
    run_state: int = STARTING
    futures: int = 0
    requests_answered: int = 0  # stays last: see `_request`

    @property
    def model(self) -> Model:
        """The geometry in force."""
        return self.view.model

    @property
    def localizer(self) -> Localizer | None:
        """What has been concluded from the samples so far; None for a vehicle without GPS and IMU."""
        return self.view.localizer

    @property
    def history(self) -> History:
        """The estimates of the last seconds."""
        return self.view.history


Outputs: TypeAlias = tuple[Output, ...]
Step: TypeAlias = tuple[CoreState, Outputs]


def start(settings: CoreSettings, model: Model, localizer: Localizer | None, now: Instant) -> CoreState:
    """Return the first state. Raises a QueryError where the model lacks the base frame or the rolling frame."""
    view = PlatformView(model, settings.base_frame, localizer, History(settings.history_s), settings.rolling_frame)
    model.get_transformation(view.base_frame, view.rolling_frame)
    return CoreState(settings, view, now.monotonic_ns, health_due_ns=now.monotonic_ns)


def step(state: CoreState, event: Event, now: Instant) -> Step:
    """Return the state after an event, and what is to be sent."""
    return _HANDLERS[type(event)](state, event, now)


# --- samples ------------------------------------------------------------------------------------------------


def _sample(state: CoreState, sample: Sample, now: Instant) -> Step:
    source = f"sensor:{sample.header.source}"
    state = _note_traffic(state, source, now)
    if sample.header.utime > now.utime + FUTURE_LIMIT_S * 1e6:
        state = _count(state._replace(futures=state.futures + 1), source, "future")
        if state.futures >= FUTURE_SAMPLES:
            # one clock was set: what is held is of another time than what is asked for now
            state = state._replace(view=replace(state.view, doubt=Invalid.CLOCK_STEPPED))
        return state, ()
    if state.futures:
        state = state._replace(futures=0, view=replace(state.view, doubt=VALID))
    if state.localizer is None:
        return state, ()
    return _localize(state, state.localizer, sample, now)


def _switch(state: CoreState, wish: SwitchMode, now: Instant) -> Step:
    source = f"command:{wish.header.source}"
    state = _note_traffic(state, source, now)
    if wish.header.utime > now.utime + FUTURE_LIMIT_S * 1e6:
        # unlike a sensor's this says nothing of the host's clock: it may be the operator's that is wrong
        return _count(state, source, "future"), ()
    if state.localizer is None:
        return state, ()
    return _localize(state, state.localizer, wish, now)


def _localize(state: CoreState, before: Localizer, sample: Sample | SwitchMode, now: Instant) -> Step:
    """Return what follows from a sample, or from a wish, for the localization."""
    localizer, notes = before.take(sample)
    outputs: list[Output] = []
    decisions: list[Decision] = []
    refused = False
    for note in notes:
        if isinstance(note, Rejected):
            state = _count(state, note.channel, note.reason)
            refused = True
        elif isinstance(note, OriginLatched):
            outputs.append(note)
        else:
            decisions.append(note)
            if note.verdict is Verdict.REJECTED:
                state = _count(state, f"sensor:{note.source}", note.reason or "rejected")
                # what is said late is of an earlier sample
                refused |= (note.source, note.seq) == (sample.header.source, sample.header.seq)
    if decisions and state.settings.publish_decisions:
        outputs.append(PublishDecisions(now.utime, tuple(decisions)))
    if localizer is before:
        return state, tuple(outputs)
    # before the first sample that can be used there is no time that an estimate could hold for
    utime = localizer.utime
    known = utime > 0
    history = state.history
    if known and (not len(history) or not 0 < utime - history.last < HISTORY_STEP_US):
        history = history.extended(localizer.deferred(utime))
    view = state.view
    view = PlatformView(view.model, view.base_frame, localizer, history, view.rolling_frame, view.doubt)
    state = state._replace(view=view)
    if known:
        # a part may be refused of a sample that moves time on all the same
        if state.settings.publish == "event" and (not refused or utime != before.utime):
            state, pose = _publish(state, utime)
            outputs.append(pose)
        if state.parked:
            state, replies = _answer_parked(state, now)
            outputs.extend(replies)
    return state, tuple(outputs)


def _publish(state: CoreState, utime: int) -> tuple[CoreState, PublishPose]:
    assert state.localizer is not None
    estimate = state.localizer.estimate(utime)
    view = state.view
    world = view.broadcast(estimate, names.WORLD_UTM)
    run_state = RUNNING if world.transformation.valid else DEGRADED
    if run_state == DEGRADED and state.run_state == STARTING:
        run_state = STARTING
    state = state._replace(poses_published=state.poses_published + 1, run_state=run_state)
    return state, PublishPose(world, view.broadcast(estimate, names.ODOM))


# --- time ---------------------------------------------------------------------------------------------------


def _tick(state: CoreState, tick: Tick, now: Instant) -> Step:
    outputs: list[Output] = []
    settings, before = state.settings, state.ticks
    state = state._replace(
        lateness=(*state.lateness[-LATENESS_KEPT + 1 :], tick.late),
        ticks=state.ticks + 1 + tick.missed,
        ticks_missed=state.ticks_missed + tick.missed,
        requests_answered=state.requests_answered + tick.answered,
    )
    localizer = state.localizer
    if localizer is not None:
        if settings.publish == "timer" and _is_due(settings.ticks_per_pose, before, state.ticks):
            state, pose = _publish(state, now.utime)
            outputs.append(pose)
        if settings.ticks_per_state and _is_due(settings.ticks_per_state, before, state.ticks):
            navigation = localizer.navigation(now.utime)
            if navigation is not None:
                outputs.append(PublishNavigation(navigation))
    if state.parked:
        state, replies = _answer_parked(state, now)
        outputs.extend(replies)
    if now.monotonic_ns >= state.health_due_ns:
        state, health = _report(state, now)
        outputs.append(health)
    return state, tuple(outputs)


def _is_due(every: int, before: int, after: int) -> bool:
    """Return whether, of ticks counted from 0, the next after `before` of them up to `after` hold one in `every`."""
    # the first tick is one at which all is due
    return (after - 1) // every > (before - 1) // every


def _report(state: CoreState, now: Instant) -> tuple[CoreState, PublishHealth]:
    elapsed = (now.monotonic_ns - state.health_sent_ns) * 1e-9 if state.health_sent_ns else 0.0
    late = sorted(state.lateness) or [0.0]
    estimate = None if state.localizer is None else state.localizer.estimate(now.utime)
    channels = tuple(_channel_health(name, traffic, elapsed, now) for name, traffic in sorted(state.traffic.items()))
    health = Health(
        utime=now.utime,
        uptime=(now.monotonic_ns - state.started_ns) * 1e-9,
        version=__version__,
        vehicle=state.settings.vehicle,
        model_revision=state.model.revision,
        state=state.run_state,
        invalid_reasons=state.view.doubt | (VALID if estimate is None else estimate.invalid),
        pose_epoch=0 if estimate is None else estimate.pose_epoch,
        origin_id=0 if estimate is None or estimate.origin is None else estimate.origin.origin_id,
        poses_published=state.poses_published,
        requests_answered=state.requests_answered,
        requests_parked=len(state.parked),
        ticks_missed=state.ticks_missed,
        handler_errors=state.handler_errors,
        tick_lateness_p50=late[len(late) // 2],
        tick_lateness_max=late[-1],
        channels=channels,
        rejected=tuple((channel, reason, count) for (channel, reason), count in sorted(state.rejected.items())),
    )
    state = state._replace(
        traffic={name: replace(traffic, reported=traffic.count) for name, traffic in state.traffic.items()},
        lateness=(),
        health_sent_ns=now.monotonic_ns,
        # from now, not from the due time: after a pause one report is enough
        health_due_ns=now.monotonic_ns + state.settings.health_period_ns,
    )
    return state, PublishHealth(health)


def _channel_health(name: str, traffic: Traffic, elapsed: float, now: Instant) -> ChannelHealth:
    rate = (traffic.count - traffic.reported) / elapsed if elapsed > 0 else 0.0
    return ChannelHealth(name, traffic.count, rate, (now.monotonic_ns - traffic.last_ns) * 1e-9)


# --- requests -----------------------------------------------------------------------------------------------


def _request(state: CoreState, request: Request, now: Instant) -> Step:
    if not request.header.is_answerable(state.settings.reply_prefix):
        return _count(state, CHANNEL_OF[type(request)], "reply_channel"), ()
    if isinstance(request, _TIMED) and request.time.wait_ms and _must_wait(state, request):
        if len(state.parked) < state.settings.parked_requests:
            wait_ms = min(request.time.wait_ms, state.settings.wait_ms)
            parked = Parked(request, now.monotonic_ns + wait_ms * 1_000_000)
            return state._replace(parked=(*state.parked, parked)), ()
        state = _count(state, CHANNEL_OF[type(request)], "load")
        why = f"{len(state.parked)} requests wait already, as many as may (limits.parked_requests); ask without wait_ms"
        return state, _turned_down(state, type(request), request.header, Status.REFUSED_LOAD, why, now)
    # what `_replace` does, at a third of its cost: this is done for every request
    counted = CoreState._make((*state[:-1], state.requests_answered + 1))
    return counted, (_reply(state, request, now),)


def _must_wait(state: CoreState, request: GetTransformation | GetStateVector | GetHTransform) -> bool:
    """Whether a request asked for a time that is yet to come, and gave time to wait for it."""
    time = request.time
    if not time.wait_ms or state.localizer is None:
        return False
    if isinstance(request, GetTransformation) and not (
        _of_world(request.frame_of_interest) or _of_world(request.frame_of_reference)
    ):
        return False
    if time.at and time.policy is not Policy.LATEST:
        return not state.view.covers(time.at)
    return not len(state.history)


def _of_world(frame: str) -> bool:
    return frame.partition(":")[0] in names.RESERVED_BODIES


def _answer_parked(state: CoreState, now: Instant) -> tuple[CoreState, list[Output]]:
    """Answer the parked requests whose data have come or whose time is up."""
    still: list[Parked] = []
    replies: list[Output] = []
    for parked in state.parked:
        if now.monotonic_ns < parked.until_ns and _must_wait(state, parked.request):
            still.append(parked)
        else:
            replies.append(_reply(state, parked.request, now))
    if replies:
        state = state._replace(parked=tuple(still), requests_answered=state.requests_answered + len(replies))
    return state, replies


def _reply(state: CoreState, request: Request, now: Instant) -> SendReply:
    return SendReply(request.header.reply_channel, answer(state.view, request, now.utime))


def refuse(state: CoreState, request: Request, now: Instant) -> Outputs:
    """Return the refusal of a request that the server has no time for."""
    message = "the server is loaded and did not take the request; ask again later"
    return _turned_down(state, type(request), request.header, Status.REFUSED_LOAD, message, now)


def fail(state: CoreState, request: Request, now: Instant) -> Outputs:
    """Return the reply to a request that an error of the server's own kept from being answered."""
    message = "the server failed on its side; its log says why"
    return _turned_down(state, type(request), request.header, Status.INTERNAL, message, now)


def turn_back(state: CoreState, kind: type[Request], header: RequestHeader, why: str, now: Instant) -> Outputs:
    """Return the reply to a request that makes no sense beyond its header."""
    return _turned_down(state, kind, header, Status.MALFORMED, why, now)


def _turned_down(
    state: CoreState, kind: type[Request], header: RequestHeader, status: Status, message: str, now: Instant
) -> Outputs:
    if not header.is_answerable(state.settings.reply_prefix):
        return ()
    return (SendReply(header.reply_channel, failure(state.view, kind, header, status, message, now.utime)),)


# --- counting -----------------------------------------------------------------------------------------------


def _rejected(state: CoreState, rejected: Rejected, now: Instant) -> Step:
    return _count(state, rejected.channel, rejected.reason), ()


def _count(state: CoreState, channel: str, reason: str) -> CoreState:
    key = (channel, reason)
    if key not in state.rejected and len(state.rejected) >= MAX_COUNTERS:
        key = ("*", "other")
    counts = dict(state.rejected)
    counts[key] = counts.get(key, 0) + 1
    errors = state.handler_errors + (reason == "handler")
    return state._replace(rejected=counts, handler_errors=errors)


def _note_traffic(state: CoreState, source: str, now: Instant) -> CoreState:
    known = state.traffic.get(source)
    if known is None and len(state.traffic) >= MAX_COUNTERS:
        return state
    known = known or Traffic()
    updated = Traffic(known.count + 1, now.monotonic_ns, known.reported)
    return state._replace(traffic={**state.traffic, source: updated})


_TIMED: Final = (GetTransformation, GetStateVector, GetHTransform)
"""Requests that ask about a time, and may wait for it."""

_HANDLERS: Final[Mapping[type, Callable[[CoreState, Any, Instant], Step]]] = {
    GpsSample: _sample,
    ImuSample: _sample,
    WheelsSample: _sample,
    JointsSample: _sample,
    AbsolutePoseSample: _sample,
    RelativePoseSample: _sample,
    RangeSample: _sample,
    SwitchMode: _switch,
    Tick: _tick,
    Rejected: _rejected,
    GetTransformation: _request,
    GetBodyList: _request,
    GetBodyFrameList: _request,
    GetStateVector: _request,
    GetHTransform: _request,
    GetHistory: _request,
}

"""The core of the server: a deterministic state machine, `step(state, event, now) -> (state, outputs)`. Pure.

Live operation and replay run this function: the same events at the same instants give the same outputs, bit for bit.
Time enters only with an event, as an `Instant` of both host clocks. `_HANDLERS` at the end dispatches by event type:

- requests are answered at once, deferred (long answers, which the server loop computes in steps), kept waiting until
  their data arrive, or rejected with the reason;
- samples update the localizer and the joints, and may publish a pose;
- ticks do what is due by the clock: poses, filter state, waiting requests, health report, snapshot, state to persist;
- commands reload the geometry, add frames, set the pose or switch the mode, only if signed. A reload and a frame have
  two steps, since the core does no input or output: it outputs `LoadModel`, the geometry is made beside the loop, and
  the result comes back as the event `ModelLoaded` (`apply_model`). A pose that is set becomes an absolute-pose sample
  of the source `OPERATOR`, and passes the gates of localization as any other measurement.

A message from the bus never raises out of `step`. What cannot be used is counted by channel and reason, and the health
report publishes the counts.

Health report: a full one is due once a period (`health_period_ns`). Between two of them, the conditions that matter to
an operator (`HealthConditions`) are evaluated every `CHANGE_PERIOD_NS`, and a report is sent at once when they have
changed. Rates, delays and the distribution of tick delays always cover a whole period: a report for a change repeats
the last ones.

Sensor timeout: a source is silent after `get_silence_limit` of its usual interval, a moving average (`state`).
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, TypeAlias, get_args

import numpy as np

from modelserver import messages
from modelserver.core.state import (
    CHANGE_PERIOD_NS,
    DEGRADED,
    LATE_LIMIT_S,
    RUNNING,
    SAMPLE_FUTURE_LIMIT_S,
    START,
    START_REPORT_NS,
    STARTING,
    AllOutputs,
    CoreSettings,
    CoreState,
    ExpectedSensor,
    HealthConditions,
    Instant,
    Outputs,
    SourceTraffic,
    StepResult,
    TimedRequest,
    WaitingRequest,
    count_decision,
    count_message,
    count_rejection,
    format_offset,
    get_silence_limit,
    handle_rejected,
    handle_warning,
    is_clock_off,
    mark_received,
    note_offset,
    start,
)
from modelserver.earth.geodesy import compute_geodetic
from modelserver.errors import Status
from modelserver.estimation.filter.protection_levels import compute_longest_axis
from modelserver.estimation.history import Localizer, LocalizerEvent, PersistentLocalizer
from modelserver.geometry import names
from modelserver.geometry.model import Model
from modelserver.named_tuples import new_tuple
from modelserver.query.answers import DeferredAnswer, complete_names, compute_replies, is_deferred, make_error_reply
from modelserver.query.dynamics import find_stability
from modelserver.query.view import PlatformView
from modelserver.transforms.transformation import find_covariance_problem
from modelserver.version import __version__


def step(state: CoreState, event: messages.Event | ModelLoaded, now: Instant) -> tuple[CoreState, AllOutputs]:
    return _HANDLERS[type(event)](state, event, now)


# --- requests ---------------------------------------------------------------------------------------------------------

_TIMED: Final = get_args(TimedRequest)
"""Requests that name a time, and may wait for its data."""


_PLAIN_NAME = re.compile(r"[A-Za-z0-9_]+")


def is_answerable(header: messages.RequestHeader, prefix: str) -> bool:
    """Return whether a server may reply on the request's reply channel: within its prefix, plain, not too long."""
    channel = header.reply_channel
    # the length first: what is looked up is cached
    return len(channel) <= messages.MAX_CHANNEL_LENGTH and _is_plain(channel, prefix)


@lru_cache(maxsize=1024)
def _is_plain(channel: str, prefix: str) -> bool:
    return len(channel) > len(prefix) and channel.startswith(prefix) and _PLAIN_NAME.fullmatch(channel) is not None


def handle_request(state: CoreState, request: messages.Request, now: Instant) -> tuple[CoreState, AllOutputs]:
    """Answer a request, defer a long answer, or let the request wait until the data it asks for arrive."""
    if not is_answerable(request.header, state.settings.reply_prefix):
        return count_rejection(state, messages.CHANNEL_OF[type(request)], "reply_channel"), ()
    request = complete_names(request)
    if isinstance(request, _TIMED) and request.time.wait_ms and _must_wait(state, request):
        if len(state.waiting) < state.settings.waiting_requests:
            wait_ms = min(request.time.wait_ms, state.settings.wait_ms)
            waiting = WaitingRequest(request, now.monotonic_ns + wait_ms * 1_000_000)
            return state._replace(waiting=(*state.waiting, waiting)), ()
        state = count_rejection(state, messages.CHANNEL_OF[type(request)], "overload")
        why = f"{len(state.waiting)} requests wait already, the limit (limits.waiting_requests); ask without wait_ms"
        return state, reply_error(state, type(request), request.header, Status.OVERLOADED, why, now)
    # a third of the cost of `_replace`, for every request
    after = CoreState._make((*state[:-1], state.requests_answered + 1))
    if is_deferred(request):
        return after, (DeferredAnswer(state.view, request, now.utime),)
    return after, _make_replies(state, request, now)


def _must_wait(state: CoreState, request: TimedRequest) -> bool:
    """Return whether the data that a request asks for are yet to come, and it may wait for them."""
    ends = (names.WORLD_UTM, state.view.base_frame)
    if isinstance(request, (messages.GetTransformation, messages.GetMotion, messages.GetExplanation)):
        ends = (request.frame_of_interest, request.frame_of_reference)
    return state.view.is_awaiting_data(request.time, *ends)


def answer_waiting(state: CoreState, now: Instant) -> tuple[CoreState, list[messages.Output]]:
    """Answer the waiting requests whose data have arrived or whose deadline has passed."""
    remaining: list[WaitingRequest] = []
    replies: list[messages.Output] = []
    for request in state.waiting:
        if now.monotonic_ns < request.deadline_ns and _must_wait(state, request.request):
            remaining.append(request)
        else:
            replies += _make_replies(state, request.request, now)
    if replies:
        state = state._replace(waiting=tuple(remaining), requests_answered=state.requests_answered + len(replies))
    return state, replies


def _make_replies(state: CoreState, request: messages.Request, now: Instant) -> tuple[messages.SendReply, ...]:
    channel = request.header.reply_channel
    return tuple([messages.SendReply(channel, reply) for reply in compute_replies(state.view, request, now.utime)])


def reply_overloaded(state: CoreState, request: messages.Request, now: Instant) -> Outputs:
    message = "the server is overloaded and dropped the request; try again later"
    return reply_error(state, type(request), request.header, Status.OVERLOADED, message, now)


def reply_internal_error(state: CoreState, request: messages.Request, now: Instant) -> Outputs:
    message = "internal error of the server; its log has the traceback"
    return reply_error(state, type(request), request.header, Status.INTERNAL, message, now)


def handle_denied(state: CoreState, command: messages.Denied, now: Instant) -> StepResult:
    """Count a denied command, and reply with the reason to a sender whose signature is verified."""
    state = count_rejection(state, command.channel, command.reason)
    if command.request_type is None or command.header is None:
        return state, ()
    status, why = Status.FORBIDDEN, f"the command is denied: {command.message}"
    if command.is_malformed:
        status, why = Status.MALFORMED, command.message
    return state, reply_error(state, command.request_type, command.header, status, why, now)


def reply_error(
    state: CoreState,
    kind: type[messages.Request],
    header: messages.RequestHeader,
    status: Status,
    message: str,
    now: Instant,
) -> Outputs:
    """Reply with an error and its reason; without output if the reply channel is not permitted."""
    if not is_answerable(header, state.settings.reply_prefix):
        return ()
    return (
        messages.SendReply(
            header.reply_channel, make_error_reply(state.view, kind, header, status, message, now.utime)
        ),
    )


# --- samples ----------------------------------------------------------------------------------------------------------

COMMAND_FUTURE_LIMIT_S: Final = 1.0
"""A command stamped this far ahead of the host's clock is rejected: one of the two clocks is wrong."""

EARLIEST_US, LATEST_US = -round(LATE_LIMIT_S * 1e6), round(SAMPLE_FUTURE_LIMIT_S * 1e6)
"""Bounds of a stamp less its receipt, microseconds."""

WARM_START: Final = "warm_start"
"""Kind of the decisions on the persisted state of an earlier run."""


def process_sample(state: CoreState, sample: messages.Sample, now: Instant) -> StepResult:
    header = sample.header
    source = f"sensor:{header.source}"
    state = check_host_clock(state, now, count_message(state.traffic, source, header.host_utime, now))
    if state.missing_sensors:
        state = mark_received(state, sample)
    offset, known = header.utime - now.utime, state.traffic.get(source)
    if (known is not None and known.num_off) or not EARLIEST_US <= offset <= LATEST_US:
        state = state._replace(traffic=note_offset(state.traffic, source, header.utime, now))
        # rejected for its own source alone: any publisher can stamp as it likes
        if offset > LATEST_US:
            return count_rejection(state, source, "future"), ()
        if is_clock_off(state.traffic, source, now):
            return count_rejection(state, source, "too_old"), ()
    if isinstance(sample, messages.JointsSample):
        return process_joints(state, sample, now)
    if state.localizer is None:
        return state, ()
    return update_localizer(state, state.localizer, sample, now)


def check_host_clock(state: CoreState, now: Instant, traffic: Mapping[str, SourceTraffic]) -> CoreState:
    """Detect a backward step of the time of day, which invalidates the pose until a sample of the new time is used.

    The last pose is then of a later time than what clients ask for now. `traffic` is that after the event.
    """
    view, clock, _, *others = state
    clock, has_stepped_back = clock.update(now)
    if has_stepped_back and view.localizer is not None:
        view = view._replace(invalid=messages.Invalid.CLOCK_STEPPED)
    return new_tuple(CoreState, (view, clock, traffic, *others))


def process_joints(state: CoreState, sample: messages.JointsSample, now: Instant) -> StepResult:
    joints, rejected = state.view.joints.update(sample, now.utime)
    for reason, count in Counter(rejected).items():
        state = count_rejection(state, f"sensor:{sample.header.source}", reason, count)
    if joints is state.view.joints:
        return state, ()
    state, replies = answer_waiting(state._replace(view=state.view._replace(joints=joints)), now)
    return state, tuple(replies)


def switch_mode(state: CoreState, command: messages.SwitchMode, now: Instant) -> StepResult:
    source = f"command:{command.header.source}"
    state = state._replace(traffic=count_message(state.traffic, source, command.header.host_utime, now))
    if command.header.utime > now.utime + COMMAND_FUTURE_LIMIT_S * 1e6:
        return count_rejection(state, source, "future"), ()
    if state.localizer is None:
        return state, ()
    return update_localizer(state, state.localizer, command, now)


def update_localizer(
    state: CoreState, before: Localizer, sample: messages.Sample | messages.SwitchMode, now: Instant
) -> StepResult:
    """Update the localizer with a sample or a mode command, and publish what follows from it."""
    localizer, events = before.process(sample)
    outputs: list[messages.Output] = []
    decisions: list[messages.Decision] = []
    is_rejected = False
    for event in events:
        if isinstance(event, messages.Rejected):
            state = count_rejection(state, event.channel, event.reason)
            is_rejected = True
        elif isinstance(event, messages.PersistOrigin):
            outputs.append(event)
        else:
            decisions.append(event)
            state = count_decision(state, event)
            if event.kind == WARM_START:
                state, reports = report_start(state, event, now)
                outputs.extend(reports)
            if event.verdict is messages.Verdict.REJECTED:
                state = count_rejection(state, f"sensor:{event.source}", event.reason or "rejected")
                # a delayed decision is on an earlier sample
                is_rejected |= (event.source, event.seq) == (sample.header.source, sample.header.seq)
    if decisions and state.settings.publish_decisions:
        outputs.append(messages.PublishDecisions(now.utime, tuple(decisions)))
    if localizer is before:
        return state, tuple(outputs)
    utime = localizer.utime
    has_estimate = utime > 0
    history = state.history
    if has_estimate and not history.is_too_soon(utime):
        history = history.append(localizer.defer_estimate(utime))
    model, base_frame, _, _, rolling, invalid, joints, dynamics = state.view
    if invalid and has_estimate and not is_rejected and utime <= now.utime + LATEST_US:
        # the estimate is of the host's new time of day
        invalid = messages.VALID
    view = new_tuple(PlatformView, (model, base_frame, localizer, history, rolling, invalid, joints, dynamics))
    state = new_tuple(CoreState, (view, *state[1:]))
    if has_estimate:
        # a sample that is rejected in part may still advance the time
        if state.settings.publish == "event" and (not is_rejected or utime != before.utime):
            state, pose = publish_pose(state, utime)
            outputs.append(pose)
        if state.waiting:
            state, replies = answer_waiting(state, now)
            outputs.extend(replies)
    return state, tuple(outputs)


def report_start(state: CoreState, decision: messages.Decision, now: Instant) -> StepResult:
    if now.monotonic_ns - state.started_ns <= START_REPORT_NS:
        state, _ = handle_warning(state, messages.HealthWarning(START, decision.reason), now)
    return state, (messages.ReportStart(decision.reason),)


def publish_pose(state: CoreState, utime: int) -> tuple[CoreState, messages.PublishPose]:
    """Make the poses to publish for an instant."""
    assert state.localizer is not None
    estimate = state.localizer.estimate(utime)
    view = state.view
    world = view.get_published_pose(estimate, names.WORLD_UTM)
    run_state = RUNNING if world.transformation.is_valid else DEGRADED
    if run_state == DEGRADED and state.run_state == STARTING:
        run_state = STARTING
    state = state._replace(
        poses_published=state.poses_published + 1,
        run_state=run_state,
        pose_invalid=world.transformation.invalid_reasons,
    )
    return state, messages.PublishPose(world, view.get_published_pose(estimate, names.ODOM))


# --- ticks ------------------------------------------------------------------------------------------------------------

MAX_TICK_LATENCIES: Final = 512
"""Tick latencies that are retained for the percentiles of a health report."""


def handle_tick(state: CoreState, tick: messages.Tick, now: Instant) -> StepResult:
    outputs: list[messages.Output] = []
    settings, before = state.settings, state.ticks
    state = check_host_clock(state, now, state.traffic)
    state = state._replace(
        tick_latencies=(*state.tick_latencies[-MAX_TICK_LATENCIES + 1 :], tick.latency),
        ticks=state.ticks + 1 + tick.missed,
        ticks_missed=state.ticks_missed + tick.missed,
        requests_answered=state.requests_answered + tick.answered,
    )
    localizer = state.localizer
    if localizer is not None:
        if settings.publish == "timer" and _is_due(settings.ticks_per_pose, before, state.ticks):
            state, pose = publish_pose(state, now.utime)
            outputs.append(pose)
        if settings.ticks_per_state and _is_due(settings.ticks_per_state, before, state.ticks):
            navigation = localizer.navigation(now.utime)
            if navigation is not None:
                outputs.append(messages.PublishNavigation(navigation))
    if state.waiting:
        state, replies = answer_waiting(state, now)
        outputs.extend(replies)
    state, reports = report_if_due(state, tick.gauges, now)
    outputs.extend(reports)
    if now.monotonic_ns >= state.snapshot_due_ns:
        state = state._replace(snapshot_due_ns=now.monotonic_ns + settings.snapshot_period_ns)
        outputs.append(messages.PublishSnapshot(now.utime))
    if settings.persist_period_ns:
        if START in state.warnings and now.monotonic_ns - state.started_ns > START_REPORT_NS:
            state, _ = handle_warning(state, messages.HealthWarning(START), now)
        if now.monotonic_ns >= state.persist_due_ns:
            state = state._replace(persist_due_ns=now.monotonic_ns + settings.persist_period_ns)
            to_persist = get_state_to_persist(state, now)
            if to_persist is not None:
                outputs.append(messages.PersistState(to_persist))
    return state, tuple(outputs)


def _is_due(every: int, before: int, after: int) -> bool:
    """Return whether ticks `before` to `after` (counted from 0, without the last) hold a multiple of `every`."""
    return (after - 1) // every > (before - 1) // every


def get_state_to_persist(state: CoreState, now: Instant) -> messages.PersistedState | None:
    """Return the state for the next run; None if it is no better than what was persisted before."""
    localizer: object = state.localizer
    found = localizer.get_state_to_persist() if isinstance(localizer, PersistentLocalizer) else None
    if found is None:
        return None
    return found._replace(vehicle=state.settings.vehicle, utime=now.utime, monotonic_ns=now.monotonic_ns)


# --- the health report -----------------------------------------------------------------------------------------------

MIN_MESSAGES = 3
"""Messages of a source before it can count as silent: its usual interval is not known earlier."""

MIN_DROPPED = 20
"""Measurements of a source that are dropped in a row before a warning: 8 s of wheels, 2 s of a GPS receiver."""


STABILITY = "stability"
"""Subject of the warning about the tip-over margin."""


def report_if_due(state: CoreState, gauges: messages.Gauges | None, now: Instant) -> tuple[CoreState, Outputs]:
    """Return the state after a tick, and the report that is due, if any."""
    is_full = now.monotonic_ns >= state.health_due_ns
    inputs = state.health_inputs
    if not is_full and now.monotonic_ns < inputs.due_ns:
        return state, ()
    stability, warning = find_stability(state.view, now.utime)
    conditions = evaluate_conditions(state, now, is_unstable=bool(warning))
    if gauges is not None:
        cpu_share = messages.NAN
        if inputs.gauges_ns and now.monotonic_ns > inputs.gauges_ns:
            cpu_share = (gauges.cpu_s - inputs.gauges.cpu_s) / ((now.monotonic_ns - inputs.gauges_ns) * 1e-9)
        inputs = inputs._replace(gauges=gauges, gauges_ns=now.monotonic_ns, cpu_share=cpu_share)
    has_changed = conditions != inputs.reported
    inputs = inputs._replace(due_ns=now.monotonic_ns + CHANGE_PERIOD_NS, reported=conditions)
    state = state._replace(health_inputs=inputs)
    if not (is_full or has_changed):
        return state, ()
    if is_full:
        state = _update_rates(state, now)
    report = messages.PublishHealth(_make_report(state, now, stability, warning))
    if is_full:
        # from now, not from the due time: after a pause one report is enough
        due = now.monotonic_ns + state.settings.health_period_ns
        state = state._replace(tick_latencies=(), health_sent_ns=now.monotonic_ns, health_due_ns=due)
    return state, (report,)


def evaluate_conditions(state: CoreState, now: Instant, is_unstable: bool = False) -> HealthConditions:
    """Return the conditions whose change is reported at once."""
    silent = tuple([name for name, traffic in state.traffic.items() if _is_silent(name, traffic, now)])
    return HealthConditions(
        state.run_state,
        state.pose_invalid,
        state.model.revision,
        silent,
        tuple(_list_missing(state)),
        state.warnings,
        tuple([(name, reason) for name, reason, _ in _find_unusable(state, now)]),
        is_unstable,
    )


def _list_missing(state: CoreState) -> list[str]:
    """Return the channels of the configured sensors without any message; joints count only if the geometry has some."""
    return [
        each.channel for each in state.missing_sensors if each.kind is not messages.JointsSample or state.model.joints
    ]


def _find_unusable(state: CoreState, now: Instant) -> Iterator[tuple[str, str, str]]:
    """Yield subject, reason and text of a warning for each sensor that localization cannot use."""
    if state.localizer is not None:
        for finding in state.localizer.summary(now.utime).findings:
            if not finding.is_choice:
                fix = f"; {finding.fix}" if finding.fix else ""
                yield f"sensors.{finding.sensor} ({finding.reason})", finding.reason, f"{finding.text}{fix}"
    for name, traffic in state.traffic.items():
        if traffic.num_off and is_clock_off(state.traffic, name, now) and not _is_silent(name, traffic, now):
            offset = format_offset(traffic.offset, now.utime * 1e-6)
            yield name, "clock", f"its clock is off: its stamps are {offset} their receipt; its samples are not used"
        elif traffic.dropped >= MIN_DROPPED and not _is_silent(name, traffic, now):
            counts = f"{traffic.count} received, {traffic.used} of {traffic.measured} measurements used"
            yield name, traffic.reason, f"{counts}; the last {traffic.dropped} were dropped: {traffic.reason}"


def _is_silent(name: str, traffic: SourceTraffic, now: Instant) -> bool:
    return (
        traffic.count >= MIN_MESSAGES
        and (now.monotonic_ns - traffic.last_received_ns) * 1e-9 > get_silence_limit(traffic.interval)
        # commands have no rate
        and name.startswith("sensor:")
    )


def _update_rates(state: CoreState, now: Instant) -> CoreState:
    elapsed = (now.monotonic_ns - state.health_sent_ns) * 1e-9 if state.health_sent_ns else 0.0

    def start_period(each: SourceTraffic) -> SourceTraffic:
        rate = (each.count - each.reported) / elapsed if elapsed > 0 else 0.0
        return each._replace(reported=each.count, rate=rate, delay=messages.NAN, reported_delay=each.delay)

    return state._replace(traffic={name: start_period(traffic) for name, traffic in state.traffic.items()})


def _make_report(state: CoreState, now: Instant, stability: messages.StabilityHealth, warning: str) -> messages.Health:
    latencies = sorted(state.tick_latencies)
    estimate = None if state.localizer is None else state.localizer.estimate(now.utime)
    gauges = state.health_inputs.gauges
    channels = [_make_channel_health(name, traffic, now) for name, traffic in state.traffic.items()]
    channels += [
        messages.ChannelHealth(channel, 0, 0.0, messages.NAN, messages.NAN, True) for channel in _list_missing(state)
    ]
    invalid = state.view.invalid | (messages.VALID if estimate is None else estimate.invalid)
    warnings = {**state.warnings, **{name: text for name, _, text in _find_unusable(state, now)}}
    if warning:
        warnings[STABILITY] = warning
    return messages.Health(
        utime=now.utime,
        uptime=(now.monotonic_ns - state.started_ns) * 1e-9,
        version=__version__,
        vehicle=state.settings.vehicle,
        model_revision=state.model.revision,
        state=state.run_state,
        invalid_reasons=invalid,
        invalid_text=_explain(state, invalid, now),
        pose_epoch=0 if estimate is None else estimate.pose_epoch,
        origin_id=0 if estimate is None or estimate.origin is None else estimate.origin.origin_id,
        poses_published=state.poses_published,
        requests_answered=state.requests_answered,
        requests_waiting=len(state.waiting),
        ticks_missed=state.ticks_missed,
        handler_errors=state.handler_errors,
        tick_latency_p50=percentile(latencies, 0.5),
        tick_latency_p90=percentile(latencies, 0.9),
        tick_latency_p99=percentile(latencies, 0.99),
        tick_latency_max=percentile(latencies, 1.0),
        channels=tuple(sorted(channels, key=lambda each: each.channel)),
        rejected=tuple(messages.RejectedCount(*key, count) for key, count in sorted(state.rejected.items())),
        warnings=tuple(sorted(warnings.items())),
        host=gauges.host,
        pid=gauges.pid,
        requests_queued=gauges.queued,
        memory=gauges.memory,
        cpu_share=state.health_inputs.cpu_share,
        localization=_make_localization_health(state, estimate, now),
        stability=stability,
    )


def _explain(state: CoreState, invalid: messages.Invalid, now: Instant) -> str:
    """Return why the pose is invalid, in words: with the distance that is left where the vehicle must drive."""
    text = invalid.explain()
    if messages.Invalid.NOT_MOVED_YET not in invalid or state.localizer is None:
        return text
    distance = state.localizer.summary(now.utime).distance_to_heading
    if math.isnan(distance):
        return text
    if distance < 1.0:
        return f"{text}; the vehicle has moved, but its fixes do not show the heading yet"
    return f"{text}; drive about {distance:.0f} m more"


def percentile(ordered: Sequence[float], share: float) -> float:
    """Return the percentile `share` (0 to 1) of values in rising order, one of the values; 0 without any."""
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else 0.0


def _make_localization_health(
    state: CoreState, estimate: messages.Estimate | None, now: Instant
) -> messages.LocalizationHealth:
    if state.localizer is None or estimate is None:
        return messages.LocalizationHealth()
    summary = state.localizer.summary(now.utime)
    geodetic = None
    if estimate.utm is not None and estimate.origin is not None:
        geodetic = compute_geodetic(estimate.utm, names.WORLD_UTM, estimate.origin)
    P = estimate.covariance
    return messages.LocalizationHealth(
        summary.mode,
        summary.phase,
        summary.stationary,
        estimate.horizontal_protection_level,
        estimate.heading_protection_level,
        estimate.seconds_to_limit,
        (now.utime - summary.fix_utime) * 1e-6 if summary.fix_utime else messages.NAN,
        *((messages.NAN,) * 4 if geodetic is None else geodetic),
        messages.NAN if P is None else math.sqrt(compute_longest_axis(P[0], P[7], P[1])),
        messages.NAN if P is None else math.sqrt(P[14]),
        estimate.horizontal_level,
        estimate.heading_level,
        estimate.limit_risk,
        summary.horizontal_limit,
        summary.heading_limit,
    )


def _make_channel_health(name: str, traffic: SourceTraffic, now: Instant) -> messages.ChannelHealth:
    age = (now.monotonic_ns - traffic.last_received_ns) * 1e-9
    return messages.ChannelHealth(
        name,
        traffic.count,
        traffic.rate,
        age,
        traffic.reported_delay,
        _is_silent(name, traffic, now),
        traffic.measured,
        traffic.used,
    )


# --- commands ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ModelLoaded:
    """Event: a geometry is there. It has a model, the localizer for it and its changes, or the reason `why` not.

    `request` is the client's request, None for a reload by signal.
    """

    request: messages.ReloadModel | messages.SetFrame | None
    model: Model | None = None
    localizer: Localizer | None = None
    why: str = ""
    changes: tuple[str, ...] = ()

    @property
    def is_dry_run(self) -> bool:
        """Whether the client only asked what would change."""
        return isinstance(self.request, messages.ReloadModel) and self.request.dry_run


Command: TypeAlias = messages.ReloadModel | messages.SetFrame | messages.SetStateVector | messages.SetHTransform
COMMANDS: Final = get_args(Command)
"""Requests that must be signed."""

SET_COVARIANCE: Final = tuple(np.diag([1.0] * 3 + [math.radians(5.0) ** 2] * 3).ravel().tolist())
"""Default covariance of a pose that is set: 1 m and 5 degrees."""

OPERATOR: Final = "operator"
"""Source of the sample that a set pose becomes."""

UNSIGNED_MESSAGE: Final = (
    "the command is not signed; sign it with the vehicle's key (Platform(key_file=...), --key FILE or "
    "$MODELSERVER_KEY_FILE; docs/wire.md for other languages)"
)


def deny_unsigned(state: CoreState, command: Command, now: Instant) -> StepResult:
    """Deny a command without signature."""
    forbidden = _forbid(state, command, now)
    if forbidden is not None:
        return forbidden
    state = count_rejection(state, messages.CHANNEL_OF[type(command)], "unsigned")
    return state, reply_error(state, type(command), command.header, Status.FORBIDDEN, UNSIGNED_MESSAGE, now)


def execute_command(state: CoreState, signed: messages.SignedCommand, now: Instant) -> StepResult:
    """Execute a command whose signature is verified, where the vehicle file permits it."""
    command = signed.command
    if isinstance(command, messages.SwitchMode):
        return switch_mode(state, command, now)
    forbidden = _forbid(state, command, now)
    if forbidden is not None:
        return forbidden
    return (
        (state, (messages.LoadModel(command),))
        if isinstance(command, messages.ReloadModel | messages.SetFrame)
        else _set_pose(state, command, now)
    )


def _forbid(state: CoreState, command: Command, now: Instant) -> StepResult | None:
    """Reject a command whose reply channel, or which itself, is not permitted; None if it is."""
    channel, settings = messages.CHANNEL_OF[type(command)], state.settings
    if not is_answerable(command.header, settings.reply_prefix):
        return count_rejection(state, channel, "reply_channel"), ()
    name, is_permitted = "set_pose", settings.may_set_pose
    if isinstance(command, messages.ReloadModel):
        name, is_permitted = "reload", settings.may_reload
    elif isinstance(command, messages.SetFrame):
        name, is_permitted = "frames", settings.may_set_frames
    if is_permitted:
        return None
    state = count_rejection(state, channel, "forbidden")
    why = (
        f"the vehicle file does not permit it; write commands: {{{name}: true}} and beside it a key_file, whose key "
        "clients sign with"
    )
    return state, reply_error(state, type(command), command.header, Status.FORBIDDEN, why, now)


def apply_model(state: CoreState, loaded: ModelLoaded, now: Instant) -> StepResult:
    """Replace the geometry as a whole, or keep the old one if the new one could not be loaded."""
    request, model = loaded.request, loaded.model
    kind = messages.ReloadModel if request is None else type(request)
    if model is None:
        state = count_rejection(state, messages.CHANNEL_OF[kind], "rejected")
        if request is None:
            return state, ()
        return state, reply_error(state, kind, request.header, Status.REJECTED, loaded.why, now)
    outputs: list[messages.Output] = []
    if not loaded.is_dry_run:
        view = state.view._replace(model=model, localizer=loaded.localizer, joints=state.view.joints.for_model(model))
        due = now.monotonic_ns + state.settings.snapshot_period_ns
        state = state._replace(view=view, snapshot_due_ns=due)
        outputs.append(messages.PublishSnapshot(now.utime))
    if request is not None:
        state = state._replace(requests_answered=state.requests_answered + 1)
        header = messages.ReplyHeader(request.header.request_id, now.utime, model_revision=state.model.revision)
        outputs.append(
            messages.SendReply(
                request.header.reply_channel, messages.ReloadReply(header, model.revision, loaded.changes)
            )
        )
    return state, tuple(outputs)


def _set_pose(state: CoreState, request: messages.SetStateVector | messages.SetHTransform, now: Instant) -> StepResult:
    given, view = request.pose.transformation, state.view
    ends = names.complete(given.frame_of_interest), names.complete(given.frame_of_reference)
    state = state._replace(requests_answered=state.requests_answered + 1)
    origin = None if view.localizer is None else view.localizer.estimate(now.utime).origin
    why = ""
    if view.localizer is None:
        why = "no localization sensor is configured (section 'sensors' of the vehicle file)"
    elif ends != (view.base_frame, names.WORLD_UTM):
        why = (
            f"the pose is of {given.frame_of_interest} in {given.frame_of_reference}; expected the pose of "
            f"{view.base_frame} in {names.WORLD_UTM}"
        )
    elif origin is None:
        why = "the origin is not known yet; configure one in the vehicle file, or wait for GPS fixes"
    elif given.covariance is not None and (problem := find_covariance_problem(given.covariance)):
        why = f"invalid covariance: {problem}"
    elif _has_other_origin(request.pose, origin):
        why = "the pose has another origin than the server; ask for the vehicle's pose to get that origin"
    elif given.utime > now.utime + COMMAND_FUTURE_LIMIT_S * 1e6:
        ahead = (given.utime - now.utime) * 1e-6
        why = f"the pose is stamped {ahead:.3f} s ahead of the server's clock; stamp it with 0 for now"
    if why or view.localizer is None:
        return state, reply_error(state, type(request), request.header, Status.REJECTED, why, now)
    covariance = SET_COVARIANCE if given.covariance is None else tuple(given.covariance.ravel().tolist())
    sample = messages.AbsolutePoseSample(
        messages.SensorHeader(given.utime or now.utime, OPERATOR, state.requests_answered),
        *ends,
        given.pose.xyz,
        given.pose.wxyz,
        covariance,
    )
    # the localizer is pure, so it may process the sample twice: the counts do not identify the rejected sample
    localizer, events = view.localizer.process(sample)
    reasons = [reason for event in events if (reason := _get_rejection_reason(event, sample))]
    state, outputs = update_localizer(state, view.localizer, sample, now)
    header = messages.ReplyHeader(request.header.request_id, now.utime, model_revision=state.model.revision)
    if reasons:
        text = f"localization rejected the pose: {', '.join(reasons)}"
        if not _STAMP_REASONS.isdisjoint(reasons):
            text += "; its time is older than what can still be fused, stamp it with 0 for now"
        header = header._replace(status=Status.REJECTED, message=text)
    elif localizer is view.localizer:
        text = "the active mode fuses no external poses (raw mode uses GPS and IMU only)"
        header = header._replace(status=Status.REJECTED, message=text)
    return state, (*outputs, messages.SendReply(request.header.reply_channel, messages.Acknowledgement(header)))


_STAMP_REASONS: Final = frozenset({"too_old", "out_of_sequence", "duplicate"})


def _get_rejection_reason(event: LocalizerEvent, sample: messages.AbsolutePoseSample) -> str:
    """Return why a sample was rejected, else an empty text; a decision may also be on an earlier sample."""
    if isinstance(event, messages.Rejected):
        return event.reason
    if isinstance(event, messages.Decision) and event.verdict is messages.Verdict.REJECTED:
        is_own = (event.source, event.seq) == (sample.header.source, sample.header.seq)
        return (event.reason or "rejected") if is_own else ""
    return ""


def _has_other_origin(pose: messages.PoseAnswer, origin: messages.Origin) -> bool:
    """Return whether a pose names another origin; without a name it means the server's."""
    named = pose.transformation.origin_id
    return (pose.origin is not None and pose.origin != origin) or (named != 0 and named != origin.origin_id)


# --- the dispatch ----------------------------------------------------------------------------------------------------

_HANDLERS: Final[Mapping[type, Callable[[CoreState, Any, Instant], tuple[CoreState, AllOutputs]]]] = {
    **dict.fromkeys(get_args(messages.Sample), process_sample),
    **dict.fromkeys(get_args(messages.Request), handle_request),
    **dict.fromkeys(COMMANDS, deny_unsigned),
    messages.SignedCommand: execute_command,
    messages.SwitchMode: switch_mode,
    ModelLoaded: apply_model,
    messages.Tick: handle_tick,
    messages.Rejected: handle_rejected,
    messages.HealthWarning: handle_warning,
    messages.Denied: handle_denied,
}

__all__ = [
    "COMMANDS",
    "DEGRADED",
    "RUNNING",
    "STARTING",
    "AllOutputs",
    "CoreSettings",
    "CoreState",
    "ExpectedSensor",
    "Instant",
    "ModelLoaded",
    "get_state_to_persist",
    "is_answerable",
    "reply_error",
    "reply_internal_error",
    "reply_overloaded",
    "start",
    "step",
]

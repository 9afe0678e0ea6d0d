"""Sensor samples: update the joints and the localizer, publish poses and decisions. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Final

from modelserver import messages
from modelserver.core.host_clock import Instant
from modelserver.core.requests import answer_waiting
from modelserver.core.source_clocks import LATE_LIMIT_S, SAMPLE_FUTURE_LIMIT_S, is_clock_off, note_offset
from modelserver.core.state import (
    DEGRADED,
    RUNNING,
    START,
    START_REPORT_NS,
    STARTING,
    CoreState,
    SourceTraffic,
    StepResult,
    count_decision,
    count_message,
    count_rejection,
    handle_warning,
    mark_received,
)
from modelserver.estimation.history import Localizer
from modelserver.geometry import names
from modelserver.named_tuples import new_tuple
from modelserver.query.view import PlatformView

COMMAND_FUTURE_LIMIT_S: Final = 1.0
"""A command stamped this far ahead of the host's clock is rejected: one of the two clocks is wrong."""

EARLIEST_US, LATEST_US = -round(LATE_LIMIT_S * 1e6), round(SAMPLE_FUTURE_LIMIT_S * 1e6)
"""Bounds of a stamp less its receipt, microseconds."""

WARM_START: Final = "warm_start"
"""Kind of the decisions on the persisted state of an earlier run."""


def process_sample(state: CoreState, sample: messages.Sample, now: Instant) -> StepResult:
    """Process a sample of a sensor."""
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
    """Process positions of joints."""
    joints, rejected = state.view.joints.update(sample, now.utime)
    for reason, count in Counter(rejected).items():
        state = count_rejection(state, f"sensor:{sample.header.source}", reason, count)
    if joints is state.view.joints:
        return state, ()
    state = state._replace(view=state.view._replace(joints=joints))
    if not state.waiting:
        return state, ()
    state, replies = answer_waiting(state, now)
    return state, tuple(replies)


def switch_mode(state: CoreState, command: messages.SwitchMode, now: Instant) -> StepResult:
    """Switch the localization mode."""
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
    """Report what became of the persisted state of an earlier run."""
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

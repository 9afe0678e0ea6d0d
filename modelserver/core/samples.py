"""What follows from what sensors say: for the joints, for localization, and for what is broadcast."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Final

from modelserver.core.host_clock import Instant
from modelserver.core.keeping import KEPT, start_told
from modelserver.core.requests import answer_parked
from modelserver.core.state import DEGRADED, RUNNING, STARTING, CoreState, Step, counted, decided, heard, traffic_noted
from modelserver.geometry import names
from modelserver.localization.interface import Localizer
from modelserver.messages import (
    VALID,
    Decision,
    Invalid,
    JointsSample,
    OriginLatched,
    Output,
    PublishDecisions,
    PublishPose,
    Rejected,
    Sample,
    SwitchMode,
    Verdict,
)
from modelserver.platform import PlatformView

FUTURE_LIMIT_S: Final = 1.0
"""A wish stamped this far ahead of the host's clock is refused: one of the two clocks is wrong."""

AHEAD_LIMIT_S: Final = 0.25
"""The same for a sample, which nobody can have taken before it is: clocks that are kept together differ by less, and a
fix that is taken for one of a quarter of a second later is off by what the vehicle drives in that."""


def sample_taken(state: CoreState, sample: Sample, now: Instant) -> Step:
    """Take a sensor's sample."""
    source = f"sensor:{sample.header.source}"
    state = traffic_noted(state, source, sample.header.host_utime, now)
    if state.unheard:
        state = heard(state, sample)
    state = check_host_clock(state, now)
    if sample.header.utime > now.utime + AHEAD_LIMIT_S * 1e6:
        # it speaks for its own source alone: anyone can stamp as it likes
        return counted(state, source, "future"), ()
    if isinstance(sample, JointsSample):
        return joints_told(state, sample, now)
    if state.localizer is None:
        return state, ()
    return localized(state, state.localizer, sample, now)


def check_host_clock(state: CoreState, now: Instant) -> CoreState:
    """Return the state after a look at the host's clocks.

    Where the time of day was set back, the pose that is held is of another time than what is asked for now: it is
    invalid until localization has used a sample of the new time.
    """
    set_back = state.host_clock.is_set_back(now)
    state = state._replace(host_clock=state.host_clock.next(now, set_back))
    if set_back and state.localizer is not None:
        state = state._replace(view=replace(state.view, doubt=Invalid.CLOCK_STEPPED))
    return state


def joints_told(state: CoreState, sample: JointsSample, now: Instant) -> Step:
    """Return what follows from positions of joints."""
    joints, refused = state.view.joints.taken(sample, now.utime)
    for why, count in Counter(refused).items():
        state = counted(state, f"sensor:{sample.header.source}", why, count)
    if joints is state.view.joints:
        return state, ()
    state = state._replace(view=replace(state.view, joints=joints))
    if not state.parked:
        return state, ()
    state, replies = answer_parked(state, now)
    return state, tuple(replies)


def mode_wished(state: CoreState, wish: SwitchMode, now: Instant) -> Step:
    """Take a wish for other sources."""
    source = f"command:{wish.header.source}"
    state = traffic_noted(state, source, wish.header.host_utime, now)
    if wish.header.utime > now.utime + FUTURE_LIMIT_S * 1e6:
        # unlike a sensor's this says nothing of the host's clock: it may be the operator's that is wrong
        return counted(state, source, "future"), ()
    if state.localizer is None:
        return state, ()
    return localized(state, state.localizer, wish, now)


def localized(state: CoreState, before: Localizer, sample: Sample | SwitchMode, now: Instant) -> Step:
    """Return what follows from a sample, or from a wish, for the localization."""
    localizer, notes = before.take(sample)
    outputs: list[Output] = []
    decisions: list[Decision] = []
    refused = False
    for note in notes:
        if isinstance(note, Rejected):
            state = counted(state, note.channel, note.reason)
            refused = True
        elif isinstance(note, OriginLatched):
            outputs.append(note)
        else:
            decisions.append(note)
            state = decided(state, note)
            if note.kind == KEPT:
                state, said = start_told(state, note, now)
                outputs.extend(said)
            if note.verdict is Verdict.REJECTED:
                state = counted(state, f"sensor:{note.source}", note.reason or "rejected")
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
    if known and not history.holds_enough(utime):
        history = history.extended(localizer.deferred(utime))
    view = state.view
    doubt = view.doubt
    if doubt and known and not refused and utime <= now.utime + AHEAD_LIMIT_S * 1e6:
        # what is held is of the time that the host has now
        doubt = VALID
    view = PlatformView(view.model, view.base_frame, localizer, history, view.rolling_frame, doubt, view.joints)
    state = state._replace(view=view)
    if known:
        # a part may be refused of a sample that moves time on all the same
        if state.settings.publish == "event" and (not refused or utime != before.utime):
            state, pose = published(state, utime)
            outputs.append(pose)
        if state.parked:
            state, replies = answer_parked(state, now)
            outputs.extend(replies)
    return state, tuple(outputs)


def published(state: CoreState, utime: int) -> tuple[CoreState, PublishPose]:
    """Return the poses to broadcast for an instant."""
    assert state.localizer is not None
    estimate = state.localizer.estimate(utime)
    view = state.view
    world = view.broadcast(estimate, names.WORLD_UTM)
    run_state = RUNNING if world.transformation.valid else DEGRADED
    if run_state == DEGRADED and state.run_state == STARTING:
        run_state = STARTING
    state = state._replace(
        poses_published=state.poses_published + 1,
        run_state=run_state,
        pose_invalid=world.transformation.invalid_reasons,
    )
    return state, PublishPose(world, view.broadcast(estimate, names.ODOM))

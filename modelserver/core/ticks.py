"""What is due by the clock: poses, the filter's state, health, the snapshot, and those who have waited long enough."""

from __future__ import annotations

from typing import Final

from modelserver.core import health
from modelserver.core.host_clock import Instant
from modelserver.core.keeping import keep_if_due
from modelserver.core.requests import answer_parked
from modelserver.core.samples import check_host_clock, published
from modelserver.core.state import CoreState, Step
from modelserver.messages import Output, PublishNavigation, PublishSnapshot, Tick

LATENESS_KEPT: Final = 512


def ticked(state: CoreState, tick: Tick, now: Instant) -> Step:
    """Do what is due by the clock."""
    outputs: list[Output] = []
    settings, before = state.settings, state.ticks
    state = check_host_clock(state, now)
    state = state._replace(
        lateness=(*state.lateness[-LATENESS_KEPT + 1 :], tick.late),
        ticks=state.ticks + 1 + tick.missed,
        ticks_missed=state.ticks_missed + tick.missed,
        requests_answered=state.requests_answered + tick.answered,
    )
    localizer = state.localizer
    if localizer is not None:
        if settings.publish == "timer" and _is_due(settings.ticks_per_pose, before, state.ticks):
            state, pose = published(state, now.utime)
            outputs.append(pose)
        if settings.ticks_per_state and _is_due(settings.ticks_per_state, before, state.ticks):
            navigation = localizer.navigation(now.utime)
            if navigation is not None:
                outputs.append(PublishNavigation(navigation))
    if state.parked:
        state, replies = answer_parked(state, now)
        outputs.extend(replies)
    state, reports = health.told(state, tick.gauges, now)
    outputs.extend(reports)
    if now.monotonic_ns >= state.snapshot_due_ns:
        state = state._replace(snapshot_due_ns=now.monotonic_ns + settings.snapshot_period_ns)
        outputs.append(PublishSnapshot(now.utime))
    if settings.keep_period_ns:
        state, keeping = keep_if_due(state, now)
        outputs.extend(keeping)
    return state, tuple(outputs)


def _is_due(every: int, before: int, after: int) -> bool:
    """Return whether, of ticks counted from 0, the next after `before` of them up to `after` hold one in `every`."""
    # the first tick is one at which all is due
    return (after - 1) // every > (before - 1) // every

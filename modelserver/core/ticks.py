"""What is due by the clock: poses, the filter's state, health, the snapshot, and those who have waited long enough."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from modelserver.core.requests import answer_parked
from modelserver.core.samples import published
from modelserver.core.state import CoreState, Instant, Step, Traffic
from modelserver.messages import (
    VALID,
    ChannelHealth,
    Health,
    Output,
    PublishHealth,
    PublishNavigation,
    PublishSnapshot,
    Tick,
)
from modelserver.version import __version__

LATENESS_KEPT: Final = 512


def ticked(state: CoreState, tick: Tick, now: Instant) -> Step:
    """Do what is due by the clock."""
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
            state, pose = published(state, now.utime)
            outputs.append(pose)
        if settings.ticks_per_state and _is_due(settings.ticks_per_state, before, state.ticks):
            navigation = localizer.navigation(now.utime)
            if navigation is not None:
                outputs.append(PublishNavigation(navigation))
    if state.parked:
        state, replies = answer_parked(state, now)
        outputs.extend(replies)
    if now.monotonic_ns >= state.health_due_ns:
        state, health = _report(state, now)
        outputs.append(health)
    if now.monotonic_ns >= state.snapshot_due_ns:
        state = state._replace(snapshot_due_ns=now.monotonic_ns + settings.snapshot_period_ns)
        outputs.append(PublishSnapshot(now.utime))
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
        notices=tuple(sorted(state.notices.items())),
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

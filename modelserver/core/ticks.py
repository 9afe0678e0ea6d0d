"""Ticks: what is due by the clock: pose, filter state, waiting requests, health, snapshot, state to persist. Pure."""

from __future__ import annotations

from typing import Final

from modelserver import messages
from modelserver.core import health
from modelserver.core.host_clock import Instant
from modelserver.core.requests import answer_waiting
from modelserver.core.samples import check_host_clock, publish_pose
from modelserver.core.state import START, START_REPORT_NS, CoreState, StepResult, handle_warning
from modelserver.estimation.history import PersistentLocalizer

MAX_TICK_LATENCIES: Final = 512
"""Tick latencies that are retained for the percentiles of a health report."""


def handle_tick(state: CoreState, tick: messages.Tick, now: Instant) -> StepResult:
    """Do what is due by the clock."""
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
    state, reports = health.report_if_due(state, tick.gauges, now)
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

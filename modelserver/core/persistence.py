"""State that is persisted for a warm start of the next run, and the report on how this run started. Pure."""

from __future__ import annotations

from typing import Final

from modelserver.core.host_clock import Instant
from modelserver.core.state import CoreState, Outputs, StepResult, handle_warning
from modelserver.estimation.interface import PersistentLocalizer
from modelserver.messages import Decision, HealthWarning, PersistedState, PersistState, ReportStart

WARM_START: Final = "warm_start"
"""Kind of the decisions on the persisted state of an earlier run."""

START: Final = "start"
"""Subject of the warning on how the server started."""

START_REPORT_NS: Final = 600_000_000_000
"""How long the health report shows how the server started: ten minutes."""


def get_state_to_persist(state: CoreState, now: Instant) -> PersistedState | None:
    """Return the state for the next run; None if it is no better than what was persisted before."""
    localizer: object = state.localizer
    found = localizer.get_state_to_persist() if isinstance(localizer, PersistentLocalizer) else None
    if found is None:
        return None
    return found._replace(vehicle=state.settings.vehicle, utime=now.utime, monotonic_ns=now.monotonic_ns)


def persist_if_due(state: CoreState, now: Instant) -> StepResult:
    """Output the state to persist if it is due, and clear the warning on the start once it is old."""
    if START in state.warnings and now.monotonic_ns - state.started_ns > START_REPORT_NS:
        state, _ = handle_warning(state, HealthWarning(START), now)
    settings = state.settings
    if not settings.persist_period_ns or now.monotonic_ns < state.persist_due_ns:
        return state, ()
    state = state._replace(persist_due_ns=now.monotonic_ns + settings.persist_period_ns)
    found = get_state_to_persist(state, now)
    return state, (() if found is None else (PersistState(found),))


def report_start(state: CoreState, decision: Decision, now: Instant) -> tuple[CoreState, Outputs]:
    """Report what became of the persisted state of an earlier run."""
    if now.monotonic_ns - state.started_ns <= START_REPORT_NS:
        state, _ = handle_warning(state, HealthWarning(START, decision.reason), now)
    return state, (ReportStart(decision.reason),)

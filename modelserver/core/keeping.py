"""What is kept for the next run of the service, and what is said of how this one started."""

from __future__ import annotations

from typing import Final

from modelserver.core.host_clock import Instant
from modelserver.core.state import CoreState, Outputs, Step, noticed
from modelserver.localization.interface import Keeps
from modelserver.messages import Decision, KeepState, Kept, Noticed, StartTold

KEPT: Final = "kept"
"""The kind of the ledger's words on what an earlier run kept."""

START: Final = "start"
"""The subject of the notice on how the service started."""

START_TOLD_NS: Final = 600_000_000_000
"""For how long after the start people who watch are told how it went: ten minutes."""


def kept(state: CoreState, now: Instant) -> Kept | None:
    """Return what the next run should know; None where it is no better than what was kept before."""
    localizer: object = state.localizer
    found = localizer.kept() if isinstance(localizer, Keeps) else None
    if found is None:
        return None
    return found._replace(vehicle=state.settings.vehicle, utime=now.utime, monotonic_ns=now.monotonic_ns)


def keep_if_due(state: CoreState, now: Instant) -> Step:
    """Say what is to be kept where that is due, and take the word on the start back once it is old."""
    if START in state.notices and now.monotonic_ns - state.started_ns > START_TOLD_NS:
        state, _ = noticed(state, Noticed(START), now)
    settings = state.settings
    if not settings.keep_period_ns or now.monotonic_ns < state.keep_due_ns:
        return state, ()
    state = state._replace(keep_due_ns=now.monotonic_ns + settings.keep_period_ns)
    found = kept(state, now)
    return state, (() if found is None else (KeepState(found),))


def start_told(state: CoreState, word: Decision, now: Instant) -> tuple[CoreState, Outputs]:
    """Tell people who watch what became of what an earlier run kept."""
    if now.monotonic_ns - state.started_ns <= START_TOLD_NS:
        state, _ = noticed(state, Noticed(START, word.reason), now)
    return state, (StartTold(word.reason),)

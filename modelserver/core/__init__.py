"""The core of the server: a deterministic state machine, `step(state, event, now) -> (state, outputs)`. Pure.

Live operation and replay run this function: the same events at the same instants give the same outputs, bit for bit.
Time enters only with an event, as an `Instant` of both host clocks. `_HANDLERS` dispatches by event type:

- samples (`samples`) update the localizer and the joints, and may publish a pose;
- ticks (`ticks`) do what is due by the clock: poses, health report, snapshot, state to persist, waiting requests;
- requests (`requests`, `answers`) are answered at once, in steps by the server loop, or wait until their data arrive;
- signed commands (`commands`) change the geometry, the pose or the mode.

A message from the bus never raises out of `step`. What cannot be used is counted by channel and reason, and the health
report publishes the counts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, get_args

from modelserver import messages
from modelserver.core import commands, requests, samples
from modelserver.core.host_clock import Instant
from modelserver.core.requests import is_answerable, reply_error, reply_internal_error, reply_overloaded
from modelserver.core.state import (
    DEGRADED,
    RUNNING,
    STARTING,
    AllOutputs,
    CoreSettings,
    CoreState,
    ExpectedSensor,
    handle_rejected,
    handle_warning,
    start,
)
from modelserver.core.ticks import get_state_to_persist, handle_tick


def step(state: CoreState, event: messages.Event | commands.ModelLoaded, now: Instant) -> tuple[CoreState, AllOutputs]:
    return _HANDLERS[type(event)](state, event, now)


_HANDLERS: Final[Mapping[type, Callable[[CoreState, Any, Instant], tuple[CoreState, AllOutputs]]]] = {
    **dict.fromkeys(get_args(messages.Sample), samples.process_sample),
    **dict.fromkeys(get_args(messages.Request), requests.handle_request),
    **dict.fromkeys(commands.COMMANDS, commands.deny_unsigned),
    messages.SignedCommand: commands.execute_command,
    messages.SwitchMode: samples.switch_mode,
    commands.ModelLoaded: commands.apply_model,
    messages.Tick: handle_tick,
    messages.Rejected: handle_rejected,
    messages.HealthWarning: handle_warning,
    messages.Denied: requests.handle_denied,
}

__all__ = [
    "DEGRADED",
    "RUNNING",
    "STARTING",
    "AllOutputs",
    "CoreSettings",
    "CoreState",
    "ExpectedSensor",
    "Instant",
    "get_state_to_persist",
    "is_answerable",
    "reply_error",
    "reply_internal_error",
    "reply_overloaded",
    "start",
    "step",
]

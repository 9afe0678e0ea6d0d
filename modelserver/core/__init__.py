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

from modelserver.core.commands import OPERATOR, SET_COVARIANCE, ModelLoaded, apply_model, deny_unsigned, execute_command
from modelserver.core.host_clock import Instant
from modelserver.core.persistence import START, get_state_to_persist, report_start
from modelserver.core.requests import (
    handle_denied,
    handle_request,
    reply_internal_error,
    reply_malformed,
    reply_overloaded,
)
from modelserver.core.samples import COMMAND_FUTURE_LIMIT_S, SAMPLE_FUTURE_LIMIT_S, process_sample, switch_mode
from modelserver.core.state import (
    DEGRADED,
    MAX_COUNTERS,
    RUNNING,
    STARTING,
    AllOutputs,
    CoreSettings,
    CoreState,
    ExpectedSensor,
    Outputs,
    SourceTraffic,
    StepResult,
    WaitingRequest,
    check_rigid,
    handle_rejected,
    handle_warning,
    start,
)
from modelserver.core.ticks import MAX_TICK_LATENCIES, handle_tick
from modelserver.messages import (
    Denied,
    Event,
    HealthWarning,
    Rejected,
    ReloadModel,
    Request,
    Sample,
    SetHTransform,
    SetStateVector,
    SignedCommand,
    SwitchMode,
    Tick,
)


def step(state: CoreState, event: Event | ModelLoaded, now: Instant) -> tuple[CoreState, AllOutputs]:
    """Return the state after an event, and the outputs to send."""
    return _HANDLERS[type(event)](state, event, now)


_HANDLERS: Final[Mapping[type, Callable[[CoreState, Any, Instant], tuple[CoreState, AllOutputs]]]] = {
    **dict.fromkeys(get_args(Sample), process_sample),
    **dict.fromkeys(get_args(Request), handle_request),
    **dict.fromkeys((ReloadModel, SetStateVector, SetHTransform), deny_unsigned),
    SignedCommand: execute_command,
    SwitchMode: switch_mode,
    ModelLoaded: apply_model,
    Tick: handle_tick,
    Rejected: handle_rejected,
    HealthWarning: handle_warning,
    Denied: handle_denied,
}

__all__ = [
    "COMMAND_FUTURE_LIMIT_S",
    "DEGRADED",
    "MAX_COUNTERS",
    "MAX_TICK_LATENCIES",
    "OPERATOR",
    "RUNNING",
    "SAMPLE_FUTURE_LIMIT_S",
    "SET_COVARIANCE",
    "START",
    "STARTING",
    "AllOutputs",
    "CoreSettings",
    "CoreState",
    "ExpectedSensor",
    "Instant",
    "Outputs",
    "SourceTraffic",
    "StepResult",
    "WaitingRequest",
    "check_rigid",
    "get_state_to_persist",
    "reply_internal_error",
    "reply_malformed",
    "reply_overloaded",
    "report_start",
    "start",
    "step",
]

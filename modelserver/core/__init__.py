"""The core: a deterministic state machine, `step(state, event, now) -> (state, outputs)`. Pure.

Live and replay run this same function: the same events at the same instants give the same outputs. Time enters
only with events. Nothing that comes from the bus can raise out of `step`; what cannot be used is counted by
channel and reason, and the counts go out with the health report.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

from modelserver.core.commands import OPERATOR, SET_COVARIANCE, commanded, model_loaded, unsigned
from modelserver.core.host_clock import Instant
from modelserver.core.keeping import START, kept, start_told
from modelserver.core.reload import ModelLoaded
from modelserver.core.requests import denied, fail, refuse, requested, turn_back
from modelserver.core.samples import AHEAD_LIMIT_S, FUTURE_LIMIT_S, mode_wished, sample_taken
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
    Parked,
    SourceTraffic,
    Step,
    check_bolted,
    noticed,
    rejected,
    start,
)
from modelserver.core.ticks import LATENESS_KEPT, ticked
from modelserver.messages import (
    AbsolutePoseSample,
    Denied,
    Event,
    GetBodyFrameList,
    GetBodyList,
    GetExplanation,
    GetHistory,
    GetHTransform,
    GetMotion,
    GetStateVector,
    GetTransformation,
    GetTransformations,
    GpsSample,
    ImuSample,
    JointsSample,
    Noticed,
    RangeSample,
    Rejected,
    RelativePoseSample,
    ReloadModel,
    SetHTransform,
    SetStateVector,
    SignedCommand,
    SwitchMode,
    Tick,
    VehicleStatusSample,
    WheelsSample,
)


def step(state: CoreState, event: Event | ModelLoaded, now: Instant) -> tuple[CoreState, AllOutputs]:
    """Return the state after an event, and what is to be sent."""
    return _HANDLERS[type(event)](state, event, now)


_HANDLERS: Final[Mapping[type, Callable[[CoreState, Any, Instant], tuple[CoreState, AllOutputs]]]] = {
    GpsSample: sample_taken,
    ImuSample: sample_taken,
    WheelsSample: sample_taken,
    VehicleStatusSample: sample_taken,
    JointsSample: sample_taken,
    AbsolutePoseSample: sample_taken,
    RelativePoseSample: sample_taken,
    RangeSample: sample_taken,
    SwitchMode: mode_wished,
    Tick: ticked,
    Rejected: rejected,
    Noticed: noticed,
    Denied: denied,
    GetTransformation: requested,
    GetBodyList: requested,
    GetBodyFrameList: requested,
    GetStateVector: requested,
    GetHTransform: requested,
    GetHistory: requested,
    GetTransformations: requested,
    GetMotion: requested,
    GetExplanation: requested,
    SignedCommand: commanded,
    ModelLoaded: model_loaded,
    ReloadModel: unsigned,
    SetStateVector: unsigned,
    SetHTransform: unsigned,
}

__all__ = [
    "AHEAD_LIMIT_S",
    "DEGRADED",
    "FUTURE_LIMIT_S",
    "LATENESS_KEPT",
    "MAX_COUNTERS",
    "OPERATOR",
    "RUNNING",
    "SET_COVARIANCE",
    "START",
    "STARTING",
    "AllOutputs",
    "CoreSettings",
    "CoreState",
    "ExpectedSensor",
    "Instant",
    "Outputs",
    "Parked",
    "SourceTraffic",
    "Step",
    "check_bolted",
    "fail",
    "kept",
    "refuse",
    "start",
    "start_told",
    "step",
    "turn_back",
]

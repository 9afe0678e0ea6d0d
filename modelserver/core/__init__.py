"""The core: a deterministic state machine, `step(state, event, now) -> (state, outputs)`. Pure.

Live and replay run this same function: the same events at the same instants give the same outputs. Time enters
only with events. Nothing that comes from the bus can raise out of `step`; what cannot be used is counted by
channel and reason, and the counts go out with the health report.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

from modelserver.core.commands import OPERATOR, SET_COVARIANCE, model_loaded, pose_set, reload_wished
from modelserver.core.requests import fail, refuse, requested, turn_back
from modelserver.core.samples import FUTURE_LIMIT_S, FUTURE_SAMPLES, mode_wished, sample_taken
from modelserver.core.state import (
    DEGRADED,
    MAX_COUNTERS,
    RUNNING,
    STARTING,
    CoreSettings,
    CoreState,
    Instant,
    Outputs,
    Parked,
    Step,
    Traffic,
    check_bolted,
    noticed,
    rejected,
    start,
)
from modelserver.core.ticks import LATENESS_KEPT, ticked
from modelserver.messages import (
    AbsolutePoseSample,
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
    SwitchMode,
    Tick,
    WheelsSample,
)
from modelserver.reload import ModelLoaded


def step(state: CoreState, event: Event | ModelLoaded, now: Instant) -> Step:
    """Return the state after an event, and what is to be sent."""
    return _HANDLERS[type(event)](state, event, now)


_HANDLERS: Final[Mapping[type, Callable[[CoreState, Any, Instant], Step]]] = {
    GpsSample: sample_taken,
    ImuSample: sample_taken,
    WheelsSample: sample_taken,
    JointsSample: sample_taken,
    AbsolutePoseSample: sample_taken,
    RelativePoseSample: sample_taken,
    RangeSample: sample_taken,
    SwitchMode: mode_wished,
    Tick: ticked,
    Rejected: rejected,
    Noticed: noticed,
    GetTransformation: requested,
    GetBodyList: requested,
    GetBodyFrameList: requested,
    GetStateVector: requested,
    GetHTransform: requested,
    GetHistory: requested,
    GetTransformations: requested,
    GetMotion: requested,
    GetExplanation: requested,
    ReloadModel: reload_wished,
    ModelLoaded: model_loaded,
    SetStateVector: pose_set,
    SetHTransform: pose_set,
}

__all__ = [
    "DEGRADED",
    "FUTURE_LIMIT_S",
    "FUTURE_SAMPLES",
    "LATENESS_KEPT",
    "MAX_COUNTERS",
    "OPERATOR",
    "RUNNING",
    "SET_COVARIANCE",
    "STARTING",
    "CoreSettings",
    "CoreState",
    "Instant",
    "Outputs",
    "Parked",
    "Step",
    "Traffic",
    "check_bolted",
    "fail",
    "refuse",
    "start",
    "step",
    "turn_back",
]

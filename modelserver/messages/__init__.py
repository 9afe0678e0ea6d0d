"""The values that the core speaks: what comes in, what is asked, what goes out. Pure, immutable.

Units, frames and signs are those of the wire types of the same names in `lcmtypes/`, where each field is
described; the codec in `modelserver.wire` is the only place that knows both. What a device did not say is
nan for a number and None for a vector or a matrix.

Requests and replies are NamedTuples where the rest are dataclasses: they are made with every query, and a
NamedTuple is made at a third of the cost.
"""

from modelserver.messages.decisions import Decision, Verdict
from modelserver.messages.driver_health import DriverHealth, DriverPhase
from modelserver.messages.estimates import Estimate, Origin
from modelserver.messages.events import (
    Event,
    OriginLatched,
    Output,
    PublishDecisions,
    PublishHealth,
    PublishNavigation,
    PublishPose,
    Rejected,
    SendReply,
    SwitchMode,
    Tick,
)
from modelserver.messages.flags import (
    NAN,
    NO_FLAGS,
    VALID,
    Direction,
    FixType,
    Invalid,
    OrientationReference,
    Policy,
    Quality,
    YawSource,
)
from modelserver.messages.health import ChannelHealth, Health
from modelserver.messages.navigation import Mode, NavigationState, Phase
from modelserver.messages.replies import (
    HistoryReply,
    NameListReply,
    PoseAnswer,
    Reply,
    ReplyHeader,
    StateVectorReply,
    TransformReply,
)
from modelserver.messages.requests import (
    CHANNEL_OF,
    MAX_CHANNEL_LENGTH,
    GetBodyFrameList,
    GetBodyList,
    GetHistory,
    GetHTransform,
    GetStateVector,
    GetTransformation,
    Request,
    RequestHeader,
    TimeQuery,
)
from modelserver.messages.samples import (
    AbsolutePoseSample,
    GpsSample,
    ImuSample,
    JointSample,
    JointsSample,
    Matrix3,
    RangeSample,
    RelativePoseSample,
    Sample,
    SensorHeader,
    WheelSample,
    WheelsSample,
)
from modelserver.messages.vehicle import DeviceSample, VehicleCommand, VehicleMode, VehicleStatusSample

__all__ = [
    "CHANNEL_OF",
    "MAX_CHANNEL_LENGTH",
    "NAN",
    "NO_FLAGS",
    "VALID",
    "AbsolutePoseSample",
    "ChannelHealth",
    "Decision",
    "DeviceSample",
    "Direction",
    "DriverHealth",
    "DriverPhase",
    "Estimate",
    "Event",
    "FixType",
    "GetBodyFrameList",
    "GetBodyList",
    "GetHTransform",
    "GetHistory",
    "GetStateVector",
    "GetTransformation",
    "GpsSample",
    "Health",
    "HistoryReply",
    "ImuSample",
    "Invalid",
    "JointSample",
    "JointsSample",
    "Matrix3",
    "Mode",
    "NameListReply",
    "NavigationState",
    "OrientationReference",
    "Origin",
    "OriginLatched",
    "Output",
    "Phase",
    "Policy",
    "PoseAnswer",
    "PublishDecisions",
    "PublishHealth",
    "PublishNavigation",
    "PublishPose",
    "Quality",
    "RangeSample",
    "Rejected",
    "RelativePoseSample",
    "Reply",
    "ReplyHeader",
    "Request",
    "RequestHeader",
    "Sample",
    "SendReply",
    "SensorHeader",
    "StateVectorReply",
    "SwitchMode",
    "Tick",
    "TimeQuery",
    "TransformReply",
    "VehicleCommand",
    "VehicleMode",
    "VehicleStatusSample",
    "Verdict",
    "WheelSample",
    "WheelsSample",
    "YawSource",
]

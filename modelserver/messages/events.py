"""Inputs (`Event`) and outputs (`Output`) of the core: samples, requests and replies, ticks, what is published."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeAlias

from modelserver.earth import Origin
from modelserver.messages.generated import *
from modelserver.messages.values import NAN, PersistedState, PoseAnswer, PoseBatch

Sample: TypeAlias = (
    GpsSample
    | ImuSample
    | WheelsSample
    | VehicleStatusSample
    | JointsSample
    | AbsolutePoseSample
    | RelativePoseSample
    | RangeSample
    | MeasurementSample
)

MAX_CHANNEL_LENGTH = 63
"""LCM rejects longer names."""

MAX_REQUEST_INSTANTS: Final = 2_000
"""In one GetTransformations, all pairs together: they take the server about a hundredth of a second."""

Request: TypeAlias = (
    GetTransformation
    | GetBodyList
    | GetBodyFrameList
    | GetStateVector
    | GetHTransform
    | GetHistory
    | GetTransformations
    | GetMotion
    | GetExplanation
    | GetDynamics
    | ReloadModel
    | SetFrame
    | SetStateVector
    | SetHTransform
)


class PoseBatchReply(NamedTuple):
    """One part of the answer to GetTransformations: pair number `pair`, from instant number `first` on.

    `poses` is None unless the status is OK.
    """

    header: ReplyHeader
    part: int = 0
    parts: int = 1
    pair: int = 0
    first: int = 0
    poses: PoseBatch | None = None


Reply: TypeAlias = (
    TransformReply
    | NameListReply
    | StateVectorReply
    | HistoryReply
    | PoseBatchReply
    | MotionReply
    | ExplanationReply
    | DynamicsReply
    | ReloadReply
    | Acknowledgement
)

_REQUESTS: Final[tuple[tuple[type[Request], str, Callable[[ReplyHeader], Reply]], ...]] = (
    (GetTransformation, "PLATFORM_GET_TRANSFORMATION", TransformReply),
    (GetBodyList, "PLATFORM_GET_BODY_LIST", NameListReply),
    (GetBodyFrameList, "PLATFORM_GET_BODY_FRAME_LIST", NameListReply),
    (GetStateVector, "POSE_GET_STATE_VECTOR", StateVectorReply),
    (GetHTransform, "POSE_GET_H_TRANSFORM", TransformReply),
    (GetHistory, "POSE_GET_HISTORY", HistoryReply),
    (GetTransformations, "PLATFORM_GET_TRANSFORMATIONS", PoseBatchReply),
    (GetMotion, "PLATFORM_GET_MOTION", MotionReply),
    (GetExplanation, "PLATFORM_GET_EXPLANATION", ExplanationReply),
    (GetDynamics, "PLATFORM_GET_DYNAMICS", DynamicsReply),
    (ReloadModel, "PLATFORM_RELOAD_MODEL", ReloadReply),
    (SetFrame, "PLATFORM_SET_FRAME", ReloadReply),
    (SetStateVector, "POSE_SET_STATE_VECTOR", Acknowledgement),
    (SetHTransform, "POSE_SET_H_TRANSFORM", Acknowledgement),
)

CHANNEL_OF: Final[Mapping[type, str]] = {kind: channel for kind, channel, _ in _REQUESTS}
"""The channel of each request type, without the vehicle's prefix."""

REPLY_OF: Final[Mapping[type, Callable[[ReplyHeader], Reply]]] = {kind: reply for kind, _, reply in _REQUESTS}
"""The reply type of each request type."""


class SensorFinding(NamedTuple):
    """Why a configured sensor cannot be used, in whole or in part.

    `sensor` is its key under `sensors`, `element` the responsible key of the vehicle file, `reason` a word for
    programs, `text` what is wrong and its effect, `fix` the remedy. `is_choice`: the vehicle file asks for it, e.g. by
    its mode.
    """

    sensor: str
    reason: str
    element: str
    text: str
    fix: str = ""
    is_choice: bool = False


class LocalizerSummary(NamedTuple):
    """Summary of a localizer: `phase` is None in raw mode, `fix_utime` 0 before the first used fix.

    `findings` lists the configured sensors that cannot be used now. `distance_to_heading`: how far the vehicle must
    still drive until its heading can be found from fixes, about, m; nan: it is known, or there are no fixes. The
    limits, m and rad, are those of a valid pose; nan: not known yet.
    """

    mode: Mode
    phase: Phase | None = None
    stationary: bool = False
    fix_utime: int = 0
    findings: tuple[SensorFinding, ...] = ()
    distance_to_heading: float = NAN
    horizontal_limit: float = NAN
    heading_limit: float = NAN


class Gauges(NamedTuple):
    """Measured values of the process and its loop, which enter the core with a tick.

    `host` and `pid` identify the process. `queued`: requests in the queue. `memory`: resident bytes, 0 = not known.
    `cpu_s`: processor time since the start of the process, seconds, nan = not known.
    """

    host: str = ""
    pid: int = 0
    queued: int = 0
    memory: int = 0
    cpu_s: float = NAN


@dataclass(frozen=True, slots=True)
class Tick:
    """Timer tick, `latency` seconds after its deadline; `missed` deadlines before it were skipped.

    `answered` counts the requests that were answered from the reply cache, without the core, since the last tick.
    `gauges` comes with ticks at which a health report is due.
    """

    latency: float = 0.0
    missed: int = 0
    answered: int = 0
    gauges: Gauges | None = None


@dataclass(frozen=True, slots=True)
class Rejected:
    """Input that was rejected `count` times; counted by channel and reason."""

    channel: str
    reason: str
    count: int = 1


@dataclass(frozen=True, slots=True)
class HealthWarning:
    """Warning about the service itself in the health report (health_t), until it is cleared.

    `subject` identifies the warning, e.g. journal; an empty `text` clears it.
    """

    subject: str
    text: str = ""


@dataclass(frozen=True, slots=True)
class SignedCommand:
    """A command whose signature was verified with the vehicle's key."""

    command: ReloadModel | SetFrame | SetStateVector | SetHTransform | SwitchMode
    sender: str = ""


@dataclass(frozen=True, slots=True)
class Denied:
    """A denied command; counted under `channel` by `reason`.

    With a valid signature the sender gets a reply of `request_type` to `header` with `message` and the status MALFORMED
    (`is_malformed`) or FORBIDDEN. Without one it gets no reply: the two fields are None.
    """

    channel: str
    reason: str
    message: str = ""
    request_type: type[Request] | None = None
    header: RequestHeader | None = None
    is_malformed: bool = False


Event: TypeAlias = Sample | SwitchMode | Request | SignedCommand | Denied | Tick | Rejected | HealthWarning


class SendReply(NamedTuple):
    """Send `reply` on `channel`."""

    channel: str
    reply: Reply


@dataclass(frozen=True, slots=True)
class PublishPose:
    """Publish the vehicle's pose in World:UTM and in Odom:Origin."""

    world: PoseAnswer
    odom: PoseAnswer


@dataclass(frozen=True, slots=True)
class PublishHealth:
    """Publish the health report."""

    health: Health


@dataclass(frozen=True, slots=True)
class PersistOrigin:
    """Persist the origin of World:UTM, which was just set."""

    origin: Origin


@dataclass(frozen=True, slots=True)
class PublishNavigation:
    """Publish the filter's state."""

    state: NavigationState


@dataclass(frozen=True, slots=True)
class LoadModel:
    """Reload the geometry file, or change an added frame; `request` is None for a reload by signal."""

    request: ReloadModel | SetFrame | None = None


@dataclass(frozen=True, slots=True)
class PublishSnapshot:
    """Publish the geometry in use."""

    utime: int


@dataclass(frozen=True, slots=True)
class PersistState:
    """Persist the state for the next run of the service, in place of the one before."""

    state: PersistedState


@dataclass(frozen=True, slots=True)
class ReportStart:
    """Log the kind of start: warm, or cold and why."""

    text: str


Output: TypeAlias = (
    SendReply
    | PublishPose
    | PublishHealth
    | PersistOrigin
    | PublishDecisions
    | PublishNavigation
    | LoadModel
    | PublishSnapshot
    | PersistState
    | ReportStart
)

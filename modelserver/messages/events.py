"""Inputs (`Event`) and outputs (`Output`) of the core."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from modelserver.messages.answers import PoseAnswer
from modelserver.messages.estimates import Origin
from modelserver.messages.flags import NAN
from modelserver.messages.generated import (
    Health,
    PublishDecisions,
    ReloadModel,
    RequestHeader,
    SetHTransform,
    SetStateVector,
    SwitchMode,
)
from modelserver.messages.navigation import NavigationState
from modelserver.messages.persistence import PersistedState
from modelserver.messages.replies import Reply
from modelserver.messages.requests import Request
from modelserver.messages.samples import Sample


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

    command: ReloadModel | SetStateVector | SetHTransform | SwitchMode
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
    """Reload the geometry file; `request` is None for a reload by signal."""

    request: ReloadModel | None = None


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

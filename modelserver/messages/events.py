"""What the core is told, and what it says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from modelserver.messages.decisions import Decision
from modelserver.messages.estimates import Origin
from modelserver.messages.health import Gauges, Health
from modelserver.messages.kept import Kept
from modelserver.messages.navigation import Mode, NavigationState
from modelserver.messages.replies import PoseAnswer, Reply
from modelserver.messages.requests import ReloadModel, Request, RequestHeader, SetHTransform, SetStateVector
from modelserver.messages.samples import Sample, SensorHeader


@dataclass(frozen=True, slots=True)
class Tick:
    """The clock has reached a due time, `late` seconds after it; `missed` due times before it were skipped.

    `answered`: requests that were answered from what is remembered, without the core, since the last tick. `gauges`
    comes with ticks at which a health report is due.
    """

    late: float = 0.0
    missed: int = 0
    answered: int = 0
    gauges: Gauges | None = None


@dataclass(frozen=True, slots=True)
class Rejected:
    """Something that came in and was not understood or not taken, `count` times: counted by channel and reason."""

    channel: str
    reason: str
    count: int = 1


@dataclass(frozen=True, slots=True)
class Noticed:
    """Something about the service itself that people who watch should know until it is over; see health_t.

    `subject` names what it is about, e.g. journal; an empty `text` takes the notice back.
    """

    subject: str
    text: str = ""


@dataclass(frozen=True, slots=True)
class SwitchMode:
    """The operator's wish that localization uses other sources from `header.utime` on; see localization_mode_t."""

    header: SensorHeader
    mode: Mode


@dataclass(frozen=True, slots=True)
class SignedCommand:
    """What changes the service, from a sender who has proved to know the vehicle's key."""

    order: ReloadModel | SetStateVector | SetHTransform | SwitchMode
    sender: str = ""


@dataclass(frozen=True, slots=True)
class Denied:
    """A signed command that is not obeyed: counted under `channel` by `reason`.

    Where its signature is right and it wants a reply, `kind` and `header` say which, and `why` is told, as of something
    `malformed` or else forbidden; who does not know the key is told nothing.
    """

    channel: str
    reason: str
    why: str = ""
    kind: type[Request] | None = None
    header: RequestHeader | None = None
    malformed: bool = False


Event: TypeAlias = Sample | SwitchMode | Request | SignedCommand | Denied | Tick | Rejected | Noticed


class SendReply(NamedTuple):
    """Send `reply` on `channel`."""

    channel: str
    reply: Reply


@dataclass(frozen=True, slots=True)
class PublishPose:
    """Broadcast the vehicle's pose in the world, and in Odom."""

    world: PoseAnswer
    odom: PoseAnswer


@dataclass(frozen=True, slots=True)
class PublishHealth:
    """Broadcast how the daemon is."""

    health: Health


@dataclass(frozen=True, slots=True)
class OriginLatched:
    """The origin was set: keep it across restarts."""

    origin: Origin


@dataclass(frozen=True, slots=True)
class PublishDecisions:
    """Broadcast what became of measurements; each is said once, when nothing can change it any more."""

    utime: int
    decisions: tuple[Decision, ...]


@dataclass(frozen=True, slots=True)
class PublishNavigation:
    """Broadcast the filter's whole state."""

    state: NavigationState


@dataclass(frozen=True, slots=True)
class LoadModel:
    """Read the geometry anew and tell the core what came of it; `request` is None where the machine's owner asks."""

    request: ReloadModel | None = None


@dataclass(frozen=True, slots=True)
class PublishSnapshot:
    """Broadcast the geometry that is in force."""

    utime: int


@dataclass(frozen=True, slots=True)
class SnapshotPart:
    """A part of the geometry on the bus; see model_snapshot_t."""

    utime: int
    model_revision: str
    part: int
    parts: int
    data: bytes


@dataclass(frozen=True, slots=True)
class KeepState:
    """Keep this for the next run of the service, in place of what was kept before."""

    kept: Kept


@dataclass(frozen=True, slots=True)
class StartTold:
    """How the start goes, for the log: warm, or cold and why."""

    text: str


Output: TypeAlias = (
    SendReply
    | PublishPose
    | PublishHealth
    | OriginLatched
    | PublishDecisions
    | PublishNavigation
    | LoadModel
    | PublishSnapshot
    | KeepState
    | StartTold
)

"""What the core knows: one value, whose successor is made for every event."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Literal, NamedTuple, TypeAlias

from modelserver.errors import NotConnectedError
from modelserver.geometry.model import Model
from modelserver.history import History
from modelserver.joints import Joints
from modelserver.localization.interface import Localizer
from modelserver.messages import (
    GetExplanation,
    GetHTransform,
    GetMotion,
    GetStateVector,
    GetTransformation,
    Noticed,
    Output,
    Rejected,
)
from modelserver.platform import PlatformView

MAX_COUNTERS: Final = 256
"""Distinct causes of rejection that are told apart; further ones are counted together."""

STARTING, RUNNING, DEGRADED = 0, 1, 2


TimedRequest: TypeAlias = GetTransformation | GetStateVector | GetHTransform | GetMotion | GetExplanation
"""A request that asks about a time, and may wait for it."""


class Instant(NamedTuple):
    """When an event is handled: the host's monotonic clock in nanoseconds, and its time of day as utime."""

    monotonic_ns: int
    utime: int


@dataclass(frozen=True, slots=True)
class CoreSettings:
    """What does not change while the core runs; see `modelserver.config` for the meanings.

    ticks_per_pose: in timer mode POSE goes out at the first of each so many ticks; missed ones are counted too.
    ticks_per_state: the same for the filter's state; 0 = it does not go out.
    publish_decisions: whether what became of measurements goes out.
    may_reload, may_set_pose: whether clients may have that done.
    """

    base_frame: str
    rolling_frame: str = ""
    vehicle: str = ""
    publish: Literal["timer", "event"] = "timer"
    ticks_per_pose: int = 1
    ticks_per_state: int = 0
    publish_decisions: bool = True
    health_period_ns: int = 1_000_000_000
    history_s: float = 60.0
    parked_requests: int = 64
    wait_ms: int = 2000
    reply_prefix: str = "REPLY_"
    snapshot_period_ns: int = 5_000_000_000
    may_reload: bool = False
    may_set_pose: bool = False


@dataclass(frozen=True, slots=True)
class Parked:
    """A request that waits for data, and is answered as best it can at `until_ns` (monotonic)."""

    request: TimedRequest
    until_ns: int


@dataclass(frozen=True, slots=True)
class Traffic:
    """Messages of one source: how many, the last one's arrival, and how many there were at the last report."""

    count: int = 0
    last_ns: int = 0
    reported: int = 0


class CoreState(NamedTuple):
    """All that the core knows. Make the first one with `start`.

    A NamedTuple, not a dataclass like the rest: its successor is made for every event, at a third of the cost.
    """

    settings: CoreSettings
    view: PlatformView
    started_ns: int
    parked: tuple[Parked, ...] = ()
    rejected: Mapping[tuple[str, str], int] = MappingProxyType({})
    traffic: Mapping[str, Traffic] = MappingProxyType({})
    lateness: tuple[float, ...] = ()
    health_due_ns: int = 0
    health_sent_ns: int = 0
    poses_published: int = 0
    ticks: int = 0
    ticks_missed: int = 0
    handler_errors: int = 0
    run_state: int = STARTING
    futures: int = 0
    snapshot_due_ns: int = 0
    notices: Mapping[str, str] = MappingProxyType({})
    requests_answered: int = 0  # stays last: see `_request`

    @property
    def model(self) -> Model:
        """The geometry in force."""
        return self.view.model

    @property
    def localizer(self) -> Localizer | None:
        """What has been concluded from the samples so far; None for a vehicle without GPS and IMU."""
        return self.view.localizer

    @property
    def history(self) -> History:
        """The estimates of the last seconds."""
        return self.view.history


Outputs: TypeAlias = tuple[Output, ...]
Step: TypeAlias = tuple[CoreState, Outputs]


def start(settings: CoreSettings, model: Model, localizer: Localizer | None, now: Instant) -> CoreState:
    """Return the first state. Raises a QueryError where the model lacks the base frame or the rolling frame."""
    history, joints = History(settings.history_s), Joints(model.joints.values(), settings.history_s)
    view = PlatformView(model, settings.base_frame, localizer, history, settings.rolling_frame, joints=joints)
    check_bolted(model, view.base_frame, view.rolling_frame)
    due = now.monotonic_ns
    return CoreState(settings, view, due, health_due_ns=due, snapshot_due_ns=due)


def check_bolted(model: Model, base_frame: str, rolling_frame: str) -> None:
    """Raise a QueryError where the model lacks one of the two frames, or a joint moves one against the other."""
    legs = model.route(base_frame, rolling_frame).legs
    if legs:
        raise NotConnectedError(
            f"joint {legs[0].name} moves {base_frame} against {rolling_frame}: both are to be of the vehicle's own body"
        )


def rejected(state: CoreState, rejected: Rejected, now: Instant) -> Step:
    """Count something that was not understood."""
    return counted(state, rejected.channel, rejected.reason), ()


def noticed(state: CoreState, notice: Noticed, now: Instant) -> Step:
    """Take a notice up, or back; the next tick tells of the change."""
    known = state.notices.get(notice.subject, "")
    if known == notice.text or (not known and len(state.notices) >= MAX_COUNTERS):
        return state, ()
    notices = {subject: text for subject, text in state.notices.items() if subject != notice.subject}
    if notice.text:
        notices[notice.subject] = notice.text
    return state._replace(notices=notices, health_due_ns=now.monotonic_ns), ()


def counted(state: CoreState, channel: str, reason: str) -> CoreState:
    """Return the state with one rejection more, by channel and reason."""
    key = (channel, reason)
    if key not in state.rejected and len(state.rejected) >= MAX_COUNTERS:
        key = ("*", "other")
    counts = dict(state.rejected)
    counts[key] = counts.get(key, 0) + 1
    errors = state.handler_errors + (reason == "handler")
    return state._replace(rejected=counts, handler_errors=errors)


def traffic_noted(state: CoreState, source: str, now: Instant) -> CoreState:
    """Return the state with one message more of a source."""
    known = state.traffic.get(source)
    if known is None and len(state.traffic) >= MAX_COUNTERS:
        return state
    known = known or Traffic()
    updated = Traffic(known.count + 1, now.monotonic_ns, known.reported)
    return state._replace(traffic={**state.traffic, source: updated})

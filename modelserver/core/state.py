"""What the core knows: one value, whose successor is made for every event."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, Literal, NamedTuple, TypeAlias

from modelserver.core.answers import DeferredAnswer
from modelserver.core.host_clock import HostClock, Instant
from modelserver.errors import NotConnectedError
from modelserver.geometry.model import Model
from modelserver.history import History
from modelserver.joints.joints import Joints
from modelserver.localization.interface import Localizer
from modelserver.messages import (
    NAN,
    Decision,
    Gauges,
    GetExplanation,
    GetHTransform,
    GetMotion,
    GetStateVector,
    GetTransformation,
    Noticed,
    Output,
    Rejected,
    Sample,
    Verdict,
)
from modelserver.platform import PlatformView

MAX_COUNTERS: Final = 256
"""Distinct causes of rejection that are told apart; further ones are counted together."""

STARTING, RUNNING, DEGRADED = 0, 1, 2

SILENT_INTERVALS: Final = 5.0
SILENT_LEAST_S: Final = 1.0
"""A source is silent after so many of its usual intervals, and so many seconds at least."""

INTERVAL_GAIN: Final = 0.1
"""By how much each interval counts for the usual one."""

UNCOUNTED: Final = frozenset(("inertial", "steering", "imu_tilt", "imu_yaw", "magnetometer"))
"""Kinds of measurements that are not counted as used or dropped: not each one is decided on."""

CHANGE_PERIOD_NS: Final = 100_000_000
"""Nanoseconds between two looks for what a health report goes out for at once: changes to and fro cannot flood."""


TimedRequest: TypeAlias = GetTransformation | GetStateVector | GetHTransform | GetMotion | GetExplanation
"""A request that asks about a time, and may wait for it."""


@dataclass(frozen=True, slots=True)
class CoreSettings:
    """What does not change while the core runs; see `modelserver.config` for the meanings.

    ticks_per_pose: in timer mode POSE goes out at the first of each so many ticks; missed ones are counted too.
    ticks_per_state: the same for the filter's state; 0 = it does not go out.
    publish_decisions: whether what became of measurements goes out.
    keep_period_ns: how often that goes out which the next run of the service should know; 0 = never.
    may_reload, may_set_pose: whether clients may have that done, where they sign.
    sensors: those of the vehicle file, so that the health report can tell which were never heard.
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
    keep_period_ns: int = 0
    sensors: tuple[ExpectedSensor, ...] = ()


@dataclass(frozen=True, slots=True)
class Parked:
    """A request that waits for data, and is answered as best it can at `until_ns` (monotonic)."""

    request: TimedRequest
    until_ns: int


class ExpectedSensor(NamedTuple):
    """A sensor of the vehicle file: its channel, what its samples are, and, where that is told, its name for itself."""

    channel: str
    kind: type[Sample]
    source: str = ""


@dataclass(frozen=True, slots=True)
class SourceTraffic:
    """Messages of one source: how many, the last one's arrival, and how many there were at the last whole report.

    `measured` counts the measurements of its samples that localization decided on, `used` those that it used, `dropped`
    those dropped in a row since, and `reason` is the last one's.

    `interval` is the usual time between two, seconds; 0 = not known yet. `delay` is the greatest from the host's
    receipt to handling since the last whole report, seconds. `rate` and `told_delay` are what that report said.
    """

    count: int = 0
    last_ns: int = 0
    reported: int = 0
    interval: float = 0.0
    delay: float = NAN
    rate: float = 0.0
    told_delay: float = NAN
    measured: int = 0
    used: int = 0
    dropped: int = 0
    reason: str = ""


class Signs(NamedTuple):
    """What a report goes out for at once when it changes. `silent` names sources, `unheard` channels.

    `unused` are sensors that cannot be used, each with a word why.
    """

    run_state: int = STARTING
    invalid: int = 0
    revision: str = ""
    silent: tuple[str, ...] = ()
    unheard: tuple[str, ...] = ()
    notices: Mapping[str, str] = MappingProxyType({})
    unused: tuple[tuple[str, str], ...] = ()


class HealthInputs(NamedTuple):
    """What the health report needs beside the rest.

    `gauges`: the last that came, at `gauged_ns`; `cpu_share` what follows from the last two. `due_ns`: when signs are
    looked at again; `said`: what they were at the last report.
    """

    gauges: Gauges = Gauges()
    gauged_ns: int = 0
    cpu_share: float = NAN
    due_ns: int = 0
    said: Signs = Signs()


class CoreState(NamedTuple):
    """All that the core knows. Make the first one with `start`.

    A NamedTuple, not a dataclass like the rest: its successor is made for every event, at a third of the cost.
    """

    settings: CoreSettings
    view: PlatformView
    started_ns: int
    parked: tuple[Parked, ...] = ()
    rejected: Mapping[tuple[str, str], int] = MappingProxyType({})
    traffic: Mapping[str, SourceTraffic] = MappingProxyType({})
    lateness: tuple[float, ...] = ()
    health_due_ns: int = 0
    health_sent_ns: int = 0
    poses_published: int = 0
    ticks: int = 0
    ticks_missed: int = 0
    handler_errors: int = 0
    run_state: int = STARTING
    host_clock: HostClock = HostClock()
    snapshot_due_ns: int = 0
    notices: Mapping[str, str] = MappingProxyType({})
    keep_due_ns: int = 0
    unheard: tuple[ExpectedSensor, ...] = ()
    pose_invalid: int = 0
    watch: HealthInputs = HealthInputs()
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

AllOutputs: TypeAlias = tuple[Output | DeferredAnswer, ...]
"""Outputs of an event, which may be a request whose answer takes long."""


def start(settings: CoreSettings, model: Model, localizer: Localizer | None, now: Instant) -> CoreState:
    """Return the first state. Raises a QueryError where the model lacks the base frame or the rolling frame."""
    history, joints = History(settings.history_s), Joints(model.joints.values(), settings.history_s)
    view = PlatformView(model, settings.base_frame, localizer, history, settings.rolling_frame, joints=joints)
    check_bolted(model, view.base_frame, view.rolling_frame)
    due = now.monotonic_ns
    clock = HostClock.at(now)
    return CoreState(
        settings, view, due, health_due_ns=due, snapshot_due_ns=due, unheard=settings.sensors, host_clock=clock
    )


def check_bolted(model: Model, base_frame: str, rolling_frame: str) -> None:
    """Raise a QueryError where the model lacks one of the two frames, or a joint moves one against the other."""
    legs = model.route(base_frame, rolling_frame).legs
    if legs:
        raise NotConnectedError(
            f"joint {legs[0].name} moves {base_frame} against {rolling_frame}: both are to be of the vehicle's own body"
        )


def rejected(state: CoreState, rejected: Rejected, now: Instant) -> Step:
    """Count something that was not understood."""
    return counted(state, rejected.channel, rejected.reason, rejected.count), ()


def noticed(state: CoreState, notice: Noticed, now: Instant) -> Step:
    """Take a notice up, or back; a health report tells of the change within `CHANGE_PERIOD_NS`."""
    known = state.notices.get(notice.subject, "")
    if known == notice.text or (not known and len(state.notices) >= MAX_COUNTERS):
        return state, ()
    notices = {subject: text for subject, text in state.notices.items() if subject != notice.subject}
    if notice.text:
        notices[notice.subject] = notice.text
    return state._replace(notices=notices), ()


def counted(state: CoreState, channel: str, reason: str, count: int = 1) -> CoreState:
    """Return the state with one rejection more, or `count`, by channel and reason."""
    key = (channel, reason)
    if key not in state.rejected and len(state.rejected) >= MAX_COUNTERS:
        key = ("*", "other")
    counts = dict(state.rejected)
    counts[key] = counts.get(key, 0) + count
    errors = state.handler_errors + count * (reason == "handler")
    return state._replace(rejected=counts, handler_errors=errors)


def traffic_noted(state: CoreState, source: str, host_utime: int, now: Instant) -> CoreState:
    """Return the state with one message more of a source, which the host received at `host_utime` (0 = not told)."""
    known = state.traffic.get(source)
    if known is None and len(state.traffic) >= MAX_COUNTERS:
        return state
    known = known or SourceTraffic()
    interval, delay = known.interval, known.delay
    if known.count:
        since = (now.monotonic_ns - known.last_ns) * 1e-9
        # a pause counts for no more than what makes it silent, or its return would be long forgotten for
        usual = min(since, silent_after(interval)) if interval else since
        interval += (usual - interval) * (INTERVAL_GAIN if known.count > 1 else 1.0)
    if host_utime:
        took = (now.utime - host_utime) * 1e-6
        # a nan fails the comparison
        delay = delay if delay >= took else took
    updated = SourceTraffic(
        known.count + 1,
        now.monotonic_ns,
        known.reported,
        interval,
        delay,
        known.rate,
        known.told_delay,
        known.measured,
        known.used,
        known.dropped,
        known.reason,
    )
    return state._replace(traffic={**state.traffic, source: updated})


def decided(state: CoreState, decision: Decision) -> CoreState:
    """Return the state with a decision of localization counted for its source.

    An inertial unit's measurements are not counted: of those that are used for propagation nothing is reported.
    """
    source = f"sensor:{decision.source}"
    known = state.traffic.get(source)
    if known is None or decision.kind in UNCOUNTED:
        return state
    dropped = decision.verdict is Verdict.REJECTED
    updated = replace(
        known,
        measured=known.measured + 1,
        used=known.used + (decision.verdict in (Verdict.USED, Verdict.TOOK_UP)),
        dropped=known.dropped + 1 if dropped else 0,
        reason=decision.reason if dropped else "",
    )
    return state._replace(traffic={**state.traffic, source: updated})


def silent_after(interval: float) -> float:
    """Return after how many seconds a source with this usual interval is silent."""
    return max(SILENT_LEAST_S, SILENT_INTERVALS * interval)


def heard(state: CoreState, sample: Sample) -> CoreState:
    """Return the state in which the sensors that a sample may be of are heard."""
    kind, source = type(sample), sample.header.source
    still = tuple([each for each in state.unheard if each.kind is not kind or each.source not in ("", source)])
    return state if len(still) == len(state.unheard) else state._replace(unheard=still)

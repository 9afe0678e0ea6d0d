"""State of the core, one immutable value that is replaced with every event, and the clocks it depends on. Pure.

Host clock: the time of day (CLOCK_REALTIME) may be set, the monotonic clock never is. If the offset between the two
clocks of an `Instant` falls by more than slewing can explain, the time of day was set back. Stamps of messages are no
evidence, since any publisher on the bus can stamp as it likes.

Source clocks: the stamps of a source are compared with their receipt. A source whose stamps are off while those of
others agree with their receipt is the one with the wrong clock. Where all are off, as in the playback of a log, none
is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Literal, NamedTuple, TypeAlias

from modelserver import messages
from modelserver.dynamics.stability import DynamicsSettings
from modelserver.errors import NotConnectedError
from modelserver.estimation.history import History, Localizer
from modelserver.geometry.model import Model
from modelserver.joints import JointHistory
from modelserver.named_tuples import new_tuple
from modelserver.query.answers import DeferredAnswer
from modelserver.query.view import PlatformView

MIN_STEP_US: Final = 100_000
"""A smaller fall of the offset between two readings is slewing: chronyd slews by at most 8 %, 2 ms between ticks."""


class Instant(NamedTuple):
    """When an event is handled: the host's monotonic clock in nanoseconds, and its time of day as utime."""

    monotonic_ns: int
    utime: int


class HostClock(NamedTuple):
    """The last reading of the host's clocks: both times, and the last two offsets of utime from monotonic time, us.

    Two offsets, since a process that is preempted between the two readings sees one offset that is too large; the fall
    back from it is no step.
    """

    monotonic_ns: int = 0
    utime: int = 0
    offset: int = 0
    previous_offset: int = 0

    @classmethod
    def start(cls, now: Instant) -> HostClock:
        monotonic_ns, utime = now
        offset = utime - monotonic_ns // 1000
        return cls(monotonic_ns, utime, offset, offset)

    def update(self, now: Instant) -> tuple[HostClock, bool]:
        """Return the reading at `now`, and whether the time of day was set back since the last one.

        In a recording both times are those of the log, so both fall. After a step earlier offsets do not count.
        """
        monotonic_ns, utime = now
        before_ns, before, last, previous = self
        offset = utime - monotonic_ns // 1000
        has_stepped_back = (previous if previous < last else last) - offset > MIN_STEP_US or (
            monotonic_ns < before_ns and before - utime > MIN_STEP_US
        )
        reading = new_tuple(HostClock, (monotonic_ns, utime, offset, offset if has_stepped_back else last))
        return reading, has_stepped_back


# --- the state --------------------------------------------------------------------------------------------------------

MAX_COUNTERS: Final = 256
"""Distinct causes of rejection with a counter of their own; further ones share one."""

STARTING, RUNNING, DEGRADED = 0, 1, 2

START: Final = "start"
"""Subject of the warning on how the server started."""

START_REPORT_NS: Final = 600_000_000_000
"""How long the health report shows how the server started: ten minutes."""

SILENT_INTERVALS: Final = 5.0
MIN_SILENCE_S: Final = 1.0
"""A source is silent after so many of its usual intervals, and so many seconds at least."""

INTERVAL_GAIN: Final = 0.1
"""Weight of a new interval in the moving average of a source's intervals."""

UNCOUNTED_KINDS: Final = frozenset(("inertial", "steering", "imu_tilt", "imu_yaw", "magnetometer"))
"""Kinds of measurements without a decision for each one: not counted as used or dropped."""

CHANGE_PERIOD_NS: Final = 100_000_000
"""Nanoseconds between two evaluations of the health conditions: alternating conditions cannot flood the bus."""

TimedRequest: TypeAlias = (
    messages.GetTransformation
    | messages.GetStateVector
    | messages.GetHTransform
    | messages.GetMotion
    | messages.GetExplanation
)
"""A request that names a time, and may wait for its data."""


@dataclass(frozen=True, slots=True)
class CoreSettings:
    """Constants of a run; see `modelserver.config.vehicle_file` for those not listed.

    Attributes
    ----------
    ticks_per_pose: ticks per POSE in timer mode, missed ones included.
    ticks_per_state: ticks per LOCALIZATION_STATE; 0 = not published.
    publish_decisions: whether the filter's decisions on measurements are published.
    persist_period_ns: how often the state for a warm start is output; 0 = never.
    may_reload, may_set_frames, may_set_pose: commands that signed clients may send.
    sensors: configured sensors, so that the health report can list those without any message.
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
    waiting_requests: int = 64
    wait_ms: int = 2000
    reply_prefix: str = "REPLY_"
    snapshot_period_ns: int = 5_000_000_000
    may_reload: bool = False
    may_set_frames: bool = False
    may_set_pose: bool = False
    persist_period_ns: int = 0
    sensors: tuple[ExpectedSensor, ...] = ()
    dynamics: DynamicsSettings | None = None


@dataclass(frozen=True, slots=True)
class WaitingRequest:
    """A request that waits for data, and is answered without them at `deadline_ns` (monotonic)."""

    request: TimedRequest
    deadline_ns: int


class ExpectedSensor(NamedTuple):
    """A configured sensor: its channel, the type of its samples, and its source name if that is configured."""

    channel: str
    kind: type[messages.Sample]
    source: str = ""


class SourceTraffic(NamedTuple):
    """Statistics of the messages of one source. The first four change with each message.

    Attributes
    ----------
    count, last_received_ns: messages, and arrival of the last one.
    interval: moving average of the time between two messages, s; 0 = not known yet.
    delay: greatest delay from the host's receipt to handling since the last full report, s.
    reported, rate, reported_delay: count, rate (Hz) and greatest delay (s) of the last full health report.
    measured, used: measurements with a decision of localization, and those that it used.
    dropped, reason: measurements dropped in a row since the last used one, and the last reason.
    offset, num_off: stamp less receipt of the last sample, s, and how many in a row had it; 0 if it was on time.
    """

    count: int = 0  # type: ignore[assignment]  # hides tuple.count
    last_received_ns: int = 0
    interval: float = 0.0
    delay: float = messages.NAN
    reported: int = 0
    rate: float = 0.0
    reported_delay: float = messages.NAN
    measured: int = 0
    used: int = 0
    dropped: int = 0
    reason: str = ""
    offset: float = 0.0
    num_off: int = 0


class HealthConditions(NamedTuple):
    """Conditions whose change is reported at once.

    `silent` names sources, `missing` channels without any message, `unusable` sensors with the reason.
    """

    run_state: int = STARTING
    invalid: int = 0
    revision: str = ""
    silent: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    warnings: Mapping[str, str] = MappingProxyType({})
    unusable: tuple[tuple[str, str], ...] = ()
    is_unstable: bool = False


class HealthInputs(NamedTuple):
    """State of the health report.

    `gauges` were read at `gauges_ns`; `cpu_share` follows from the last two readings. The conditions are evaluated next
    at `due_ns`; `reported` are those of the last report.
    """

    gauges: messages.Gauges = messages.Gauges()
    gauges_ns: int = 0
    cpu_share: float = messages.NAN
    due_ns: int = 0
    reported: HealthConditions = HealthConditions()


class CoreState(NamedTuple):
    """State of the core. `start` makes the first one.

    A NamedTuple, not a dataclass: it is replaced with every event, at a third of the cost. The first three change with
    each sample.
    """

    view: PlatformView
    host_clock: HostClock
    traffic: Mapping[str, SourceTraffic]
    settings: CoreSettings
    started_ns: int
    waiting: tuple[WaitingRequest, ...] = ()
    rejected: Mapping[tuple[str, str], int] = MappingProxyType({})
    tick_latencies: tuple[float, ...] = ()
    health_due_ns: int = 0
    health_sent_ns: int = 0
    poses_published: int = 0
    ticks: int = 0
    ticks_missed: int = 0
    handler_errors: int = 0
    run_state: int = STARTING
    snapshot_due_ns: int = 0
    warnings: Mapping[str, str] = MappingProxyType({})
    persist_due_ns: int = 0
    missing_sensors: tuple[ExpectedSensor, ...] = ()
    pose_invalid: int = 0
    health_inputs: HealthInputs = HealthInputs()
    requests_answered: int = 0  # last: see `handle_request`

    @property
    def model(self) -> Model:
        return self.view.model

    @property
    def localizer(self) -> Localizer | None:
        return self.view.localizer

    @property
    def history(self) -> History:
        return self.view.history


Outputs: TypeAlias = tuple[messages.Output, ...]
StepResult: TypeAlias = tuple[CoreState, Outputs]

AllOutputs: TypeAlias = tuple[messages.Output | DeferredAnswer, ...]
"""Outputs of an event, also of a request with a deferred answer."""


def start(settings: CoreSettings, model: Model, localizer: Localizer | None, now: Instant) -> CoreState:
    """Make the first state. Raises QueryError if the model lacks the base frame or the rolling frame."""
    history, joints = History(settings.history_s), JointHistory(model.joints.values(), settings.history_s)
    view = PlatformView(
        model,
        settings.base_frame,
        localizer,
        history,
        settings.rolling_frame,
        joints=joints,
        dynamics=settings.dynamics,
    )
    check_rigid(model, view.base_frame, view.rolling_frame)
    due = now.monotonic_ns
    return CoreState(
        view,
        HostClock.start(now),
        {},
        settings,
        due,
        health_due_ns=due,
        snapshot_due_ns=due,
        missing_sensors=settings.sensors,
    )


def check_rigid(model: Model, base_frame: str, rolling_frame: str) -> None:
    """Raise a QueryError if the model lacks one of the two frames, or a joint moves one relative to the other."""
    joints = model.get_kinematic_path(base_frame, rolling_frame).joints
    if joints:
        raise NotConnectedError(
            f"joint {joints[0].name} moves {base_frame} relative to {rolling_frame}; choose frames that are rigidly "
            "fixed to each other"
        )


def handle_rejected(state: CoreState, rejected: messages.Rejected, now: Instant) -> StepResult:
    return count_rejection(state, rejected.channel, rejected.reason, rejected.count), ()


def handle_warning(state: CoreState, warning: messages.HealthWarning, now: Instant) -> StepResult:
    """Set or clear a warning; a health report follows within `CHANGE_PERIOD_NS`."""
    known = state.warnings.get(warning.subject, "")
    if known == warning.text or (not known and len(state.warnings) >= MAX_COUNTERS):
        return state, ()
    warnings = {subject: text for subject, text in state.warnings.items() if subject != warning.subject}
    if warning.text:
        warnings[warning.subject] = warning.text
    return state._replace(warnings=warnings), ()


def count_rejection(state: CoreState, channel: str, reason: str, count: int = 1) -> CoreState:
    """Count one rejection, or `count`, by channel and reason."""
    key = (channel, reason)
    if key not in state.rejected and len(state.rejected) >= MAX_COUNTERS:
        key = ("*", "other")
    counts = dict(state.rejected)
    counts[key] = counts.get(key, 0) + count
    errors = state.handler_errors + count * (reason == "handler")
    return state._replace(rejected=counts, handler_errors=errors)


def count_message(
    traffic: Mapping[str, SourceTraffic], source: str, host_utime: int, now: Instant
) -> Mapping[str, SourceTraffic]:
    """Count a message of a source that the host received at `host_utime` (0 = unknown)."""
    known = traffic.get(source)
    if known is None:
        if len(traffic) >= MAX_COUNTERS:
            return traffic
        known = SourceTraffic()
    count, last_received_ns, interval, delay, *others = known
    if count:
        since = (now.monotonic_ns - last_received_ns) * 1e-9
        # limited, so that a pause does not hide the next ones
        usual = min(since, get_silence_limit(interval)) if interval else since
        interval += (usual - interval) * (INTERVAL_GAIN if count > 1 else 1.0)
    if host_utime:
        latest = (now.utime - host_utime) * 1e-6
        delay = delay if delay >= latest else latest  # also if it is nan
    updated = new_tuple(SourceTraffic, (count + 1, now.monotonic_ns, interval, delay, *others))
    return {**traffic, source: updated}


def count_decision(state: CoreState, decision: messages.Decision) -> CoreState:
    """Count a decision of localization on a measurement for its source."""
    source = f"sensor:{decision.source}"
    known = state.traffic.get(source)
    if known is None or decision.kind in UNCOUNTED_KINDS:
        return state
    is_rejected = decision.verdict is messages.Verdict.REJECTED
    updated = SourceTraffic(
        *known[:7],
        known.measured + 1,
        known.used + (decision.verdict in (messages.Verdict.USED, messages.Verdict.RESET)),
        known.dropped + 1 if is_rejected else 0,
        decision.reason if is_rejected else "",
        *known[11:],
    )
    return CoreState(state.view, state.host_clock, {**state.traffic, source: updated}, *state[3:])


def get_silence_limit(interval: float) -> float:
    return max(MIN_SILENCE_S, SILENT_INTERVALS * interval)


def mark_received(state: CoreState, sample: messages.Sample) -> CoreState:
    """Remove the sensors that a sample may be from from the missing ones."""
    kind, source = type(sample), sample.header.source
    for sensor in state.missing_sensors:
        if sensor.kind is kind and sensor.source in ("", source):
            missing = tuple([each for each in state.missing_sensors if each is not sensor])
            return mark_received(state._replace(missing_sensors=missing), sample)
    return state


# --- the clock of each source -----------------------------------------------------------------------------------------

SAMPLE_FUTURE_LIMIT_S: Final = 0.25
"""A sample stamped this far ahead of the host's clock is rejected: synchronized clocks differ by less, and a fix that
is fused a quarter of a second late is off by what the vehicle travels in that time."""

LATE_LIMIT_S: Final = 12.0
"""A stamp this far behind is not that of a late sample: more than the longest `horizon`, 10 s."""

SPREAD_S: Final = 2.0
"""Within which the offsets of one clock agree, seconds."""

OFF_SAMPLES: Final = 3
"""Samples in a row with one offset until a clock is off: one alone is an outlier."""

ON_TIME_NS: Final = 5_000_000_000
"""How long the others count as on time after their last sample."""

SINCE_START_S: Final = 1e9
"""Seconds since 1970 that no clock has that was ever set: 2001."""

LEAP_S: Final = 18.0
"""GPS time less UTC since 2017."""


def note_offset(
    traffic: Mapping[str, SourceTraffic], source: str, utime: int, now: Instant
) -> Mapping[str, SourceTraffic]:
    """Record by how much a stamp of a source differs from its receipt."""
    known = traffic.get(source)
    if known is None:
        return traffic
    offset = (utime - now.utime) * 1e-6
    if -LATE_LIMIT_S <= offset <= SAMPLE_FUTURE_LIMIT_S:
        updated = (*known[:-2], 0.0, 0)
    else:
        num_off = known.num_off + 1 if abs(offset - known.offset) < SPREAD_S else 1
        updated = (*known[:-2], offset, num_off)
    return {**traffic, source: new_tuple(SourceTraffic, updated)}


def is_clock_off(traffic: Mapping[str, SourceTraffic], source: str, now: Instant) -> bool:
    """Return whether the clock of a source is off: it is ahead of the host's, or behind it while others are on time."""
    known = traffic.get(source)
    if known is None or known.num_off < OFF_SAMPLES:
        return False
    return known.offset > 0.0 or any(
        not each.num_off and name.startswith("sensor:") and now.monotonic_ns - each.last_received_ns < ON_TIME_NS
        for name, each in traffic.items()
    )


def format_offset(offset: float, received_s: float) -> str:
    """Format an offset with what it is known as, e.g. `3,600.0 s (1 h: a time zone?) behind`.

    offset: stamp less receipt, seconds. received_s: time of the receipt, seconds since 1970.
    """
    size, stamp_s = abs(offset), received_s + offset
    hours = round(size / 3600.0)
    known = ""
    if abs(size - LEAP_S) < 0.5:
        known = " (GPS time instead of UTC?)"
    elif 1 <= hours <= 14 and abs(size - 3600.0 * hours) < SPREAD_S:
        known = f" ({hours} h: a time zone?)"
    elif abs(1000.0 * stamp_s / max(received_s, 1.0) - 1.0) < 0.01:
        known = " (milliseconds instead of microseconds?)"
    elif abs(stamp_s / max(1000.0 * received_s, 1.0) - 1.0) < 0.01:
        known = " (nanoseconds instead of microseconds?)"
    elif stamp_s < SINCE_START_S < received_s:
        known = " (from 0 on, as of a simulation, or of a unit since its start?)"
    return f"{size:,.1f} s{known} {'ahead of' if offset > 0.0 else 'behind'}"

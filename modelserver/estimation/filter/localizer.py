"""The filter as a localizer: samples in any order of arrival in, the pose at any instant out.

Read top-down: `FilterLocalizer.process` -> `ClockMonitor.update` -> `Timeline.insert`, `fuse`, `settle` -> `step`.

Timeline: delayed measurements (out-of-sequence). Each item is inserted at its instant, and what follows is fused again
from the state before it, a bounded number of items at a time. Whatever the order of arrival, the final state is that of
one order: instant, source, sequence number. Items older than the horizon are settled: their decisions are final, and
the state before the rest is the base.

Step: one item after another, in the order of their instants, from state to state. `step(setup, state, item)` is a pure
function, and does not depend on the order of arrival.
Read top-down: `step` -> the handlers in `motion_step`, `gnss_step`, `heading_step` and `fusion` -> `eskf`.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple, TypeAlias

from modelserver.earth.geodesy import Geodesy
from modelserver.estimation.filter import (
    eskf,
    fusion,
    gnss_step,
    heading_step,
    leveling,
    motion_step,
    output,
    sensor_monitors,
    warm_start,
)
from modelserver.estimation.filter.fusion import (
    IMU,
    MODE,
    NOTHING,
    STEERING,
    Fused,
    Handler,
    Item,
    fuse_measurement,
    reject,
    report_reset,
    split_sample,
)
from modelserver.estimation.filter.output import Odometry
from modelserver.estimation.filter.state import (
    Aligned,
    Common,
    FilterState,
    GyroBiases,
    Leveling,
    Navigating,
    Setup,
    Unaligned,
    WarmStart,
)
from modelserver.estimation.filter.stream_correlation import StreamCorrelation
from modelserver.estimation.history import LocalizerEvent
from modelserver.estimation.inputs import IMU_RANK, ClockMonitor, StampVerdict
from modelserver.messages import (
    Decision,
    Estimate,
    ImuSample,
    Invalid,
    LocalizerSummary,
    Mode,
    NavigationState,
    Origin,
    PersistedState,
    PersistOrigin,
    RestoredState,
    Sample,
    SensorFinding,
    SwitchMode,
    WheelsSample,
)
from modelserver.named_tuples import new_tuple

ODOM_STEP_US: Final = 15_000
"""Microseconds between two steps of Odom, at least: between them it is extrapolated by its twist."""

ODOM_HORIZON_US: Final = 2_000_000
ODOM_SPACING_US: Final = 20_000
"""How far back poses in Odom are stored, and how close together, microseconds."""

RANKS: Final[Mapping[type, int]] = MappingProxyType({ImuSample: IMU_RANK, WheelsSample: 1})
"""Rank of the clock of each type of sample, see `ClockMonitor`; 0 of all others."""

STEERING_TIMEOUT: Final = 1.0
"""Seconds without a usable steering angle after which that is reported; the wheels are used without it at once."""


class Deferred(NamedTuple):
    """An estimate that is computed when it is read: most of those in the history never are."""

    setup: Setup
    state: FilterState
    odom: Odometry
    utime: int
    newest: int

    def resolve(self) -> Estimate:
        return output.estimate(self.setup, self.state, self.odom, self.utime, self.newest)


class FilterLocalizer(NamedTuple):
    """The filter: an immutable value. Create the first with `start`.

    Attributes
    ----------
    timeline: the measurements within the horizon.
    head: the state that estimates come from: the newest, or while a delayed measurement is being worked in, the one
        before it propagated by the IMU.
    clocks: the stamps of all sources.
    odom, odoms: Odom now, and in the last two seconds.
    is_origin_reported: whether the origin was configured or reported.
    streams: finds sensors whose clocks, axes or signs contradict each other.
    """

    setup: Setup
    timeline: Timeline
    head: FilterState
    clocks: ClockMonitor = ClockMonitor()
    odom: Odometry = Odometry()
    odoms: tuple[Odometry, ...] = ()
    is_origin_reported: bool = False
    streams: StreamCorrelation = StreamCorrelation()

    @classmethod
    def start(
        cls,
        setup: Setup,
        origin: Origin | None = None,
        mode: Mode = Mode.FULL,
        restored: RestoredState | None = None,
    ) -> FilterLocalizer:
        """Return a localizer before its first sample.

        `origin` is the configured or persisted one; None captures it from the first good fixes. `restored` is the state
        of an earlier run, for a warm start. Raises GeodesyError for an invalid origin.
        """
        first = start(mode, None if origin is None else Geodesy(origin), restored)
        return cls(setup, Timeline(first), first, is_origin_reported=origin is not None)

    def start_from(self, last: Estimate, before: Estimate) -> FilterLocalizer:
        """Return the localizer at another one's estimate `last`; `before` is an earlier one, for the velocity.

        Only before the first sample. If the other had no valid pose in the world, this one starts from nothing.
        """
        assert isinstance(self.head, Leveling)
        state = leveling.start_from(self.setup, self.head, last, before)
        if state is None:
            return self
        odom = self.odom.advance(state.nav, self.setup.rig.base, is_stationary=False)
        return self._replace(timeline=Timeline(state), head=state, odom=odom, odoms=(odom,))

    @property
    def utime(self) -> int:
        """The instant of the newest sample processed, 0 before leveling."""
        head = self.head
        if isinstance(head, Leveling):
            return 0
        utime, newest = head.nav.utime, self.clocks.newest
        # a measurement that waits for IMU samples counts as processed
        return newest if newest > utime and self.setup.uses_imu(head.common.mode) else utime

    @property
    def mode(self) -> Mode:
        return self.head.common.mode

    def process(self, sample: Sample | SwitchMode) -> tuple[FilterLocalizer, tuple[LocalizerEvent, ...]]:
        """Return the localizer after a sample, and the events.

        Events are `PersistOrigin`, and a `Decision` for each measurement: at once for a rejected stamp, otherwise when
        the horizon has passed and no delayed measurement can change it any more.
        """
        setup, timeline, head, clocks, odom, odoms, is_origin_reported, streams = self
        items, header = split_sample(setup, sample), sample.header
        if not items:
            return self, ()
        if not streams.is_settled:
            streams = streams.update(setup, head.common.mode, sample)
            if streams is not self.streams:
                self = self._replace(streams=streams)
        first, kind = items[0], type(sample)
        name, rank = (kind.__name__, header.source), RANKS.get(kind, 0)
        clocks, verdict = clocks.update(name, rank, first.utime, header.seq, setup.settings, setup.settings.horizon)
        if verdict is not StampVerdict.GOOD:
            if verdict is not StampVerdict.STEPPED_BACK:
                return self._replace(clocks=clocks), (reject(first, verdict.value),)
            self = self._restart(first.utime)
            timeline, head, odom, odoms, streams = self.timeline, self.head, self.odom, self.odoms, self.streams
        oldest = clocks.newest - setup.horizon_us
        # a command takes effect at once; a measurement waits only for IMU samples that will be used
        waits = setup.uses_imu(head.common.mode) and kind is not SwitchMode
        limit = clocks.get_complete_utime() if waits else clocks.newest
        budget = setup.settings.replay_budget
        events: tuple[LocalizerEvent, ...] = ()
        appended = timeline.append(setup, items, budget, limit, oldest)
        if appended is not None:
            timeline, head, events = appended
        else:
            timeline, events = self._insert(items, oldest)
            if timeline is self.timeline:
                return self._replace(clocks=clocks), events
            again = self.timeline.num_fused - timeline.num_fused
            if again > 0 and rank < IMU_RANK:
                afforded = clocks.spend_replays(name, again)
                if afforded is None:
                    return self._replace(clocks=clocks), (reject(first, "overload"),)
                clocks = afforded
            timeline = timeline.fuse(setup, budget, limit)
            head = timeline.newest if timeline.is_fused(limit) else self._propagate_head(sample, first)
            timeline, decisions = timeline.settle(oldest)
            events += decisions
        if isinstance(head, Leveling):
            odom = odom.stop(odom.utime)
        elif head.nav.utime >= odom.utime + ODOM_STEP_US:
            odom, odoms = self._advance_odom(head)
        if not is_origin_reported and (geodesy := head.common.geodesy) is not None:
            is_origin_reported = True
            events = (*events, PersistOrigin(geodesy.origin))
        found = (setup, timeline, head, clocks, odom, odoms, is_origin_reported, streams)
        return new_tuple(FilterLocalizer, found), events

    def _insert(self, items: list[Item], oldest: int) -> tuple[Timeline, tuple[LocalizerEvent, ...]]:
        """Return the timeline with the items that are neither too old nor duplicates, and the decisions on the rest."""
        timeline, base = self.timeline, self.timeline.base
        # nor before the state that another localizer handed over
        earliest = oldest if isinstance(base, Leveling) else max(oldest, base.nav.utime)
        events: list[LocalizerEvent] = []
        for item in items:
            if item.utime < earliest:
                events.append(reject(item, "too_old"))
                continue
            inserted = timeline.insert(item)
            if isinstance(inserted, str):
                events.append(reject(item, inserted))
                continue
            timeline, replaced = inserted
            if replaced is not None:
                events.append(reject(replaced, "duplicate"))
        return timeline, tuple(events)

    def _propagate_head(self, sample: Sample | SwitchMode, item: Item) -> FilterState:
        """Return the head propagated by an IMU sample alone, while a delayed measurement is being worked in."""
        head = self.head
        if item.kind == IMU and isinstance(sample, ImuSample) and not isinstance(head, Leveling):
            values = sensor_monitors.read_imu(sample, self.setup.mount)
            if not isinstance(values, str) and item.utime > head.nav.utime and self.setup.uses_imu(head.common.mode):
                imu = head.imu._replace(used_utime=item.utime)
                return fusion.propagate_imu(self.setup, head, item.utime, *values, head.stationary, imu)
        return head

    def _advance_odom(self, head: Navigating) -> tuple[Odometry, tuple[Odometry, ...]]:
        """Return Odom at a newer state, and the stored ones."""
        odom, odoms = self.odom, self.odoms
        odom = odom.advance(head.nav, self.setup.rig.base, head.constraints.is_stationary)
        if not odoms or odom.utime - odoms[-1].utime >= ODOM_SPACING_US:
            first = 1 if odoms and odom.utime - odoms[0].utime > ODOM_HORIZON_US else 0
            odoms = (*odoms[first:], odom)
        return odom, odoms

    def _restart(self, utime: int) -> FilterLocalizer:
        """Return the localizer after its clock was set back to `utime`: only Odom, the origin and the biases stay."""
        old = self.head
        common = old.common.restart()._replace(is_clock_stepped=True)
        if not isinstance(old, Leveling):
            P = old.nav.covariance
            sigma = float(max(P[9, 9], P[10, 10], P[11, 11])) ** 0.5
            common = common._replace(gyro_biases=GyroBiases(old.nav.gyro_bias, sigma))
        fresh = Leveling(common)
        return self._replace(
            timeline=Timeline(fresh),
            head=fresh,
            odom=self.odom.stop(utime),
            odoms=(),
            clocks=ClockMonitor(),
            streams=StreamCorrelation(),
        )

    def estimate(self, utime: int) -> Estimate:
        """Return the rolling frame's pose at `utime`: predicted beyond the newest sample, else of the state then."""
        return self.defer_estimate(utime).resolve()

    def defer_estimate(self, utime: int) -> Deferred:
        """Return `estimate(utime)`, computed when it is read; it refers to no more of the past than it needs."""
        state, odom = self.head, self.odom
        if not isinstance(state, Leveling) and utime < state.nav.utime:
            state = self.timeline.get_state_at(utime)
            odom = _get_odom_at(self.odoms, utime, odom)
        return new_tuple(Deferred, (self.setup, state, odom, utime, self.utime))

    def navigation(self, utime: int) -> NavigationState | None:
        """Return the whole state as of the newest sample; None before leveling."""
        head = self.head
        if not isinstance(head, Leveling):
            head = fusion.propagate_covariance(self.setup, head)
        return output.get_navigation_state(self.setup, head)

    def get_state_to_persist(self) -> PersistedState | None:
        """Return the state for the next run; None where it is no better than what was persisted before."""
        head = self.head
        if isinstance(head, Leveling):
            return None
        return warm_start.get_persisted_state(self.setup, head, self.estimate(head.nav.utime).invalid)

    def find_stale_sensors(self, utime: int) -> Invalid:
        """Return the bits of STALE_SENSORS of an estimate at `utime`, which is not before the newest sample."""
        return output.find_stale_sensors(self.setup, self.head, utime)

    def summary(self, utime: int) -> LocalizerSummary:
        """Return mode and phase, whether the vehicle is stationary, when a fix was last used, and the findings."""
        head = self.head
        used_utime = head.gnss.used_utime if isinstance(head, Aligned) else 0
        distance = head.alignment.estimate_distance(self.setup.settings) if isinstance(head, Unaligned) else math.nan
        limits = output.get_limits(self.setup, head) if isinstance(head, Aligned) else (math.nan, math.nan)
        return LocalizerSummary(
            self.mode, head.phase, head.is_stationary, used_utime, self._find_unusable(), distance, *limits
        )

    def _find_unusable(self) -> tuple[SensorFinding, ...]:
        """Return the configured sensors that cannot be used now: by their configuration, or by what they measure."""
        setup, head = self.setup, self.head
        findings = setup.findings[self.mode]
        if isinstance(head, Leveling) and head.tilt:
            if math.isinf(head.tilt):
                text = "its specific force at rest is not gravity: check its units (m/s2) and its axes"
            else:
                off = math.degrees(head.tilt)
                text = f"gravity is {off:.0f} deg off the geometry's up: a wrong mount, or a vehicle on its side"
            fix = "modelserver calibrate imu LOG -c FILE finds the mount that fits"
            findings += (SensorFinding("imu", "gravity", "sensors.imu.frame", text, fix),)
        signal = setup.rig.steering
        if signal is not None and not isinstance(head, Leveling) and self.mode is not Mode.NO_WHEELS:
            age = (head.nav.utime - head.common.wheels.steering.utime) * 1e-6
            if age > max(signal.max_age, STEERING_TIMEOUT):
                text = "no fresh steering angle: the steered wheels are used by the speed of their contact points alone"
                fix = "start the driver of the vehicle controller, and see that it measures steering_angle"
                findings += (SensorFinding("wheels", "steering", "sensors.wheels.steering", text, fix),)
        if head.common.receiver.lacks_velocity:
            text = "the velocity of its fixes is always 0 while the vehicle moves: nobody fills it, and it is not used"
            fix = "fill velocity in its driver, or leave it nan where the receiver measures none"
            findings += (SensorFinding("gps", "unfilled", "sensors.gps", text, fix),)
        has_gyro = (setup.has_imu or setup.yaw_gyro is not None) and self.mode is not Mode.NO_IMU
        findings += self.streams.find_contradictions(has_gyro=has_gyro, has_heading=isinstance(head, Aligned))
        if isinstance(head, Unaligned) and head.alignment.is_direction_unknown:
            text = (
                "the course is known, but not whether the vehicle drives forward or backward: the heading waits until "
                "it brakes, turns or stops, or wheels measure it"
            )
            findings += (SensorFinding("gps", "direction", "sensors.gps", text),)
        return findings


def _get_odom_at(odoms: tuple[Odometry, ...], utime: int, newest: Odometry) -> Odometry:
    """Return the newest stored pose in Odom not newer than an instant, else the oldest."""
    for odom in reversed(odoms):
        if odom.utime <= utime:
            return odom
    return odoms[0] if odoms else newest


# --- timeline -----------------------------------------------------------------------------------------------

MAX_ITEMS: Final = 8192
"""Items within a horizon: more come from a flood, and are rejected."""


class Entry(NamedTuple):
    """An item, the state after it (None: not fused yet), and the decisions on it."""

    item: Item
    state: FilterState | None
    decisions: tuple[Decision, ...]


Key: TypeAlias = tuple[int, str, int, int]


def _get_key(entry: Entry) -> Key:
    return entry.item.key


def _get_order(item: Item) -> tuple[int, str]:
    """Return what orders two items of one source and instant; samples are values, so their repr is complete."""
    return item.seq, repr(item.sample)


class Timeline(NamedTuple):
    """`base` is the state before all `entries`; the first `num_fused` of them are fused."""

    base: FilterState
    entries: tuple[Entry, ...] = ()
    num_fused: int = 0

    @property
    def newest(self) -> FilterState:
        state = self.entries[self.num_fused - 1].state if self.num_fused else self.base
        assert state is not None
        return state

    def is_fused(self, limit: int) -> bool:
        """Return whether everything up to the instant `limit` is fused."""
        return self.num_fused == len(self.entries) or self.entries[self.num_fused].item.utime > limit

    def append(
        self, setup: Setup, items: Sequence[Item], budget: int, limit: int, oldest: int
    ) -> tuple[Timeline, FilterState, tuple[Decision, ...]] | None:
        """Return the timeline with the items of a sample more, all fused and settled, and what follows from it.

        That is its newest state, and the settled decisions. None if the items do not follow all others. The usual case
        of `insert`, `fuse` and `settle`, at a fraction of their cost; `oldest` is the beginning of the horizon.
        """
        base, entries, num_fused = self.base, self.entries, self.num_fused
        first = items[0]
        utime = first.utime
        if not entries or not oldest <= utime <= limit:
            return None
        if len(items) > 1 and any(each.utime != utime for each in items):
            return None
        newest = entries[-1].item
        # one of the same source and instant may be a duplicate
        if utime < newest.utime or (utime == newest.utime and first.source <= newest.source):
            return None
        waiting = len(entries) - num_fused
        if waiting + len(items) > budget:
            return None
        state = self.newest
        fused = []
        for item in (*[entry.item for entry in entries[num_fused:]], *items) if waiting else items:
            state, decisions = step(setup, state, item)
            fused.append(new_tuple(Entry, (item, state, decisions)))
        entries = (*entries[:num_fused], *fused) if waiting else (*entries, *fused)
        # one or two at a time, and never the last one
        cut, settled = 0, NOTHING
        while entries[cut].item.utime < oldest:
            settled += entries[cut].decisions
            cut += 1
        if cut:
            before = entries[cut - 1].state
            assert before is not None
            base, entries = before, entries[cut:]
        return new_tuple(Timeline, (base, entries, len(entries))), state, settled

    def insert(self, item: Item) -> tuple[Timeline, Item | None] | str:
        """Return the timeline with an item more, and the item that it replaces; or in one word why not.

        Of two items of one source and instant the lower sequence number counts, whichever arrived first.
        """
        entries = self.entries
        key = item.key
        if not entries or key > entries[-1].item.key:
            at = len(entries)
        elif len(entries) >= MAX_ITEMS:
            return "overload"
        else:
            at = bisect_left(entries, key, key=_get_key)
        replaced = None
        duplicate = self._find_duplicate(item, at)
        if duplicate is not None:
            replaced = entries[duplicate].item
            if _get_order(replaced) <= _get_order(item):
                return "duplicate"
            entries = entries[:duplicate] + entries[duplicate + 1 :]
        entries = entries[:at] + (Entry(item, None, ()),) + entries[at:]  # noqa: RUF005 - a third faster here
        return Timeline(self.base, entries, min(self.num_fused, at)), replaced

    def _find_duplicate(self, item: Item, at: int) -> int | None:
        """Return the index of the same measurement of the same source and instant; `at` is the item's own index.

        A source measures a thing once at an instant, whatever its numbering; all of that instant are side by side.
        """
        for around in (range(at - 1, -1, -1), range(at, len(self.entries))):
            for n in around:
                other = self.entries[n].item
                if other.utime != item.utime or other.source != item.source:
                    break
                # different types of samples may have the same source name
                if other.part == item.part and type(other.sample) is type(item.sample):
                    return n
        return None

    def fuse(self, setup: Setup, budget: int, limit: int) -> Timeline:
        """Return the timeline with up to `budget` items more fused, none later than the instant `limit`."""
        entries, at = self.entries, self.num_fused
        if self.is_fused(limit):
            return self
        state = self.newest
        fused = []
        for entry in entries[at : at + budget]:
            if entry.item.utime > limit:
                break
            state, decisions = step(setup, state, entry.item)
            fused.append(Entry(entry.item, state, decisions))
        until = at + len(fused)
        return Timeline(self.base, entries[:at] + tuple(fused) + entries[until:], until)

    def settle(self, utime: int) -> tuple[Timeline, tuple[Decision, ...]]:
        """Return the timeline without the fused items older than `utime`, and the decisions on them."""
        entries = self.entries
        cut = 0
        decisions: tuple[Decision, ...] = ()
        # one or two at a time
        while cut < self.num_fused and entries[cut].item.utime < utime:
            decisions += entries[cut].decisions
            cut += 1
        if not cut:
            return self, ()
        state = entries[cut - 1].state
        assert state is not None
        return Timeline(state, entries[cut:], self.num_fused - cut), decisions

    def get_state_at(self, utime: int) -> FilterState:
        """Return the newest fused state not newer than an instant; the base before all."""
        for entry in reversed(self.entries[: self.num_fused]):
            if entry.item.utime <= utime and entry.state is not None:
                found: FilterState = entry.state
                return found
        return self.base


# --- step ---------------------------------------------------------------------------------------------------


def start(mode: Mode, geodesy: Geodesy | None, restored: RestoredState | None = None) -> Leveling:
    """Return the state before the first sample; `restored` is the state of an earlier run, for a warm start."""
    waiting = None if restored is None or restored.state is None else WarmStart(restored)
    return Leveling(Common(mode=mode, geodesy=geodesy, warm_start=waiting))


def step(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state after an item, and the decisions."""
    decisions = NOTHING
    pending = state.common.pending
    if pending and pending[0].utime <= item.utime:
        state, decisions = _apply_pending(setup, state, item.utime)
    state, more = _HANDLERS.get(item.kind, fuse_measurement)(setup, state, item)
    if not isinstance(state, Leveling):
        # the whole check after an update, its cheap part after a propagation
        if not (eskf.is_sound if more else eskf.is_plausible)(state.nav, setup.settings):
            state = Leveling(state.common.restart())
            more = (*more, report_reset(item, "the filter had diverged"))
        elif state.common.warm_start is not None:
            state, steps = warm_start.advance(setup, state, item.utime)
            more = (*more, *steps)
    return state, decisions + more


def _apply_pending(setup: Setup, state: FilterState, utime: int) -> Fused:
    """Return the state with the pending decisions applied that no delayed sample can change any more."""
    decisions = NOTHING
    for each in state.common.pending:
        if each.utime > utime:
            break
        common = state.common._replace(pending=state.common.pending[1:])
        if each.origin is not None:
            common = common._replace(geodesy=Geodesy(each.origin))
        state = state._replace(common=common)
        if each.resets_position and isinstance(state, Aligned) and state.bank is None:
            state = fusion.propagate_covariance(setup, state)
            state, decision = gnss_step.reset_position(setup, state)
            decisions += () if decision is None else (decision,)
    return state, decisions


def _switch_mode(setup: Setup, state: FilterState, item: Item) -> Fused:
    sample = item.sample
    assert isinstance(sample, SwitchMode)
    if not isinstance(state, Leveling):
        state = fusion.advance(setup, state, item.utime)
    state = state._replace(common=state.common._replace(mode=sample.mode))
    return state, (report_reset(item, f"mode {sample.mode.name.lower()}"),)


def _fuse_gnss(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state after a measurement of the receiver.

    It is not used while a driver fills a gap of the IMU: of a unit that measures both, it may have filled that of the
    receiver too, and a straight line between two fixes is off the path by meters in a turn.
    """
    imu, is_imu_used = state.imu, setup.uses_imu(state.common.mode)
    if imu.fills_gap and is_imu_used and (item.utime - imu.used_utime) * 1e-6 <= setup.settings.rate_hold:
        return state, (reject(item, "interpolated"),)
    return _GNSS_HANDLERS[item.kind](setup, state, item)


_GNSS_HANDLERS: dict[str, Handler] = {
    "gps_position": gnss_step.fuse_fix,
    "gps_height": gnss_step.fuse_height,
    "gps_velocity": heading_step.fuse_velocity,
    "gps_baseline": heading_step.fuse_baseline,
}

_HANDLERS: dict[str, Handler] = {
    IMU: motion_step.fuse_imu,
    MODE: _switch_mode,
    STEERING: motion_step.fuse_steering,
    "wheel_speed": motion_step.fuse_wheels,
    **dict.fromkeys(_GNSS_HANDLERS, _fuse_gnss),
    "imu_yaw": heading_step.fuse_imu_yaw,
    "absolute_pose": heading_step.fuse_absolute_pose,
}

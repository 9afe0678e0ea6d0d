"""The filter as a localizer: samples in any order of arrival in, the pose at any instant out.

Read top-down: `FilterLocalizer.process` -> `ClockMonitor.update` -> `Timeline.insert`, `fuse`, `settle` -> `step`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from modelserver.earth.geodesy import Geodesy
from modelserver.estimation.filter import imu_monitor, leveling, output, persistence, propagation
from modelserver.estimation.filter.clock_monitor import IMU_RANK, ClockMonitor, StampVerdict
from modelserver.estimation.filter.fusion import IMU, Item, reject, split_sample
from modelserver.estimation.filter.odometry import Odometry
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import Aligned, FilterState, GyroBiases, Leveling, Navigating, Unaligned
from modelserver.estimation.filter.step import start
from modelserver.estimation.filter.stream_correlation import StreamCorrelation
from modelserver.estimation.filter.timeline import Timeline
from modelserver.estimation.interface import LocalizerEvent
from modelserver.messages import (
    STALE_SENSORS,
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
            values = imu_monitor.read_imu(sample, self.setup.mount)
            if not isinstance(values, str) and item.utime > head.nav.utime and self.setup.uses_imu(head.common.mode):
                imu = head.imu._replace(used_utime=item.utime)
                return propagation.propagate_imu(self.setup, head, item.utime, *values, head.stationary, imu)
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
            head = propagation.propagate_covariance(self.setup, head)
        return output.get_navigation_state(self.setup, head)

    def get_state_to_persist(self) -> PersistedState | None:
        """Return the state for the next run; None where it is no better than what was persisted before."""
        head = self.head
        if isinstance(head, Leveling):
            return None
        return persistence.get_persisted_state(self.setup, head, self.estimate(head.nav.utime).invalid)

    def find_stale_sensors(self, utime: int) -> Invalid:
        """Return the bits of STALE_SENSORS of an estimate at `utime`, which is not before the newest sample."""
        return output.find_invalid(self.setup, self.head, utime) & STALE_SENSORS

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

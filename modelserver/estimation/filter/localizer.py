"""The filter as a localizer: accepts samples in any order of arrival and answers with the pose."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from modelserver.earth.geodesy import Geodesy
from modelserver.estimation.filter import clocks, engine, inertial, motion, persistence, start, world
from modelserver.estimation.filter.clocks import Clocks
from modelserver.estimation.filter.items import INERTIAL, Item, items
from modelserver.estimation.filter.odometry import Odometry
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState, Said
from modelserver.estimation.filter.timeline import Timeline
from modelserver.estimation.interface import LocalizerEvent
from modelserver.messages import (
    STALE_SENSORS,
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
    Phase,
    RestoredState,
    Sample,
    SensorFinding,
    SwitchMode,
    Verdict,
    WheelsSample,
)

ODOM_LEAST_US = 15_000
"""Microseconds between two steps of Odom, at least: between them it goes on by its twist."""

ODOM_KEPT_US = 2_000_000
ODOM_STEP_US = 20_000
"""How far back poses in Odom are kept, and how close together, microseconds."""


STEERING_STALE = 1.0
"""Seconds without a usable steering angle after which that is reported; wheels do without it at once."""


class Deferred(NamedTuple):
    """An estimate that is worked out when it is looked at: most of those held for questions never are."""

    setup: Setup
    state: FilterState
    odom: Odometry
    utime: int
    newest: int

    def resolve(self) -> Estimate:
        """Return the estimate."""
        return world.estimate(self.setup, self.state, self.odom, self.utime, self.newest)


@dataclass(frozen=True, slots=True)
class FilterLocalizer:
    """The filter: an immutable value. Make the first with `start`.

    `timeline` holds what was measured within the horizon. `head` is the state that answers come from: the newest, or
    while one is being worked through anew for a late measurement, the one before it carried forward. `odoms` are the
    last two seconds of Odom.
    """

    setup: Setup
    timeline: Timeline
    head: FilterState
    clocks: Clocks = field(default_factory=Clocks)
    odom: Odometry = field(default_factory=Odometry)
    odoms: tuple[Odometry, ...] = field(default=(), repr=False)
    latched: bool = False

    @classmethod
    def start(
        cls,
        setup: Setup,
        origin: Origin | None = None,
        mode: Mode = Mode.FULL,
        recalled: RestoredState | None = None,
    ) -> FilterLocalizer:
        """Return a localizer that has seen nothing yet.

        `origin` is the configured or persisted one; None captures it from the first good fixes. `recalled` is what an
        earlier run kept, where it may be used. Raises GeodesyError for an origin that is no place.
        """
        first = engine.first(setup, mode, None if origin is None else Geodesy(origin), recalled)
        return cls(setup, Timeline(first), first, latched=origin is not None)

    @property
    def utime(self) -> int:
        """The instant of the newest sample taken, 0 before the first that the state could be carried to."""
        nav = self.head.nav
        if nav is None:
            return 0
        # what waits for inertial samples counts as taken
        return max(nav.utime, self.clocks.newest) if motion.inertial(self.setup, self.mode) else nav.utime

    @property
    def mode(self) -> Mode:
        """Which sources are used."""
        return self.head.mode

    def process(self, sample: Sample | SwitchMode) -> tuple[FilterLocalizer, tuple[LocalizerEvent, ...]]:
        """Return what is concluded with one sample more, and what there is to say about it.

        Notes are `OriginLatched` and a `Decision` for each measurement: at once where its stamp is refused (late,
        order, future, duplicate), else when the horizon has passed and nothing can change it any more.
        """
        setup, header = self.setup, sample.header
        found = items(setup, sample)
        if not found:
            return self, ()
        settings = setup.settings
        name, rank = (type(sample).__name__, header.source), _rank(sample)
        known, verdict = self.clocks.take(name, rank, found[0].utime, header.seq, settings)
        if verdict is clocks.Verdict.STEPPED_BACK:
            self = self._begun_anew(found[0].utime)
        elif verdict is not clocks.Verdict.GOOD:
            return replace(self, clocks=known), (_refused(found[0], verdict.value),)
        oldest = known.newest - round(settings.horizon * 1e6)
        timeline = self.timeline
        begun = timeline.base.nav
        # nor can anything be put before what another localizer handed over
        earliest = oldest if begun is None else max(oldest, begun.utime)
        notes: list[LocalizerEvent] = []
        for item in found:
            if item.utime < earliest:
                notes.append(_refused(item, "too_old"))
                continue
            longer = timeline.with_item(item)
            if isinstance(longer, str):
                notes.append(_refused(item, longer))
                continue
            timeline, out = longer
            if out is not None:
                notes.append(_refused(out, "duplicate"))
        if timeline is self.timeline:
            return replace(self, clocks=known), tuple(notes)
        again = self.timeline.fused - timeline.fused
        if again > 0 and rank < clocks.INERTIAL_RANK:
            afforded = known.with_replay(name, again)
            if afforded is None:
                return replace(self, clocks=known), (_refused(found[0], "overload"),)
            known = afforded
        # an order is obeyed at once, and what was measured waits only for inertial samples that will be used
        waits = motion.inertial(setup, self.mode) and not isinstance(sample, SwitchMode)
        limit = known.complete_to() if waits else known.newest
        timeline = timeline.worked(setup, settings.replay_budget, limit)
        head = timeline.newest if timeline.settled(limit) else self._carried(sample, found[0])
        timeline, decisions = timeline.settled_before(oldest)
        notes += decisions
        odom, odoms = self.odom, self.odoms
        if head.nav is not None and head.nav.utime >= odom.utime + ODOM_LEAST_US:
            odom = odom.advanced(head.nav, setup.rig.base, head.standing)
            if not odoms or odom.utime - odoms[-1].utime >= ODOM_STEP_US:
                odoms = _kept(odoms, odom)
        elif head.nav is None:
            odom = odom.stopped(odom.utime)
        latched = self.latched
        if not latched and head.geodesy is not None:
            latched = True
            notes.append(PersistOrigin(head.geodesy.origin))
        return (
            FilterLocalizer(setup, timeline, head, known, odom, odoms, latched),
            tuple(notes),
        )

    def _carried(self, sample: Sample | SwitchMode, item: Item) -> FilterState:
        """Return the head carried on by an inertial sample alone, while the timeline is not settled."""
        head = self.head
        if item.kind == INERTIAL and isinstance(sample, ImuSample) and head.nav is not None:
            read = inertial.read(self.setup, sample)
            if not isinstance(read, str) and item.utime > head.nav.utime and head.mode is not Mode.NO_IMU:
                rate, force = read
                said = head.said or Said(item.utime, rate, force, item.utime)
                return motion.felt(self.setup, head, item.utime, rate, force, head.stillness, said)
        return head

    def _begun_anew(self, utime: int) -> FilterLocalizer:
        """Return the localizer after its clock was set back to `utime`: only Odom, the origin and the biases stay."""
        old = self.head
        biases = old.biases
        if old.nav is not None:
            P = old.nav.covariance
            biases = (old.nav.gyro_bias, float(max(P[9, 9], P[10, 10], P[11, 11])) ** 0.5)
        fresh = FilterState(
            mode=old.mode,
            geodesy=old.geodesy,
            capture=old.capture,
            epoch=old.epoch + 1,
            biases=biases,
            stepped=True,
        )
        return replace(
            self, timeline=Timeline(fresh), head=fresh, odom=self.odom.stopped(utime), odoms=(), clocks=Clocks()
        )

    def start_from(self, last: Estimate, before: Estimate) -> FilterLocalizer:
        """Return the localizer knowing what another one knew at `last`, and a moment `before` for the speed.

        Only of one that has seen nothing yet. Where the other had no valid pose in the world this one starts alone.
        """
        state = start.start_from(self.setup, self.head, last, before)
        if state is None:
            return self
        assert state.nav is not None
        odom = self.odom.advanced(state.nav, self.setup.rig.base, standing=False)
        return replace(self, timeline=Timeline(state), head=state, odom=odom, odoms=(odom,))

    def estimate(self, utime: int) -> Estimate:
        """Return the rolling frame's pose at `utime`: predicted past the newest sample, else of the state then."""
        return self.defer_estimate(utime).resolve()

    def defer_estimate(self, utime: int) -> Deferred:
        """Return `estimate(utime)`, to be worked out later; it holds no more of the past than it needs."""
        state, odom = self.head, self.odom
        if state.nav is not None and utime < state.nav.utime:
            state = self.timeline.state_at(utime)
            odom = _at(self.odoms, utime, odom)
        return Deferred(self.setup, state, odom, utime, self.utime)

    def navigation(self, utime: int) -> NavigationState | None:
        """Return the whole state as of the newest sample; None before levelling."""
        return world.navigation(self.setup, motion.caught_up(self.setup, self.head))

    def get_state_to_persist(self) -> PersistedState | None:
        """Return what the next run should know; None where it is no better than what was kept before."""
        nav = self.head.nav
        return None if nav is None else persistence.kept(self.setup, self.head, self.estimate(nav.utime).invalid)

    def find_stale_sensors(self, utime: int) -> Invalid:
        """Return what of SILENCE speaks against an estimate at `utime`, which is not before the newest sample."""
        return world.invalid(self.setup, self.head, utime) & STALE_SENSORS

    def summary(self, utime: int) -> LocalizerSummary:
        """Return mode and phase, whether the vehicle stands, and when a fix was last used."""
        head = self.head
        return LocalizerSummary(head.mode, head.phase, head.standing, head.fix_utime, self._findings())

    def _findings(self) -> tuple[SensorFinding, ...]:
        """Return the configured sensors that cannot be used now: by their configuration, or by what they measure."""
        setup, head = self.setup, self.head
        found = setup.findings[head.mode]
        if head.phase is Phase.LEVELING and head.tilt:
            if math.isinf(head.tilt):
                text = "its specific force at rest is no gravity: are its units m/s2, are its axes in order?"
            else:
                off = math.degrees(head.tilt)
                text = f"gravity is {off:.0f} deg off the geometry's up: a wrong mount, or a vehicle on its side"
            fix = "modelserver calibrate imu LOG -c FILE says which mount fits"
            found += (SensorFinding("imu", "gravity", "sensors.imu.frame", text, fix),)
        signal, nav = setup.rig.steering, head.nav
        if signal is not None and nav is not None and head.mode is not Mode.NO_WHEELS:
            age = (nav.utime - head.steering.utime) * 1e-6
            if age > max(signal.max_age, STEERING_STALE):
                text = "no fresh steering angle: the steered wheels are used by the speed of their contact points alone"
                fix = "start the driver of the vehicle controller, and see that it measures steering_angle"
                found += (SensorFinding("wheels", "steering", "sensors.wheels.steering", text, fix),)
        if head.undirected:
            text = (
                "the course is known, and not whether the vehicle drives forward or backward along it: heading waits "
                "until it brakes, turns or stops, or wheels measure it"
            )
            found += (SensorFinding("gps", "direction", "sensors.gps", text),)
        return found


def _rank(sample: Sample | SwitchMode) -> int:
    return clocks.INERTIAL_RANK if isinstance(sample, ImuSample) else 1 if isinstance(sample, WheelsSample) else 0


def _refused(item: Item, reason: str) -> Decision:
    return Decision(item.utime, item.source, item.seq, item.kind, Verdict.REJECTED, reason)


def _kept(odoms: tuple[Odometry, ...], newest: Odometry) -> tuple[Odometry, ...]:
    if odoms and newest.utime - odoms[0].utime > ODOM_KEPT_US:
        return (*odoms[1:], newest)
    return (*odoms, newest)


def _at(odoms: tuple[Odometry, ...], utime: int, newest: Odometry) -> Odometry:
    """Return the pose in Odom kept nearest before an instant, else the oldest."""
    for odom in reversed(odoms):
        if odom.utime <= utime:
            return odom
    return odoms[0] if odoms else newest

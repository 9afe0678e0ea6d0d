"""Mode switch: runs the filter or raw mode, and hands the pose over when the mode changes while running.

Odom continues without a step: the pose of the new localizer's Odom in the published one is composed, and its drift
covariance is added to that reached before (sigmas add up, or variances of a random walk). A switch starts a new pose
epoch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

from modelserver.estimation.filter.localizer import Deferred, FilterLocalizer
from modelserver.estimation.filter.state import Setup
from modelserver.estimation.history import LocalizerEvent
from modelserver.estimation.inputs import FixAlternation, evaluate_fix
from modelserver.estimation.raw.localizer import Heading, RawLocalizer
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.sensor_rig import Mounts
from modelserver.messages import (
    Decision,
    Estimate,
    GpsSample,
    Invalid,
    LocalizerSummary,
    Mode,
    NavigationState,
    Origin,
    PersistedState,
    Rejected,
    RestoredState,
    Sample,
    SensorFinding,
    SwitchMode,
    Verdict,
)
from modelserver.named_tuples import new_tuple
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose

SPEED_SPAN_US = 100_000
"""Microseconds of Odom from which the initial speed of the filter is computed."""


@dataclass(frozen=True, slots=True)
class LocalizerConfig:
    """Configuration of both localizers; `mounts` is None where raw mode lacks a GPS or an inertial unit."""

    setup: Setup
    raw: RawSettings
    mounts: Mounts | None


class ModeLocalizer(NamedTuple):
    """The localizer for all modes, immutable. Create the first with `start`.

    `active` is the filter or raw mode. `X_odom` is the pose of its Odom in the published Odom, `epochs` the number of
    epochs of the localizers before it, and `drift` the 36 numbers of Odom's covariance reached with them. `alternation`
    finds two receivers on one channel, from which no pose is valid.
    """

    config: LocalizerConfig
    active: FilterLocalizer | RawLocalizer
    X_odom: Pose
    epochs: int = 0
    drift: tuple[float, ...] = ()
    alternation: FixAlternation = FixAlternation()

    @classmethod
    def start(
        cls, config: LocalizerConfig, mode: Mode, origin: Origin | None = None, restored: RestoredState | None = None
    ) -> ModeLocalizer:
        """Return the initial localizer; `restored` is the state of an earlier run, for a warm start.

        Raises GeodesyError for an invalid origin, ValueError for raw mode without GPS or inertial unit.
        """
        if mode is Mode.RAW:
            if config.mounts is None:
                raise ValueError("raw mode needs a GPS and an inertial unit")
            return cls(config, RawLocalizer.start(config.mounts, config.raw, origin), Pose.identity())
        return cls(config, FilterLocalizer.start(config.setup, origin, mode, restored), Pose.identity())

    @property
    def utime(self) -> int:
        """The instant of the newest sample processed, 0 before the first."""
        return self.active.utime

    def process(self, sample: Sample | SwitchMode) -> tuple[ModeLocalizer, tuple[LocalizerEvent, ...]]:
        """Return the state after a sample, and the events."""
        config, before, X_odom, epochs, drift, alternation = self
        if isinstance(sample, SwitchMode) and (isinstance(before, RawLocalizer) or sample.mode is Mode.RAW):
            return self._switch_mode(sample)
        active, notes = before.process(sample)
        if isinstance(sample, GpsSample):
            settings = config.raw if isinstance(before, RawLocalizer) else config.setup.settings
            fix = evaluate_fix(sample, settings, True)
            alternation = alternation if isinstance(fix, str) else alternation.add(sample, fix)
        elif active is before:
            return self, notes
        return new_tuple(ModeLocalizer, (config, active, X_odom, epochs, drift, alternation)), notes

    def estimate(self, utime: int) -> Estimate:
        """Return the pose at `utime`, in the Odom published since the start."""
        found = self._continue_odom(self.active.estimate(utime))
        return replace(found, invalid=found.invalid | Invalid.GNSS_INCONSISTENT) if self.has_two_receivers else found

    @property
    def has_two_receivers(self) -> bool:
        """Whether fixes alternate between two places, and are used."""
        is_used = isinstance(self.active, RawLocalizer) or self.active.mode not in (Mode.NO_GPS, Mode.DEAD_RECKONING)
        return bool(self.alternation.distance) and is_used

    def defer_estimate(self, utime: int) -> Estimate | Deferred:
        """Return `estimate(utime)`, deferred until it is read where that saves work."""
        if isinstance(self.active, FilterLocalizer) and not self.epochs and not self.alternation.distance:
            return self.active.defer_estimate(utime)
        return self.estimate(utime)

    def navigation(self, utime: int) -> NavigationState | None:
        """Return the filter's navigation state; None in raw mode."""
        return self.active.navigation(utime)

    def get_state_to_persist(self) -> PersistedState | None:
        """Return the state for the next run; None where it is no better than what was persisted before."""
        return self.active.get_state_to_persist() if isinstance(self.active, FilterLocalizer) else None

    def find_stale_sensors(self, utime: int) -> Invalid:
        return self.active.find_stale_sensors(utime)

    def summary(self, utime: int) -> LocalizerSummary:
        """Return the status of the active localizer."""
        found = self.active.summary(utime)
        if isinstance(self.active, RawLocalizer):
            found = found._replace(findings=self.config.setup.findings[Mode.RAW])
        if self.has_two_receivers:
            apart = (
                f"two receivers on one channel: fixes alternate between places {self.alternation.distance:.1f} m apart"
            )
            fix = "give each receiver a channel of its own, and name one under sensors.gps"
            found = found._replace(
                findings=(*found.findings, SensorFinding("gps", "receivers", "sensors.gps", apart, fix))
            )
        return found

    def _continue_odom(self, estimate: Estimate) -> Estimate:
        if not self.epochs:
            return estimate
        return replace(
            estimate,
            odom=self.X_odom @ estimate.odom,
            odom_covariance=_add_drift(self.drift, estimate),
            pose_epoch=estimate.pose_epoch + self.epochs,
        )

    def _switch_mode(self, command: SwitchMode) -> tuple[ModeLocalizer, tuple[LocalizerEvent, ...]]:
        """Return the localizer with the other mode active, started from the current estimate."""
        raw = isinstance(self.active, RawLocalizer)
        if raw == (command.mode is Mode.RAW):
            return self, ()
        if command.mode is Mode.RAW and self.config.mounts is None:
            return self, (Rejected(f"command:{command.header.source}", "no_raw_mode"),)
        decision = Decision(
            self.active.utime,
            command.header.source,
            command.header.seq,
            "mode",
            Verdict.RESET,
            f"mode {command.mode.name.lower()}",
        )
        return self._restart(self.config, command.mode), (decision,)

    def reconfigure(self, config: LocalizerConfig) -> ModeLocalizer:
        """Return the localizer for a changed vehicle geometry.

        Where nothing that localization uses has moved it continues; else it restarts from the current estimate, in a
        new pose epoch, with Odom continuing without a step.
        """
        old, active = self.config, self.active
        if old.mounts == config.mounts and old.setup.rig.geometry_key() == config.setup.rig.geometry_key():
            if isinstance(active, FilterLocalizer):
                active = active._replace(setup=config.setup)
            return self._replace(config=config, active=active)
        if not active.utime:
            mode = active.mode if isinstance(active, FilterLocalizer) else Mode.RAW
            fresh = ModeLocalizer.start(config, mode, self.estimate(0).origin)
            return fresh._replace(X_odom=self.X_odom, epochs=self.epochs, drift=self.drift)
        return self._restart(config, active.mode if isinstance(active, FilterLocalizer) else Mode.RAW)

    def _restart(self, config: LocalizerConfig, mode: Mode) -> ModeLocalizer:
        """Return the localizer of a mode, started from the current estimate."""
        utime = self.active.utime
        last = self.estimate(utime)
        active: FilterLocalizer | RawLocalizer
        if mode is Mode.RAW:
            assert config.mounts is not None
            active = _start_raw(RawLocalizer.start(config.mounts, config.raw, last.origin), last)
            # raw mode's Odom starts level at its first sample: tilt is the unit's own
            yaw = math.atan2(*_heading_vector(last.odom))
            X_odom = Pose.from_rpy(last.odom.xyz, 0.0, 0.0, yaw)
        else:
            before = self.estimate(utime - SPEED_SPAN_US)
            active = FilterLocalizer.start(config.setup, last.origin, mode).start_from(last, before)
            if active.odom.is_started:
                X_odom = last.odom @ active.odom.pose(utime).inverse()
            else:
                # its Odom will start with the vehicle's tilt and yaw 0
                X_odom = Pose.from_rpy(last.odom.xyz, 0.0, 0.0, math.atan2(*_heading_vector(last.odom)))
        return ModeLocalizer(config, active, X_odom, last.pose_epoch + 1, last.odom_covariance or self.drift)


def _add_drift(drift: tuple[float, ...], estimate: Estimate) -> tuple[float, ...] | None:
    """Return Odom's covariance plus the earlier drift: sigmas add up, or variances of a random walk.

    Tilt does not drift: it is that of the active localizer.
    """
    own = estimate.odom_covariance
    if own is None or not drift:
        return own
    numbers = list(own)
    for place in (0, 7, 14, 35):
        if estimate.is_odom_random_walk:
            numbers[place] = drift[place] + own[place]
        else:
            numbers[place] = (math.sqrt(drift[place]) + math.sqrt(own[place])) ** 2
    return tuple(numbers)


def _heading_vector(pose: Pose) -> tuple[float, float]:
    """Return sine and cosine of a pose's yaw, both times the cosine of its pitch."""
    x, y, _ = so3.rotate(pose.wxyz, (1.0, 0.0, 0.0))
    return y, x


def _start_raw(fresh: RawLocalizer, last: Estimate) -> RawLocalizer:
    """Return raw mode with the heading of the last estimate, where that was valid; its Odom's yaw starts with 0."""
    if last.enu is None or last.covariance is None or last.invalid:
        return fresh
    heading = Heading(
        is_known=True,
        offset=math.atan2(*_heading_vector(last.enu)),
        variance=last.covariance[35],
        bias_variance=fresh.heading.bias_variance,
    )
    return fresh._replace(heading=heading)

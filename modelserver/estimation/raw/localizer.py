"""Raw mode: the pose straight from GPS and IMU, ignoring odometry (report 7.2, C7).

Position is the last good fix, brought to the base frame and carried on by speed along heading; roll and pitch
are the inertial unit's; heading is the GPS course while moving and the gyro's in between. See
docs/raw-mode.md for the equations and the limits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from modelserver.earth.geodesy import Geodesy, geodetic_from_ecef
from modelserver.estimation import fix_quality as gate
from modelserver.estimation.filter.clock_monitor import StampVerdict
from modelserver.estimation.interface import LocalizerEvent
from modelserver.estimation.origin import OriginProjection
from modelserver.estimation.raw import fixes
from modelserver.estimation.raw.fixes import FixMonitor
from modelserver.estimation.raw.heading import Heading
from modelserver.estimation.raw.motion import RawMotion, compute_yaw_rate, correct_up, get_first_up, read_raw_imu
from modelserver.estimation.raw.output import estimate
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.raw.stamps import StampMonitor
from modelserver.estimation.raw.state import RawState
from modelserver.estimation.raw.stationary import QuietDetector
from modelserver.estimation.sensor_rig import Mounts
from modelserver.messages import (
    STALE_SENSORS,
    Estimate,
    GpsSample,
    ImuSample,
    Invalid,
    LocalizerSummary,
    Mode,
    NavigationState,
    Origin,
    PersistOrigin,
    Rejected,
    Sample,
    SwitchMode,
)
from modelserver.transforms.so3 import Vector3

_HISTORY_STEP = 20_000
_HISTORY_LENGTH = 2_000_000
"""Microseconds between the motions kept, and how far back they reach: fixes arrive late."""


@dataclass(frozen=True, slots=True)
class RawLocalizer(RawState):
    """The localizer of raw mode: an immutable value. Make the first with `start`."""

    @classmethod
    def start(cls, mounts: Mounts, settings: RawSettings | None = None, origin: Origin | None = None) -> RawLocalizer:
        """Return a localizer that has seen nothing yet.

        `origin` is the configured or persisted one; None captures it from the first good fixes. Raises
        GeodesyError for an origin that is no place.
        """
        settings = settings or RawSettings()
        return cls(
            mounts,
            settings,
            None if origin is None else OriginProjection(Geodesy(origin)),
            heading=Heading(bias_variance=settings.gyro_bias_sigma**2),
        )

    @property
    def utime(self) -> int:
        """The instant of the newest sample taken, 0 before the first."""
        return self.newest

    def process(self, sample: Sample | SwitchMode) -> tuple[RawLocalizer, tuple[LocalizerEvent, ...]]:
        """Return what is concluded with one sample more, and what there is to say about it.

        Wheels and joints are ignored. Notes are `Rejected("sensor:<source>", reason)` with one of the reasons
        order, duplicate, future (its stamp); nan, range (its numbers); orientation (an inertial unit whose own
        vertical and specific force contradict each other: its orientation reference is wrong, say); gap (an
        inertial sample after a gap: the turn in it is not known); no_fix, satellites, dilution, sigma, jump (a
        fix); course (a fix whose course was not used) and `OriginLatched`.
        """
        if isinstance(sample, ImuSample):
            return self._process_imu(sample)
        if isinstance(sample, GpsSample):
            return self._process_gps(sample)
        return self, ()

    def estimate(self, utime: int) -> Estimate:
        """Return the base frame's pose at `utime`: predicted past the newest sample, held before the oldest kept."""
        return estimate(self, utime)

    def defer_estimate(self, utime: int) -> Estimate:
        """Return `estimate(utime)`, worked out at once: it costs little."""
        return self.estimate(utime)

    def navigation(self, utime: int) -> NavigationState | None:
        """Return None: raw mode has no filter."""
        return None

    def find_stale_sensors(self, utime: int) -> Invalid:
        """Return what of SILENCE speaks against an estimate at `utime`."""
        return self.estimate(utime).invalid & STALE_SENSORS

    def summary(self, utime: int) -> LocalizerSummary:
        """Return whether the vehicle stands, and when a fix was last used."""
        anchor = self.fixes.anchor
        standing = self.quiet.is_stationary(utime, self.settings)
        return LocalizerSummary(Mode.RAW, None, standing, 0 if anchor is None else anchor.utime)

    # --- inertial samples -----------------------------------------------------------------------------------

    def _process_imu(self, sample: ImuSample) -> tuple[RawLocalizer, tuple[LocalizerEvent, ...]]:
        utime, settings = sample.header.utime, self.settings
        stamps, verdict = self.imu_stamps.update(utime, settings)
        if verdict is StampVerdict.STEPPED_BACK:
            self = self._restart(utime, stamps.lost_time)
        elif verdict is not StampVerdict.GOOD:
            return replace(self, imu_stamps=stamps), _reject(sample, verdict.value)
        inertial = read_raw_imu(sample, self.mounts.X_base_imu)
        if isinstance(inertial, str):
            return replace(self, imu_stamps=stamps), _reject(sample, inertial)
        heading, still, before = self.heading, self.quiet, self.motion
        bx, by = self.tilt_bias
        wx, wy, wz = inertial.rate
        rate = (wx - bx, wy - by, wz - heading.bias)
        notes: tuple[LocalizerEvent, ...] = ()
        known_fixes = self.fixes
        if before is None or self.imu_utime is None:
            # the first one: there is nothing to integrate from, but it tells where up is
            if before is None:
                before = RawMotion(utime)
            motion = before.advance(utime, (0.0, 0.0, 0.0), settings)
            heading = heading.propagate((utime - before.utime) * 1e-6, settings, measured=False)
            known_fixes = known_fixes.forget_path()
            up = get_first_up(inertial) or motion.up
        else:
            dt = (utime - self.imu_utime) * 1e-6
            a, b, c = before.rate
            gap = dt > settings.rate_hold
            mean = before.rate if gap else (0.5 * (a + rate[0]), 0.5 * (b + rate[1]), 0.5 * (c + rate[2]))
            motion = before.advance(utime, mean, settings)
            heading = heading.propagate((utime - before.utime) * 1e-6, settings)
            if gap:
                notes = _reject(sample, "gap")
                known_fixes = known_fixes.forget_path()
            speed = motion.speed
            lever = self.mounts.X_base_imu.xyz
            up = inertial.up or motion.up
            if inertial.up is None and inertial.force is not None:
                up = correct_up(up, inertial.force, rate, speed, lever, dt, settings)
            wz_level = compute_yaw_rate(rate, up)
            short = min(dt, settings.rate_hold)
            still = still.update(utime, wz_level, short, math.sqrt(heading.bias_variance), settings)
            if still.is_stationary(utime, settings):
                rest = known_fixes.stationary
                if rest is None or not heading.is_known or rest.is_bias_certain(utime, settings):
                    heading = heading.update_stationary(wz_level, max(settings.gyro_noise**2 / short, still.variance))
                if rest is not None:
                    heading = rest.inflate_heading(utime, short, heading, settings)
                gain = short / (settings.tilt_time + short)
                bx, by = bx + gain * rate[0], by + gain * rate[1]
                if speed:
                    motion = replace(motion, speed=0.0, speed_sigma=0.5 * settings.stationary_speed)
        motion = motion.with_attitude(up, rate)
        return (
            RawLocalizer(
                self.mounts,
                settings,
                self.projection,
                motion,
                _append_motion(self.history, motion),
                heading,
                still,
                (bx, by),
                known_fixes,
                self.capture,
                stamps,
                self.gps_stamps,
                utime,
                self.pose_epoch,
                self.is_clock_stepped,
                max(self.newest, utime),
            ),
            notes,
        )

    # --- fixes ----------------------------------------------------------------------------------------------

    def _process_gps(self, sample: GpsSample) -> tuple[RawLocalizer, tuple[LocalizerEvent, ...]]:
        utime, settings = sample.header.utime, self.settings
        stamps, verdict = self.gps_stamps.update(utime, settings)
        if verdict is StampVerdict.STEPPED_BACK:
            self = self._restart(utime, stamps.lost_time)
        elif verdict is not StampVerdict.GOOD:
            return replace(self, gps_stamps=stamps), _reject(sample, verdict.value)
        fix = gate.evaluate_fix(sample, settings)
        if not isinstance(fix, str) and self.projection is not None and not self.projection.is_in_zone(fix):
            fix = "range"
        if isinstance(fix, str):
            refused = replace(self.fixes, num_rejected=self.fixes.num_rejected + 1)
            return replace(self, gps_stamps=stamps, fixes=refused), _reject(sample, fix)

        motion, heading = self.motion or RawMotion(utime), self.heading
        ahead = (utime - motion.utime) * 1e-6
        if ahead > settings.imu_timeout:
            # no inertial samples: what was predicted so far is what Odom keeps. Samples that merely lag behind
            # the fixes must still find their place, so until then the prediction is for the fix alone
            heading = heading.propagate(ahead, settings)
            ahead = 0.0
            motion = motion.advance(utime, motion.rate, settings)
        then = self.get_motion_at(utime, motion)
        step = fixes.update_fixes(
            self.fixes,
            heading,
            sample,
            fix,
            then,
            self.quiet.is_stationary(utime, settings),
            self.mounts.X_base_antenna.xyz,
            math.nan if self.origin is None else self.origin.height,
            (settings.gap_rate_sigma * max(ahead - settings.rate_hold, 0.0)) ** 2,
            settings,
        )
        notes = _reject(sample, step.rejected) if step.rejected else ()
        result = replace(
            self,
            motion=motion,
            fixes=step.fixes,
            heading=step.heading,
            gps_stamps=stamps,
            pose_epoch=self.pose_epoch + (1 if step.has_jumped else 0),
        )
        if step.rejected == "jump":
            return result, notes
        result, latched = result._set_origin(utime, step.ecef, fix.sigma)
        return (
            replace(
                result,
                motion=replace(motion, speed=step.speed, speed_utime=utime, speed_sigma=step.speed_sigma),
                quiet=replace(self.quiet, is_slow=step.is_slow),
                is_clock_stepped=self.is_clock_stepped and not step.heading.is_known,
                newest=max(self.newest, utime),
            ),
            notes + latched,
        )

    def _set_origin(self, utime: int, ecef: Vector3, sigma: float) -> tuple[RawLocalizer, tuple[LocalizerEvent, ...]]:
        """Return the localizer with the origin set, where it can be, and its axes at the new fix."""
        notes: tuple[LocalizerEvent, ...] = ()
        capture, projected = self.capture, self.projection
        if projected is None:
            capture, origin = capture.add_fix(utime, ecef, sigma, self.settings)
            if origin is not None:
                projected = OriginProjection(Geodesy(origin))
                notes = (PersistOrigin(origin),)
        if projected is not None and self.fixes.work is not None:
            latitude, longitude, _ = geodetic_from_ecef(ecef)
            projected = projected.at(latitude, longitude, self.fixes.work)
        return replace(self, capture=capture, projection=projected), notes

    # --- shared ---------------------------------------------------------------------------------------------

    def _restart(self, utime: int, lost: float) -> RawLocalizer:
        """Return the localizer after its clock was set back: only Odom, the origin and the biases stay.

        How the vehicle moved for the `lost` seconds until that was certain is not known.
        """
        motion = self.motion
        if motion is not None:
            yaw_variance = motion.yaw_variance + (self.settings.gap_rate_sigma * lost) ** 2
            way = max(abs(motion.speed), motion.speed_sigma) * lost
            motion = replace(
                motion,
                utime=utime,
                rate=(0.0, 0.0, 0.0),
                speed=0.0,
                speed_utime=0,
                yaw_variance=min(yaw_variance, 1e3),
                position_variance=min(motion.position_variance + way * way, 1e12),
            )
        return replace(
            self,
            motion=motion,
            history=(),
            heading=Heading(bias=self.heading.bias, bias_variance=self.heading.bias_variance),
            quiet=QuietDetector(),
            fixes=FixMonitor(),
            imu_stamps=StampMonitor(),
            gps_stamps=StampMonitor(),
            imu_utime=None,
            pose_epoch=self.pose_epoch + 1,
            is_clock_stepped=True,
            newest=utime,
        )


def _reject(sample: ImuSample | GpsSample, reason: str) -> tuple[LocalizerEvent, ...]:
    return (Rejected(f"sensor:{sample.header.source}", reason),)


def _append_motion(history: tuple[RawMotion, ...], motion: RawMotion) -> tuple[RawMotion, ...]:
    """Return the history with a motion more, thinned and bounded."""
    if not history:
        return (motion,)
    if motion.utime - history[-1].utime < _HISTORY_STEP:
        return history
    if motion.utime - history[0].utime > _HISTORY_LENGTH:
        oldest = motion.utime - _HISTORY_LENGTH
        first = 1
        while first < len(history) and history[first].utime < oldest:
            first += 1
        return (*history[first:], motion)
    return (*history, motion)

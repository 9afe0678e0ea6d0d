"""Raw mode: the pose directly from GPS and IMU, without odometry (report 7.2, C7).

Position is the last good fix, moved to the base frame by the lever arm and propagated by speed along the heading
(fixes.py, track.py). Roll and pitch are the IMU's, or its gyros' corrected by the specific force (motion.py). Heading
is the course while moving, and the integrated gyro in between (heading.py). A stationary vehicle shows the biases of
the gyros (stationary.py). Equations and limits together: docs/raw-mode.md.

Each sample passes its source's clock monitor (stamps.py) first. An IMU sample propagates motion and heading; a fix
updates position, heading and speed at its own instant, for which two seconds of motion are stored. After a step back
of the clock all but Odom, origin and biases restarts.

Read top-down: `RawLocalizer.process` -> `_process_imu`, `_process_gps` -> `estimate`.
"""

from __future__ import annotations

import math
from typing import Final

from modelserver.earth.geodesy import Geodesy, geodetic_from_ecef
from modelserver.estimation.filter.clock_monitor import StampVerdict
from modelserver.estimation.filter.eskf import ZERO
from modelserver.estimation.fix_quality import evaluate_fix
from modelserver.estimation.interface import LocalizerEvent
from modelserver.estimation.origin import OriginProjection
from modelserver.estimation.raw.fixes import FixInput, FixMonitor, update_fixes
from modelserver.estimation.raw.heading import Heading
from modelserver.estimation.raw.motion import (
    RawImuSample,
    RawMotion,
    compute_yaw_rate,
    correct_up,
    get_first_up,
    read_raw_imu,
)
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

HISTORY_STEP_US: Final = 20_000
HISTORY_LENGTH_US: Final = 2_000_000
"""Microseconds between the motions stored for delayed fixes, and how far back they reach."""


class RawLocalizer(RawState):
    """The localizer of raw mode: an immutable value. Create the first with `start`."""

    __slots__ = ()

    @classmethod
    def start(cls, mounts: Mounts, settings: RawSettings | None = None, origin: Origin | None = None) -> RawLocalizer:
        """Return the initial localizer.

        `origin` is the configured or persisted one; None: the first good fixes give it. Raises GeodesyError for an
        invalid origin.
        """
        settings = settings or RawSettings()
        projection = None if origin is None else OriginProjection(Geodesy(origin))
        return cls(mounts, settings, projection, heading=Heading(bias_variance=settings.gyro_bias_sigma**2))

    @property
    def utime(self) -> int:
        """The instant of the newest sample processed, 0 before the first."""
        return self.newest

    def process(self, sample: Sample | SwitchMode) -> tuple[RawLocalizer, tuple[LocalizerEvent, ...]]:
        """Return the localizer after a sample, and the events; wheels and joints are ignored.

        Events are `PersistOrigin` and `Rejected("sensor:<source>", reason)`. Reasons: out_of_sequence, duplicate,
        future (stamp); nan, range (numbers); orientation (the IMU's vertical contradicts its specific force: a wrong
        orientation reference, for example); gap (IMU sample after a gap: the turn in it is unknown); no_fix,
        satellites, dilution, sigma, jump (fix); course (fix whose course is not used).
        """
        if not isinstance(sample, ImuSample | GpsSample):
            return self, ()
        is_imu = isinstance(sample, ImuSample)
        stamps = self.imu_stamps if is_imu else self.gps_stamps
        stamps, verdict = stamps.update(sample.header.utime, self.settings)
        if verdict is StampVerdict.STEPPED_BACK:
            self = self._restart(sample.header.utime, stamps.lost_time)
        self = self._replace(imu_stamps=stamps) if is_imu else self._replace(gps_stamps=stamps)
        if verdict not in (StampVerdict.GOOD, StampVerdict.STEPPED_BACK):
            return self, _reject(sample, verdict.value)
        return self._process_imu(sample) if isinstance(sample, ImuSample) else self._process_gps(sample)

    def estimate(self, utime: int) -> Estimate:
        """Return the pose of the base frame at an instant: predicted after the newest sample, held before history."""
        return estimate(self, utime)

    def defer_estimate(self, utime: int) -> Estimate:
        """Return `estimate(utime)`, computed at once: it is cheap."""
        return self.estimate(utime)

    def navigation(self, utime: int) -> NavigationState | None:
        """Return None: raw mode has no filter."""
        return None

    def find_stale_sensors(self, utime: int) -> Invalid:
        """Return the bits of STALE_SENSORS of an estimate at an instant."""
        return self.estimate(utime).invalid & STALE_SENSORS

    def summary(self, utime: int) -> LocalizerSummary:
        """Return whether the vehicle is stationary, and when a fix was last used."""
        anchor = self.fixes.anchor
        is_stationary = self.quiet.is_stationary(utime, self.settings)
        return LocalizerSummary(
            Mode.RAW,
            None,
            is_stationary,
            0 if anchor is None else anchor.utime,
            horizontal_limit=self.settings.horizontal_limit,
            heading_limit=self.settings.heading_limit,
        )

    # --- IMU ------------------------------------------------------------------------------------------------

    def _process_imu(self, sample: ImuSample) -> tuple[RawLocalizer, tuple[LocalizerEvent, ...]]:
        utime, settings, before = sample.header.utime, self.settings, self.motion
        imu = read_raw_imu(sample, self.mounts.X_base_imu)
        if isinstance(imu, str):
            return self, _reject(sample, imu)
        (wx, wy, wz), (bx, by) = imu.rate, self.tilt_bias
        rate = (wx - bx, wy - by, wz - self.heading.bias)
        if before is None or self.imu_utime is None:
            return self._start_imu(utime, imu, rate), ()
        dt = (utime - self.imu_utime) * 1e-6
        is_gap = dt > settings.rate_hold
        a, b, c = before.rate
        mean = before.rate if is_gap else (0.5 * (a + rate[0]), 0.5 * (b + rate[1]), 0.5 * (c + rate[2]))
        motion = before.propagate(utime, mean, settings)
        heading = self.heading.propagate((utime - before.utime) * 1e-6, settings)
        fixes = self.fixes.forget_path() if is_gap else self.fixes
        up = imu.up or motion.up
        if imu.up is None and imu.force is not None:
            up = correct_up(up, imu.force, rate, motion.speed, self.mounts.X_base_imu.xyz, dt, settings)
        yaw_rate = compute_yaw_rate(rate, up)
        step = min(dt, settings.rate_hold)
        quiet = self.quiet.update(utime, yaw_rate, step, math.sqrt(heading.bias_variance), settings)
        speed, speed_sigma = motion.speed, motion.speed_sigma
        if quiet.is_stationary(utime, settings):
            place = fixes.stationary
            if place is None or not heading.is_known or place.is_bias_certain(utime, settings):
                heading = heading.update_stationary(yaw_rate, max(settings.gyro_noise**2 / step, quiet.variance))
            if place is not None:
                heading = place.inflate_heading(utime, step, heading, settings)
            gain = step / (settings.tilt_time + step)
            bx, by = bx + gain * rate[0], by + gain * rate[1]
            if speed:
                speed, speed_sigma = 0.0, 0.5 * settings.stationary_speed
        localizer = self._replace(heading=heading, quiet=quiet, tilt_bias=(bx, by), fixes=fixes)
        motion = motion._replace(up=up, rate=rate, speed=speed, speed_sigma=speed_sigma)
        return localizer._with_imu(utime, motion), _reject(sample, "gap") if is_gap else ()

    def _start_imu(self, utime: int, imu: RawImuSample, rate: Vector3) -> RawLocalizer:
        """Return the localizer after a first sample: there is nothing to integrate from, but it gives the vertical."""
        before = self.motion or RawMotion(utime)
        motion = before.propagate(utime, ZERO, self.settings)
        heading = self.heading.propagate((utime - before.utime) * 1e-6, self.settings, measured=False)
        localizer = self._replace(heading=heading, fixes=self.fixes.forget_path())
        return localizer._with_imu(utime, motion._replace(up=get_first_up(imu) or motion.up, rate=rate))

    def _with_imu(self, utime: int, motion: RawMotion) -> RawLocalizer:
        history = _append_motion(self.history, motion)
        return self._replace(motion=motion, history=history, imu_utime=utime, newest=max(self.newest, utime))

    # --- fixes ----------------------------------------------------------------------------------------------

    def _process_gps(self, sample: GpsSample) -> tuple[RawLocalizer, tuple[LocalizerEvent, ...]]:
        utime, settings = sample.header.utime, self.settings
        fix = evaluate_fix(sample, settings)
        if not isinstance(fix, str) and self.projection is not None and not self.projection.is_in_zone(fix):
            fix = "range"
        if isinstance(fix, str):
            fixes = self.fixes._replace(num_rejected=self.fixes.num_rejected + 1)
            return self._replace(fixes=fixes), _reject(sample, fix)
        motion, heading = self.motion or RawMotion(utime), self.heading
        ahead = (utime - motion.utime) * 1e-6
        if ahead > settings.imu_timeout:
            # without IMU samples Odom continues by the prediction. If they are merely delayed they must still be
            # integrated from the last one: until the timeout the prediction is for the fix alone
            heading = heading.propagate(ahead, settings)
            ahead = 0.0
            motion = motion.propagate(utime, motion.rate, settings)
        given = FixInput(
            sample,
            fix,
            self.get_motion_at(utime, motion),
            self.quiet.is_stationary(utime, settings),
            self.mounts.X_base_antenna.xyz,
            math.nan if self.origin is None else self.origin.height,
            (settings.gap_rate_sigma * max(ahead - settings.rate_hold, 0.0)) ** 2,
        )
        step = update_fixes(self.fixes, heading, given, settings)
        events = _reject(sample, step.rejected) if step.rejected else ()
        result = self._replace(
            motion=motion, fixes=step.fixes, heading=step.heading, pose_epoch=self.pose_epoch + int(step.has_jumped)
        )
        if step.rejected == "jump":
            return result, events
        result, captured = result._set_origin(utime, step.ecef, fix.sigma)
        result = result._replace(
            motion=motion._replace(speed=step.speed, speed_utime=utime, speed_sigma=step.speed_sigma),
            quiet=self.quiet._replace(is_slow=step.is_slow),
            is_clock_stepped=self.is_clock_stepped and not step.heading.is_known,
            newest=max(self.newest, utime),
        )
        return result, events + captured

    def _set_origin(self, utime: int, ecef: Vector3, sigma: float) -> tuple[RawLocalizer, tuple[LocalizerEvent, ...]]:
        """Return the localizer with the origin set, if it can be, and its projection at the new fix."""
        events: tuple[LocalizerEvent, ...] = ()
        capture, projection = self.capture, self.projection
        if projection is None:
            capture, origin = capture.add_fix(utime, ecef, sigma, self.settings)
            if origin is not None:
                projection = OriginProjection(Geodesy(origin))
                events = (PersistOrigin(origin),)
        if projection is not None and self.fixes.work is not None:
            latitude, longitude, _ = geodetic_from_ecef(ecef)
            projection = projection.at(latitude, longitude, self.fixes.work)
        return self._replace(capture=capture, projection=projection), events

    # --- clock ----------------------------------------------------------------------------------------------

    def _restart(self, utime: int, lost: float) -> RawLocalizer:
        """Return the localizer after its clock was set back: Odom, origin and biases continue, in a new epoch.

        The motion during the `lost` seconds until the step was confirmed is unknown.
        """
        motion, heading = self.motion, self.heading
        if motion is not None:
            travel = max(abs(motion.speed), motion.speed_sigma) * lost
            motion = motion._replace(
                utime=utime,
                rate=ZERO,
                speed=0.0,
                speed_utime=0,
                yaw_variance=min(motion.yaw_variance + (self.settings.gap_rate_sigma * lost) ** 2, 1e3),
                position_variance=min(motion.position_variance + travel * travel, 1e12),
            )
        return self._replace(
            motion=motion,
            history=(),
            heading=Heading(bias=heading.bias, bias_variance=heading.bias_variance),
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
    """Return the history with a motion more, thinned and limited in length."""
    if not history:
        return (motion,)
    if motion.utime - history[-1].utime < HISTORY_STEP_US:
        return history
    oldest = motion.utime - HISTORY_LENGTH_US
    first = next((n for n, each in enumerate(history) if each.utime >= oldest), len(history))
    return (*history[first:], motion)

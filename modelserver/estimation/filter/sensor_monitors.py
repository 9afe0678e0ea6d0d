"""Monitors of IMU, wheels and mount: what samples so far show of the sensors. Values that know nothing of the state.

IMU monitor: does the IMU measure, or repeat and interpolate numbers?

Noise changes the last digit of every real sample. So a unit that repeats one sample for `frozen_time` is frozen, and
numbers that stay, or change along a straight line in all six components, were made up by a driver that filled a gap.
Three such samples in a row cannot be chance. While they last, the process noise is that of a gap.

A gyro's axis that stays while others change is dead. Two samples of noise s with steps of q are equal by chance with
p = q / (2 sqrt(pi) s), so n in a row with p^n: a unit with coarse steps may repeat a rate for long.

Stationary detector: stationary detection, by IMU and wheels together.

Each alone can be wrong: a stuck encoder reports 0, and a smooth ride looks stationary to the IMU. The IMU is quiet
while the variance of rate and force, about a running mean with time constant AVERAGING_TIME, and the mean rate beyond
its bias are below their limits. Rolling wheels overrule it. Whether a quiet vehicle is stationary also depends on the
state's own speed and on fixes: see `motion_step`.

Wheel monitor: which source of wheels is used, whether it measures the speed now, and the steering angle.

Encoders that are stuck measure no speed, and each sample outside its gate is used with inflated noise: for long enough
they hold the state. So wheels that are stationary while the state is not, by the mean of their NIS, are suspect, and
not used until they measure the speed of a vehicle that is known to move.

Mount monitor: the force that the IMU measures against the acceleration of the wheels.

With the wheels' speed v and the angle psi turned since the start of a window, the velocity changes by
dv = d(v exp(i psi)) over it: by the change of speed and, in turns, by v times the turn rate. The horizontal specific
force adds up to df along the same axes. An IMU that is mounted turned about up by an angle m sees

    df = c dv + noise,      c = exp(i m)                                                                     (1)

The least squares c over many windows, c = sum df dv* / sum |dv|^2, shows m. Its standard deviation is that of the
residuals over the square root of sum |dv|^2. Bias and tilt, about 0.1 m/s2, are noise here: the monitor finds a mount
that is wrong by a large angle, for which the pose may not be used, and is silent about the last few degrees.
"""

from __future__ import annotations

import cmath
import math
from typing import Final, NamedTuple

from modelserver.estimation.filter.eskf import ZERO
from modelserver.estimation.filter.measurements.wheels import TurnRate
from modelserver.estimation.filter.settings import SharedSettings
from modelserver.estimation.sensor_rig import YawGyro
from modelserver.messages import ImuSample
from modelserver.named_tuples import new_tuple
from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3

MAX_RATE: Final = 35.0
"""rad/s: 2000 deg/s, the widest range of gyros on vehicles."""

MAX_FORCE: Final = 500.0
"""m/s2: 50 g, the widest range of accelerometers on vehicles."""

LINE_TOLERANCE: Final = 3e-4
"""Relative difference of two slopes on one line: stamps of whole microseconds, 100 times a second."""

INTERPOLATED_SAMPLES: Final = 3
"""Samples in a row on one line, in all six components, that cannot be chance."""

DEAD_SAMPLES: Final = 10
DEAD_CHANCE: Final = 1e-12
"""Samples in a row in which a gyro's axis is dead, at least: a driver that joins axes of different rates repeats the
slower ones, up to ten times; and the chance that a healthy one repeats its rate: once in three hundred years at 100 Hz.
"""

NO_REPEATS: Final = (0, 0, 0)

SHORTEST_PERIOD: Final = 1e-3
"""Seconds between two samples, at least: no unit measures faster, but stamps may be closer."""


class GyroAxes(NamedTuple):
    """How often each axis of the gyro has repeated its rate, and the smallest step that it has changed by, rad/s."""

    rate: Vector3 = ZERO
    repeats: tuple[int, int, int] = NO_REPEATS
    steps: Vector3 = (math.inf, math.inf, math.inf)

    def update(self, rate: Vector3) -> GyroAxes:
        """Return the axes after a sample, by the unit's own axes; a repeated sample shows nothing."""
        (a, b, c), (x, y, z) = rate, self.rate
        if a == x and b == y and c == z:
            return self
        d, e, f = steps = self.steps
        p, q, r = abs(a - x), abs(b - y), abs(c - z)
        repeats = NO_REPEATS
        if p < d or q < e or r < f:
            n, m, k = self.repeats
            repeats = (0 if p else n + 1, 0 if q else m + 1, 0 if r else k + 1)
            steps = (p if 0.0 < p < d else d, q if 0.0 < q < e else e, r if 0.0 < r < f else f)
        return new_tuple(GyroAxes, (rate, repeats, steps))

    def is_dead(self, noise: float, seconds: float) -> bool:
        """Return whether an axis repeats a rate, as by chance it does not.

        `noise` is that of the gyro, rad/s/sqrt(Hz), `seconds` the sampling period.
        """
        if self.repeats is NO_REPEATS or max(self.repeats) < DEAD_SAMPLES:
            return False
        sigma = noise / math.sqrt(max(seconds, SHORTEST_PERIOD))
        for count, step in zip(self.repeats, self.steps, strict=True):
            chance = step / (2.0 * math.sqrt(math.pi) * sigma)
            if count >= DEAD_SAMPLES and chance < 1.0 and chance**count < DEAD_CHANCE:
                return True
        return False


class ImuMonitor(NamedTuple):
    """The last sample of the IMU, and how its numbers change.

    Attributes
    ----------
    utime: of the last sample; 0: none yet.
    rate, force: its angular rate and specific force along the body axes, rad/s and m/s2.
    changed_utime: the sample since which the numbers have not changed.
    slope: change of the six numbers, per second; empty: unknown, or they have not changed.
    num_collinear: samples in a row that continue exactly along that slope.
    used_utime: the last sample that was used for leveling or propagation.
    is_interpolated: whether the process noise is that of interpolated samples.
    axes: of the gyro, as they are.
    """

    utime: int = 0
    rate: Vector3 = ZERO
    force: Vector3 = ZERO
    changed_utime: int = 0
    slope: tuple[float, ...] = ()
    num_collinear: int = 0
    used_utime: int = 0
    is_interpolated: bool = False
    axes: GyroAxes = GyroAxes()

    def update(self, utime: int, rate: Vector3, force: Vector3, axes: GyroAxes) -> ImuMonitor:
        """Return the monitor after a used sample; the caller sets `used_utime` back if it rejects the sample."""
        before, last_rate, last_force, _, last_slope, num_collinear, _, is_interpolated, _ = self
        if not before:
            return ImuMonitor(utime, rate, force, utime, (), 0, utime, is_interpolated, axes)
        dt = (utime - before) * 1e-6
        if dt <= 0.0:
            return self._replace(used_utime=utime)
        if rate == last_rate and force == last_force:
            count = num_collinear + 1 if not last_slope else 1
            return self._replace(utime=utime, slope=(), num_collinear=count, used_utime=utime, axes=axes)
        (a, b, c), (d, e, f) = last_rate, last_force
        (g, h, i), (j, k, m) = rate, force
        slope = ((g - a) / dt, (h - b) / dt, (i - c) / dt, (j - d) / dt, (k - e) / dt, (m - f) / dt)
        count = 0
        if last_slope:
            for x, y in zip(slope, last_slope, strict=True):
                if abs(x - y) > LINE_TOLERANCE * (0.3 + abs(x) + abs(y)):
                    break
            else:
                count = num_collinear + 1
        return new_tuple(ImuMonitor, (utime, rate, force, utime, slope, count, utime, is_interpolated, axes))

    @property
    def seems_interpolated(self) -> bool:
        """Whether the numbers stay or follow a line, as no noise allows."""
        return self.num_collinear >= INTERPOLATED_SAMPLES

    @property
    def fills_gap(self) -> bool:
        """Whether the numbers follow a line between two real samples: a driver fills a gap."""
        return self.is_interpolated and bool(self.slope)

    def get_frozen_time(self, utime: int) -> float:
        """Return for how long the numbers have not changed, seconds."""
        return (utime - self.changed_utime) * 1e-6


def read_imu(sample: ImuSample, mount: Quaternion) -> tuple[Vector3, Vector3] | str:
    """Return angular rate and specific force along the body axes, rad/s and m/s2; or in one word why not."""
    rate, force = sample.angular_velocity, sample.specific_force
    if force is None and rate is not None:
        return "no_force"
    if rate is None or force is None:
        return "nan"
    (a, b, c), (d, e, f) = rate, force
    # a comparison with nan is false
    if not (
        -MAX_RATE <= a <= MAX_RATE
        and -MAX_RATE <= b <= MAX_RATE
        and -MAX_RATE <= c <= MAX_RATE
        and -MAX_FORCE <= d <= MAX_FORCE
        and -MAX_FORCE <= e <= MAX_FORCE
        and -MAX_FORCE <= f <= MAX_FORCE
    ):
        return "range" if math.isfinite(a + b + c) and math.isfinite(d + e + f) else "nan"
    return so3.rotate(mount, rate), so3.rotate(mount, force)


def read_turn_rate(sample: ImuSample, gyro: YawGyro) -> float | str:
    """Return the turn rate to the left by a gyro that measures nothing else, rad/s; or in one word why not."""
    rate = sample.angular_velocity
    if rate is None or not math.isfinite(rate[gyro.axis]):
        return "nan"
    return rate[gyro.axis] / gyro.share if abs(rate[gyro.axis]) <= MAX_RATE else "range"


# --- stationary detection -----------------------------------------------------------------------------------

AVERAGING_TIME: Final = 0.3
"""Time constant of the running mean and variance, seconds: a few strokes of an idling engine."""

CONFIRMED_RATE: Final = 0.06
"""Largest mean rate beyond the bias, rad/s, of a vehicle whose wheels are stationary: the bias may have changed."""

SURE_US: Final = 10_000_000
LOUD: Final = 9.0
"""Microseconds for which wheels must have been stationary so that an engine may shake the vehicle, and how much more it
may, in variance: wheels that are stuck while it drives are suspect by then."""

WHEELS_TIMEOUT: Final = 1.0
"""Seconds for which a wheel sample counts."""


class StationaryDetector(NamedTuple):
    """Running mean and variance of the IMU, and what the wheels measured last.

    Attributes
    ----------
    utime: of the last IMU sample.
    mean_rate, mean_force: running means, rad/s and m/s2 along the body axes.
    rate_variance, force_variance: about them, summed over the axes, (rad/s)2 and (m/s2)2.
    since: first sample (utime) of the present quiet; 0 while it is not quiet.
    wheels_stationary: None: the wheels do not measure it.
    wheels_utime, wheels_since: of that wheel sample, and of the first since when they have measured so.
    rate_sum: integral of the rate since the quiet began or the mean was last used, rad.
    sum_time: its duration, seconds.
    """

    utime: int = 0
    mean_rate: Vector3 = ZERO
    mean_force: Vector3 = ZERO
    rate_variance: float = math.inf
    force_variance: float = math.inf
    since: int = 0
    wheels_stationary: bool | None = None
    wheels_utime: int = 0
    wheels_since: int = 0
    rate_sum: Vector3 = ZERO
    sum_time: float = 0.0

    def update(
        self,
        utime: int,
        rate: Vector3,
        force: Vector3,
        bias: Vector3,
        bias_sigma: float,
        settings: SharedSettings,
    ) -> StationaryDetector:
        """Return the detector after an IMU sample; `bias` is that of the gyros, with `bias_sigma` on each axis."""
        dt = (utime - self.utime) * 1e-6
        if not self.utime or not 0.0 < dt <= settings.rate_hold:
            return StationaryDetector(
                utime,
                rate,
                force,
                settings.stationary_rate**2 * 9.0,
                settings.stationary_force**2 * 9.0,
                0,
                *self[6:9],
            )
        _, last_mean_rate, last_mean_force, rate_variance, force_variance, since = self[:6]
        are_stationary, wheels_utime, wheels_since = self[6:9]
        gain = dt / (AVERAGING_TIME + dt)
        keep = 1.0 - gain
        (mx, my, mz), (rx, ry, rz) = last_mean_rate, rate
        dx, dy, dz = rx - mx, ry - my, rz - mz
        rate_variance = keep * (rate_variance + gain * (dx * dx + dy * dy + dz * dz))
        mean_rate = ux, uy, uz = (mx + gain * dx, my + gain * dy, mz + gain * dz)
        (fx, fy, fz), (gx, gy, gz) = last_mean_force, force
        ex, ey, ez = gx - fx, gy - fy, gz - fz
        force_variance = keep * (force_variance + gain * (ex * ex + ey * ey + ez * ez))
        mean_force = (fx + gain * ex, fy + gain * ey, fz + gain * ez)
        loudest = 3.0 * settings.stationary_force**2
        is_confirmed = self.is_confirmed_by_wheels(utime)
        if is_confirmed and utime - wheels_since > SURE_US:
            loudest *= LOUD
        is_quiet = rate_variance < 3.0 * settings.stationary_rate**2 and force_variance < loudest
        if is_quiet:
            bx, by, bz = bias
            a, b, c = ux - bx, uy - by, uz - bz
            most = settings.stationary_rate + 4.0 * bias_sigma
            if is_confirmed:
                most = max(most, CONFIRMED_RATE)
            are_rolling = are_stationary is False and (utime - wheels_utime) * 1e-6 < WHEELS_TIMEOUT
            is_quiet = a * a + b * b + c * c < most * most and not are_rolling
        rate_sum, sum_time = ZERO, 0.0
        if is_quiet:
            sx, sy, sz = self.rate_sum
            rate_sum, sum_time = (sx + rx * dt, sy + ry * dt, sz + rz * dt), self.sum_time + dt
        return new_tuple(
            StationaryDetector,
            (
                utime,
                mean_rate,
                mean_force,
                rate_variance,
                force_variance,
                (since or utime) if is_quiet else 0,
                are_stationary,
                wheels_utime,
                wheels_since,
                rate_sum,
                sum_time,
            ),
        )

    def update_wheels(self, utime: int, are_stationary: bool | None) -> StationaryDetector:
        """Return the detector after a wheel sample; None: it does not measure whether the wheels are stationary."""
        if are_stationary is None:
            return self
        if are_stationary:
            since = self.wheels_since if self.is_confirmed_by_wheels(utime) else utime
            return StationaryDetector(*self[:6], True, utime, since, *self[9:])
        return StationaryDetector(*self[:5], 0, False, utime)

    def restart_mean(self) -> StationaryDetector:
        return self._replace(rate_sum=ZERO, sum_time=0.0)

    @property
    def mean_stationary_rate(self) -> Vector3:
        """Mean rate over `sum_time`, rad/s. Only for a `sum_time` above 0."""
        x, y, z = self.rate_sum
        return (x / self.sum_time, y / self.sum_time, z / self.sum_time)

    def is_confirmed_by_wheels(self, utime: int) -> bool:
        return self.wheels_stationary is True and (utime - self.wheels_utime) * 1e-6 < WHEELS_TIMEOUT

    def get_quiet_time(self, utime: int) -> float:
        """Return for how long the IMU has been quiet, seconds."""
        return (utime - self.since) * 1e-6 if self.since else 0.0


# --- wheels -------------------------------------------------------------------------------------------------

SPEED_TIMEOUT_US: Final = 1_000_000
"""Microseconds for which the wheels used last measure the speed of the vehicle."""


SUSPECT_MEAN: Final = 1.0
"""Running mean of the NIS, relative to its gate, beyond which stationary wheels are suspect; usual is 0.1."""

TRUSTED_MEAN: Final = 0.3
"""The same below which the wheels of a vehicle that moves are not."""

GAIN: Final = 0.1
"""Weight of a sample in that mean."""

LARGEST_RATIO: Final = 10.0
"""Largest share of one sample, or one ZUPT, in a mean of NIS relative to the gate."""

RECEIVED: Final = "seen"
"""Kind under which the last wheel sample received is stored as a previous sample, beside the last one compared."""


class SteeringAngle(NamedTuple):
    """The steering angle (rad) that the vehicle controller measured last, at `utime`; nan: it measures none."""

    utime: int = 0
    angle: float = math.nan


class WheelMonitor(NamedTuple):
    """The wheels used last.

    Attributes
    ----------
    source: name of their source: the travel since a sample is that of one source.
    used_utime: last sample that passed its gate; 0: none yet.
    turn_rate: by the wheels, or by the gyro while it measures it.
    steering: of the vehicle controller.
    mean_ratio: running mean of the NIS relative to its gate.
    is_suspect: whether they are stuck.
    has_held: whether a sample was used since the wheels are stationary: where they are stuck, it has held the state.
    """

    source: str = ""
    used_utime: int = 0
    turn_rate: TurnRate = TurnRate(0.0, 0.0)
    steering: SteeringAngle = SteeringAngle()
    mean_ratio: float = 0.0
    is_suspect: bool = False
    has_held: bool = False

    def compare(self, ratio: float, *, is_used: bool, are_stationary: bool, is_moving: bool) -> WheelMonitor:
        """Return the monitor after a sample with a NIS of `ratio` times its gate.

        `is_used`: whether the state was updated with it; `is_moving`: known without it.
        """
        if not are_stationary and not self.is_suspect:
            ratio = 0.0
        mean = self.mean_ratio + GAIN * (min(ratio, LARGEST_RATIO) - self.mean_ratio)
        has_held = are_stationary and (self.has_held or is_used)
        if self.is_suspect:
            measures = is_moving and not are_stationary and mean < TRUSTED_MEAN
            return self._replace(mean_ratio=mean, is_suspect=not measures, has_held=has_held)
        return self._replace(mean_ratio=mean, is_suspect=mean > SUSPECT_MEAN, has_held=has_held)

    def suspect(self) -> WheelMonitor:
        return self._replace(mean_ratio=max(self.mean_ratio, SUSPECT_MEAN), is_suspect=True)

    def measures_speed(self, utime: int) -> bool:
        return not self.is_suspect and self.used_utime > 0 and utime - self.used_utime < SPEED_TIMEOUT_US


# --- mount of the IMU ---------------------------------------------------------------------------------------

WINDOW: Final = 1.0
"""Seconds of a window: accelerations of a vehicle last about as long."""

MAX_GAP: Final = 1.2
"""Seconds between two wheel samples beyond which a window starts again."""

FORGET_TIME: Final = 300.0
"""Seconds in which what was found is forgotten."""

LARGEST_ANGLE: Final = 0.7
"""Angle of the mount, rad, beyond which it is wrong."""

SIGMAS: Final = 4.0
FIRST_SIGMAS: Final = 2.0
"""Standard deviations by which the angle must differ from zero: of a mount that was right before, and at first."""

SMALLEST_FACTOR: Final = 0.25
LARGEST_FACTOR: Final = 1.6
"""Size of c by which a mount is judged: tilt takes up a part of the acceleration."""

LEAST_POWER: Final = 0.3
"""Sum of |dv|^2, (m/s)^2, at least."""

FEWEST: Final = 5.0
"""Windows, at least."""


class MountMonitor(NamedTuple):
    """The window, and the sums over the windows so far.

    Attributes
    ----------
    begin, newest: utime of the first and of the last sample of the window; 0: none.
    speed: by the wheels at its first sample, m/s.
    rate, turned: the newest turn rate, rad/s, and the angle turned since its first sample, rad.
    force, num: sum of the horizontal specific force at its samples, along the vehicle's axes at its start, m/s2, and
        how many.
    product: sum of df times the conjugate of dv, (m/s)^2.
    power, force_power: sums of |dv|^2 and |df|^2.
    windows: how many, as far as they are not forgotten.
    is_confirmed, is_wrong: whether the mount was once seen to be right, and is seen to be another than the geometry's.
    """

    begin: int = 0
    newest: int = 0
    speed: float = 0.0
    rate: float = 0.0
    turned: float = 0.0
    force: complex = 0j
    num: int = 0
    product: complex = 0j
    power: float = 0.0
    force_power: float = 0.0
    windows: float = 0.0
    is_confirmed: bool = False
    is_wrong: bool = False

    def update(self, utime: int, speed: float, rate: float, force: complex) -> MountMonitor:
        """Return the monitor after a wheel sample.

        `speed` forward, m/s, turn rate, rad/s, and horizontal specific force (forward + i left), m/s2.
        """
        dt = (utime - self.newest) * 1e-6
        if not self.begin or not 0.0 < dt < MAX_GAP:
            return self._restart(utime, speed, rate, force)
        turned = self.turned + 0.5 * (self.rate + rate) * dt
        total = self.force + force * cmath.rect(1.0, turned)
        seconds = (utime - self.begin) * 1e-6
        if seconds < WINDOW:
            return self._replace(newest=utime, rate=rate, turned=turned, force=total, num=self.num + 1)
        dv = cmath.rect(speed, turned) - self.speed
        df = total / (self.num + 1) * seconds
        keep = math.exp(-seconds / FORGET_TIME)
        return (
            self._restart(utime, speed, rate, force)
            ._replace(
                product=keep * self.product + df * dv.conjugate(),
                power=keep * self.power + abs(dv) ** 2,
                force_power=keep * self.force_power + abs(df) ** 2,
                windows=keep * self.windows + 1.0,
            )
            ._judge()
        )

    def _restart(self, utime: int, speed: float, rate: float, force: complex) -> MountMonitor:
        return self._replace(begin=utime, newest=utime, speed=speed, rate=rate, turned=0.0, force=force, num=1)

    def find_angle(self) -> tuple[float, float] | None:
        """Return the angle of the mount and its standard deviation, rad; None: the motion so far does not show it."""
        if self.windows < FEWEST or self.power < LEAST_POWER:
            return None
        c = self.product / self.power
        # a force of another size is not that of the motion
        if not SMALLEST_FACTOR < abs(c) < LARGEST_FACTOR:
            return None
        residual = max(self.force_power - abs(self.product) ** 2 / self.power, 0.0)
        return cmath.phase(c), math.sqrt(residual / (self.windows - 1.0) / self.power) / abs(c)

    def _judge(self) -> MountMonitor:
        """Return the monitor with its verdict, which lasts until the motion shows the contrary."""
        found = self.find_angle()
        if found is None:
            return self
        angle, sigma = abs(found[0]), found[1]
        if angle + FIRST_SIGMAS * sigma <= LARGEST_ANGLE:
            return self._replace(is_confirmed=True, is_wrong=False)
        # at first a smaller certainty is enough
        is_wrong = angle > max(LARGEST_ANGLE, (SIGMAS if self.is_confirmed else FIRST_SIGMAS) * sigma)
        return self._replace(is_wrong=self.is_wrong or is_wrong)

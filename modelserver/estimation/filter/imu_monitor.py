"""IMU monitor: does the IMU measure, or repeat and interpolate numbers?

Noise changes the last digit of every real sample. So a unit that repeats one sample for `frozen_time` is frozen, and
numbers that stay, or change along a straight line in all six components, were made up by a driver that filled a gap.
Three such samples in a row cannot be chance. While they last, the process noise is that of a gap.

A gyro's axis that stays while others change is dead. Two samples of noise s with steps of q are equal by chance with
p = q / (2 sqrt(pi) s), so n in a row with p^n: a unit with coarse steps may repeat a rate for long.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from modelserver.estimation.filter.eskf import ZERO
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

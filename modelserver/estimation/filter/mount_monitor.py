"""Mount monitor: the force that the IMU measures against the acceleration of the wheels.

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

"""Wheel monitor: which source of wheels is used, whether it measures the speed now, and the steering angle.

Encoders that are stuck measure no speed, and each sample outside its gate is used with inflated noise: for long enough
they hold the state. So wheels that are stationary while the state is not, by the mean of their NIS, are suspect, and
not used until they measure the speed of a vehicle that is known to move.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from modelserver.estimation.filter.measurements.wheels import TurnRate

SPEED_TIMEOUT_US: Final = 1_000_000
"""Microseconds for which the wheels used last measure the speed of the vehicle."""


SUSPECT_MEAN: Final = 1.0
"""Running mean of the NIS, relative to its gate, beyond which stationary wheels are suspect; usual is 0.1."""

TRUSTED_MEAN: Final = 0.3
"""The same below which the wheels of a vehicle that moves are not."""

GAIN: Final = 0.1
"""Weight of a sample in that mean."""

LARGEST_RATIO: Final = 10.0
"""Largest share of one sample, relative to its gate."""

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

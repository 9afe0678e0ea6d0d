"""Wheel monitor: which source of wheels is used, whether it measures the speed now, and the steering angle."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

SPEED_TIMEOUT_US: Final = 1_000_000
"""Microseconds for which the wheels used last measure the speed of the vehicle."""


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
    turn_rate: by the wheels, rad/s; 0 if a gyro measures it.
    steering: of the vehicle controller.
    """

    source: str = ""
    used_utime: int = 0
    turn_rate: float = 0.0
    steering: SteeringAngle = SteeringAngle()

    def measures_speed(self, utime: int) -> bool:
        """Return whether the wheels measure the speed at an instant."""
        return self.used_utime > 0 and utime - self.used_utime < SPEED_TIMEOUT_US

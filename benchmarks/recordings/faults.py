"""Faults that are injected into the events of a recording, in memory: fixes that are off, and a gyro bias.

A fault begins `BEGIN` after the first fix, by the stamps. Fixes are off along one direction; a velocity of a fix stays,
as with multipath. The gyro bias is about the axis along which the mean specific force until then points up.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from benchmarks.requirements import FAULT, MILD_FAULT, Required
from modelserver.messages import GpsSample, ImuSample
from modelserver.wire.codec import decode, encode
from modelserver.wire.eventlog import LogEvent

BEGIN: Final = 75.0
DRIFT_TIME: Final = 180.0
DIRECTION: Final = (0.6, 0.8)
"""East and north."""
EARTH_RADIUS: Final = 6.37e6


@dataclass(frozen=True)
class RecordingFault:
    """A fault with its bars. `offset`: seconds since it begins, and meters that fixes are off then, 0 after the last.

    `gyro_bias` (rad/s) is added to the turn rate to the left until the end.
    """

    name: str
    required: Required
    offset: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    gyro_bias: float = 0.0

    def __call__(self, events: Iterable[LogEvent]) -> Iterator[LogEvent]:
        """Yield the events with the fault."""
        begin, force = math.inf, np.zeros(3)
        for event in events:
            data = event.data
            if event.channel == "GPS":
                fix: GpsSample = decode("gps_t", data)
                begin = min(begin, fix.header.utime + BEGIN * 1e6)
                data = encode(self._move((fix.header.utime - begin) * 1e-6, fix))
            elif event.channel == "IMU" and self.gyro_bias:
                imu: ImuSample = decode("imu_t", data)
                if imu.header.utime < begin:
                    force += imu.specific_force or (0.0, 0.0, 0.0)
                elif imu.angular_velocity is not None:
                    rate = np.array(imu.angular_velocity) + self.gyro_bias * force / np.linalg.norm(force)
                    data = encode(replace(imu, angular_velocity=tuple(rate.tolist())))
            yield event._replace(data=data)

    def _move(self, since: float, fix: GpsSample) -> GpsSample:
        """Return a fix that is off by the offset of an instant, seconds since the fault began."""
        times, sizes = zip(*self.offset, strict=True)
        east, north = (float(np.interp(since, times, sizes, 0.0, 0.0)) / EARTH_RADIUS * part for part in DIRECTION)
        return replace(
            fix,
            latitude_deg=fix.latitude_deg + math.degrees(north),
            longitude_deg=fix.longitude_deg + math.degrees(east) / math.cos(math.radians(fix.latitude_deg)),
        )


def _drift(name: str, rate: float) -> RecordingFault:
    return RecordingFault(name, FAULT, ((0.0, 0.0), (DRIFT_TIME, rate * DRIFT_TIME)))


FAULTS: Final = (
    _drift("drift_01", 0.1),
    _drift("drift_03", 0.3),
    _drift("drift_05", 0.5),
    RecordingFault("ramp_8m", MILD_FAULT, ((0.0, 0.0), (60.0, 8.0), (120.0, 0.0))),
    RecordingFault("step_10m", MILD_FAULT, ((0.0, 10.0), (60.0, 10.0))),
    RecordingFault("gyro_bias_001", MILD_FAULT, gyro_bias=0.01),
)

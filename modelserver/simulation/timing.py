"""Sampling instants and latency of simulated sensors, and what the sensors of a run share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeAlias

from modelserver.earth.geodesy import Geodesy
from modelserver.messages import SensorHeader
from modelserver.simulation.noise import NoiseSource
from modelserver.simulation.trajectory import MotionModel

Intervals: TypeAlias = tuple[tuple[float, float], ...]
"""Begin and end in seconds since the start."""


def is_within(intervals: Intervals, t: float) -> bool:
    """Return whether an instant lies in one of the intervals [begin, end)."""
    return any(begin <= t < end for begin, end in intervals)


@dataclass(frozen=True, slots=True)
class Timing:
    """Sampling rate, latency from measurement to arrival, and its jitter, seconds.

    Jitter only delays, by the absolute value of a normal number of that standard deviation; samples of one sensor
    arrive in the order of measurement.
    """

    rate_hz: float
    latency: float = 0.0
    jitter: float = 0.0

    def __post_init__(self) -> None:
        if not (0 < self.rate_hz <= 10_000 and self.latency >= 0 and self.jitter >= 0):
            raise ValueError(f"rate_hz must be in (0, 10000], latency and jitter not negative; got {self}")


@dataclass(frozen=True, slots=True)
class Run:
    """What the sensors of a run share. `start_utime` is the instant of the first samples."""

    drive: MotionModel
    geodesy: Geodesy
    start_utime: int
    seed: int

    def noise(self, name: str) -> NoiseSource:
        """Return the random generator of a name, by the run's seed."""
        return NoiseSource(self.seed, name)

    def generate_headers(
        self, timing: Timing, name: str, device_epoch: int | None = None
    ) -> Iterator[tuple[SensorHeader, float]]:
        """Yield the header of each sample of `kind/source` without end, and its instant in seconds since the start.

        `device_epoch` is the utime at which the device's own clock shows 0; None for a second before the start.
        """
        epoch = self.start_utime - 1_000_000 if device_epoch is None else device_epoch
        noise = self.noise(f"{name}/arrival").prefetch()
        source = name.rpartition("/")[2]
        arrived = seq = 0
        while True:
            utime = self.start_utime + round(seq * 1e6 / timing.rate_hz)
            delay = timing.latency + (abs(noise.normal(timing.jitter)) if timing.jitter else 0.0)
            arrived = max(arrived, utime + round(delay * 1e6))
            header = SensorHeader(utime, source, seq, host_utime=arrived, device_utime=utime - epoch, utime_sigma=0.0)
            yield header, (utime - self.start_utime) * 1e-6
            seq += 1

"""Sampling instants and latency of simulated sensors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeAlias

from modelserver.messages import SensorHeader
from modelserver.simulation.noise import NoiseSource

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


def generate_headers(
    timing: Timing, start_utime: int, device_epoch: int, source: str, noise: NoiseSource
) -> Iterator[SensorHeader]:
    """Yield the header of each sample without end; the first is measured at `start_utime`.

    `device_epoch` is the utime at which the device's own clock shows 0.
    """
    arrived = 0
    seq = 0
    noise.prefetch()
    while True:
        utime = start_utime + round(seq * 1e6 / timing.rate_hz)
        delay = timing.latency + (abs(noise.normal(timing.jitter)) if timing.jitter else 0.0)
        arrived = max(arrived, utime + round(delay * 1e6))
        yield SensorHeader(
            utime=utime,
            source=source,
            seq=seq,
            host_utime=arrived,
            device_utime=utime - device_epoch,
            utime_sigma=0.0,
        )
        seq += 1

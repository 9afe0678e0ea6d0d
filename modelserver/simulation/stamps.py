"""When samples are taken, and when they arrive."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeAlias

from modelserver.messages import SensorHeader
from modelserver.simulation.noise import NoiseSource

Intervals: TypeAlias = tuple[tuple[float, float], ...]
"""Seconds since the start, from and to."""


def within(intervals: Intervals, t: float) -> bool:
    """Return whether an instant lies in one of the intervals, whose ends do not belong to them."""
    return any(begin <= t < end for begin, end in intervals)


@dataclass(frozen=True, slots=True)
class Timing:
    """A sensor's pace: samples a second, seconds from measurement to arrival, and how much that varies.

    The variation only delays, by the size of a normal number of standard deviation `jitter`; samples of one
    sensor arrive in the order they were taken.
    """

    rate_hz: float
    latency: float = 0.0
    jitter: float = 0.0

    def __post_init__(self) -> None:
        if not (0 < self.rate_hz <= 10_000 and self.latency >= 0 and self.jitter >= 0):
            raise ValueError(f"a rate is above 0 and at most 10000 Hz, a latency not negative; got {self}")


def headers(
    timing: Timing, start_utime: int, device_epoch: int, source: str, noise: NoiseSource
) -> Iterator[SensorHeader]:
    """Yield the header of each sample, for ever; the first is taken at `start_utime`.

    `device_epoch` is the utime at which the device's own clock shows 0.
    """
    arrived = 0
    seq = 0
    noise.draw_ahead()
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

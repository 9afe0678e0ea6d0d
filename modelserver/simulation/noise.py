"""Errors, sampling instants and latency of simulated sensors, and what the sensors of a run share.

Random numbers come from one generator per source: sensors do not change each other's numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from modelserver.earth.geodesy import Geodesy
from modelserver.messages import SensorHeader
from modelserver.simulation.trajectory import MotionModel
from modelserver.transforms.so3 import Matrix3, Vector3

_BLOCK = 512


class NoiseSource:
    """Random generator of one source: the same seed (not negative) and name give the same numbers."""

    __slots__ = ("_prefetched", "_random")

    def __init__(self, seed: int, name: str):
        self._random = np.random.default_rng([seed, *name.encode()])
        self._prefetched: Iterator[float] | None = None

    def prefetch(self) -> NoiseSource:
        """Draw normal numbers in blocks from now on, and return itself: the same numbers at a fifth of the cost.

        Draws from other distributions would come out of sequence and raise ValueError then.
        """
        self._prefetched = self._blocks()
        return self

    def _blocks(self) -> Iterator[float]:
        while True:
            yield from self._random.standard_normal(_BLOCK).tolist()

    def normal(self, sigma: float = 1.0) -> float:
        if self._prefetched is not None:
            return sigma * next(self._prefetched)
        return sigma * float(self._random.standard_normal())

    def vector(self, sigma: float = 1.0) -> Vector3:
        """Return three normal numbers of standard deviation `sigma`."""
        prefetched = self._prefetched
        if prefetched is not None:
            return (sigma * next(prefetched), sigma * next(prefetched), sigma * next(prefetched))
        x, y, z = self._random.standard_normal(3).tolist()
        return (sigma * x, sigma * y, sigma * z)

    @property
    def generator(self) -> np.random.Generator:
        """Other distributions. Raises ValueError while normal numbers are prefetched."""
        if self._prefetched is not None:
            raise ValueError("this source prefetches normal numbers; use another NoiseSource for other distributions")
        return self._random


class GaussMarkov:
    """First-order Gauss-Markov process: zero mean, `sigma`, correlation exp(-dt / time_constant).

    It starts in its steady state. P. Maybeck, "Stochastic models, estimation, and control", vol. 1, 1979, 4.11.
    """

    __slots__ = ("_decay", "_driving_sigma", "_dt", "_noise", "sigma", "time_constant", "value")

    def __init__(self, sigma: float, time_constant: float, noise: NoiseSource):
        self.sigma = sigma
        self.time_constant = time_constant
        self._noise = noise
        self._dt, self._decay, self._driving_sigma = 0.0, 1.0, 0.0
        self.value = noise.normal(sigma)

    def step(self, dt: float) -> float:
        if dt != self._dt:
            keep = math.exp(-dt / self.time_constant)
            self._dt, self._decay, self._driving_sigma = dt, keep, self.sigma * math.sqrt(1.0 - keep * keep)
        self.value = self._decay * self.value + self._noise.normal(self._driving_sigma)
        return self.value


def quantize(value: float, step: float) -> float:
    """Return the multiple of `step` nearest to `value`; a step of 0 changes nothing."""
    return round(value / step) * step if step > 0 else value


def diagonal_covariance(x: float, y: float, z: float) -> Matrix3:
    """Return the row-major covariance of three independent standard deviations."""
    return (x * x, 0.0, 0.0, 0.0, y * y, 0.0, 0.0, 0.0, z * z)


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

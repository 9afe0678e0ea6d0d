"""Random parts of sensor errors, each from a generator of its own so that sensors do not disturb each other."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from modelserver.spatial.so3 import Vector3

_BLOCK = 512


class NoiseSource:
    """Normally distributed numbers of one source: the same seed and name give the same ones."""

    __slots__ = ("_ahead", "_random")

    def __init__(self, seed: int, name: str):
        """Take the seed of the run, not negative, and the source's name."""
        self._random = np.random.default_rng([seed, *name.encode()])
        self._ahead: Iterator[float] | None = None

    def draw_ahead(self) -> NoiseSource:
        """Return itself, from now on drawing normal numbers many at a time: the same ones at a fifth of the cost.

        Other draws would come out of their order then and are refused.
        """
        self._ahead = self._blocks()
        return self

    def _blocks(self) -> Iterator[float]:
        while True:
            yield from self._random.standard_normal(_BLOCK).tolist()

    def normal(self, sigma: float = 1.0) -> float:
        """Return a number of standard deviation `sigma`."""
        if self._ahead is not None:
            return sigma * next(self._ahead)
        return sigma * float(self._random.standard_normal())

    def vector(self, sigma: float = 1.0) -> Vector3:
        """Return three numbers of standard deviation `sigma`."""
        ahead = self._ahead
        if ahead is not None:
            return (sigma * next(ahead), sigma * next(ahead), sigma * next(ahead))
        x, y, z = self._random.standard_normal(3).tolist()
        return (sigma * x, sigma * y, sigma * z)

    def uniform(self, low: float, high: float) -> float:
        """Return a number between two, all alike likely."""
        return float(self._other().uniform(low, high))

    def chance(self, share: float) -> bool:
        """Return True in that share of the calls."""
        return bool(self._other().random() < share)

    def wait(self, mean: float) -> float:
        """Return an exponentially distributed number: the time to the next of what comes at random."""
        return float(self._other().exponential(mean))

    def hits(self, tries: int, share: float) -> int:
        """Return how many of the tries succeed, each with that share."""
        return int(self._other().binomial(tries, share))

    def index(self, count: int) -> int:
        """Return a whole number from 0 to below `count`, all alike likely."""
        return int(self._other().integers(count))

    def _other(self) -> np.random.Generator:
        if self._ahead is not None:
            raise ValueError("this source draws normal numbers ahead; take another Noise for other ones")
        return self._random


class GaussMarkov:
    """A first-order Gauss-Markov process: zero mean, `sigma`, correlation exp(-dt / time_constant).

    It starts in its steady state. Source: P. Maybeck, "Stochastic models, estimation, and control", vol. 1, 1979, 4.11.
    """

    __slots__ = ("_dt", "_fresh", "_keep", "_noise", "sigma", "time_constant", "value")

    def __init__(self, sigma: float, time_constant: float, noise: NoiseSource):
        self.sigma = sigma
        self.time_constant = time_constant
        self._noise = noise
        self._dt, self._keep, self._fresh = 0.0, 1.0, 0.0
        self.value = noise.normal(sigma)

    def step(self, dt: float) -> float:
        """Return the value `dt` seconds on."""
        if dt != self._dt:
            keep = math.exp(-dt / self.time_constant)
            self._dt, self._keep, self._fresh = dt, keep, self.sigma * math.sqrt(1.0 - keep * keep)
        self.value = self._keep * self.value + self._noise.normal(self._fresh)
        return self.value


def quantised(value: float, step: float) -> float:
    """Return the multiple of `step` nearest to `value`; a step of 0 changes nothing."""
    return round(value / step) * step if step > 0 else value


def diagonal(x: float, y: float, z: float) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return the covariance, row-major, of three independent standard deviations."""
    return (x * x, 0.0, 0.0, 0.0, y * y, 0.0, 0.0, 0.0, z * z)

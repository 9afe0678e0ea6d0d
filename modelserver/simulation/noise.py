"""Random numbers of sensor errors, from one generator per source: sensors do not change each other's numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

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
        """Return a normal number of standard deviation `sigma`."""
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
        """Return the value `dt` seconds later."""
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

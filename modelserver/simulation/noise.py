"""Random parts of sensor errors, each from a generator of its own so that sensors do not disturb each other."""

from __future__ import annotations

import math

import numpy as np

from modelserver.spatial.so3 import Vector3


class Noise:
    """Normally distributed numbers of one source: the same seed and name give the same ones."""

    __slots__ = ("_random",)

    def __init__(self, seed: int, name: str):
        """Take the seed of the run, not negative, and the source's name."""
        self._random = np.random.default_rng([seed, *name.encode()])

    def normal(self, sigma: float = 1.0) -> float:
        """Return a number of standard deviation `sigma`."""
        return sigma * float(self._random.standard_normal())

    def vector(self, sigma: float = 1.0) -> Vector3:
        """Return three numbers of standard deviation `sigma`."""
        x, y, z = self._random.standard_normal(3).tolist()
        return (sigma * x, sigma * y, sigma * z)

    def uniform(self, low: float, high: float) -> float:
        """Return a number between two, all alike likely."""
        return float(self._random.uniform(low, high))


class GaussMarkov:
    """A first-order Gauss-Markov process: zero mean, `sigma`, correlation exp(-dt / time_constant).

    It starts in its steady state. Source: P. Maybeck, "Stochastic models, estimation, and control", vol. 1, 1979, 4.11.
    """

    __slots__ = ("_noise", "sigma", "time_constant", "value")

    def __init__(self, sigma: float, time_constant: float, noise: Noise):
        self.sigma = sigma
        self.time_constant = time_constant
        self._noise = noise
        self.value = noise.normal(sigma)

    def step(self, dt: float) -> float:
        """Return the value `dt` seconds on."""
        keep = math.exp(-dt / self.time_constant)
        self.value = keep * self.value + self._noise.normal(self.sigma * math.sqrt(1.0 - keep * keep))
        return self.value


def quantised(value: float, step: float) -> float:
    """Return the multiple of `step` nearest to `value`; a step of 0 changes nothing."""
    return round(value / step) * step if step > 0 else value


def diagonal(x: float, y: float, z: float) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return the covariance, row-major, of three independent standard deviations."""
    return (x * x, 0.0, 0.0, 0.0, y * y, 0.0, 0.0, 0.0, z * z)

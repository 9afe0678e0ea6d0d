"""Layout of the error state: names and indices of its elements."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from modelserver.transforms.so3 import Array

POSITION, VELOCITY, ATTITUDE, GYRO_BIAS, ACCELEROMETER_BIAS = (slice(n, n + 3) for n in (0, 3, 6, 9, 12))
"""Indices of the strapdown states: errors along the axes of N, biases along the body axes."""

STRAPDOWN: Final = 15
"""Number of the strapdown states; the additional states follow them."""

_STRAPDOWN_NAMES = (
    *("position_east", "position_north", "position_up"),
    *("velocity_east", "velocity_north", "velocity_up"),
    *("attitude_east", "attitude_north", "attitude_up"),
    *("gyro_bias_x", "gyro_bias_y", "gyro_bias_z"),
    *("accelerometer_bias_x", "accelerometer_bias_y", "accelerometer_bias_z"),
)


@dataclass(frozen=True, slots=True)
class ErrorState:
    """An additional state: a parameter that a measurement needs and that is estimated with the strapdown states.

    Attributes
    ----------
    names: one for each number.
    sigma: initial standard deviation of each number.
    walk: density of a random walk, unit per square root of a second.
    time_constant: of a Gauss-Markov process with steady standard deviation `sigma`, seconds; infinite: a random walk.
    """

    names: tuple[str, ...]
    sigma: float
    walk: float = 0.0
    time_constant: float = math.inf


class ErrorLayout:
    """The error vector: the 15 strapdown states, then the additional ones in their order. Immutable."""

    def __init__(self, extras: Iterable[ErrorState] = ()):
        """Lay out the additional states. Raises ValueError for a name that is declared twice."""
        self.extras = tuple(dict.fromkeys(extras))
        self.extra_names = tuple(name for extra in self.extras for name in extra.names)
        self.names = _STRAPDOWN_NAMES + self.extra_names
        self.size = len(self.names)
        twice = {name for name in self.names if self.names.count(name) > 1}
        if twice:
            raise ValueError(f"an error state is declared twice: {min(twice)}")
        self._index = {name: index for index, name in enumerate(self.names)}

    def __contains__(self, name: str) -> bool:
        return name in self._index

    def index(self, name: str) -> int:
        """Return the index of a state. Raises KeyError for one that is not declared."""
        return self._index[name]

    def extra_index(self, name: str) -> int:
        """Return the index of an additional state among the additional ones. Raises KeyError."""
        return self._index[name] - STRAPDOWN

    @cached_property
    def extra_sigmas(self) -> tuple[float, ...]:
        """Initial standard deviation of each additional state."""
        return tuple(extra.sigma for extra in self.extras for _ in extra.names)

    @cached_property
    def decay_rates(self) -> Array:
        """1 / time constant of each additional state, 1/s; 0 for a random walk."""
        rates = [0.0 if math.isinf(e.time_constant) else 1.0 / e.time_constant for e in self.extras for _ in e.names]
        return np.array(rates)

    @cached_property
    def growth_rates(self) -> Array:
        """The decay rates with their sign, -1 / time constant, 1/s."""
        return -self.decay_rates

    @cached_property
    def densities_and_rates(self) -> tuple[tuple[float, float], ...]:
        """Noise density and decay rate of each additional state, as plain numbers."""
        return tuple(zip(self.noise_densities.tolist(), self.decay_rates.tolist(), strict=True))

    @cached_property
    def noise_densities(self) -> Array:
        """Spectral density of the process noise of each additional state, its unit squared per second."""
        found = [
            e.walk**2 if math.isinf(e.time_constant) else 2.0 * e.sigma**2 / e.time_constant
            for e in self.extras
            for _ in e.names
        ]
        return np.array(found)

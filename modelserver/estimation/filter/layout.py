"""Layout of the error state: names and indices of its elements."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modelserver.transforms.so3 import Array

POSITION, VELOCITY, ATTITUDE, GYRO_BIAS, ACCELEROMETER_BIAS = (slice(n, n + 3) for n in (0, 3, 6, 9, 12))
"""Where the strapdown's states stand: errors along the navigation frame's axes, biases along the body's."""

STRAPDOWN = 15

_CORE_NAMES = (
    *("position_east", "position_north", "position_up"),
    *("velocity_east", "velocity_north", "velocity_up"),
    *("attitude_east", "attitude_north", "attitude_up"),
    *("gyro_bias_x", "gyro_bias_y", "gyro_bias_z"),
    *("accelerometer_bias_x", "accelerometer_bias_y", "accelerometer_bias_z"),
)


@dataclass(frozen=True, slots=True)
class ErrorState:
    """A further state beside the strapdown's: what a measurement brings that has to be estimated with it.

    `names` has one for each number. `sigma` is that of each at the start. A random walk drifts by `walk` in the square
    root of a second; with a finite `time_constant` (seconds) it is a Gauss-Markov process of steady sigma `sigma`.
    """

    names: tuple[str, ...]
    sigma: float
    walk: float = 0.0
    time_constant: float = math.inf


class Layout:
    """The error vector: the strapdown's 15 states, then the further ones in their order. Immutable."""

    def __init__(self, extras: Iterable[ErrorState] = ()):
        """Take the further states. Raises ValueError where a name is given twice."""
        self.extras = tuple(dict.fromkeys(extras))
        self.extra_names = tuple(name for extra in self.extras for name in extra.names)
        self.names = _CORE_NAMES + self.extra_names
        self.size = len(self.names)
        twice = {name for name in self.names if self.names.count(name) > 1}
        if twice:
            raise ValueError(f"an error state is declared twice: {min(twice)}")
        self._index = {name: index for index, name in enumerate(self.names)}

    def __contains__(self, name: str) -> bool:
        return name in self._index

    def index(self, name: str) -> int:
        """Return where a state stands. Raises KeyError for one that is not declared."""
        return self._index[name]

    def extra(self, name: str) -> int:
        """Return where a further state stands among the further ones. Raises KeyError."""
        return self._index[name] - STRAPDOWN

    @cached_property
    def extra_sigmas(self) -> tuple[float, ...]:
        """Sigma of each further state at the start."""
        return tuple(extra.sigma for extra in self.extras for _ in extra.names)

    @cached_property
    def decays(self) -> Array:
        """1 / time constant of each further state, 1/s; 0 for a random walk."""
        rates = [0.0 if math.isinf(e.time_constant) else 1.0 / e.time_constant for e in self.extras for _ in e.names]
        return np.array(rates)

    @cached_property
    def drives(self) -> Array:
        """Spectral density that drives each further state, its unit squared a second."""
        found = [
            e.walk**2 if math.isinf(e.time_constant) else 2.0 * e.sigma**2 / e.time_constant
            for e in self.extras
            for _ in e.names
        ]
        return np.array(found)

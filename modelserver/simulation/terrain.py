"""Ground that rises: a plane and a few waves, in closed form with all the derivatives that a vehicle on it feels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

from modelserver.simulation.noise import NoiseSource
from modelserver.spatial.so3 import Vector3


@dataclass(frozen=True, slots=True)
class Wave:
    """A wave of the ground: its height either way in metres, length in metres, where it runs to, where it starts.

    `direction` is radians counter-clockwise from east, `phase` is radians at the origin.
    """

    amplitude: float
    length: float
    direction: float = 0.0
    phase: float = 0.0

    def __post_init__(self) -> None:
        numbers = (self.amplitude, self.length, self.direction, self.phase)
        if not (all(map(math.isfinite, numbers)) and self.length > 0):
            raise ValueError(f"a wave has a length above 0 and finite numbers, got {self}")


class Rise(NamedTuple):
    """The ground under a moving point: height in metres and slopes to east and north, each with two time rates."""

    height: Vector3
    east: Vector3
    north: Vector3


@dataclass(frozen=True, slots=True)
class Terrain:
    """The height of the ground above the tangent plane: z = slope_east x + slope_north y + the waves.

    Slopes are rise over run. The vehicle stands along the slope under its rolling frame: waves shorter than a few
    wheelbases are steeper to it than they would be to a real one.
    """

    slope_east: float = 0.0
    slope_north: float = 0.0
    waves: tuple[Wave, ...] = ()
    _waves: tuple[tuple[float, float, float, float], ...] = field(init=False, repr=False, compare=False)
    """Amplitude, wave numbers to east and north, phase: worked out once, `under` stands in the hot loop."""

    def __post_init__(self) -> None:
        waves = []
        for wave in self.waves:
            k = math.tau / wave.length
            waves.append((wave.amplitude, k * math.cos(wave.direction), k * math.sin(wave.direction), wave.phase))
        object.__setattr__(self, "_waves", tuple(waves))

    @classmethod
    def hills(
        cls, seed: int, steepness: float = 0.05, count: int = 4, lengths: tuple[float, float] = (20.0, 120.0)
    ) -> Terrain:
        """Return waves of random direction, phase and length whose slope has the root mean square `steepness`."""
        noise = NoiseSource(seed, "terrain")
        waves = []
        for _ in range(count):
            length = math.exp(noise.uniform(math.log(lengths[0]), math.log(lengths[1])))
            amplitude = steepness * math.sqrt(2.0 / count) * length / math.tau
            waves.append(Wave(amplitude, length, noise.uniform(-math.pi, math.pi), noise.uniform(-math.pi, math.pi)))
        return cls(waves=tuple(waves))

    def height(self, east: float, north: float) -> float:
        """Return the ground's height in metres at a place given in metres."""
        return self.under((east, north, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)).height[0]

    def under(self, position: Vector3, velocity: Vector3, acceleration: Vector3) -> Rise:
        """Return the ground under a point that moves over the plan; heights in the arguments do not count."""
        x, y, _ = position
        vx, vy, _ = velocity
        ax, ay, _ = acceleration
        se, sn = self.slope_east, self.slope_north
        z0, z1, z2 = se * x + sn * y, se * vx + sn * vy, se * ax + sn * ay
        e0, e1, e2, n0, n1, n2 = se, 0.0, 0.0, sn, 0.0, 0.0
        for amplitude, ke, kn, phase in self._waves:
            # along the point's way a wave is a function of its argument alone, so that the chain rule is short
            u = ke * x + kn * y + phase
            u1, u2 = ke * vx + kn * vy, ke * ax + kn * ay
            sine, cosine = amplitude * math.sin(u), amplitude * math.cos(u)
            first, second = cosine * u1, cosine * u2 - sine * u1 * u1
            bend, bend_rate = -sine * u1, -sine * u2 - cosine * u1 * u1
            z0 += sine
            z1 += first
            z2 += second
            e0 += ke * cosine
            e1 += ke * bend
            e2 += ke * bend_rate
            n0 += kn * cosine
            n1 += kn * bend
            n2 += kn * bend_rate
        return Rise((z0, z1, z2), (e0, e1, e2), (n0, n1, n2))

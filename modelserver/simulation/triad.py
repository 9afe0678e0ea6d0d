"""Errors of three gyros or three accelerometers as data sheets tell them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from modelserver.simulation.noise import GaussMarkov, NoiseSource
from modelserver.spatial.so3 import Vector3

_MOVING = 0.05
"""m/s from which on the vehicle shakes what it carries."""


@dataclass(frozen=True, slots=True)
class TriadModel:
    """Errors beyond white noise and a constant bias, in the unit of the quantity (rad/s or m/s2); 0 for none.

    scale_sigma: of each axis' error of scale, no unit; misalignment_sigma: radians by which each axis leans to each
    other one; both drawn once. instability: standard deviation of the in-run bias, a Gauss-Markov process of
    `instability_time` seconds. walk: how the bias wanders besides, unit/sqrt(s). vibration: standard deviation of
    each sample's shaking while the vehicle moves.
    """

    scale_sigma: float = 0.0
    misalignment_sigma: float = 0.0
    instability: float = 0.0
    instability_time: float = 300.0
    walk: float = 0.0
    vibration: float = 0.0


class Triad:
    """Three axes at work; each `seen` is a sample."""

    __slots__ = ("_drift", "_instability", "_model", "_noise", "_period", "_rows", "_walk")

    def __init__(self, model: TriadModel, rate_hz: float, noise: NoiseSource):
        """Take the model, samples a second, and a source of noise of its own."""
        self._model = model
        self._noise = noise.draw_ahead()
        lean = [noise.vector(model.misalignment_sigma) for _ in range(3)]
        scale = noise.vector(model.scale_sigma)
        self._rows = [tuple(1.0 + scale[i] if i == j else lean[i][j] for j in range(3)) for i in range(3)]
        self._instability = [GaussMarkov(model.instability, model.instability_time, noise) for _ in range(3)]
        self._walk = (0.0, 0.0, 0.0)
        self._drift = model.walk / math.sqrt(rate_hz)
        self._period = 1.0 / rate_hz

    def seen(self, true: Vector3, speed: float) -> Vector3:
        """Return what the axes make of the true vector while the vehicle goes at `speed` m/s."""
        x, y, z = true
        a, b, c = self._rows
        dx, dy, dz = self._walk
        if self._drift:
            wx, wy, wz = self._noise.vector(self._drift)
            self._walk = dx, dy, dz = (dx + wx, dy + wy, dz + wz)
        if self._model.instability:
            one, two, three = self._instability
            dt = self._period
            dx, dy, dz = dx + one.step(dt), dy + two.step(dt), dz + three.step(dt)
        if self._model.vibration and abs(speed) > _MOVING:
            wx, wy, wz = self._noise.vector(self._model.vibration)
            dx, dy, dz = dx + wx, dy + wy, dz + wz
        return (
            a[0] * x + a[1] * y + a[2] * z + dx,
            b[0] * x + b[1] * y + b[2] * z + dy,
            c[0] * x + c[1] * y + c[2] * z + dz,
        )

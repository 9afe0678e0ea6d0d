"""One wheel's encoder: pulses counted, and what goes wrong with them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from modelserver.messages import NAN, Direction, WheelSample
from modelserver.simulation.noise import NoiseSource, quantised


@dataclass(frozen=True, slots=True)
class EncoderModel:
    """What goes wrong with the wheels and their encoders; by default nothing.

    burst_rate: how often a second each wheel, for itself, starts to spin; burst_seconds: for how long;
    burst_excess: by which share it turns too much then. missed: share of pulses that are not counted, for encoders
    with a `travel_step`. stuck: names of wheels, and seconds from which on no pulse comes from them. swapped: wheels
    that count backward when they roll forward. speed_from_travel: speed is pulses counted since the last sample over
    the time between. tells_travel, tells_speed: what is not told is nan.
    """

    burst_rate: float = 0.0
    burst_seconds: float = 1.0
    burst_excess: float = 0.5
    missed: float = 0.0
    stuck: tuple[tuple[str, float], ...] = ()
    swapped: frozenset[str] = frozenset()
    speed_from_travel: bool = False
    tells_travel: bool = True
    tells_speed: bool = True


class Encoder:
    """An encoder at work: each `sample` follows the last."""

    def __init__(
        self,
        model: EncoderModel,
        name: str,
        *,
        scale: float,
        travel_step: float,
        speed_sigma: float,
        standstill: float,
        noise: NoiseSource,
        faults: NoiseSource,
    ):
        """Take the model, the wheel's name, its measures as in `WheelsModel`, and where chance comes from.

        `scale` is what the wheel shows for each metre. `noise` is shared by the wheels, `faults` this one's own.
        """
        self._model = model
        self._name = name
        self._scale = scale
        self._step = travel_step
        self._noise_sigma = speed_sigma
        self._standstill = standstill
        self._noise = noise
        self._faults = faults
        self._stuck_from = min((t for wheel, t in model.stuck if wheel == name), default=math.inf)
        self._sign = -1.0 if name in model.swapped else 1.0
        self._travel_sigma = max(travel_step / math.sqrt(12.0), 1e-4) if model.tells_travel else NAN
        self._speed_sigma = max(speed_sigma, 1e-4) if model.tells_speed else NAN
        self._turned = 0.0
        self._counted = 0.0
        self._pulses = 0
        self._t = 0.0
        self._burst = faults.wait(1.0 / model.burst_rate) if model.burst_rate else math.inf

    def sample(self, t: float, rolled: float, speed: float, excess: float, steering: float) -> WheelSample:
        """Return what the encoder says at `t` seconds.

        `rolled` metres since the last sample and `speed` are those of the wheel over ground; it turns by the factor
        `excess` more. `steering` is passed on.
        """
        model = self._model
        seen = self._scale * excess
        if self._spins(t):
            seen *= 1.0 + model.burst_excess
        error = self._noise.normal(self._noise_sigma) if abs(speed) > self._standstill else 0.0
        measured = speed * seen + error
        stuck = t >= self._stuck_from
        if stuck:
            measured = speed = 0.0
        else:
            self._turned += rolled * seen
        travel = self._count() if model.missed and self._step else quantised(self._turned, self._step)
        if model.speed_from_travel:
            measured = (travel - self._counted) / (t - self._t) if t > self._t else 0.0
            speed = measured
        self._counted, self._t = travel, t
        sign = self._sign
        return WheelSample(
            self._name,
            travel=sign * travel if model.tells_travel else NAN,
            travel_sigma=self._travel_sigma,
            speed=sign * measured if model.tells_speed else NAN,
            speed_sigma=self._speed_sigma,
            direction=_direction(sign * speed, self._standstill),
            steering=steering,
        )

    def _spins(self, t: float) -> bool:
        while t >= self._burst + self._model.burst_seconds:
            self._burst += self._model.burst_seconds + self._faults.wait(1.0 / self._model.burst_rate)
        return t >= self._burst

    def _count(self) -> float:
        """Return the way of the pulses that were counted."""
        pulses = round(self._turned / self._step)
        new = pulses - self._pulses
        self._pulses = pulses
        counted = abs(new) - self._faults.hits(abs(new), self._model.missed)
        return self._counted + math.copysign(counted, new) * self._step


def _direction(speed: float, standstill: float) -> Direction:
    if abs(speed) <= standstill:
        return Direction.STOPPED
    return Direction.FORWARD if speed > 0 else Direction.BACKWARD

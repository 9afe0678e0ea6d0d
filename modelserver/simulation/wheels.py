"""Wheel encoders: way rolled, speed and direction of each wheel at its contact point."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from modelserver.messages import Direction, WheelSample, WheelsSample
from modelserver.simulation.noise import Noise, quantised
from modelserver.simulation.stamps import Timing, headers
from modelserver.simulation.trajectory import Motion, Trajectory
from modelserver.spatial.so3 import Vector3

_GRAVITY = 9.81
_NODES = ((0.5 - math.sqrt(0.15), 5.0 / 18.0), (0.5, 8.0 / 18.0), (0.5 + math.sqrt(0.15), 5.0 / 18.0))
"""Gauss-Legendre on [0, 1]."""


_TIMING = Timing(20.0, latency=0.01, jitter=0.002)
_PROMPT = Timing(20.0)


@dataclass(frozen=True, slots=True)
class WheelsModel:
    """How good the encoders are, and which wheels steer. Metres, m/s.

    scale_sigma: of each wheel's error of scale, drawn once (tyre pressure, load). speed_sigma: of the speed's
    noise. travel_step: way from one pulse to the next, 0 for none. slip: share that a wheel turns too much when
    the vehicle accelerates forward with 1 g, or turns with 1 g. standstill: below this speed an encoder sees no
    turning. steered: names of wheels that turn into the direction in which their contact point moves; the others
    roll straight ahead.
    """

    timing: Timing = _TIMING
    scale_sigma: float = 0.01
    speed_sigma: float = 0.02
    travel_step: float = 0.01
    slip: float = 0.0
    standstill: float = 0.02
    steered: frozenset[str] = frozenset()

    @classmethod
    def noise_free(cls, timing: Timing = _PROMPT, steered: frozenset[str] = frozenset()) -> WheelsModel:
        """Return encoders without error."""
        return cls(timing, scale_sigma=0.0, speed_sigma=0.0, travel_step=0.0, steered=steered)


def turns(
    model: WheelsModel,
    trajectory: Trajectory,
    contacts: Mapping[str, Vector3],
    start_utime: int,
    seed: int,
    source: str,
) -> Iterator[WheelsSample]:
    """Yield the samples, for ever. `contacts` has each wheel's contact point in the vehicle's moving frame."""
    noise = Noise(seed, f"wheels/{source}")
    scales = {name: 1.0 + noise.normal(model.scale_sigma) for name in contacts}
    travels = dict.fromkeys(contacts, 0.0)
    speed_sigma = max(model.speed_sigma, 1e-4)
    travel_sigma = max(model.travel_step / math.sqrt(12.0), 1e-4)
    stamps = headers(
        model.timing, start_utime, start_utime - 1_000_000, source, Noise(seed, f"wheels/{source}/arrival")
    )
    before = trajectory.at(0.0)
    t_before = 0.0
    for header in stamps:
        t = (header.utime - start_utime) * 1e-6
        motion = trajectory.at(t)
        # the steered wheels' way has no closed form
        between = (
            [(trajectory.at(t_before + u * (t - t_before)), weight) for u, weight in _NODES] if model.steered else []
        )
        excess = 1.0 + model.slip * _push(motion) / _GRAVITY
        wheels = []
        for name, contact in contacts.items():
            steered = name in model.steered
            if steered:
                rolled = (t - t_before) * sum(weight * _steered_speed(each, contact) for each, weight in between)
                speed = _steered_speed(motion, contact)
                steering = math.atan2(motion.curvature * contact[0], 1.0 - motion.curvature * contact[1])
            else:
                rolled = (motion.way - before.way) - contact[1] * (motion.yaw - before.yaw)
                speed = motion.speed - contact[1] * motion.yaw_rate
                steering = 0.0
            seen = scales[name] * excess
            travels[name] += rolled * seen
            measured = speed * seen + (noise.normal(model.speed_sigma) if abs(speed) > model.standstill else 0.0)
            wheels.append(
                WheelSample(
                    name,
                    travel=quantised(travels[name], model.travel_step),
                    travel_sigma=travel_sigma,
                    speed=measured,
                    speed_sigma=speed_sigma,
                    direction=_direction(speed, model.standstill),
                    steering=steering,
                )
            )
        before, t_before = motion, t
        yield WheelsSample(header, tuple(wheels))


def _steered_speed(motion: Motion, contact: Vector3) -> float:
    """Return the speed of a contact point along the direction it moves in, negative when backing up."""
    k = motion.curvature
    return motion.speed * math.hypot(1.0 - k * contact[1], k * contact[0])


def _push(motion: Motion) -> float:
    """Return how hard the tyres push, m/s2: speeding up makes wheels turn too much, braking too little."""
    along = math.copysign(1.0, motion.speed) * motion.forward_acceleration
    return along + abs(motion.speed * motion.yaw_rate)


def _direction(speed: float, standstill: float) -> Direction:
    if abs(speed) <= standstill:
        return Direction.STOPPED
    return Direction.FORWARD if speed > 0 else Direction.BACKWARD

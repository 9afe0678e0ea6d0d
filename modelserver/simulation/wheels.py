"""Wheel encoders: way rolled, speed and direction of each wheel at its contact point; and the vehicle controller."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from modelserver.messages import VehicleMode, VehicleStatusSample, WheelsSample
from modelserver.simulation.encoder import Encoder, EncoderModel
from modelserver.simulation.noise import NoiseSource
from modelserver.simulation.stamps import Timing, headers
from modelserver.simulation.trajectory import MotionModel, Trajectory, TrajectoryMotion
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

    track_factor: over 1 for a vehicle that steers by the difference of its sides' speeds and skids: that difference
    is yaw rate times track times this (1.5 to 2); steered wheels do not skid so. unstated_latency: seconds by which
    a sample is older than its utime says. encoder: faults of the encoders.
    """

    timing: Timing = _TIMING
    scale_sigma: float = 0.01
    speed_sigma: float = 0.02
    travel_step: float = 0.01
    slip: float = 0.0
    standstill: float = 0.02
    steered: frozenset[str] = frozenset()
    track_factor: float = 1.0
    unstated_latency: float = 0.0
    encoder: EncoderModel = field(default_factory=EncoderModel)

    @classmethod
    def noise_free(cls, timing: Timing = _PROMPT, steered: frozenset[str] = frozenset()) -> WheelsModel:
        """Return encoders without error."""
        return cls(timing, scale_sigma=0.0, speed_sigma=0.0, travel_step=0.0, steered=steered)


def turns(
    model: WheelsModel,
    drive: MotionModel,
    contacts: Mapping[str, Vector3],
    start_utime: int,
    seed: int,
    source: str,
) -> Iterator[WheelsSample]:
    """Yield the samples, for ever. `contacts` has each wheel's contact point in the vehicle's moving frame.

    A wheel rolls by what its contact point moves along it: side slip it does not see, a slope it follows.
    """
    noise = NoiseSource(seed, f"wheels/{source}")
    encoders = {
        name: Encoder(
            model.encoder,
            name,
            scale=1.0 + noise.normal(model.scale_sigma),
            travel_step=model.travel_step,
            speed_sigma=model.speed_sigma,
            standstill=model.standstill,
            noise=noise,
            faults=NoiseSource(seed, f"wheels/{source}/{name}"),
        )
        for name in contacts
    }
    noise.draw_ahead()
    stamps = headers(
        model.timing, start_utime, start_utime - 1_000_000, source, NoiseSource(seed, f"wheels/{source}/arrival")
    )
    rolling = _Rolling(model, drive, contacts)
    for header in stamps:
        t = (header.utime - start_utime) * 1e-6 - model.unstated_latency
        motion, ways = rolling.to(t)
        excess = 1.0 + model.slip * _push(motion) / _GRAVITY
        wheels = []
        for name, contact in contacts.items():
            if name in model.steered:
                speed = rolling.steered_speed(motion, contact)
                steering = math.atan2(motion.curvature * contact[0], 1.0 - motion.curvature * contact[1])
            else:
                rates = _rates(motion)
                speed = rates[0] - model.track_factor * contact[1] * rates[1] + contact[2] * rates[2]
                steering = 0.0
            wheels.append(encoders[name].sample(t, ways[name], speed, excess, steering))
        yield WheelsSample(header, tuple(wheels))


class _Rolling:
    """What each wheel rolls from one instant to the next, in metres."""

    def __init__(self, model: WheelsModel, drive: MotionModel, contacts: Mapping[str, Vector3]):
        self.model = model
        self.drive = drive
        self.contacts = contacts
        # on level ground without side slip the way of wheels that do not steer has a closed form
        self.closed = isinstance(drive, Trajectory)
        self.steered_speed = _steered_speed if self.closed else _steered_speed_sliding
        self.quadrature = bool(model.steered) or not self.closed
        self.before = drive.at(0.0)
        self.t_before = 0.0

    def to(self, t: float) -> tuple[TrajectoryMotion, dict[str, float]]:
        """Return the motion at `t` seconds, and each wheel's way since the last call, the first since 0."""
        model, drive, t_before, before = self.model, self.drive, self.t_before, self.before
        motion = drive.at(t)
        elapsed = t - t_before
        between = [(drive.at(t_before + u * elapsed), weight) for u, weight in _NODES] if self.quadrature else []
        if self.closed:
            along, turned, pitched = motion.way - before.way, motion.yaw - before.yaw, 0.0
        else:
            along = turned = pitched = 0.0
            for each, weight in between:
                speed, turn, pitch = _rates(each)
                along += weight * elapsed * speed
                turned += weight * elapsed * turn
                pitched += weight * elapsed * pitch
        ways = {}
        for name, contact in self.contacts.items():
            if name in model.steered:
                ways[name] = elapsed * sum(weight * self.steered_speed(each, contact) for each, weight in between)
            else:
                ways[name] = along - model.track_factor * contact[1] * turned + contact[2] * pitched
        self.before, self.t_before = motion, t
        return motion, ways


@dataclass(frozen=True, slots=True)
class StatusModel:
    """What the vehicle controller measures. `wheelbase`: meters from the rolling frame ahead to the steered axle.

    angle_sigma: standard deviation of the steering angle's noise, radians. angle_error: what it is off by, radians.
    """

    wheelbase: float
    timing: Timing = _TIMING
    angle_sigma: float = 0.002
    angle_error: float = 0.0


def statuses(
    model: StatusModel, drive: MotionModel, start_utime: int, seed: int, source: str
) -> Iterator[VehicleStatusSample]:
    """Yield the controller's samples, for ever: forward speed, and the steering angle of the equivalent front wheel."""
    noise = NoiseSource(seed, f"status/{source}")
    stamps = headers(
        model.timing, start_utime, start_utime - 1_000_000, source, NoiseSource(seed, f"status/{source}/arrival")
    )
    for header in stamps:
        motion = drive.at((header.utime - start_utime) * 1e-6)
        angle = math.atan(motion.curvature * model.wheelbase) + model.angle_error + noise.normal(model.angle_sigma)
        yield VehicleStatusSample(header, VehicleMode.AUTONOMOUS, motion.speed, angle)


def _rates(motion: TrajectoryMotion) -> Vector3:
    """Return forward speed and the rates about the vehicle's z and y axes."""
    if motion.attitude is None:
        return (motion.speed, motion.yaw_rate, 0.0)
    return (motion.speed, motion.attitude.rate[2], motion.attitude.rate[1])


def _steered_speed(motion: TrajectoryMotion, contact: Vector3) -> float:
    """Return the speed of a contact point along the direction it moves in, negative when backing up."""
    k = motion.curvature
    return motion.speed * math.hypot(1.0 - k * contact[1], k * contact[0])


def _steered_speed_sliding(motion: TrajectoryMotion, contact: Vector3) -> float:
    """Return the speed of a contact point along its wheel, negative when backing up.

    The wheel is steered as a vehicle on level ground without side slip would need it, so it moves aslant.
    """
    k = motion.curvature
    x, y, z = contact
    wx, wy, wz = motion.attitude.rate if motion.attitude is not None else (0.0, 0.0, motion.yaw_rate)
    ahead, left = motion.speed - wz * y + wy * z, motion.lateral_speed + wz * x - wx * z
    return (ahead * (1.0 - k * y) + left * k * x) / math.hypot(1.0 - k * y, k * x)


def _push(motion: TrajectoryMotion) -> float:
    """Return how hard the tyres push, m/s2: speeding up makes wheels turn too much, braking too little."""
    along = math.copysign(1.0, motion.speed) * motion.forward_acceleration
    return along + abs(motion.speed * motion.yaw_rate)

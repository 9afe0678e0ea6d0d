"""Wheel odometry simulation: travel, speed and direction of each wheel, and the vehicle controller's status.

Kinematics: the speed of a contact point at (x, y, z) of the rolling frame is v_x - k w_z y + w_y z along the vehicle
and for a steered wheel the speed along the wheel, which is steered for
level ground without side slip. Travel is its integral: closed form on level ground without slip, else Gauss-Legendre
with three nodes per sample.
Encoder: travel is quantized to pulses; scale error per wheel; slip proportional to traction.
Limits: side slip is not measured by a wheel; the wheels follow the slope of the ground without suspension.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from modelserver.messages import Direction, VehicleMode, VehicleStatusSample, WheelSample, WheelsSample
from modelserver.simulation.noise import NoiseSource, Run, Timing, quantize
from modelserver.simulation.trajectory import MotionModel, Trajectory, TrajectoryMotion
from modelserver.transforms.so3 import Vector3

_GRAVITY = 9.81
_NODES = ((0.5 - math.sqrt(0.15), 5.0 / 18.0), (0.5, 8.0 / 18.0), (0.5 + math.sqrt(0.15), 5.0 / 18.0))
"""Gauss-Legendre nodes and weights on [0, 1]."""


class Encoder:
    """One simulated encoder; each call of `sample` follows the last."""

    def __init__(self, model: WheelsModel, name: str, noise: NoiseSource, run: Run):
        """Draw the errors of a wheel's encoder; `noise` is shared by the wheels, `run` has others for more."""
        self._model, self._name, self._noise = model, name, noise
        self._scale = 1.0 + noise.normal(model.scale_sigma)
        self._rotated = 0.0

    def sample(self, t: float, rolled: float, speed: float, excess: float, steering: float) -> WheelSample:
        """Return the encoder's sample at `t` seconds.

        `rolled` (m since the last sample) and `speed` are those over ground; wheel slip multiplies them by `excess`.
        """
        model, seen = self._model, self._scale * excess
        error = self._noise.normal(model.speed_sigma) if abs(speed) > model.stationary_speed else 0.0
        self._rotated += rolled * seen
        return WheelSample(
            self._name,
            travel=quantize(self._rotated, model.travel_step),
            travel_sigma=max(model.travel_step / math.sqrt(12.0), 1e-4),
            speed=speed * seen + error,
            speed_sigma=max(model.speed_sigma, 1e-4),
            direction=_direction(speed, model.stationary_speed),
            steering=steering,
        )


_TIMING = Timing(20.0, latency=0.01, jitter=0.002)


@dataclass(frozen=True, slots=True)
class WheelsModel:
    """Errors of the wheel encoders, and the steering geometry. Meters, m/s.

    Attributes
    ----------
    scale_sigma : standard deviation of each wheel's scale error, drawn once (tire pressure, load)
    speed_sigma : noise of the speed
    travel_step : travel per pulse, 0 for continuous
    slip : share of excess rotation at a traction of 1 g
    stationary_speed : speed below which an encoder measures none
    steered : names of the wheels that steer into the direction of motion of their contact points
    unstated_latency : age of a sample at its utime, s
    encoder : makes the encoder of a wheel by model, name, the noise that the wheels share, and the run
    """

    timing: Timing = _TIMING
    scale_sigma: float = 0.01
    speed_sigma: float = 0.02
    travel_step: float = 0.01
    slip: float = 0.0
    stationary_speed: float = 0.02
    steered: frozenset[str] = frozenset()
    unstated_latency: float = 0.0
    encoder: Callable[[WheelsModel, str, NoiseSource, Run], Encoder] = Encoder


def _direction(speed: float, stationary_speed: float) -> Direction:
    if abs(speed) <= stationary_speed:
        return Direction.STOPPED
    return Direction.FORWARD if speed > 0 else Direction.BACKWARD


def simulate_wheels(model: WheelsModel, run: Run, contacts: Mapping[str, Vector3]) -> Iterator[WheelsSample]:
    """Yield samples without end. `contacts` has each wheel's contact point in the vehicle's moving frame, meters."""
    noise = run.noise("wheels/wheels")
    encoders = {name: model.encoder(model, name, noise, run) for name in contacts}
    noise.prefetch()
    rolling = _WheelOdometry(model, run.drive, contacts)
    for header, t in run.generate_headers(model.timing, "wheels/wheels"):
        t -= model.unstated_latency
        motion, distances = rolling.advance(t)
        slip = model.slip * _traction(motion) / _GRAVITY
        wheels = []
        for name, contact in contacts.items():
            if name in model.steered:
                speed = _steered_speed(motion, contact)
                steering = math.atan2(motion.curvature * contact[0], 1.0 - motion.curvature * contact[1])
            else:
                forward, turn, pitch = _rates(motion)
                speed, steering = forward - contact[1] * turn + contact[2] * pitch, 0.0
            wheels.append(encoders[name].sample(t, distances[name], speed, 1.0 + slip, steering))
        yield WheelsSample(header, tuple(wheels))


class _WheelOdometry:
    """Travel of each wheel between two calls, in meters."""

    def __init__(self, model: WheelsModel, drive: MotionModel, contacts: Mapping[str, Vector3]):
        self.model = model
        self.drive = drive
        self.contacts = contacts
        # on level ground without side slip the travel of wheels that do not steer has a closed form
        self.has_closed_form = isinstance(drive, Trajectory)
        self.quadrature = bool(model.steered) or not self.has_closed_form
        self.previous = drive.at(0.0)
        self.t_previous = 0.0

    def advance(self, t: float) -> tuple[TrajectoryMotion, dict[str, float]]:
        """Return the motion at `t` seconds, and each wheel's travel since the last call, the first since 0."""
        model, drive, t_previous, before = self.model, self.drive, self.t_previous, self.previous
        motion = drive.at(t)
        elapsed = t - t_previous
        between = [(drive.at(t_previous + u * elapsed), weight) for u, weight in _NODES] if self.quadrature else []
        if self.has_closed_form:
            along, turned, pitched = motion.distance - before.distance, motion.yaw - before.yaw, 0.0
        else:
            along = turned = pitched = 0.0
            for each, weight in between:
                speed, turn, pitch = _rates(each)
                along += weight * elapsed * speed
                turned += weight * elapsed * turn
                pitched += weight * elapsed * pitch
        distances = {}
        for name, contact in self.contacts.items():
            if name in model.steered:
                distances[name] = elapsed * sum(weight * _steered_speed(each, contact) for each, weight in between)
            else:
                distances[name] = along - contact[1] * turned + contact[2] * pitched
        self.previous, self.t_previous = motion, t
        return motion, distances


@dataclass(frozen=True, slots=True)
class StatusModel:
    """Measurements of the vehicle controller. `wheelbase`: meters from the rolling frame to the steered axle.

    `angle_sigma` is the noise of the steering angle and `angle_error` its offset, radians.
    """

    wheelbase: float
    timing: Timing = _TIMING
    angle_sigma: float = 0.002
    angle_error: float = 0.0


def simulate_status(model: StatusModel, run: Run) -> Iterator[VehicleStatusSample]:
    """Yield the controller's samples without end: forward speed and steering angle of the equivalent front wheel."""
    noise = run.noise("status/vehicle")
    for header, t in run.generate_headers(model.timing, "status/vehicle"):
        motion = run.drive.at(t)
        angle = math.atan(motion.curvature * model.wheelbase) + model.angle_error + noise.normal(model.angle_sigma)
        yield VehicleStatusSample(header, VehicleMode.AUTONOMOUS, motion.speed, angle)


def _rates(motion: TrajectoryMotion) -> Vector3:
    """Return forward speed, yaw rate and pitch rate, along the vehicle's axes."""
    if motion.attitude is None:
        return (motion.speed, motion.yaw_rate, 0.0)
    return (motion.speed, motion.attitude.rate[2], motion.attitude.rate[1])


def _steered_speed(motion: TrajectoryMotion, contact: Vector3) -> float:
    """Return the speed of a contact point along its wheel, negative in reverse, steered as without side slip."""
    k = motion.curvature
    x, y, z = contact
    wx, wy, wz = motion.attitude.rate if motion.attitude is not None else (0.0, 0.0, motion.yaw_rate)
    ahead, left = motion.speed - wz * y + wy * z, motion.lateral_speed + wz * x - wx * z
    return (ahead * (1.0 - k * y) + left * k * x) / math.hypot(1.0 - k * y, k * x)


def _traction(motion: TrajectoryMotion) -> float:
    """Return the acceleration at the tires, m/s2: positive makes wheels rotate too much, braking too little."""
    along = math.copysign(1.0, motion.speed) * motion.forward_acceleration
    return along + abs(motion.speed * motion.yaw_rate)

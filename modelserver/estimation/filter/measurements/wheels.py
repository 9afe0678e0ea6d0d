"""Wheel speeds: each wheel measures the speed of its contact point along the direction in which it rolls.

Measurement. With v the velocity of the rolling frame, w the angular rate and c the contact point (body axes; x and y
span the ground plane), the contact point moves with u = v + w x c. A wheel at the steering angle a measures

    z = (1 + s) d(a) . u + noise,   d(a) = (cos(a + m), sin(a + m)),

s the scale error and m the mounting yaw of the wheels (states of the filter). H follows from du/d(v, attitude, bias).

Steering angle. It is 0 for a wheel that does not steer, or measured: by the wheel's own encoder, or by the vehicle
controller for the whole axle (`SteeringSignal`). A wheel that steers and whose angle nobody measures rolls where its
contact point goes, so it measures |u| with the sign of its encoder. |u| has no derivative at u = 0, and the direction
of u is noise there; so the angle is estimated from both that are known of it, as a weighted mean of

    the prior m +- steering_sigma   and   the course of u, atan2(u_y, u_x) +- sqrt(V), V = var(u across) / |u|^2.

With the weight k = steering_sigma^2 / (steering_sigma^2 + V) the measurement is |u| where the course is known (k = 1),
and a wheel that points ahead by an uncertain angle where it is not (k = 0), with a continuous transition. The angle's
remaining variance P = k V acts through u across the wheel, to the second order: (u_across)^2 P + 3/4 (|u| P)^2.

Sign. An encoder without a direction (`Direction.UNSIGNED`) measures |z|. Its sign is that of the predicted speed where
that is certain to three sigmas; otherwise the sample is not used.

Slip acts as for every wheel: a share of speed, larger under acceleration. Of a skid-steered vehicle, whose wheels slide
in every turn, the mean of all wheels is one measurement; a wheel that steers has no place there.

Limits: one steering angle for the time between two samples; a wheel beyond 3 steering_sigma needs a measured angle.
Read top-down: `read_wheels` -> `WheelSpeed.evaluate` -> `_steer` -> `are_wheels_stationary`, `estimate_turn_rate`.

Constraints: non-holonomic constraint (NHC), zero-velocity update (ZUPT), zero angular rate update (ZARU). Measurements
without a sensor: a rolling vehicle does not slide sideways or leave the ground, a stationary one does not
move or turn. Each takes the seconds since its last update: an error that lasts longer must not count as a new one each
time, so its variance is multiplied by slip_time / dt.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Final, NamedTuple, Self

import numpy as np

from modelserver.estimation.filter.eskf import GYRO_BIAS, VELOCITY, ZERO, ErrorState, Innovation
from modelserver.estimation.filter.measurements.measurement import (
    IMU_AVERAGING,
    MeasurementContext,
    body_velocity_jacobian,
    register,
)
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.sensor_rig import SPEEDOMETER, SensorRig, SpeedometerSignal, SteeringSignal
from modelserver.messages import Direction, VehicleStatusSample, WheelSample, WheelsSample
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Vector3, cross

SCALE, YAW = "wheel_scale", "wheel_yaw"
"""States: the common scale error of the wheels, and the angle by which they roll to the left of the geometry's x."""

SLIP_INFLATION_LIMIT = 4.0
"""A NIS up to this many times the gate is used with inflated noise: a slip of twice the gate."""

MAX_TRAVEL_TIME = 1.0
"""Seconds between two samples, at most, for a speed from their travel."""

SIGN_KNOWN = 3.0
"""Sigmas by which a predicted speed must differ from 0 to give an unsigned measurement its sign."""

TURN_STEPS = 6
"""Iterations for the directions of steered wheels: at full lock each reduces the error to a fifth."""

SKID_SHARE = 0.3
"""Share of the difference of its sides by which a skid-steered vehicle turns less: sigma."""

LARGEST_TURN_RATE = 10.0
"""Turn rate, rad/s, beyond which wheels spin."""

NO_ANGLES: Mapping[str, float] = MappingProxyType({})


def wheel_states(settings: FilterSettings) -> tuple[ErrorState, ...]:
    """Return the error states of the wheels."""
    return (
        ErrorState((SCALE,), settings.wheel_scale_sigma, settings.wheel_scale_walk),
        ErrorState((YAW,), settings.wheel_yaw_sigma, settings.wheel_yaw_walk),
    )


class WheelMotion(NamedTuple):
    """One wheel between two samples: mean speed (m/s) and its variance, steering angle (rad), contact point (body, m).

    `is_mean`: over the time between, from travel; else of the instant. `steering` is nan where nobody measures it,
    `steering_sigma` its standard deviation where the vehicle controller does. `is_unsigned`: `speed` is a magnitude.
    """

    speed: float
    variance: float
    steering: float
    contact: Vector3
    is_mean: bool
    steering_sigma: float = 0.0
    is_unsigned: bool = False


def read_wheels(
    sample: WheelsSample,
    previous: WheelsSample | None,
    contacts: Mapping[str, Vector3],
    settings: FilterSettings,
    angles: Mapping[str, float] = NO_ANGLES,
    angle_sigma: float = 0.0,
) -> list[WheelMotion]:
    """Return what each known wheel of a sample measures: from its travel since `previous`, else from its speed.

    `angles` are the steering angles (rad) that the vehicle controller measures, to `angle_sigma`, by the wheel's name:
    for wheels that steer and do not measure it themselves.
    """
    dt = 0.0 if previous is None else (sample.header.utime - previous.header.utime) * 1e-6
    earlier = (
        {wheel.name: wheel for wheel in previous.wheels} if previous is not None and 0.0 < dt <= MAX_TRAVEL_TIME else {}
    )
    found = []
    for wheel in sample.wheels:
        contact = contacts.get(wheel.name)
        if contact is None:
            continue
        steering, steering_sigma = wheel.steering, 0.0
        if not math.isfinite(steering) and wheel.name in angles:
            steering, steering_sigma = angles[wheel.name], angle_sigma
        unsigned = wheel.direction is Direction.UNSIGNED
        last = earlier.get(wheel.name)
        travel = wheel.travel - last.travel if last is not None else math.nan
        if math.isfinite(travel):
            sigma = wheel.travel_sigma if 0.0 < wheel.travel_sigma < 10.0 else settings.wheel_sigma * 0.5
            speed, variance, mean = travel / dt, 2.0 * (sigma / dt) ** 2, True
        elif math.isfinite(wheel.speed):
            sigma = wheel.speed_sigma if 0.0 < wheel.speed_sigma < 10.0 else settings.wheel_sigma
            speed, variance, mean = wheel.speed, sigma * sigma, False
        else:
            continue
        speed = abs(speed) if unsigned else speed
        found.append(WheelMotion(speed, variance, steering, contact, mean, steering_sigma, unsigned))
    return found


def read_speedometer(sample: VehicleStatusSample, signal: SpeedometerSignal) -> WheelsSample:
    """Return the one speed of a vehicle as that of a wheel at the rolling frame."""
    direction = Direction.UNSIGNED if signal.is_unsigned else Direction.UNKNOWN
    wheel = WheelSample(SPEEDOMETER, speed=sample.forward_speed, speed_sigma=signal.sigma, direction=direction)
    return WheelsSample(sample.header, (wheel,))


class SteeredDirection(NamedTuple):
    """The direction of a wheel: its angle (rad), how much of the course's change it follows, and its variance (rad2).

    `follow` is the weight k of the module's theory, `course_gradient` d(course)/du (rad per m/s).
    """

    angle: float
    follow: float
    variance: float
    course_gradient: tuple[float, float]


@register
@dataclass(frozen=True, slots=True)
class WheelSpeed:
    """Speed of the wheels: measured = (1 + scale) d . (v + w x c), d its rolling direction, c its contact point.

    Each wheel is one number; of a skid-steered vehicle, whose wheels slide in every turn, the mean of all is.
    """

    kind: ClassVar[str] = "wheel_speed"
    sample: ClassVar[type] = WheelsSample
    states: ClassVar[tuple[ErrorState, ...]] = ()
    contacts: dict[str, Vector3]
    skid: bool
    half_track: float
    imu: Vector3
    steering: SteeringSignal | None = None

    @classmethod
    def create(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        """Return it for a vehicle with configured wheels."""
        if not rig.wheel_frames:
            return None
        contacts = {name: rig.pose(frame).xyz for name, frame in rig.wheel_frames.items()}
        half = max(abs(contact[1]) for contact in contacts.values())
        return cls(contacts, rig.kinematics == "skid_steer", half, rig.imu, rig.steering)

    def get_utime(self, sample: WheelsSample) -> int | None:
        return sample.header.utime

    def evaluate(self, context: MeasurementContext, sample: WheelsSample) -> Innovation | str:
        """Compare the mean speeds since the previous sample with the mean motion, or the present speeds."""
        settings = context.settings
        wheels = self.read_wheels(sample, context.previous, settings, context.steering)
        if not wheels:
            known = [wheel for wheel in sample.wheels if wheel.name in self.contacts]
            if not known:
                return "names" if sample.wheels else "empty"
            if self.skid and read_wheels(sample, context.previous, self.contacts, settings):
                return "steering"
            if not any(math.isfinite(wheel.travel) for wheel in known):
                return "nan"
            # the first travel has nothing to be compared with
            return "" if context.previous is None else "gap"
        top = settings.maximum_speed
        if not all(abs(wheel.speed) <= top for wheel in wheels):
            return "range"
        if self.skid:
            wheels = [_mean(wheels)]
        return self._evaluate(context, wheels)

    def read_wheels(
        self, sample: WheelsSample, previous: WheelsSample | None, settings: FilterSettings, steering: float = math.nan
    ) -> list[WheelMotion]:
        """Return what each wheel measures that can be used; `steering` is the controller's steering angle, rad.

        On a skid-steered vehicle a wheel that steers by an unknown angle cannot be averaged with the others.
        """
        angles, sigma = NO_ANGLES, 0.0
        if self.steering is not None and math.isfinite(steering):
            angles, sigma = self.steering.wheel_angles(steering, self.contacts), self.steering.sigma
        found = read_wheels(sample, previous, self.contacts, settings, angles, sigma)
        return [each for each in found if math.isfinite(each.steering)] if self.skid else found

    def has_travel(self, sample: WheelsSample, previous: WheelsSample | None) -> bool:
        """Return whether a wheel measures the travel since a previous sample."""
        earlier = {wheel.name: wheel.travel for wheel in previous.wheels} if previous is not None else {}
        return any(math.isfinite(wheel.travel - earlier.get(wheel.name, math.nan)) for wheel in sample.wheels)

    def _evaluate(self, context: MeasurementContext, wheels: list[WheelMotion]) -> Innovation | str:
        nav, layout, settings = context.nav, context.layout, context.settings
        dt = context.age
        scale, yaw = 1.0 + context.extra(SCALE), context.extra(YAW)
        base = context.rig.base
        now = nav.body_velocity(base)
        rate = nav.angular_rate
        residuals, rows, noises = [], [], []
        body = body_velocity_jacobian(nav, base, layout.size)
        for wheel in wheels:
            if wheel.is_mean:
                motion = nav.travel
                lever = cross(nav.rotation, wheel.contact)
                v = (
                    (motion[0] + lever[0]) / dt,
                    (motion[1] + lever[1]) / dt,
                    (motion[2] + lever[2]) / dt,
                )
            else:
                lever = cross(rate, wheel.contact)
                v = (now[0] + lever[0], now[1] + lever[1], now[2] + lever[2])
            steered = _steer(wheel, v, yaw, body, nav.covariance, settings)
            c, s = math.cos(steered.angle), math.sin(steered.angle)
            along, across = c * v[0] + s * v[1], c * v[1] - s * v[0]
            # d(along)/du: the angle follows the course of u, and so turns what is across into what is along
            gx, gy = steered.course_gradient
            rx, ry = c + steered.follow * across * gx, s + steered.follow * across * gy
            row = scale * _row(rx, ry, wheel.contact, body)
            row[layout.index(SCALE)] = along
            row[layout.index(YAW)] = scale * (1.0 - steered.follow) * across
            variance = wheel.variance
            if not wheel.is_mean:
                # the rate of the instant has the noise of one gyro sample
                x, y, _ = wheel.contact
                variance += ((c * y - s * x) * settings.gyro_noise) ** 2 / IMU_AVERAGING
            fast = max(math.hypot(v[0], v[1]), abs(wheel.speed))
            variance += (across * across + 0.75 * fast * fast * steered.variance) * steered.variance
            speed = wheel.speed
            if wheel.is_unsigned:
                certain = along * along > SIGN_KNOWN**2 * float(row @ nav.covariance @ row)
                if not certain and speed > settings.stationary_speed:
                    continue
                speed = math.copysign(speed, along) if certain else 0.0
            residuals.append(speed - scale * along)
            rows.append(row)
            noises.append(variance + self._slip(nav.force, along, rate[2], settings) * _correlate(dt, settings))
        if not rows:
            return "direction"
        return Innovation(
            np.array(residuals),
            np.array(rows),
            np.diag(noises),
            is_separable=True,
            inflation_limit=SLIP_INFLATION_LIMIT,
        )

    def _slip(self, force: Vector3, speed: float, turn: float, settings: FilterSettings) -> float:
        """Return the variance of slip, (m/s)2: on firm ground, under acceleration, and of a skid-steered in turns."""
        push = min(abs(force[0]), 5.0)
        share = settings.slip_ratio + settings.slip_acceleration * push
        turning = settings.slip_turn * turn * self.half_track if self.skid else 0.0
        return (share * speed) ** 2 + turning * turning


def _correlate(dt: float, settings: FilterSettings) -> float:
    """Return the factor of a correlated noise's variance for updates `dt` seconds apart that count as independent."""
    return max(settings.slip_time / dt, 1.0) if 0.0 < dt < settings.slip_time else 1.0


def _row(rx: float, ry: float, contact: Vector3, body: Array) -> Array:
    """Return the Jacobian (n) of rx u_x + ry u_y, u the velocity of a contact point; `body` that of the body's."""
    row: Array = rx * body[0] + ry * body[1]
    # an error of the gyro's bias changes w x c by c x error: r . (c x error) = (r x c) . error
    x, y, z = contact
    row[9:12] += (ry * z, -rx * z, rx * y - ry * x)
    return row


def _steer(
    wheel: WheelMotion, u: Vector3, yaw: float, body: Array, covariance: Array, settings: FilterSettings
) -> SteeredDirection:
    """Return the direction of a wheel whose contact point moves with `u` (body axes, m/s): see the module's theory."""
    if math.isfinite(wheel.steering):
        return SteeredDirection(wheel.steering + yaw, 0.0, wheel.steering_sigma**2, (0.0, 0.0))
    prior = settings.steering_sigma**2
    square = u[0] * u[0] + u[1] * u[1]
    if square < 1e-12:
        return SteeredDirection(yaw, 0.0, prior, (0.0, 0.0))
    # a wheel does not turn round: rolling backward it points away from the course
    ahead = math.copysign(1.0, u[0])
    course = math.atan2(ahead * u[1], ahead * u[0])
    size = math.sqrt(square)
    row = _row(-u[1] / size, u[0] / size, wheel.contact, body)
    variance = max(float(row @ covariance @ row), 0.0) / square
    follow = prior / (prior + variance)
    most = 3.0 * settings.steering_sigma
    turned = course - yaw
    # no wheel steers farther than its stop: the angle follows the course no longer
    gradient = (-u[1] / square, u[0] / square) if abs(turned) <= most else (0.0, 0.0)
    angle = yaw + follow * min(max(turned, -most), most)
    return SteeredDirection(angle, follow, follow * variance, gradient)


def _mean(wheels: list[WheelMotion]) -> WheelMotion:
    """Return the mean of the left and of the right wheels, so that the turn cancels, also with a wheel missing."""
    sides: dict[bool, list[WheelMotion]] = {}
    for wheel in wheels:
        sides.setdefault(wheel.contact[1] > 0.0, []).append(wheel)
    speed = variance = y = z = 0.0
    for side in sides.values():
        part = 1.0 / (len(side) * len(sides))
        for wheel in side:
            speed += part * wheel.speed
            variance += part * part * wheel.variance
            y, z = y + part * wheel.contact[1], z + part * wheel.contact[2]
    # along x the mean contact point does not matter to the way it rolls, and in a skid nothing rolls about it
    return WheelMotion(speed, variance, 0.0, (0.0, y, z), all(wheel.is_mean for wheel in wheels))


def are_wheels_stationary(
    sample: WheelsSample, previous: WheelsSample | None, contacts: Mapping[str, Vector3], settings: FilterSettings
) -> bool | None:
    """Return whether the wheels are stationary; None where they do not measure it. Steering does not matter here."""
    wheels = read_wheels(sample, previous, contacts, settings)
    if not wheels:
        return None
    return all(abs(wheel.speed) <= settings.stationary_speed for wheel in wheels)


class TurnRate(NamedTuple):
    """A turn rate and its standard deviation, rad/s."""

    value: float
    sigma: float


def estimate_turn_rate(
    sample: WheelsSample,
    previous: WheelsSample | None,
    measurement: WheelSpeed,
    settings: FilterSettings,
    steering: float = math.nan,
) -> TurnRate:
    """Return the turn rate that the wheels measure; 0, and how fast a vehicle turns, where they do not.

    Each wheel rolls at d . (v + w x c): two unknowns, forward speed and turn rate, by least squares. The direction of a
    wheel whose angle is not measured follows from the two, so it is found by iteration from straight ahead. A
    skid-steered vehicle's wheels slide: it turns by less than the difference of its sides, by an unknown share.
    `steering`: as in `read_wheels`.
    """
    # a single speed measures no turns: a third of the error of a gap, since they are smooth
    unknown = TurnRate(0.0, settings.gap_rate_sigma / 3.0)
    wheels = [each for each in measurement.read_wheels(sample, previous, settings, steering) if not each.is_unsigned]
    if len(wheels) < 2:
        return unknown
    speeds = np.array([wheel.speed for wheel in wheels])
    angles = [wheel.steering if math.isfinite(wheel.steering) else 0.0 for wheel in wheels]
    free = [n for n, wheel in enumerate(wheels) if not math.isfinite(wheel.steering)]
    most = 3.0 * settings.steering_sigma
    for _ in range(TURN_STEPS if free else 1):
        A = np.array(
            [
                (math.cos(a), math.sin(a) * wheel.contact[0] - math.cos(a) * wheel.contact[1])
                for a, wheel in zip(angles, wheels, strict=True)
            ]
        )
        (v, w), _, rank, _ = np.linalg.lstsq(A, speeds, rcond=1e-6)
        if rank < 2:
            return unknown
        for n in free:
            x, y, _ = wheels[n].contact
            ahead = math.copysign(1.0, v - w * y)
            angles[n] = min(max(math.atan2(ahead * w * x, ahead * (v - w * y)), -most), most)
    if abs(w) > LARGEST_TURN_RATE:
        return unknown
    # a fast one slips by more than a slow one that turns on the spot
    variance = max(settings.wheel_rate_sigma**2, (settings.slip_ratio * v) ** 2 * np.linalg.inv(A.T @ A)[1, 1])
    if measurement.skid:
        variance += (SKID_SHARE * w) ** 2
    return TurnRate(float(w), math.sqrt(variance))


# --- constraints --------------------------------------------------------------------------------------------

NON_HOLONOMIC: Final = "non_holonomic"
ZERO_VELOCITY: Final = "zero_velocity"
ZERO_RATE: Final = "zero_rate"


def non_holonomic(context: MeasurementContext, dt: float, *, are_wheels_stationary: bool = False) -> Innovation:
    """Compare the sideways and upward speed of the rolling frame with 0.

    Sideways along the wheels: v_y - yaw v_x, with the angle between the wheels and the geometry's x axis. The noise is
    that of the side slip angle, proportional to the lateral acceleration, and of the point that moves straight ahead.
    While wheels are stationary a velocity is an error, whose direction shows no heading.
    """
    nav, layout, settings = context.nav, context.layout, context.settings
    base = context.rig.base
    vx, vy, vz = nav.body_velocity(base)
    wz = nav.angular_rate[2]
    yaw = context.extra(YAW)
    seen = nav._replace(velocity=ZERO) if are_wheels_stationary else nav
    body = body_velocity_jacobian(seen, base, layout.size)
    H = np.array((body[1] - yaw * body[0], body[2]))
    if YAW in layout:
        H[0, layout.index(YAW)] = -vx
    slip = settings.side_slip * vx * wz * vx
    offset = settings.roll_point_sigma * wz
    correlated = max(settings.slip_time / dt, 1.0)
    side = (settings.side_sigma**2 + slip * slip + offset * offset) * correlated
    up = (settings.up_sigma**2 + (settings.up_share * vx) ** 2) * correlated
    return Innovation(np.array((yaw * vx - vy, -vz)), H, np.diag((side, up)), inflation_limit=math.inf)


def zero_velocity(context: MeasurementContext, dt: float) -> Innovation:
    """Compare the velocity with 0."""
    nav = context.nav
    H = context.zero_jacobian(3)
    H[:, VELOCITY] = np.eye(3)
    correlated = max(context.settings.slip_time / dt, 1.0)
    return Innovation(-np.array(nav.velocity), H, np.eye(3) * (context.settings.stationary_sigma**2 * correlated))


def zero_rate(context: MeasurementContext, mean_rate: Vector3, earth_rate: Vector3, dt: float) -> Innovation:
    """Compare the angular rate with 0: the mean of the gyros over `dt` seconds is their bias and the earth rate."""
    nav = context.nav
    H = context.zero_jacobian(3)
    H[:, GYRO_BIAS] = np.eye(3)
    variance = context.settings.gyro_noise**2 / max(dt, 1e-3)
    measured = np.subtract(mean_rate, so3.rotate(so3.conjugate(nav.attitude), earth_rate))
    return Innovation(measured - nav.gyro_bias, H, np.eye(3) * variance)

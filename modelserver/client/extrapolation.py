"""Vehicle estimates from published poses, and their extrapolation beyond the newest one. Pure.

A client without the filter's state knows the base frame from POSE (World:UTM) and POSE_ODOM (Odom) only.

Velocity: X_AB between two poses in Odom, `MIN_SPAN_US` to `MAX_SPAN_US` apart, is taken for a constant twist
(v, w): w dt = log R_AB, v dt = J_l(w dt)^-1 p_AB, J_l the left Jacobian of SO(3) (Lynch & Park 2017, eq. 3.88; Sola
2018, eq. 145). Its sigma is half of the change that `ACCELERATION_SIGMA` makes in dt: the mean velocity is used for the
end of the interval. Acceleration stays unknown.

Extrapolation by dt: X <- X D with D = exp((v, w) dt), covariance by `covariance.compose` with Q = diag(s_p^2, s_a^2),
s_a = s_w dt + a_w dt^2 / 2, s_p = s_v dt + a_v dt^2 / 2 + |v| dt s_a / 3. The last term is the lateral drift from a
heading error that grows as t^2. Protection levels become unknown (nan).

Limits: constant velocity and turn rate; an estimate without a new pose for `POSE_TIMEOUT_S` is flagged stale.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from modelserver.earth.geodesy import GeodesyError, geodesy_of
from modelserver.estimation.history import DeferredEstimate
from modelserver.messages import (
    NAN,
    STALE_SENSORS,
    VALID,
    Estimate,
    Invalid,
    LocalizerSummary,
    Mode,
    NavigationState,
    Origin,
    PoseAnswer,
    Quality,
    Sample,
    SwitchMode,
    VehicleMotion,
)
from modelserver.transforms import covariance as cov
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3, cross

MIN_SPAN_US: Final = 50_000
MAX_SPAN_US: Final = 500_000
"""Time between the two poses of a velocity, microseconds: long against their noise, short against maneuvers."""

ACCELERATION_SIGMA: Final = 2.0
ANGULAR_ACCELERATION_SIGMA: Final = 1.0
"""Unobserved acceleration of the vehicle, m/s2 and rad/s2, one sigma."""

SPEED_SIGMA: Final = 10.0
TURN_RATE_SIGMA: Final = 1.0
"""Velocity of a vehicle whose motion is unknown, m/s and rad/s, one sigma."""

MAX_ANGLE_SIGMA: Final = math.pi / math.sqrt(3.0)
"""Sigma of an angle that is uniform in (-pi, pi], radians: an upper limit."""

POSE_TIMEOUT_S: Final = 1.0
POSE_TIMEOUT_PERIODS: Final = 3.0
"""Poses are missing after this time without one, and after this many publishing periods."""


class OdomSample(NamedTuple):
    """Pose of the base frame in Odom at a time."""

    utime: int
    odom: Pose


class PublishedEstimate(NamedTuple):
    """The estimate of the base frame in a POSE (`world`) and a POSE_ODOM of one time, computed when it is needed.

    `previous` is an earlier pose in Odom to compute the velocity with, None if there is none; `is_random_walk` is
    whether Odom's covariance grows as a random walk.
    """

    utime: int
    world: PoseAnswer
    odom: PoseAnswer
    previous: OdomSample | None
    is_random_walk: bool

    def resolve(self) -> Estimate:
        """Return the estimate."""
        world, odom = self.world.transformation, self.odom.transformation
        origin = self.world.origin
        utm = enu = None
        # without a pose in the world the server publishes the identity, with reasons and no covariance
        if origin is not None and (world.covariance is not None or world.pose != Pose.identity()):
            utm, enu = world.pose, to_enu(origin, world.pose)
        return Estimate(
            self.utime,
            odom.pose,
            enu,
            utm,
            None if world.covariance is None else tuple(world.covariance.ravel().tolist()),
            None if odom.covariance is None else tuple(odom.covariance.ravel().tolist()),
            Invalid(world.invalid_reasons),
            self.world.quality,
            world.pose_epoch,
            origin,
            self.world.horizontal_protection_level,
            self.world.heading_protection_level,
            self.world.seconds_to_limit,
            None if self.previous is None else estimate_motion(self.previous, OdomSample(self.utime, odom.pose)),
            self.is_random_walk,
            self.world.horizontal_level,
            self.world.heading_level,
            self.world.limit_risk,
            self.world.horizontal_allowance,
        )


def to_enu(origin: Origin, X_utm: Pose) -> Pose | None:
    """Convert a pose from World:UTM to World:ENU; None if it is too far from the origin, or the origin is invalid."""
    try:
        return geodesy_of(origin).pose_in_enu(X_utm)
    except GeodesyError:
        return None


def estimate_motion(before: OdomSample, after: OdomSample) -> VehicleMotion:
    """Return the constant twist between two poses in Odom, along the vehicle's axes; see the module."""
    seconds = (after.utime - before.utime) * 1e-6
    X_AB = before.odom.inverse() @ after.odom
    rotation = so3.logarithm(X_AB.wxyz)
    J = [_apply_left_jacobian(axis, rotation) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
    x, y, z = np.linalg.solve(np.array(J).T, np.array(X_AB.xyz)).tolist()
    sigmas = (0.5 * ACCELERATION_SIGMA * seconds,) * 3 + (0.5 * ANGULAR_ACCELERATION_SIGMA * seconds,) * 3
    covariance = tuple(np.diag([sigma * sigma for sigma in sigmas]).ravel().tolist())
    return VehicleMotion(
        _scale((x, y, z), 1.0 / seconds), _scale(rotation, 1.0 / seconds), covariance=lambda: covariance
    )


def _scale(vector: Vector3, factor: float) -> Vector3:
    return (vector[0] * factor, vector[1] * factor, vector[2] * factor)


def _apply_left_jacobian(v: Vector3, rotation: Vector3) -> Vector3:
    """Return J_l(rotation) v: the displacement of a body that travels `v` along its axes while it rotates evenly."""
    angle = math.sqrt(sum(value * value for value in rotation))
    if angle < 1e-6:
        a, b = 0.5, 1.0 / 6.0
    else:
        a, b = (1.0 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3
    once = cross(rotation, v)
    twice = cross(rotation, once)
    x, y, z = (each + a * o + b * t for each, o, t in zip(v, once, twice, strict=True))
    return (x, y, z)


@dataclass(frozen=True, slots=True)
class PoseExtrapolator:
    """A `Localizer` for clients: it extrapolates the newest published pose.

    `last` is the newest estimate, None before the first; `period` the time between the last two, seconds.
    """

    last: Estimate | DeferredEstimate | None = None
    period: float = 0.0

    @property
    def utime(self) -> int:
        """Time of the newest estimate, 0 before the first."""
        return 0 if self.last is None else self.last.utime

    def estimate(self, utime: int) -> Estimate:
        """Extrapolate the newest estimate to a time; not valid after a pose timeout."""
        if self.last is None:
            return Estimate(utime, Pose.identity(), invalid=Invalid.NO_FIX | Invalid.NO_IMU)
        last = self.last if isinstance(self.last, Estimate) else self.last.resolve()
        seconds = (utime - last.utime) * 1e-6
        return last if seconds <= 0.0 else _extrapolate(last, utime, seconds, seconds > self._timeout)

    @property
    def _timeout(self) -> float:
        return max(POSE_TIMEOUT_S, POSE_TIMEOUT_PERIODS * self.period)

    def process(self, sample: Sample | SwitchMode) -> tuple[PoseExtrapolator, tuple[()]]:
        return self, ()

    def defer_estimate(self, utime: int) -> Estimate:
        return self.estimate(utime)

    def navigation(self, utime: int) -> NavigationState | None:
        """Return None: there is no filter."""
        return None

    def find_stale_sensors(self, utime: int) -> Invalid:
        """Return the STALE_SENSORS flags of an estimate at `utime`."""
        if self.last is None:
            return VALID
        last = self.last if isinstance(self.last, Estimate) else self.last.resolve()
        is_stale = (utime - last.utime) * 1e-6 > self._timeout
        return STALE_SENSORS if is_stale else last.invalid & STALE_SENSORS

    def summary(self, utime: int) -> LocalizerSummary:
        """Return an empty summary: the server reports the health of its localization itself."""
        return LocalizerSummary(Mode.FULL)


def _extrapolate(last: Estimate, utime: int, dt: float, is_stale: bool) -> Estimate:
    motion = last.motion
    velocity, rate, speed_sigma, rate_sigma = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), SPEED_SIGMA, TURN_RATE_SIGMA
    if motion is not None:
        velocity, rate = motion.velocity, motion.angular_velocity
        numbers = motion.covariance() if motion.covariance is not None else (0.0,) * 36
        speed_sigma, rate_sigma = math.sqrt(numbers[0]), math.sqrt(numbers[-1])
    rotation = _scale(rate, dt)
    D = Pose(_apply_left_jacobian(_scale(velocity, dt), rotation), so3.exponential(rotation))
    angle = min(rate_sigma * dt + 0.5 * ANGULAR_ACCELERATION_SIGMA * dt * dt, MAX_ANGLE_SIGMA)
    lateral = math.sqrt(sum(value * value for value in velocity)) * dt * angle / 3.0
    position = speed_sigma * dt + 0.5 * ACCELERATION_SIGMA * dt * dt + lateral
    Q = np.diag([position * position] * 3 + [angle * angle] * 3)

    def inflate(X: Pose, numbers: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if numbers is None:
            return None
        return tuple(cov.compose(X, np.array(numbers).reshape(6, 6), D, Q).ravel().tolist())

    invalid = Invalid.STALE_GPS | Invalid.STALE_IMU if is_stale else VALID
    left = last.seconds_to_limit - dt
    if left <= 0.0:
        invalid |= Invalid.LIMIT_EXCEEDED
    return replace(
        last,
        utime=utime,
        odom=last.odom @ D,
        enu=None if last.enu is None else last.enu @ D,
        utm=None if last.utm is None else last.utm @ D,
        covariance=None if last.utm is None else inflate(last.utm, last.covariance),
        odom_covariance=inflate(last.odom, last.odom_covariance),
        invalid=last.invalid | invalid,
        quality=last.quality | Quality.PREDICTED,
        horizontal_protection_level=NAN,
        heading_protection_level=NAN,
        horizontal_level=NAN,
        heading_level=NAN,
        limit_risk=NAN,
        horizontal_allowance=NAN,
        seconds_to_limit=max(left, 0.0) if left == left else NAN,
    )

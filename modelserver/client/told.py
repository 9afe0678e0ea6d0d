"""What POSE and POSE_ODOM tell of the vehicle, as estimates; and the vehicle carried on past the last of them. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from modelserver.earth.geodesy import Geodesy, GeodesyError
from modelserver.history import Later
from modelserver.messages import (
    NAN,
    SILENCE,
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
from modelserver.spatial import covariance as cov
from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Vector3, cross

SHORTEST_SPAN_US: Final = 50_000
LONGEST_SPAN_US: Final = 500_000
"""Microseconds between two poses in Odom that a velocity is told from: not the noise of neighbours, nor long past."""

ACCELERATION: Final = 2.0
TURN_ACCELERATION: Final = 1.0
"""m/s2 and rad/s2 that a vehicle's motion may change by without anybody telling; one sigma."""

SPEED: Final = 10.0
TURN_RATE: Final = 1.0
"""m/s and rad/s of a vehicle whose motion nobody told; one sigma."""

ANY_ANGLE: Final = math.pi / math.sqrt(3.0)
"""Sigma, radians, of an angle of which nothing is known: an error cannot be larger."""

SILENT_S: Final = 1.0
SILENT_PERIODS: Final = 3.0
"""Poses are missed when none has come for so long, and for so many of the times between the last two."""


class Stand(NamedTuple):
    """Where the base frame stood in Odom at an instant."""

    utime: int
    odom: Pose


class PublishedEstimate:
    """The estimate that a POSE and the POSE_ODOM beside it tell: of the base frame, worked out when it is looked at.

    `earlier` is a pose in Odom a little before it, from which the velocity comes. `walks`: how Odom's covariance grows.
    """

    __slots__ = ("_earlier", "_odom", "_walks", "_world", "utime")

    utime: int

    def __init__(self, world: PoseAnswer, odom: PoseAnswer, earlier: Stand | None, walks: bool):
        self.utime = world.transformation.utime
        self._world = world
        self._odom = odom
        self._earlier = earlier
        self._walks = walks

    def resolved(self) -> Estimate:
        """Return the estimate."""
        world, odom = self._world.transformation, self._odom.transformation
        origin = self._world.origin
        utm = enu = None
        # where there is no pose in the world the service sends none: the identity, with reasons and no covariance
        if origin is not None and (world.covariance is not None or world.pose != Pose.identity()):
            utm, enu = world.pose, in_enu(origin, world.pose)
        return Estimate(
            self.utime,
            odom.pose,
            enu,
            utm,
            None if world.covariance is None else tuple(world.covariance.ravel().tolist()),
            None if odom.covariance is None else tuple(odom.covariance.ravel().tolist()),
            Invalid(world.invalid_reasons),
            self._world.quality,
            world.pose_epoch,
            origin,
            self._world.horizontal_bound,
            self._world.heading_bound,
            self._world.seconds_to_limit,
            None if self._earlier is None else told_motion(self._earlier, Stand(self.utime, odom.pose)),
            self._walks,
        )


def in_enu(origin: Origin, X_utm: Pose) -> Pose | None:
    """Return a pose in World:UTM as one in World:ENU; None where the origin is none, or the place out of its reach."""
    try:
        return _geodesy(origin).pose_in_enu(X_utm)
    except GeodesyError:
        return None


@lru_cache(maxsize=16)
def _geodesy(origin: Origin) -> Geodesy:
    return Geodesy(origin)


def told_motion(before: Stand, after: Stand) -> VehicleMotion:
    """Return how the vehicle moved on its way between two poses in Odom, along its own axes, as by an even twist.

    It is the mean over the time between; by its end motion may have changed by half of what accelerations make of that
    time, which is what its covariance states. Acceleration is not known.
    """
    seconds = (after.utime - before.utime) * 1e-6
    X_AB = before.odom.inverse() @ after.odom
    turned = so3.logarithm(X_AB.wxyz)
    way = _unrolled(X_AB.xyz, turned)
    sigmas = (0.5 * ACCELERATION * seconds,) * 3 + (0.5 * TURN_ACCELERATION * seconds,) * 3
    covariance = tuple(np.diag([sigma * sigma for sigma in sigmas]).ravel().tolist())
    return VehicleMotion(_over(way, seconds), _over(turned, seconds), covariance=lambda: covariance)


def _over(vector: Vector3, seconds: float) -> Vector3:
    return (vector[0] / seconds, vector[1] / seconds, vector[2] / seconds)


def _unrolled(p: Vector3, turned: Vector3) -> Vector3:
    """Return the way that leads to `p` by an even turn: the inverse of `_rolled`."""
    columns = [_rolled(axis, turned) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
    x, y, z = np.linalg.solve(np.array(columns).T, np.array(p)).tolist()
    return (x, y, z)


def _rolled(way: Vector3, turned: Vector3) -> Vector3:
    """Return where a body comes that goes `way` along its own axes while it turns evenly by `turned`.

    The exponential of a twist, e.g. K. Lynch, F. Park, "Modern Robotics", 2017, eq. 3.88.
    """
    angle = math.sqrt(sum(value * value for value in turned))
    if angle < 1e-6:
        a, b = 0.5, 1.0 / 6.0
    else:
        a, b = (1.0 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3
    once = cross(turned, way)
    twice = cross(turned, once)
    x, y, z = (w + a * o + b * t for w, o, t in zip(way, once, twice, strict=True))
    return (x, y, z)


@dataclass(frozen=True, slots=True)
class Carried:
    """What stands in for the localizer in one who only hears of poses: the last one, carried on.

    `last` is the newest estimate, None before the first; `period` the seconds between the last two.
    """

    last: Estimate | Later | None = None
    period: float = 0.0

    @property
    def utime(self) -> int:
        """The instant of the newest estimate, 0 before the first."""
        return 0 if self.last is None else self.last.utime

    def estimate(self, utime: int) -> Estimate:
        """Return the vehicle at a time past the newest estimate: on as it moved last, ever less sure.

        What a bound is then nobody said. Where poses are missed it is not valid.
        """
        if self.last is None:
            return Estimate(utime, Pose.identity(), invalid=Invalid.NO_FIX | Invalid.NO_IMU)
        last = self.last if isinstance(self.last, Estimate) else self.last.resolved()
        ahead = (utime - last.utime) * 1e-6
        return last if ahead <= 0.0 else _carried(last, utime, ahead, ahead > self._patience)

    @property
    def _patience(self) -> float:
        return max(SILENT_S, SILENT_PERIODS * self.period)

    def take(self, sample: Sample | SwitchMode) -> tuple[Carried, tuple[()]]:
        """Return the same: samples are the service's to take."""
        return self, ()

    def deferred(self, utime: int) -> Estimate:
        """Return `estimate`."""
        return self.estimate(utime)

    def navigation(self, utime: int) -> NavigationState | None:
        """Return None: there is no filter here."""
        return None

    def silence(self, utime: int) -> Invalid:
        """Return what of SILENCE speaks against an estimate at `utime`."""
        if self.last is None:
            return VALID
        last = self.last if isinstance(self.last, Estimate) else self.last.resolved()
        missed = (utime - last.utime) * 1e-6 > self._patience
        return SILENCE if missed else last.invalid & SILENCE

    def summary(self, utime: int) -> LocalizerSummary:
        """Return nothing that is known: the service's own health tells how its localization is."""
        return LocalizerSummary(Mode.FULL)


def _carried(last: Estimate, utime: int, ahead: float, missed: bool) -> Estimate:
    motion = last.motion
    velocity, rate, faster, turning = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), SPEED, TURN_RATE
    if motion is not None:
        velocity, rate = motion.velocity, motion.rate
        numbers = motion.covariance() if motion.covariance is not None else (0.0,) * 36
        faster, turning = math.sqrt(numbers[0]), math.sqrt(numbers[-1])
    turned = (rate[0] * ahead, rate[1] * ahead, rate[2] * ahead)
    D = Pose(_rolled((velocity[0] * ahead, velocity[1] * ahead, velocity[2] * ahead), turned), so3.exponential(turned))
    angle = min(turning * ahead + 0.5 * TURN_ACCELERATION * ahead * ahead, ANY_ANGLE)
    # a heading that goes astray as time squared leads a third of its end's angle off the way
    astray = math.sqrt(sum(value * value for value in velocity)) * ahead * angle / 3.0
    metres = faster * ahead + 0.5 * ACCELERATION * ahead * ahead + astray
    Q = np.diag([metres * metres] * 3 + [angle * angle] * 3)

    def less_sure(X: Pose, numbers: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if numbers is None:
            return None
        return tuple(cov.compose(X, np.array(numbers).reshape(6, 6), D, Q).ravel().tolist())

    invalid = Invalid.STALE_GPS | Invalid.STALE_IMU if missed else VALID
    left = last.seconds_to_limit - ahead
    if left <= 0.0:
        invalid |= Invalid.BOUND_EXCEEDED
    return replace(
        last,
        utime=utime,
        odom=last.odom @ D,
        enu=None if last.enu is None else last.enu @ D,
        utm=None if last.utm is None else last.utm @ D,
        covariance=None if last.utm is None else less_sure(last.utm, last.covariance),
        odom_covariance=less_sure(last.odom, last.odom_covariance),
        invalid=last.invalid | invalid,
        quality=last.quality | Quality.PREDICTED,
        horizontal_bound=NAN,
        heading_bound=NAN,
        seconds_to_limit=max(left, 0.0) if left == left else NAN,
    )

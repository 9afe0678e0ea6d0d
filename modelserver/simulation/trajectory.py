"""Trajectory: where a point of the vehicle that does not slide sideways is at any time, in closed form.

A drive is a list of phases. In each, forward speed v and path curvature k go from their last value to the
phase's own along the quintic 10u^3 - 15u^4 + 6u^5 of its share u of the duration, so that acceleration and yaw
acceleration are continuous. Both are polynomials of u, hence yaw rate k v and yaw are; only x and y, the
integrals of v cos(yaw) and v sin(yaw), need quadrature (Gauss-Legendre on short steps, exact to rounding).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
from numpy.polynomial import polynomial

from modelserver.spatial.so3 import Quaternion, Vector3

Coefficients: TypeAlias = tuple[float, ...]
"""Of a polynomial in u, the constant first."""

_SMOOTH_STEP = (0.0, 0.0, 0.0, 10.0, -15.0, 6.0)
_KNOT_SECONDS = 0.1
_NODES: tuple[tuple[float, float], ...] = tuple(
    (float(node + 1.0) / 2.0, float(weight) / 2.0)
    for node, weight in zip(*np.polynomial.legendre.leggauss(4), strict=True)
)
"""Nodes and weights of the quadrature on [0, 1]: over 0.1 s its error is below the rounding of metres."""


@dataclass(frozen=True, slots=True)
class DrivePhase:
    """A stretch of a drive: what speed and curvature are reached at its end; None keeps the one there is.

    `duration` in seconds. `speed` is forward, m/s; below 0 the vehicle backs up. `curvature` is 1/m, to the
    left positive; it belongs to the steering, so that backing up with it turns the vehicle to the right.
    """

    duration: float
    speed: float | None = None
    curvature: float | None = None


class Attitude(NamedTuple):
    """How a vehicle on rising ground stands and turns.

    `wxyz` turns the vehicle's axes to east, north, up. `rate`, rad/s, and its derivative `acceleration`, rad/s2,
    are with respect to east, north, up and along the vehicle's axes.
    """

    wxyz: Quaternion
    rate: Vector3
    acceleration: Vector3


class TrajectoryMotion(NamedTuple):
    """The vehicle at one instant: the point that drives the trajectory, and how the vehicle turns.

    `position`, `velocity`, `acceleration` along east, north, up. `yaw` is counter-clockwise from east and not
    wrapped; `yaw_rate` and `yaw_acceleration` are its derivatives. `speed` is forward along the vehicle, m/s, and
    `forward_acceleration` its rate. `way` is the speed's integral on level ground without side slip, whose closed
    form is lost on other ground: what is backed up counts off. `curvature`, 1/m, is the steering's.
    `lateral_speed` is to the left, m/s, 0 without side slip. `attitude` is None on level ground, where the vehicle
    turns about up alone.
    """

    position: Vector3
    velocity: Vector3
    acceleration: Vector3
    yaw: float
    yaw_rate: float
    yaw_acceleration: float
    speed: float
    forward_acceleration: float
    way: float
    curvature: float
    lateral_speed: float = 0.0
    attitude: Attitude | None = None


class MotionModel(Protocol):
    """Whatever tells the vehicle's motion at any time."""

    def at(self, t: float) -> TrajectoryMotion:
        """Return the motion `t` seconds after the start."""


class Trajectory:
    """A drive on level ground that starts and ends at rest; before and after it the vehicle stands.

    Raises ValueError for a phase that takes no time, a number that is not finite, or a drive that does not stop.
    """

    __slots__ = ("_pieces", "_starts", "duration")

    def __init__(self, phases: Iterable[DrivePhase], start: tuple[float, float] = (0.0, 0.0), yaw: float = 0.0):
        """Take the phases, and where the drive starts: east and north in metres, yaw in radians."""
        self._pieces: list[_Piece] = []
        self._starts: list[float] = []
        self.duration = 0.0
        """Seconds until the vehicle stands for good."""
        speed = curvature = 0.0
        x, y = start
        way = 0.0
        for phase in phases:
            to_speed = speed if phase.speed is None else phase.speed
            to_curvature = curvature if phase.curvature is None else phase.curvature
            if not all(map(math.isfinite, (phase.duration, to_speed, to_curvature))) or phase.duration <= 0:
                raise ValueError(f"a phase takes time and has finite numbers, got {phase}")
            piece = _Piece(phase.duration, (speed, to_speed), (curvature, to_curvature), (x, y), yaw, way)
            self._pieces.append(piece)
            self._starts.append(self.duration)
            self.duration += phase.duration
            x, y = piece.knots[-1]
            # the value of a polynomial at 1
            yaw, way = sum(piece.yaw), sum(piece.way)
            speed, curvature = to_speed, to_curvature
        if not self._pieces:
            raise ValueError("a trajectory needs a phase or more")
        if speed != 0.0:
            raise ValueError(f"a drive ends at rest, this one at {speed:g} m/s: add a phase with speed 0")

    def at(self, t: float) -> TrajectoryMotion:
        """Return the motion `t` seconds after the start."""
        t = min(max(t, 0.0), self.duration)
        index = max(bisect_right(self._starts, t) - 1, 0)
        return self._pieces[index].at(t - self._starts[index])

    def higher_rates(self, t: float) -> Vector3:
        """Return what `TrajectoryMotion` leaves out: rate and second rate of curvature (1/m/s, 1/m/s2), jerk (m/s3).

        Jerk is the second rate of forward speed.
        """
        t = min(max(t, 0.0), self.duration)
        index = max(bisect_right(self._starts, t) - 1, 0)
        return self._pieces[index].higher_rates(t - self._starts[index])


class _Piece:
    """One phase with all its polynomials."""

    __slots__ = (
        "curvature",
        "curvature_rate",
        "curvature_rate_rate",
        "duration",
        "jerk",
        "knots",
        "speed",
        "speed_rate",
        "way",
        "yaw",
        "yaw_acceleration",
        "yaw_rate",
    )

    def __init__(
        self,
        duration: float,
        speed: tuple[float, float],
        curvature: tuple[float, float],
        start: tuple[float, float],
        yaw: float,
        way: float,
    ):
        self.duration = duration
        self.speed = _ramp(*speed)
        self.curvature = _ramp(*curvature)
        self.yaw_rate = _trimmed(polynomial.polymul(self.speed, self.curvature))
        self.speed_rate = _trimmed(polynomial.polyder(self.speed) / duration)
        self.jerk = _trimmed(polynomial.polyder(self.speed_rate) / duration)
        self.curvature_rate = _trimmed(polynomial.polyder(self.curvature) / duration)
        self.curvature_rate_rate = _trimmed(polynomial.polyder(self.curvature_rate) / duration)
        self.yaw_acceleration = _trimmed(polynomial.polyder(self.yaw_rate) / duration)
        self.yaw = _trimmed(polynomial.polyint(np.multiply(self.yaw_rate, duration), k=yaw))
        self.way = _trimmed(polynomial.polyint(np.multiply(self.speed, duration), k=way))
        steps = max(1, math.ceil(duration / _KNOT_SECONDS))
        self.knots = [start]
        for step in range(steps):
            self.knots.append(self._moved(self.knots[-1], step / steps, 1.0 / steps))

    def _moved(self, start: tuple[float, float], u: float, share: float) -> tuple[float, float]:
        """Return the place reached from `start`, at share `u`, after a further share of the duration."""
        x, y = start
        if self.speed == (0.0,):
            return start
        seconds = share * self.duration
        for node, weight in _NODES:
            at = u + share * node
            way = _value(self.speed, at) * weight * seconds
            angle = _value(self.yaw, at)
            x += way * math.cos(angle)
            y += way * math.sin(angle)
        return (x, y)

    def at(self, t: float) -> TrajectoryMotion:
        u = t / self.duration
        steps = len(self.knots) - 1
        knot = min(int(u * steps), steps - 1)
        x, y = self._moved(self.knots[knot], knot / steps, u - knot / steps)
        v = _value(self.speed, u)
        rate = _value(self.speed_rate, u)
        yaw = _value(self.yaw, u)
        yaw_rate = _value(self.yaw_rate, u)
        cos, sin = math.cos(yaw), math.sin(yaw)
        return TrajectoryMotion(
            (x, y, 0.0),
            (v * cos, v * sin, 0.0),
            (rate * cos - v * yaw_rate * sin, rate * sin + v * yaw_rate * cos, 0.0),
            yaw,
            yaw_rate,
            _value(self.yaw_acceleration, u),
            v,
            rate,
            _value(self.way, u),
            _value(self.curvature, u),
        )

    def higher_rates(self, t: float) -> Vector3:
        u = t / self.duration
        return (_value(self.curvature_rate, u), _value(self.curvature_rate_rate, u), _value(self.jerk, u))


def _ramp(start: float, end: float) -> Coefficients:
    if start == end:
        return (start,)
    return (start, *((end - start) * each for each in _SMOOTH_STEP[1:]))


def _trimmed(coefficients: npt.ArrayLike) -> Coefficients:
    return tuple(float(each) for each in polynomial.polytrim(np.asarray(coefficients, dtype=float)))


def _value(coefficients: Coefficients, u: float) -> float:
    """Return the polynomial at `u`, by Horner's rule."""
    total = 0.0
    for each in reversed(coefficients):
        total = total * u + each
    return total

"""Trajectory of a point of the vehicle that does not slide sideways, in closed form.

A drive is a list of phases. In each, forward speed v and path curvature k go from their last value to the phase's own
along the quintic 10u^3 - 15u^4 + 6u^5 of the share u of its duration, so that acceleration and yaw acceleration are
continuous. Both are polynomials of u, hence yaw rate k v and yaw are; only x and y, the integrals of v cos(yaw) and
v sin(yaw), need quadrature (Gauss-Legendre on steps of 0.1 s, exact to rounding).
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

from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion, Vector3

Coefficients: TypeAlias = tuple[float, ...]
"""Of a polynomial in u, the constant first."""

_SMOOTH_STEP = (0.0, 0.0, 0.0, 10.0, -15.0, 6.0)
_KNOT_SECONDS = 0.1
_NODES: tuple[tuple[float, float], ...] = tuple(
    (float(node + 1.0) / 2.0, float(weight) / 2.0)
    for node, weight in zip(*np.polynomial.legendre.leggauss(4), strict=True)
)
"""Nodes and weights of the quadrature on [0, 1]: over 0.1 s its error is below the rounding of meters."""


@dataclass(frozen=True, slots=True)
class DrivePhase:
    """A phase of a drive: the speed and curvature reached at its end; None keeps the current value.

    `duration` in seconds. `speed` is forward, m/s, negative in reverse. `curvature` is the steering's, 1/m, positive to
    the left, so that in reverse it turns the vehicle to the right.
    """

    duration: float
    speed: float | None = None
    curvature: float | None = None


class Attitude(NamedTuple):
    """Attitude of a vehicle on uneven ground, with its rates.

    `wxyz` rotates the vehicle's axes to east, north, up. `rate`, rad/s, and its derivative `acceleration`, rad/s2, are
    relative to east, north, up and along the vehicle's axes.
    """

    wxyz: Quaternion
    rate: Vector3
    acceleration: Vector3


class TrajectoryMotion(NamedTuple):
    """Motion of the vehicle at one instant.

    Attributes
    ----------
    position, velocity, acceleration : of the rolling frame, along east, north, up
    yaw, yaw_rate, yaw_acceleration : counter-clockwise from east, not wrapped
    speed, forward_acceleration : along the vehicle, m/s, m/s2
    distance : integral of the speed on level ground without side slip (reverse counts negative), m
    curvature : of the steering, 1/m
    lateral_speed : to the left, m/s
    attitude : None on level ground
    """

    position: Vector3
    velocity: Vector3
    acceleration: Vector3
    yaw: float
    yaw_rate: float
    yaw_acceleration: float
    speed: float
    forward_acceleration: float
    distance: float
    curvature: float
    lateral_speed: float = 0.0
    attitude: Attitude | None = None

    def orientation(self) -> Quaternion:
        if self.attitude is not None:
            return self.attitude.wxyz
        half = self.yaw / 2.0
        return (math.cos(half), 0.0, 0.0, math.sin(half))

    def pose_of(self, X_VP: Pose) -> Pose:
        """Return the pose along east, north, up of a frame at `X_VP` in the vehicle's moving frame."""
        return Pose(self.position, self.orientation()) @ X_VP

    def angular_rate(self) -> Vector3:
        """Return the angular rate along east, north, up, rad/s."""
        if self.attitude is not None:
            return so3.rotate(self.attitude.wxyz, self.attitude.rate)
        return (0.0, 0.0, self.yaw_rate)

    def velocity_at(self, lever: Vector3) -> Vector3:
        """Return the velocity of the point at `lever` in the vehicle's moving frame, m/s: v + w x r."""
        if self.attitude is not None:
            relative = so3.cross(self.attitude.rate, lever)
            return so3.add(self.velocity, so3.rotate(self.attitude.wxyz, relative))
        vx, vy, vz = self.velocity
        x, y = _rotate_by_yaw(self.yaw, lever)
        w = self.yaw_rate
        return (vx - w * y, vy + w * x, vz)

    def acceleration_at(self, lever: Vector3) -> Vector3:
        """Return the acceleration of the point at `lever`, m/s2: a + dw/dt x r + w x (w x r) (Groves (2013) 2.3)."""
        if self.attitude is not None:
            q, rate, faster = self.attitude
            relative = so3.add(so3.cross(faster, lever), so3.cross(rate, so3.cross(rate, lever)))
            return so3.add(self.acceleration, so3.rotate(q, relative))
        ax, ay, az = self.acceleration
        x, y = _rotate_by_yaw(self.yaw, lever)
        w, wd = self.yaw_rate, self.yaw_acceleration
        return (ax - wd * y - w * w * x, ay + wd * x - w * w * y, az)


def _rotate_by_yaw(yaw: float, v: Vector3) -> tuple[float, float]:
    """Return the horizontal components, along east and north, of a vector in vehicle axes."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return (v[0] * cos - v[1] * sin, v[0] * sin + v[1] * cos)


class MotionModel(Protocol):
    """Motion of a vehicle as a function of time."""

    def at(self, t: float) -> TrajectoryMotion:
        """Return the motion `t` seconds after the start."""


class Trajectory:
    """A drive on level ground that starts and ends stationary; before and after it the vehicle is stationary.

    Raises ValueError for a phase without duration, a number that is not finite, or a drive that does not stop.
    """

    __slots__ = ("_phases", "_pieces", "_starts", "duration")

    def __init__(self, phases: Iterable[DrivePhase], start: tuple[float, float] = (0.0, 0.0), yaw: float = 0.0):
        """Set the phases of the drive, which starts at `start` (east and north, m) with `yaw` (rad)."""
        self._phases: list[DrivePhase] = []
        """With the speed and curvature at its end."""
        self._starts: list[float] = []
        self.duration = 0.0
        """Seconds until the vehicle is stationary for good."""
        speed = curvature = 0.0
        for phase in phases:
            speed = speed if phase.speed is None else phase.speed
            curvature = curvature if phase.curvature is None else phase.curvature
            if not all(map(math.isfinite, (phase.duration, speed, curvature))) or phase.duration <= 0:
                raise ValueError(f"a phase must have a positive duration and finite numbers; got {phase}")
            self._phases.append(DrivePhase(phase.duration, speed, curvature))
            self._starts.append(self.duration)
            self.duration += phase.duration
        if not self._phases:
            raise ValueError("a trajectory must have at least one phase")
        if speed != 0.0:
            raise ValueError(f"the drive ends at {speed:g} m/s; it must end stationary: add a phase with speed 0")
        self._pieces = [_Piece(self._phases[0], (0.0, 0.0), start, yaw, 0.0)]
        """Of the phases so far: each follows from the one before it, and a device needs only those until now."""

    def at(self, t: float) -> TrajectoryMotion:
        piece, u = self._locate(t)
        return piece.at(u)

    def _locate(self, t: float) -> tuple[_Piece, float]:
        """Return the phase at an instant, and the share of its duration that is over."""
        t = min(max(t, 0.0), self.duration)
        index = max(bisect_right(self._starts, t) - 1, 0)
        while len(self._pieces) <= index:
            # from the values at u = 1
            last, phase = self._pieces[-1], self._phases[len(self._pieces)]
            self._pieces.append(_Piece(phase, last.last, last.knots[-1], sum(last.yaw), sum(last.distance)))
        return self._pieces[index], (t - self._starts[index]) / self._pieces[index].duration


class _Piece:
    """Polynomials of one phase, of the share u of its duration."""

    def __init__(
        self, phase: DrivePhase, before: tuple[float, float], start: tuple[float, float], yaw: float, distance: float
    ):
        """Compute a phase that begins with speed and curvature `before`, and at `start`."""
        duration = phase.duration
        assert phase.speed is not None
        assert phase.curvature is not None

        def derive(coefficients: Coefficients) -> Coefficients:
            return _trim(polynomial.polyder(coefficients) / duration)

        def integrate(coefficients: Coefficients, start: float) -> Coefficients:
            return _trim(polynomial.polyint(np.multiply(coefficients, duration), k=start))

        self.duration, self.last = duration, (phase.speed, phase.curvature)
        self.speed, self.curvature = _ramp(before[0], phase.speed), _ramp(before[1], phase.curvature)
        self.yaw_rate = _trim(polynomial.polymul(self.speed, self.curvature))
        self.speed_rate, self.curvature_rate = derive(self.speed), derive(self.curvature)
        self.yaw_acceleration = derive(self.yaw_rate)
        self.yaw, self.distance = integrate(self.yaw_rate, yaw), integrate(self.speed, distance)
        steps = max(1, math.ceil(duration / _KNOT_SECONDS))
        self.knots = [start]
        for step in range(steps):
            self.knots.append(self._integrate(self.knots[-1], step / steps, 1.0 / steps))

    def _integrate(self, start: tuple[float, float], u: float, share: float) -> tuple[float, float]:
        """Return the position reached from `start`, at share `u`, after a further share of the duration."""
        x, y = start
        if self.speed == (0.0,):
            return start
        seconds = share * self.duration
        for node, weight in _NODES:
            at = u + share * node
            distance = _evaluate(self.speed, at) * weight * seconds
            angle = _evaluate(self.yaw, at)
            x += distance * math.cos(angle)
            y += distance * math.sin(angle)
        return (x, y)

    def at(self, u: float) -> TrajectoryMotion:
        steps = len(self.knots) - 1
        knot = min(int(u * steps), steps - 1)
        x, y = self._integrate(self.knots[knot], knot / steps, u - knot / steps)
        v = _evaluate(self.speed, u)
        rate = _evaluate(self.speed_rate, u)
        yaw = _evaluate(self.yaw, u)
        yaw_rate = _evaluate(self.yaw_rate, u)
        cos, sin = math.cos(yaw), math.sin(yaw)
        return TrajectoryMotion(
            (x, y, 0.0),
            (v * cos, v * sin, 0.0),
            (rate * cos - v * yaw_rate * sin, rate * sin + v * yaw_rate * cos, 0.0),
            yaw,
            yaw_rate,
            _evaluate(self.yaw_acceleration, u),
            v,
            rate,
            _evaluate(self.distance, u),
            _evaluate(self.curvature, u),
        )


def _ramp(start: float, end: float) -> Coefficients:
    if start == end:
        return (start,)
    return (start, *((end - start) * each for each in _SMOOTH_STEP[1:]))


def _trim(coefficients: npt.ArrayLike) -> Coefficients:
    return tuple(float(each) for each in polynomial.polytrim(np.asarray(coefficients, dtype=float)))


def _evaluate(coefficients: Coefficients, u: float) -> float:
    """Return the polynomial at `u` (Horner's rule)."""
    total = 0.0
    for each in reversed(coefficients):
        total = total * u + each
    return total


# --- maneuvers ----------------------------------------------------------------------------------------------

_LOOP_ANGLE = 3.0 * math.pi / 2.0
"""Turn of each loop of the figure eight: its straights cross at a right angle."""


def straight(
    speed: float = 2.0, length: float = 30.0, stationary: float = 4.0, ramp: float = 3.0
) -> tuple[DrivePhase, ...]:
    """Return: stationary, drive `length` straight ahead, stop, stationary as long again.

    `ramp` is the time to reach the speed and to stop; a negative speed drives backward. Raises ValueError where the
    ramps alone are longer.
    """
    cruise = length / abs(speed) - ramp
    if cruise <= 0:
        raise ValueError(f"length {length:g} m is too short for two ramps of {ramp:g} s at {speed:g} m/s")
    return (
        DrivePhase(stationary),
        DrivePhase(ramp, speed),
        DrivePhase(cruise),
        DrivePhase(ramp, 0.0),
        DrivePhase(stationary),
    )


def figure_eight(
    speed: float = 2.0,
    radius: float = 8.0,
    stationary: float = 4.0,
    laps: int = 1,
    ramp: float = 3.0,
    stop: float = 0.0,
    reverse: float = 0.0,
) -> tuple[DrivePhase, ...]:
    """Return: stationary, drive off, `laps` times round an eight of two loops of `radius`, stop, stationary.

    The steering goes from straight to full lock in `ramp` seconds, and the speed from 0 to `speed`. With `stop` the
    vehicle halts for that time in the middle of the straight that ends each lap; with `reverse` it then backs up for
    that time at half the speed, and halts again. Except for these, each lap closes on itself. Raises ValueError for
    impossible values.
    """
    if speed <= 0 or radius <= 0 or laps < 1:
        raise ValueError(f"speed and radius must be positive, laps at least 1; got {speed}, {radius}, {laps}")
    curvature = 1.0 / radius
    # each steering ramp turns by half of ramp * speed * curvature
    hold = _LOOP_ANGLE / (speed * curvature) - ramp
    if hold <= 0:
        raise ValueError(f"a loop of {radius:g} m at {speed:g} m/s is shorter than {ramp:g} s of steering")

    def loop(side: float) -> tuple[DrivePhase, ...]:
        return (DrivePhase(ramp, curvature=side * curvature), DrivePhase(hold), DrivePhase(ramp, curvature=0.0))

    # length of the straights for which the tangents at both ends of a loop meet in the crossing
    probe = Trajectory((DrivePhase(ramp, speed), *loop(1.0), DrivePhase(1.0, 0.0)))
    (x0, _, _), (x1, _, _) = probe.at(ramp).position, probe.at(3 * ramp + hold).position
    half = (x0 - x1) / (1.0 + math.cos(_LOOP_ANGLE)) / speed
    if half <= 0:
        raise ValueError(f"ramp {ramp:g} s is too long for a loop of {radius:g} m at {speed:g} m/s")
    lap = [DrivePhase(half), *loop(1.0), DrivePhase(2.0 * half), *loop(-1.0), DrivePhase(half)]
    halt = [DrivePhase(ramp, 0.0), DrivePhase(max(stop, 1.0))]
    if stop > 0 or reverse > 0:
        lap += halt
        if reverse > 0:
            lap += [DrivePhase(ramp, -speed / 2.0), DrivePhase(reverse), *halt]
        lap.append(DrivePhase(ramp, speed))
    wait = [DrivePhase(stationary)] if stationary > 0 else []
    return (*wait, DrivePhase(ramp, speed), *lap * laps, DrivePhase(ramp, 0.0), *wait)


def stationary(seconds: float) -> tuple[DrivePhase, ...]:
    return (DrivePhase(seconds),)


_MAX_LATERAL_ACCELERATION = 2.0
"""m/s2 that a driver does not exceed in a turn in town."""

_MEAN_ACCELERATION = 1.5
"""m/s2, the upper end of the mean acceleration when driving off and stopping."""


def city(seed: int, seconds: float = 120.0, speed: float = 6.0, min_radius: float = 6.0) -> tuple[DrivePhase, ...]:
    """Return a random drive of `seconds`: straights, turns either way, stops, reversing; stationary at both ends.

    `speed` is the largest, `min_radius` the smallest radius. The same seed gives the same drive. Raises ValueError for
    less than 20 seconds, or for a limit that is not positive.
    """
    if not (seconds >= 20.0 and speed > 0 and min_radius > 0):
        raise ValueError(
            f"seconds must be at least 20, speed and radius positive; got {seconds}, {speed}, {min_radius}"
        )
    chance = np.random.default_rng([seed, *b"city"])
    phases = [DrivePhase(chance.uniform(2.0, 4.0))]
    left = seconds - phases[0].duration
    now = 0.0

    def to(target: float) -> DrivePhase:
        """Return the phase that reaches a speed, with a random acceleration."""
        return DrivePhase(
            max(1.5, abs(target - now) / chance.uniform(0.5 * _MEAN_ACCELERATION, _MEAN_ACCELERATION)), target
        )

    while True:
        part: list[DrivePhase] = []
        end = now
        kind = chance.integers(6) if now else 5
        if kind == 4:
            part, end = [to(0.0), DrivePhase(chance.uniform(1.0, 6.0))], 0.0
        elif kind == 3:
            back = -chance.uniform(0.2, 0.4) * speed
            bend = chance.uniform(-1.0, 1.0) / min_radius
            part = [to(0.0), DrivePhase(chance.uniform(0.5, 2.0)), DrivePhase(2.0, back, bend)]
            part += [
                DrivePhase(chance.uniform(1.0, 5.0)),
                DrivePhase(2.0, 0.0, 0.0),
                DrivePhase(chance.uniform(0.5, 2.0)),
            ]
            end = 0.0
        elif kind in (1, 2):
            bend = math.copysign(1.0, chance.uniform(-1.0, 1.0)) / (min_radius * chance.uniform(1.0, 4.0))
            slow = min(now, math.sqrt(_MAX_LATERAL_ACCELERATION / abs(bend)))
            # a steering ramp turns by half of what full lock does
            hold = max(chance.uniform(0.3, 2.0) / (abs(bend) * slow) - 1.5, 0.2)
            part, end = [to(slow), DrivePhase(1.5, None, bend), DrivePhase(hold), DrivePhase(1.5, None, 0.0)], slow
        elif kind == 0:
            part = [DrivePhase(chance.uniform(1.0, 6.0))]
        else:
            end = chance.uniform(0.4, 1.0) * speed
            part = [to(end), DrivePhase(chance.uniform(0.5, 4.0))]
        # keep enough time to stop
        if sum(phase.duration for phase in part) + end / (0.5 * _MEAN_ACCELERATION) + 2.0 > left:
            break
        phases += part
        left -= sum(phase.duration for phase in part)
        now = end
    if now:
        stopping = max(1.5, now / (0.5 * _MEAN_ACCELERATION))
        phases.append(DrivePhase(stopping, 0.0))
        left -= stopping
    return (*phases, DrivePhase(left))

"""Ride: a trajectory driven on ground that rises by a vehicle that slides, with exact derivatives.

The path over the plan is the trajectory's. Side slip turns the vehicle beside the path instead of moving the path
beside the vehicle: then nothing needs to be integrated. The ground gives the third coordinate and the tilt.
"""

from __future__ import annotations

import math

from modelserver.simulation.side_slip import SideSlip, SlipAngle
from modelserver.simulation.terrain import Rise, Terrain
from modelserver.simulation.trajectory import Attitude, MotionModel, Trajectory, TrajectoryMotion
from modelserver.spatial import so3
from modelserver.spatial.so3 import Vector3


def ride(
    trajectory: Trajectory, terrain: Terrain | None = None, side_slip: SideSlip | None = None, seed: int = 1
) -> MotionModel:
    """Return the drive: the trajectory itself on level ground without slip."""
    if terrain is None and side_slip is None:
        return trajectory
    return Ride(trajectory, terrain, side_slip, seed)


class Ride:
    """A trajectory on rising ground, with side slip, or both; `at` is to it what it is to `Trajectory`."""

    __slots__ = ("_slip", "_terrain", "_trajectory")

    def __init__(self, trajectory: Trajectory, terrain: Terrain | None, side_slip: SideSlip | None, seed: int):
        """Take the trajectory, the ground or None for level, the slip or None, and the slip's seed."""
        self._trajectory = trajectory
        self._terrain = terrain
        self._slip = None if side_slip is None else SlipAngle(side_slip, seed)

    def at(self, t: float) -> TrajectoryMotion:
        """Return the motion `t` seconds after the start."""
        plan = self._trajectory.at(t)
        turn = (plan.yaw, plan.yaw_rate, plan.yaw_acceleration)
        along, across = plan.speed, 0.0
        if self._slip is not None:
            b, b1, b2 = self._slip.at(t, plan, self._trajectory.higher_rates(t))
            turn = (plan.yaw - b, plan.yaw_rate - b1, plan.yaw_acceleration - b2)
            along, across = plan.speed * math.cos(b), plan.speed * math.sin(b)
        yaw, yaw_rate, yaw_acceleration = turn
        cos, sin = math.cos(yaw), math.sin(yaw)
        ax, ay, _ = plan.acceleration
        push = ax * cos + ay * sin
        if self._terrain is None:
            return TrajectoryMotion(
                plan.position,
                plan.velocity,
                plan.acceleration,
                yaw,
                yaw_rate,
                yaw_acceleration,
                along,
                push + yaw_rate * across,
                plan.way,
                plan.curvature,
                across,
            )
        ground = self._terrain.under(plan.position, plan.velocity, plan.acceleration)
        slope = _Slope(turn, cos, sin, ground)
        attitude = slope.attitude
        z, vz, az = ground.height
        # forward is (cos, sin, ahead) / length; along the ground to the left a way is longer than over the plan
        left = across * slope.steepness / slope.length
        return TrajectoryMotion(
            (plan.position[0], plan.position[1], z),
            (plan.velocity[0], plan.velocity[1], vz),
            (ax, ay, az),
            yaw,
            yaw_rate,
            yaw_acceleration,
            (along + slope.ahead * vz) / slope.length,
            (push + slope.ahead * az) / slope.length + attitude.rate[2] * left,
            plan.way,
            plan.curvature,
            left,
            attitude,
        )


class _Slope:
    """The ground's slope along a heading, and the attitude of what stands on it, from fixed-axis angles.

    With slopes q ahead and p to the left: pitch = -atan q, roll = atan(p / sqrt(1 + q^2)), so that the vehicle's z is
    the ground's normal and its x the tangent ahead. `length` is sqrt(1 + q^2), `steepness` sqrt(1 + q^2 + p^2).
    """

    __slots__ = ("ahead", "attitude", "length", "steepness")

    def __init__(self, turn: Vector3, cos: float, sin: float, ground: Rise):
        """Take yaw with its two rates, its cosine and sine, and the ground."""
        yaw, w, w1 = turn
        e, e1, e2 = ground.east
        n, n1, n2 = ground.north
        q, p = e * cos + n * sin, n * cos - e * sin
        f1, g1 = e1 * cos + n1 * sin, n1 * cos - e1 * sin
        q1, p1 = f1 + w * p, g1 - w * q
        q2 = e2 * cos + n2 * sin + w * g1 + w1 * p + w * p1
        p2 = n2 * cos - e2 * sin - w * f1 - w1 * q - w * q1
        # D = sqrt(1 + q^2) and r = p / D, with their rates
        D2 = 1.0 + q * q
        D = math.sqrt(D2)
        D_1 = q * q1 / D
        D_2 = (q1 * q1 + q * q2 - D_1 * D_1) / D
        r = p / D
        r1 = (p1 - r * D_1) / D
        r2 = (p2 - 2.0 * r1 * D_1 - r * D_2) / D
        pitch, pitch1, pitch2 = -math.atan(q), -q1 / D2, (2.0 * q * q1 * q1 / D2 - q2) / D2
        R2 = 1.0 + r * r
        roll, roll1, roll2 = math.atan(r), r1 / R2, (r2 - 2.0 * r * r1 * r1 / R2) / R2
        sp, cp = -q / D, 1.0 / D
        cr = 1.0 / math.sqrt(R2)
        sr = r * cr
        # rates along the vehicle's axes of yaw, pitch and roll; their derivatives are the acceleration's parts
        wx, wy, wz = roll1 - w * sp, pitch1 * cr + w * cp * sr, w * cp * cr - pitch1 * sr
        # w cp and its rate
        level1 = w1 * cp - w * sp * pitch1
        self.ahead, self.length, self.steepness = q, D, math.sqrt(D2 + p * p)
        self.attitude = Attitude(
            so3.from_rpy(roll, pitch, yaw),
            (wx, wy, wz),
            (
                roll2 - w1 * sp - w * cp * pitch1,
                pitch2 * cr + level1 * sr + roll1 * wz,
                level1 * cr - pitch2 * sr - roll1 * wy,
            ),
        )

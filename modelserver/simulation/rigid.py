"""How a point of a rigid vehicle moves, given how one other point does: v + w x r, a + w' x r + w x (w x r)."""

from __future__ import annotations

import math

from modelserver.simulation.trajectory import Motion
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Vector3


def pose(motion: Motion, X_VP: Pose) -> Pose:
    """Return the pose, along east, north, up, of a frame that stands at `X_VP` in the vehicle's moving frame."""
    half = motion.yaw / 2.0
    return Pose(motion.position, (math.cos(half), 0.0, 0.0, math.sin(half))) @ X_VP


def velocity(motion: Motion, lever: Vector3) -> Vector3:
    """Return the velocity, east, north, up, of the point at `lever` in the vehicle's moving frame."""
    x, y = _turned(motion.yaw, lever)
    vx, vy, vz = motion.velocity
    w = motion.yaw_rate
    return (vx - w * y, vy + w * x, vz)


def acceleration(motion: Motion, lever: Vector3) -> Vector3:
    """Return the acceleration, east, north, up, of the point at `lever` in the vehicle's moving frame."""
    x, y = _turned(motion.yaw, lever)
    ax, ay, az = motion.acceleration
    w, wd = motion.yaw_rate, motion.yaw_acceleration
    return (ax - wd * y - w * w * x, ay + wd * x - w * w * y, az)


def _turned(yaw: float, v: Vector3) -> tuple[float, float]:
    """Return the horizontal part of a vector of the vehicle along east and north."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return (v[0] * cos - v[1] * sin, v[0] * sin + v[1] * cos)

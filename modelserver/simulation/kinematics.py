"""Rigid-body kinematics: motion of a point of the vehicle at lever arm r from the rolling frame's motion.

v_p = v + w x r, a_p = a + dw/dt x r + w x (w x r). Results are along east, north, up (Groves (2013) 2.3).
"""

from __future__ import annotations

import math

from modelserver.simulation.trajectory import TrajectoryMotion
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion, Vector3


def orientation(motion: TrajectoryMotion) -> Quaternion:
    """Return the quaternion that rotates the vehicle's axes to east, north, up."""
    if motion.attitude is not None:
        return motion.attitude.wxyz
    half = motion.yaw / 2.0
    return (math.cos(half), 0.0, 0.0, math.sin(half))


def pose(motion: TrajectoryMotion, X_VP: Pose) -> Pose:
    """Return the pose along east, north, up of a frame at `X_VP` in the vehicle's moving frame."""
    return Pose(motion.position, orientation(motion)) @ X_VP


def angular_rate(motion: TrajectoryMotion) -> Vector3:
    """Return the angular rate, rad/s."""
    if motion.attitude is not None:
        return so3.rotate(motion.attitude.wxyz, motion.attitude.rate)
    return (0.0, 0.0, motion.yaw_rate)


def velocity(motion: TrajectoryMotion, lever: Vector3) -> Vector3:
    """Return the velocity of the point at `lever` in the vehicle's moving frame, m/s."""
    if motion.attitude is not None:
        turning = so3.cross(motion.attitude.rate, lever)
        return so3.add(motion.velocity, so3.rotate(motion.attitude.wxyz, turning))
    vx, vy, vz = motion.velocity
    x, y = _rotate_by_yaw(motion.yaw, lever)
    w = motion.yaw_rate
    return (vx - w * y, vy + w * x, vz)


def acceleration(motion: TrajectoryMotion, lever: Vector3) -> Vector3:
    """Return the acceleration of the point at `lever` in the vehicle's moving frame, m/s2."""
    if motion.attitude is not None:
        q, rate, faster = motion.attitude
        relative = so3.add(so3.cross(faster, lever), so3.cross(rate, so3.cross(rate, lever)))
        return so3.add(motion.acceleration, so3.rotate(q, relative))
    ax, ay, az = motion.acceleration
    x, y = _rotate_by_yaw(motion.yaw, lever)
    w, wd = motion.yaw_rate, motion.yaw_acceleration
    return (ax - wd * y - w * w * x, ay + wd * x - w * w * y, az)


def _rotate_by_yaw(yaw: float, v: Vector3) -> tuple[float, float]:
    """Return the horizontal components, along east and north, of a vector in vehicle axes."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return (v[0] * cos - v[1] * sin, v[0] * sin + v[1] * cos)

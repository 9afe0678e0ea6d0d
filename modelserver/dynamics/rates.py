"""From rates of the geometry's coordinates to the velocities of Pinocchio's joints.

Pinocchio's velocity w of a joint with several degrees of freedom is along the axes of its far frame: angular velocity
(spherical), twist in the plane (planar), twist (floating). The coordinates here are lengths and rotation vectors, with
plain derivatives. So for each joint

    w = S(q) q',    w' = S(q) q'' + S'(q, q') q'

S is the joint's Jacobian, turned into the far frame. For a joint passed backward the far frame is the constraint's
`from` frame, which moves by the inverse displacement; with the position p, angular velocity o and left Jacobian J_l of
the rotation vector, along the axes of the near frame at 0:

    forward    linear R' p',         angular J_r phi' = J_l(-phi) phi'
    backward   linear -p' + o x p,   angular -o = -J_l(phi) phi'

J_l is that of Sola (2017), eq. 183; its derivative follows from its two scalar functions of the angle. A rotation
vector is singular at a length of 2 pi, as every three numbers of a rotation are somewhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from modelserver.geometry.joint import Joint, JointType
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Vector3

SMALL_ANGLE = 0.1
"""Radians below which the functions of the angle are taken from their series: the quotients lose digits there."""


def compute_configuration(joint: Joint, forward: bool, position: Sequence[float]) -> tuple[float, ...]:
    """Return Pinocchio's configuration of a joint: x y z w of a quaternion, x y cos sin, or x y z and a quaternion."""
    if joint.type is JointType.PLANAR:
        u, v, turn = position
        c, s = math.cos(turn), math.sin(turn)
        return (u, v, c, s) if forward else (-c * u - s * v, s * u - c * v, c, -s)
    X = joint.compute_pose(position)
    if not forward:
        X = X.inverse()
    w, x, y, z = X._q
    return (x, y, z, w) if joint.type is JointType.SPHERICAL else (*X._p, x, y, z, w)


def compute_rate_map(joint: Joint, forward: bool, position: Sequence[float]) -> Array:
    """Return S (k, n) of a joint with several coordinates."""
    if joint.type is JointType.PLANAR:
        u, v, turn = position
        c, s = math.cos(turn), math.sin(turn)
        rows = [(c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)] if forward else [(-1, 0, -v), (0, -1, u), (0, 0, -1)]
        return np.array(rows, dtype=float)
    x, y, z = position[-3:]
    turning = so3.left_jacobian((-x, -y, -z)) if forward else -so3.left_jacobian((x, y, z))
    if joint.type is JointType.SPHERICAL:
        return turning
    S = np.zeros((6, 6))
    S[3:, 3:] = turning
    if forward:
        S[:3, :3] = np.array(so3.matrix_rows(so3.exponential((x, y, z)))).T
    else:
        S[:3, :3] = -np.eye(3)
        S[:3, 3:] = so3.skew(position[:3]) @ turning
    return S


def compute_rate_bias(joint: Joint, forward: bool, position: Sequence[float], rates: Sequence[float]) -> Array:
    """Return S' q' (k) of a joint with several coordinates."""
    if joint.type is JointType.PLANAR:
        du, dv, turning = rates
        c, s = math.cos(position[2]), math.sin(position[2])
        found = (-s * du + c * dv, -c * du - s * dv, 0.0) if forward else (-dv, du, 0.0)
        return turning * np.array(found)
    phi, change = np.array(position[-3:]), np.array(rates[-3:])
    sign = -1.0 if forward else 1.0
    J = so3.left_jacobian(so3.to_vector3(sign * phi))
    # forward: J_l(-phi) phi'; backward: -J_l(phi) phi'
    angular = -sign * (left_jacobian_rate(so3.to_vector3(sign * phi), so3.to_vector3(sign * change)) @ change)
    if joint.type is JointType.SPHERICAL:
        return np.asarray(angular)
    p, dp = np.array(position[:3]), np.array(rates[:3])
    if forward:
        R = np.array(so3.matrix_rows(so3.exponential(so3.to_vector3(phi))))
        linear = -np.cross(J @ change, R.T @ dp)
    else:
        linear = np.cross(-angular, p) + np.cross(J @ change, dp)
    return np.concatenate((linear, angular))


def left_jacobian_rate(v: Vector3, rate: Vector3) -> Array:
    """Return the derivative (3, 3) of the left Jacobian at a rotation vector that changes at a rate."""
    square = v[0] ** 2 + v[1] ** 2 + v[2] ** 2
    angle = math.sqrt(square)
    if angle < SMALL_ANGLE:
        a = 0.5 - square / 24.0 + square**2 / 720.0
        b = 1.0 / 6.0 - square / 120.0 + square**2 / 5040.0
        da = -1.0 / 12.0 + square / 180.0 - square**2 / 6720.0
        db = -1.0 / 60.0 + square / 1260.0 - square**2 / 60480.0
    else:
        sine, versine = math.sin(angle), 2.0 * math.sin(angle / 2.0) ** 2
        a, b = versine / square, (angle - sine) / (square * angle)
        da = (angle * sine - 2.0 * versine) / square**2
        db = (angle * versine - 3.0 * (angle - sine)) / (square**2 * angle)
    along = v[0] * rate[0] + v[1] * rate[1] + v[2] * rate[2]
    K, dK = so3.skew(v), so3.skew(rate)
    return np.asarray(along * (da * K + db * (K @ K)) + a * dK + b * (dK @ K + K @ dK))

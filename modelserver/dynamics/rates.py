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

Vector = tuple[float, ...]

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
    phi = (-x, -y, -z) if forward else (x, y, z)
    turning = _compute_left_jacobian(phi, 1.0 if forward else -1.0)
    if joint.type is JointType.SPHERICAL:
        return np.array(turning)
    S = np.zeros((6, 6))
    S[3:, 3:] = turning
    if forward:
        S[:3, :3] = so3.matrix_rows(so3.exponential(phi))
    else:
        S[0, 0] = S[1, 1] = S[2, 2] = -1.0
        S[:3, 3:] = so3.skew(position[:3]) @ S[3:, 3:]
    return S


def _compute_left_jacobian(v: Vector3, factor: float) -> tuple[Vector3, Vector3, Vector3]:
    """Return the rows of J_l(v) times a factor; `so3.left_jacobian` in plain floats."""
    a, b, _, _ = _get_coefficients(v)
    x, y, z = v
    a, b = factor * a, factor * b
    xx, yy, zz, xy, xz, yz = b * x * x, b * y * y, b * z * z, b * x * y, b * x * z, b * y * z
    return (
        (factor - yy - zz, xy - a * z, xz + a * y),
        (xy + a * z, factor - xx - zz, yz - a * x),
        (xz - a * y, yz + a * x, factor - xx - yy),
    )


def compute_rate_bias(joint: Joint, forward: bool, position: Sequence[float], rates: Sequence[float]) -> Vector:
    """Return S' q' (k) of a joint with several coordinates."""
    if joint.type is JointType.PLANAR:
        du, dv, turning = rates
        c, s = math.cos(position[2]), math.sin(position[2])
        if forward:
            return (turning * (-s * du + c * dv), -turning * (c * du + s * dv), 0.0)
        return (-turning * dv, turning * du, 0.0)
    # forward: J_l(-phi) phi'; backward: -J_l(phi) phi'
    sign = -1.0 if forward else 1.0
    phi = so3.scale(sign, so3.to_vector3(position[-3:]))
    change = so3.scale(sign, so3.to_vector3(rates[-3:]))
    angular = so3.scale(-1.0, compute_turn_bias(phi, change))
    if joint.type is JointType.SPHERICAL:
        return angular
    p, dp = so3.to_vector3(position[:3]), so3.to_vector3(rates[:3])
    turning_rate = so3.scale(sign, compute_turn_rate(phi, change))
    if forward:
        w, x, y, z = so3.exponential(phi)
        linear = so3.cross(so3.rotate((w, x, y, z), dp), turning_rate)
    else:
        linear = so3.add(so3.cross(p, angular), so3.cross(turning_rate, dp))
    return (*linear, *angular)


def compute_turn_rate(v: Vector3, rate: Vector3) -> Vector3:
    """Return J_l(v) v', the angular velocity of a rotation vector that changes at a rate."""
    a, b, _, _ = _get_coefficients(v)
    turned = so3.cross(v, rate)
    return so3.add(rate, so3.scale(a, turned), so3.scale(b, so3.cross(v, turned)))


def compute_turn_bias(v: Vector3, rate: Vector3) -> Vector3:
    """Return J_l' v', the angular acceleration of a rotation vector that changes at a constant rate.

    With J_l = 1 + a [v]x + b [v]x [v]x, and da, db the derivatives of a, b by v.v / 2.
    """
    _, b, da, db = _get_coefficients(v)
    along = v[0] * rate[0] + v[1] * rate[1] + v[2] * rate[2]
    turned = so3.cross(v, rate)
    twice = so3.cross(v, turned)
    return so3.add(so3.scale(along * da, turned), so3.scale(along * db, twice), so3.scale(b, so3.cross(rate, turned)))


def _get_coefficients(v: Vector3) -> tuple[float, float, float, float]:
    square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    angle = math.sqrt(square)
    if angle < SMALL_ANGLE:
        return (
            0.5 - square / 24.0 + square * square / 720.0,
            1.0 / 6.0 - square / 120.0 + square * square / 5040.0,
            -1.0 / 12.0 + square / 180.0 - square * square / 6720.0,
            -1.0 / 60.0 + square / 1260.0 - square * square / 60480.0,
        )
    sine, versine = math.sin(angle), 2.0 * math.sin(angle / 2.0) ** 2
    return (
        versine / square,
        (angle - sine) / (square * angle),
        (angle * sine - 2.0 * versine) / (square * square),
        (angle * versine - 3.0 * (angle - sine)) / (square * square * angle),
    )

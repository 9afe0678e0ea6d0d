"""From rates of a rotation vector to angular velocity and back, in plain floats.

With the left Jacobian J_l(v) = 1 + a [v]x + b [v]x [v]x of SO(3) (Sola 2017, eq. 183), a rotation vector that changes
at the rate v' has the angular velocity J_l(v) v' along the axes of the near frame, J_r(v) v' = J_l(-v) v' along those
of the far one. a and b are functions of v.v, so the derivative of J_l needs only theirs, da and db by v.v / 2. All are
taken from series at small angles, where their quotients lose digits. A rotation vector is singular at a length of 2 pi,
as every three numbers of a rotation are somewhere.
"""

from __future__ import annotations

import math

from modelserver.transforms.so3 import Vector3

SMALL_ANGLE = 0.1
"""Radians below which the functions of the angle are taken from their series: the quotients lose digits there."""


def compute_turn_bias(v: Vector3, rate: Vector3, sign: float = 1.0) -> Vector3:
    """Return the angular acceleration of a rotation vector that changes at a constant rate: the derivative of J_l v'.

    It is (v.v') (da v x v' + db v x (v x v')) + b v' x (v x v'). With `sign` -1 it is that of J_r v'.
    """
    x, y, z = v
    dx, dy, dz = rate
    square = x * x + y * y + z * z
    along = x * dx + y * dy + z * dz
    b, da, db = _get_coefficients(square)
    k = sign * along * da
    m = along * along * db + b * (dx * dx + dy * dy + dz * dz)
    n = -along * (square * db + b)
    return (
        k * (y * dz - z * dy) + m * x + n * dx,
        k * (z * dx - x * dz) + m * y + n * dy,
        k * (x * dy - y * dx) + m * z + n * dz,
    )


def compute_turn_rate(v: Vector3, velocity: Vector3, sign: float = 1.0) -> Vector3:
    """Return the rate at which a rotation vector changes with an angular velocity: the inverse of J_l, times that.

    It is 1 - [v]x / 2 + c [v]x [v]x, c = (1 - h cot h) / v.v with half the angle h. With `sign` -1 it is that of J_r.
    """
    x, y, z = v
    dx, dy, dz = velocity
    square = x * x + y * y + z * z
    if square < SMALL_ANGLE * SMALL_ANGLE:
        c = 1.0 / 12.0 + square / 720.0 + square * square / 30240.0 + square * square * square / 1209600.0
    elif square < math.inf:
        half = 0.5 * math.sqrt(square)
        c = (1.0 - half / math.tan(half)) / square
    else:
        c = math.nan
    m = c * (x * dx + y * dy + z * dz)
    n = 1.0 - c * square
    k = -0.5 * sign
    return (
        k * (y * dz - z * dy) + m * x + n * dx,
        k * (z * dx - x * dz) + m * y + n * dy,
        k * (x * dy - y * dx) + m * z + n * dz,
    )


def _get_coefficients(square: float) -> tuple[float, float, float]:
    """Return b, da and db of the squared angle."""
    if square < SMALL_ANGLE * SMALL_ANGLE:
        return (
            1.0 / 6.0 - square / 120.0 + square * square / 5040.0,
            -1.0 / 12.0 + square / 180.0 - square * square / 6720.0,
            -1.0 / 60.0 + square / 1260.0 - square * square / 60480.0,
        )
    if not square < math.inf:
        return (math.nan,) * 3
    angle = math.sqrt(square)
    sine, versine = math.sin(angle), 2.0 * math.sin(angle / 2.0) ** 2
    return (
        (angle - sine) / (square * angle),
        (angle * sine - 2.0 * versine) / (square * square),
        (angle * versine - 3.0 * (angle - sine)) / (square * square * angle),
    )

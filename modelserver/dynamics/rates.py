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


def compute_turn_motion(
    v: Vector3, rate: Vector3, change: Vector3 = (0.0, 0.0, 0.0), sign: float = 1.0
) -> tuple[Vector3, Vector3]:
    """Return angular velocity J_l v' and acceleration of a rotation vector, with v' and v''. `sign` -1: of J_r.

    The acceleration is J_l v'' + (v.v') (da v x v' + db v x (v x v')) + b v' x (v x v').
    """
    x, y, z = v
    dx, dy, dz = rate
    ddx, ddy, ddz = change
    square = x * x + y * y + z * z
    along = x * dx + y * dy + z * dz
    a, b, da, db = _get_coefficients(square)
    # sums of multiples: of crosses, of v, of v' and v''
    c, n = sign * a, 1.0 - b * square
    m = b * along
    cx, cy, cz = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
    k = sign * along * da
    dm = along * along * db + b * (dx * dx + dy * dy + dz * dz + x * ddx + y * ddy + z * ddz)
    dn = -along * (square * db + b)
    return (
        (c * cx + m * x + n * dx, c * cy + m * y + n * dy, c * cz + m * z + n * dz),
        (
            k * cx + c * (y * ddz - z * ddy) + dm * x + dn * dx + n * ddx,
            k * cy + c * (z * ddx - x * ddz) + dm * y + dn * dy + n * ddy,
            k * cz + c * (x * ddy - y * ddx) + dm * z + dn * dz + n * ddz,
        ),
    )


def compute_turn_rate(v: Vector3, velocity: Vector3, sign: float = 1.0) -> Vector3:
    """Return the rate at which a rotation vector changes with an angular velocity: the inverse of J_l, times that.

    It is 1 - [v]x / 2 + c [v]x [v]x, c = (1 - h cot h) / v.v with half the angle h. With `sign` -1 it is that of J_r.
    """
    x, y, z = v
    dx, dy, dz = velocity
    square = x * x + y * y + z * z
    if square < SMALL_ANGLE * SMALL_ANGLE:
        c = 1.0 / 12.0 + square * (1.0 / 720.0 + square * (1.0 / 30240.0 + square / 1209600.0))
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


def _get_coefficients(square: float) -> tuple[float, float, float, float]:
    """Return a, b, da and db of the squared angle."""
    if square < SMALL_ANGLE * SMALL_ANGLE:
        return (
            1.0 / 2.0 - square * (1.0 / 24.0 - square * (1.0 / 720.0 - square / 40320.0)),
            1.0 / 6.0 - square * (1.0 / 120.0 - square * (1.0 / 5040.0 - square / 362880.0)),
            -1.0 / 12.0 + square * (1.0 / 180.0 - square * (1.0 / 6720.0 - square / 453600.0)),
            -1.0 / 60.0 + square * (1.0 / 1260.0 - square * (1.0 / 60480.0 - square / 4989600.0)),
        )
    if not square < math.inf:
        return (math.nan,) * 4
    angle = math.sqrt(square)
    sine, versine = math.sin(angle), 2.0 * math.sin(angle / 2.0) ** 2
    return (
        versine / square,
        (angle - sine) / (square * angle),
        (angle * sine - 2.0 * versine) / (square * square),
        (angle * versine - 3.0 * (angle - sine)) / (square * square * angle),
    )

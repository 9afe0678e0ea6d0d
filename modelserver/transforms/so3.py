"""Rotations as unit quaternions (Hamilton, scalar first), in plain floats.

A quaternion is a tuple `(w, x, y, z)`. Plain floats, not arrays: at this size numpy costs ten times the arithmetic, and
these functions run in the hot loop. `pose_array` has them for many rotations.

Sources: J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017 (product, exponential, logarithm, left
Jacobian eq. 183); S. Shepperd, "Quaternion from rotation matrix", 1978 (largest-component branch).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Vector3: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]

Matrix3: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]
"""Nine numbers, row-major."""
Array: TypeAlias = npt.NDArray[np.float64]

IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)

UNIT_TOLERANCE = 2e-15
"""A squared length this near to 1 is 1 within rounding: what one normalization leaves is 1.1e-15 at most."""


def normalize(q: Quaternion) -> Quaternion:
    """Return `q` at unit length with w >= 0.

    A quaternion that is unit within rounding keeps its bits, so that a round trip through a file is exact.
    Raises ValueError for a zero or non-finite quaternion.
    """
    w, x, y, z = q
    squared = w * w + x * x + y * y + z * z
    scale = 1.0
    if abs(squared - 1.0) <= UNIT_TOLERANCE:
        if w > 0.0:
            return q
    elif 1e-200 < squared < 1e200:
        scale = 1.0 / math.sqrt(squared)
    else:
        # the squares overflow or vanish: bring the largest component to 1 first
        largest = max(map(abs, q))
        if not all(map(math.isfinite, q)) or largest == 0.0:
            raise ValueError(f"a quaternion must be finite and not zero, got {q}")
        return normalize((w / largest, x / largest, y / largest, z / largest))
    if w < 0.0 or (w == 0.0 and (x, y, z) < (0.0, 0.0, 0.0)):
        scale = -scale
    if scale == 1.0:
        return q
    # + 0.0 turns a negative zero into zero
    return (w * scale + 0.0, x * scale + 0.0, y * scale + 0.0, z * scale + 0.0)


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation `b` followed by `a`: R(a) R(b)."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def conjugate(q: Quaternion) -> Quaternion:
    return (q[0], -q[1], -q[2], -q[3])


def rotate(q: Quaternion, v: Vector3) -> Vector3:
    """Return R(q) v."""
    w, x, y, z = q
    vx, vy, vz = v
    tx = 2.0 * (y * vz - z * vy)
    ty = 2.0 * (z * vx - x * vz)
    tz = 2.0 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )


def rotate_back(q: Quaternion, v: Vector3) -> Vector3:
    """Return R(q)' v: the bits of `rotate` by the conjugate."""
    w, x, y, z = q
    vx, vy, vz = v
    tx = 2.0 * (z * vy - y * vz)
    ty = 2.0 * (x * vz - z * vx)
    tz = 2.0 * (y * vx - x * vy)
    return (
        vx + w * tx - y * tz + z * ty,
        vy + w * ty - z * tx + x * tz,
        vz + w * tz - x * ty + y * tx,
    )


def cross(a: Vector3, b: Vector3) -> Vector3:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def add(*vectors: Vector3) -> Vector3:
    """Return the sum of vectors."""
    x = y = z = 0.0
    for a, b, c in vectors:
        x, y, z = x + a, y + b, z + c
    return (x, y, z)


def scale(factor: float, v: Vector3) -> Vector3:
    return (factor * v[0], factor * v[1], factor * v[2])


def to_vector3(values: Iterable[float]) -> Vector3:
    """Return three numbers, e.g. of an array, as plain floats."""
    x, y, z = values
    return (float(x), float(y), float(z))


def matrix_rows(q: Quaternion) -> tuple[Vector3, Vector3, Vector3]:
    """Return the rows of the rotation matrix R(q)."""
    w, x, y, z = q
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz = x * y, x * z, y * z
    wx, wy, wz = w * x, w * y, w * z
    return (
        (1.0 - 2.0 * (yy + zz), 2.0 * (xy - wz), 2.0 * (xz + wy)),
        (2.0 * (xy + wz), 1.0 - 2.0 * (xx + zz), 2.0 * (yz - wx)),
        (2.0 * (xz - wy), 2.0 * (yz + wx), 1.0 - 2.0 * (xx + yy)),
    )


def from_rows(rows: tuple[Vector3, Vector3, Vector3]) -> Quaternion:
    """Return the unit quaternion of the rows of a rotation matrix; see `nearest_rotation` for one that is inexact."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    trace = a + e + i
    largest = max(trace, a, e, i)
    if largest == trace:
        q = (1.0 + trace, h - f, c - g, d - b)
    elif largest == a:
        q = (h - f, 1.0 + a - e - i, b + d, c + g)
    elif largest == e:
        q = (c - g, b + d, 1.0 - a + e - i, f + h)
    else:
        q = (d - b, c + g, f + h, 1.0 - a - e + i)
    return normalize(q)


def from_matrix(R: npt.ArrayLike) -> Quaternion:
    """Return the unit quaternion of a rotation matrix (3, 3); see `nearest_rotation` for one that is inexact."""
    a, b, c = map(to_vector3, np.asarray(R, dtype=float).tolist())
    return from_rows((a, b, c))


def from_rpy(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the rotation of fixed-axis roll, pitch, yaw in radians: Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return normalize(
        (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        )
    )


def to_rpy(q: Quaternion) -> Vector3:
    """Return fixed-axis roll, pitch, yaw in radians, pitch within +-pi/2.

    At pitch = +-pi/2 roll and yaw are about one axis: roll is then 0. Full precision up to there: half the sum and half
    the difference of roll and yaw are read from the quaternion (E. Bernardes and S. Viollet, "Quaternion to Euler
    angles conversion", 2022).
    """
    w, x, y, z = q
    up = math.hypot(w - y, x + z)  # 0 at pitch = pi/2, where the sum of roll and yaw is undefined
    down = math.hypot(w + y, x - z)  # 0 at pitch = -pi/2, where the difference is undefined
    pitch = math.atan2(2.0 * (w * y - x * z), up * down)
    if up < 1e-12 or down < 1e-12:
        return (0.0, pitch, math.remainder(2.0 * math.atan2(z, w), math.tau))
    half_sum = math.atan2(x + z, w - y)
    half_difference = math.atan2(x - z, w + y)
    return (
        math.remainder(half_sum + half_difference, math.tau),
        pitch,
        math.remainder(half_sum - half_difference, math.tau),
    )


def exponential(v: Vector3) -> Quaternion:
    """Return the rotation by |v| radians about v (the exponential map)."""
    x, y, z = v
    angle = math.sqrt(x * x + y * y + z * z)
    if not math.isfinite(angle):
        raise ValueError(f"a rotation vector must be finite, got {v}")
    # sin(a/2)/a by its series below 1e-4 rad, where the quotient loses digits
    s = 0.5 - angle * angle / 48.0 if angle < 1e-4 else math.sin(angle / 2) / angle
    return normalize((math.cos(angle / 2), x * s, y * s, z * s))


def small_angle_exponential(v: Vector3) -> Quaternion:
    """Return `exponential` to 1e-9 for |v| < 0.2 rad at a third of its cost; `exponential` itself for larger angles."""
    x, y, z = v
    square = 0.25 * (x * x + y * y + z * z)
    if not square < 0.01:
        return exponential(v)
    s = 0.5 * (1.0 - square / 6.0 + square * square / 120.0)
    return (1.0 - square / 2.0 + square * square / 24.0, x * s, y * s, z * s)


def turn(q: Quaternion, v: Vector3) -> Quaternion:
    """Return the rotation by a small vector `v` followed by `q`: `multiply(q, small_angle_exponential(v))` in one."""
    x, y, z = v
    square = 0.25 * (x * x + y * y + z * z)
    if not square < 0.01:
        return multiply(q, exponential(v))
    s = 0.5 * (1.0 - square / 6.0 + square * square / 120.0)
    aw, ax, ay, az = q
    bw, bx, by, bz = 1.0 - square / 2.0 + square * square / 24.0, x * s, y * s, z * s
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def logarithm(q: Quaternion) -> Vector3:
    """Return the rotation vector of `q`, its length within [0, pi]: the inverse of `exponential`."""
    w, x, y, z = q if q[0] >= 0 else (-q[0], -q[1], -q[2], -q[3])
    n = math.sqrt(x * x + y * y + z * z)
    s = 2.0 / w * (1.0 - n * n / (3.0 * w * w)) if n < 1e-6 else 2.0 * math.atan2(n, w) / n
    return (x * s, y * s, z * s)


def slerp(a: Quaternion, b: Quaternion, fraction: float) -> Quaternion:
    """Return the rotation at `fraction` between `a` and `b`, at constant rate along the shorter arc."""
    x, y, z = logarithm(normalize(multiply(conjugate(a), b)))
    return normalize(multiply(a, exponential((x * fraction, y * fraction, z * fraction))))


def nearest_rotation(M: npt.ArrayLike) -> tuple[Array, float]:
    """Return the rotation matrix nearest to `M` (3, 3), and the largest entry of |M'M - I|.

    Nearest in the Frobenius norm, by the polar decomposition (N. Higham, "Computing the polar decomposition", 1986).
    Raises ValueError where `M` is not finite, singular or a reflection.
    """
    m = np.asarray(M, dtype=float)
    if m.shape != (3, 3) or not np.isfinite(m).all():
        raise ValueError("a rotation matrix has 3 rows of 3 finite numbers")
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = float(np.abs(m.T @ m - np.eye(3)).max())
    if not math.isfinite(deviation):
        raise ValueError("the entries of the matrix are too large for a rotation")
    U, s, Vt = np.linalg.svd(m)
    if s[-1] < 1e-6:
        raise ValueError("the matrix is singular, so it is no rotation")
    R = U @ Vt
    if np.linalg.det(R) < 0:
        raise ValueError("the matrix is a reflection (determinant -1): an axis points the wrong way")
    return R, deviation


def left_jacobian(v: Vector3) -> Array:
    """Return the left Jacobian J (3, 3) at a rotation vector: exp(v + dv) = exp(J dv) exp(v) to first order.

    The right Jacobian is that of -v.
    """
    angle = math.hypot(*v)
    K = skew(v)
    if angle < 1e-4:
        return np.asarray(np.eye(3) + K / 2.0 + K @ K / 6.0)
    square = angle * angle
    return np.asarray(
        np.eye(3) + (1.0 - math.cos(angle)) / square * K + (angle - math.sin(angle)) / (square * angle) * (K @ K)
    )


def skew(v: npt.ArrayLike) -> Array:
    """Return the matrix (3, 3) of the cross product: skew(v) u = v x u."""
    x, y, z = np.asarray(v, dtype=float).tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])

"""Many poses at once: positions (n, 3) and unit quaternions (n, 4), scalar first, as arrays.

A vehicle asks for one pose again and again, where plain floats are faster (see `so3`); a thousand instants of a
nodding laser are asked for together, where these are. Formulas as in `so3`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array


class Poses(NamedTuple):
    """Poses X_AB, one for each row, or one for all in a single row: positions (n, 3), quaternions (n, 4)."""

    p: Array
    q: Array

    @classmethod
    def of(cls, pose: Pose) -> Poses:
        """Return a pose that is the same in every row."""
        return cls(np.array([pose.xyz]), np.array([pose.wxyz]))

    def __matmul__(self, other: Poses) -> Poses:
        """Return X_AB @ X_BC row by row."""
        return Poses(self.p + rotated(self.q, other.p), multiplied(self.q, other.q))

    def inverse(self) -> Poses:
        """Return X_BA row by row."""
        q = conjugated(self.q)
        return Poses(-rotated(q, self.p), q)

    def canonical(self) -> Poses:
        """Return the same poses with quaternions at unit length and w >= 0."""
        q = self.q / np.linalg.norm(self.q, axis=1, keepdims=True)
        return Poses(self.p, np.where(q[:, :1] < 0.0, -q, q) + 0.0)


def multiplied(a: Array, b: Array) -> Array:
    """Return the products a b, row by row."""
    aw, ax, ay, az = a.T
    bw, bx, by, bz = b.T
    return np.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        axis=1,
    )


def conjugated(q: Array) -> Array:
    """Return the inverse rotations."""
    return q * (1.0, -1.0, -1.0, -1.0)


def rotated(q: Array, v: Array) -> Array:
    """Return R(q) v, row by row."""
    w, x, y, z = q.T
    vx, vy, vz = v.T
    tx = 2.0 * (y * vz - z * vy)
    ty = 2.0 * (z * vx - x * vz)
    tz = 2.0 * (x * vy - y * vx)
    return np.stack(
        (vx + w * tx + y * tz - z * ty, vy + w * ty + z * tx - x * tz, vz + w * tz + x * ty - y * tx), axis=1
    )


def about(axis: Array, angles: Array) -> Array:
    """Return the rotations by angles (n) about one axis (3)."""
    half = 0.5 * angles
    return np.concatenate((np.cos(half)[:, None], np.sin(half)[:, None] * axis), axis=1)


def exponentials(v: Array) -> Array:
    """Return the rotations by |v| radians about v (n, 3), row by row."""
    angles = np.sqrt(np.einsum("ij,ij->i", v, v))
    # np.sinc(x) is sin(pi x) / (pi x), and 1 at 0
    s = 0.5 * np.sinc(angles / (2.0 * math.pi))
    return np.concatenate((np.cos(0.5 * angles)[:, None], s[:, None] * v), axis=1)


def left_jacobians(v: Array) -> Array:
    """Return the left Jacobians (n, 3, 3) of SO(3) at rotation vectors (n, 3); see `geometry.joint.left_jacobian`."""
    square = np.einsum("ij,ij->i", v, v)
    angles = np.sqrt(square)
    small = angles < 1e-4
    divisor = np.where(small, 1.0, square)
    a = np.where(small, 0.5, (1.0 - np.cos(angles)) / divisor)
    b = np.where(small, 1.0 / 6.0, (angles - np.sin(angles)) / (divisor * np.where(small, 1.0, angles)))
    K = skews(v)
    return np.asarray(np.eye(3) + a[:, None, None] * K + b[:, None, None] * (K @ K))


def skews(v: Array) -> Array:
    """Return the matrices (n, 3, 3) of the cross products with v (n, 3)."""
    K = np.zeros((len(v), 3, 3))
    x, y, z = v.T
    K[:, 0, 1], K[:, 0, 2] = -z, y
    K[:, 1, 0], K[:, 1, 2] = z, -x
    K[:, 2, 0], K[:, 2, 1] = -y, x
    return K


def slerped(a: Array, b: Array, part: Array) -> Array:
    """Return the rotations `part` (n) of the way from a to b at constant rate, the short way round."""
    d = multiplied(conjugated(a), b)
    d = np.where(d[:, :1] < 0.0, -d, d)
    length = np.linalg.norm(d[:, 1:], axis=1)
    angle = 2.0 * np.arctan2(length, d[:, 0])
    with np.errstate(invalid="ignore", divide="ignore"):
        axis = np.where(length[:, None] > 0.0, d[:, 1:] / length[:, None], 0.0)
    half = 0.5 * angle * part
    step = np.concatenate((np.cos(half)[:, None], np.sin(half)[:, None] * axis), axis=1)
    return multiplied(a, step)


def matrices(q: Array) -> Array:
    """Return the rotation matrices (n, 3, 3)."""
    w, x, y, z = q.T
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz = x * y, x * z, y * z
    wx, wy, wz = w * x, w * y, w * z
    rows = (
        (1.0 - 2.0 * (yy + zz), 2.0 * (xy - wz), 2.0 * (xz + wy)),
        (2.0 * (xy + wz), 1.0 - 2.0 * (xx + zz), 2.0 * (yz - wx)),
        (2.0 * (xz - wy), 2.0 * (yz + wx), 1.0 - 2.0 * (xx + yy)),
    )
    return np.moveaxis(np.array(rows), 2, 0)

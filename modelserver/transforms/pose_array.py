"""Arrays of poses: positions (n, 3) and unit quaternions (n, 4), scalar first.

For batch queries, as the thousand beams of a scan. A single pose is faster in plain floats: see `so3`, which has the
same functions for one rotation, and whose formulas are applied to columns here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array


class PoseArray(NamedTuple):
    """Poses X_AB, one a row, or a single row for all: positions (n, 3), quaternions (n, 4)."""

    p: Array
    q: Array

    @classmethod
    def of(cls, pose: Pose) -> PoseArray:
        """Return a single pose that holds for all rows."""
        return cls(np.array([pose.xyz]), np.array([pose.wxyz]))

    def __matmul__(self, other: PoseArray) -> PoseArray:
        """Return X_AB @ X_BC."""
        return PoseArray(self.p + rotate(self.q, other.p), multiply(self.q, other.q))

    def inverse(self) -> PoseArray:
        q = conjugate(self.q)
        return PoseArray(-rotate(q, self.p), q)

    def canonical(self) -> PoseArray:
        """Return the same poses with quaternions at unit length and w >= 0."""
        q = self.q / np.linalg.norm(self.q, axis=1, keepdims=True)
        return PoseArray(self.p, np.where(q[:, :1] < 0.0, -q, q) + 0.0)


def multiply(a: Array, b: Array) -> Array:
    return _by_row(so3.multiply(_by_column(a), _by_column(b)))


def _by_column(values: Array) -> Any:
    """Return the columns, to which the formulas of `so3` apply as they do to floats."""
    return values.T


def _by_row(columns: Sequence[Any]) -> Array:
    return np.stack(columns, axis=1)


def conjugate(q: Array) -> Array:
    return q * (1.0, -1.0, -1.0, -1.0)


def rotate(q: Array, v: Array) -> Array:
    return _by_row(so3.rotate(_by_column(q), _by_column(v)))


def from_axis_angle(axis: Array, angles: Array) -> Array:
    """Return the rotations by angles (n) about one axis (3)."""
    half = 0.5 * angles
    return np.concatenate((np.cos(half)[:, None], np.sin(half)[:, None] * axis), axis=1)


def exponential(v: Array) -> Array:
    """Return the rotations by |v| radians about v (n, 3)."""
    angles = np.sqrt(np.einsum("ij,ij->i", v, v))
    # np.sinc(x) is sin(pi x) / (pi x), and 1 at 0
    s = 0.5 * np.sinc(angles / (2.0 * math.pi))
    return np.concatenate((np.cos(0.5 * angles)[:, None], s[:, None] * v), axis=1)


def left_jacobian(v: Array) -> Array:
    """Return the left Jacobians (n, 3, 3) of SO(3) at rotation vectors (n, 3); see `so3.left_jacobian`."""
    square = np.einsum("ij,ij->i", v, v)
    angles = np.sqrt(square)
    small = angles < 1e-4
    divisor = np.where(small, 1.0, square)
    a = np.where(small, 0.5, (1.0 - np.cos(angles)) / divisor)
    b = np.where(small, 1.0 / 6.0, (angles - np.sin(angles)) / (divisor * np.where(small, 1.0, angles)))
    K = skew(v)
    return np.asarray(np.eye(3) + a[:, None, None] * K + b[:, None, None] * (K @ K))


def skew(v: Array) -> Array:
    """Return the matrices (n, 3, 3) of the cross products with v (n, 3)."""
    K = np.zeros((len(v), 3, 3))
    x, y, z = v.T
    K[:, 0, 1], K[:, 0, 2] = -z, y
    K[:, 1, 0], K[:, 1, 2] = z, -x
    K[:, 2, 0], K[:, 2, 1] = -y, x
    return K


def slerp(a: Array, b: Array, fraction: Array) -> Array:
    """Return the rotations at `fraction` (n) between a and b, at constant rate along the shorter arc."""
    d = multiply(conjugate(a), b)
    d = np.where(d[:, :1] < 0.0, -d, d)
    length = np.linalg.norm(d[:, 1:], axis=1)
    angle = 2.0 * np.arctan2(length, d[:, 0])
    with np.errstate(invalid="ignore", divide="ignore"):
        axis = np.where(length[:, None] > 0.0, d[:, 1:] / length[:, None], 0.0)
    half = 0.5 * angle * fraction
    step = np.concatenate((np.cos(half)[:, None], np.sin(half)[:, None] * axis), axis=1)
    return multiply(a, step)


def to_matrices(q: Array) -> Array:
    return np.moveaxis(np.array(so3.matrix_rows(_by_column(q))), 2, 0)

"""Rotations and poses to try things on: ordinary ones, and those where formulas break."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from modelserver.transforms import Pose, so3

TINY = (0.0, 5e-324, 1e-300, 1e-160, 1e-16, 1e-12, 1e-8, 1e-6, 0.99e-4, 1.01e-4, 1e-3)

_unit = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: math.hypot(*v) > 1e-3)
_angle = st.one_of(
    st.floats(0, math.pi),
    st.sampled_from(TINY),
    st.sampled_from(TINY).map(lambda small: math.pi - small),
    st.sampled_from((math.pi / 2, math.pi / 3, 2 * math.pi / 3)),
)


def _about(axis, angle):
    n = math.hypot(*axis)
    s = math.sin(angle / 2) / n
    return so3.normalize((math.cos(angle / 2), axis[0] * s, axis[1] * s, axis[2] * s))


axes = st.one_of(_unit, st.sampled_from([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)]))
rotations = st.builds(_about, axes, _angle)
coordinates = st.one_of(st.floats(-100, 100), st.sampled_from((0.0, 1e-12, -6e5, 5e6)))
points = st.tuples(coordinates, coordinates, coordinates)
near_points = st.tuples(*[st.floats(-10, 10)] * 3)
poses = st.builds(Pose, near_points, rotations)


def scipy_of(q):
    """Return the oracle's rotation of a scalar-first quaternion."""
    w, x, y, z = q
    return Rotation.from_quat([x, y, z, w])


def angle_between(a, b):
    """Return the angle from one quaternion to another, accurate near 0; independent of the package's own logarithm."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    return 4 * math.asin(min(1.0, min(np.linalg.norm(a - b), np.linalg.norm(a + b)) / 2))

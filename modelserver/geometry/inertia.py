"""Mass, center of mass and inertia tensor of a rigid body; spatial inertia (6x6), parallel axis theorem included.

The spatial inertia maps a body's motion to its momentum, both at the body's origin and along the body's axes. Rows and
columns are ordered x, y, z, then about x, about y, about z; the 2005 report leaves the order open. With mass m, center
of mass c and inertia I about it (R. Featherstone, "Rigid Body Dynamics Algorithms", 2008, eq. 2.63, blocks exchanged):

    [   m 1       -m [c]x          ]
    [ m [c]x   I - m [c]x [c]x     ]

Kilograms, meters, kg m2.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array, Vector3

Rows = tuple[tuple[float, ...], ...]

RIGID_TOLERANCE = 1e-9
"""Largest relative deviation of a block from that of a rigid body: the rounding of its text."""

MOMENT_TOLERANCE = 1e-6
"""Relative tolerance of the triangle inequality of the moments: flat bodies satisfy it with equality."""


class RigidInertia(NamedTuple):
    """Mass, center of mass in the body, and the inertia (3, 3) about that point along the body's axes."""

    mass: float
    center: Vector3
    about_center: tuple[Vector3, Vector3, Vector3]

    @classmethod
    def from_moments(cls, mass: float, pose: Pose, moments: Sequence[Sequence[float]]) -> RigidInertia:
        """Return the inertia from `moments` (3, 3) about the origin and along the axes of `pose`, as in URDF."""
        R = np.array(so3.matrix_rows(pose.wxyz))
        return cls(mass, pose.xyz, to_rows(R @ np.asarray(moments, dtype=float) @ R.T))

    def matrix(self) -> Rows:
        """Return the spatial inertia, 6 rows of 6."""
        m = self.mass
        C = m * so3.skew(self.center)
        inertia = np.asarray(self.about_center, dtype=float)
        M = np.zeros((6, 6))
        M[:3, :3] = m * np.eye(3)
        M[:3, 3:] = -C
        M[3:, :3] = C
        M[3:, 3:] = inertia - C @ so3.skew(self.center)
        return tuple(tuple(float(value) + 0.0 for value in row) for row in M)

    def find_problem(self) -> str:
        """Return why no body can have this inertia, "" if one can.

        The principal moments are positive and satisfy the triangle inequality: none is greater than the sum of the
        other two.
        """
        if not self.mass > 0.0:
            return f"the mass is {self.mass:g} kg; it must be positive"
        least, middle, greatest = self._find_moments()
        moments = _format_moments(least, middle, greatest)
        if not least > 0.0:
            return f"{moments}; all must be positive"
        if greatest > (least + middle) * (1.0 + MOMENT_TOLERANCE):
            return f"{moments}; none can be greater than the sum of the other two"
        return ""

    def find_error(self) -> str:
        """Return what is certainly wrong, "" for nothing: a negative mass, or a negative moment.

        A moment of 0, or one greater than the sum of the others, stands in many files, and computes.
        """
        if self.mass < 0.0:
            return f"the mass is {self.mass:g} kg; it must be positive"
        least, middle, greatest = self._find_moments()
        if least < -MOMENT_TOLERANCE * max(greatest, -least):
            return f"{_format_moments(least, middle, greatest)}; no body has a negative one"
        return ""

    def _find_moments(self) -> tuple[float, float, float]:
        """Return the principal moments, the least first."""
        inertia = np.asarray(self.about_center, dtype=float)
        least, middle, greatest = (float(value) for value in np.linalg.eigvalsh((inertia + inertia.T) / 2.0))
        return least, middle, greatest


def _format_moments(least: float, middle: float, greatest: float) -> str:
    return f"the principal moments of inertia are {least:.4g}, {middle:.4g} and {greatest:.4g} kg m2"


def from_spatial_inertia(matrix: Sequence[Sequence[float]]) -> RigidInertia | None:
    """Return mass, center and inertia of a spatial inertia (6, 6); None where no rigid body has it."""
    M = np.asarray(matrix, dtype=float)
    m = float(M[0, 0])
    if not m > 0.0:
        return None
    C = M[3:, :3]
    center = (float(C[2, 1]) / m, float(C[0, 2]) / m, float(C[1, 0]) / m)
    with np.errstate(over="ignore", invalid="ignore"):
        about = M[3:, 3:] + m * so3.skew(center) @ so3.skew(center)
    if not np.isfinite(about).all():
        return None
    found = RigidInertia(m, center, to_rows((about + about.T) / 2.0))
    rebuilt = np.asarray(found.matrix())
    for rows in (slice(0, 3), slice(3, 6)):
        for columns in (slice(0, 3), slice(3, 6)):
            block = M[rows, columns]
            if not np.abs(block - rebuilt[rows, columns]).max() <= RIGID_TOLERANCE * max(np.abs(block).max(), 1e-300):
                return None
    return found


def to_rows(M: Array) -> tuple[Vector3, Vector3, Vector3]:
    """Return the rows of a matrix (3, 3) as plain floats."""
    (a, b, c), (d, e, f), (g, h, i) = (M + 0.0).tolist()
    return (a, b, c), (d, e, f), (g, h, i)

"""Mass, centre of mass and inertia of a rigid body, and the 6x6 spatial inertia that holds all three.

A body's spatial inertia takes its motion to its momentum, both at the body's origin and along the body's axes. Rows and
columns are ordered as everywhere in this package, first along x, y, z, then about x, y, z; the 2005 report, which keeps
such a matrix with each body ("expressed in the local coordinates of the Body"), does not say. With mass m, centre of
mass c and the inertia I about it (R. Featherstone, "Rigid Body Dynamics Algorithms", 2008, eq. 2.63, with its two
blocks exchanged):

    [   m 1       -m [c]x          ]
    [ m [c]x   I - m [c]x [c]x     ]

Kilograms, metres, kg m2.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array, Vector3

Rows = tuple[tuple[float, ...], ...]

RIGID = 1e-9
"""A matrix is a rigid body's where it is off by no more than this part of what it is made of: rounding of its text."""

ROUNDING = 1e-6
"""Moments of inertia may be off the rules by this part of the greatest: flat things stand on the border."""


class RigidInertia(NamedTuple):
    """Mass, centre of mass in the body, and the inertia (3, 3) about that point along the body's axes."""

    mass: float
    centre: Vector3
    about_centre: tuple[Vector3, Vector3, Vector3]

    @classmethod
    def turned(cls, mass: float, pose: Pose, moments: Sequence[Sequence[float]]) -> RigidInertia:
        """Return the inertia of a body whose `moments` (3, 3) are about the origin and along the axes of `pose`.

        That is how URDF states it: `pose` is the place of the centre of mass, with axes of its own.
        """
        R = np.array(so3.matrix_rows(pose.wxyz))
        return cls(mass, pose.xyz, _three(R @ np.asarray(moments, dtype=float) @ R.T))

    def matrix(self) -> Rows:
        """Return the spatial inertia, 6 rows of 6."""
        m = self.mass
        C = m * so3.skew(self.centre)
        inertia = np.asarray(self.about_centre, dtype=float)
        M = np.zeros((6, 6))
        M[:3, :3] = m * np.eye(3)
        M[:3, 3:] = -C
        M[3:, :3] = C
        M[3:, 3:] = inertia - C @ so3.skew(self.centre)
        return tuple(tuple(float(value) + 0.0 for value in row) for row in M)

    def fault(self) -> str:
        """Return why no body can have this inertia; empty where one can.

        The moments about the principal axes are positive, and none is greater than the sum of the other two: each is
        a sum over the body's matter of squared distances in two directions.
        """
        if not self.mass > 0.0:
            return f"the mass is {self.mass:g} kg; it must be positive"
        inertia = np.asarray(self.about_centre, dtype=float)
        least, middle, greatest = (float(value) for value in np.linalg.eigvalsh((inertia + inertia.T) / 2.0))
        moments = f"the principal moments of inertia are {least:.4g}, {middle:.4g} and {greatest:.4g} kg m2"
        if not least > 0.0:
            return f"{moments}; all must be positive"
        if greatest > (least + middle) * (1.0 + ROUNDING):
            return f"{moments}; none can be greater than the sum of the other two"
        return ""


def rigid(matrix: Sequence[Sequence[float]]) -> RigidInertia | None:
    """Return the mass, centre and inertia that a spatial inertia is made of; None where it is not a rigid body's.

    A body without mass has no centre, so what has none is no rigid body's either.
    """
    M = np.asarray(matrix, dtype=float)
    m = float(M[0, 0])
    if not m > 0.0:
        return None
    C = M[3:, :3]
    centre = (float(C[2, 1]) / m, float(C[0, 2]) / m, float(C[1, 0]) / m)
    with np.errstate(over="ignore", invalid="ignore"):
        about = M[3:, 3:] + m * so3.skew(centre) @ so3.skew(centre)
    if not np.isfinite(about).all():
        return None
    found = RigidInertia(m, centre, _three((about + about.T) / 2.0))
    rebuilt = np.asarray(found.matrix())
    for rows in (slice(0, 3), slice(3, 6)):
        for columns in (slice(0, 3), slice(3, 6)):
            block = M[rows, columns]
            if not np.abs(block - rebuilt[rows, columns]).max() <= RIGID * max(np.abs(block).max(), 1e-300):
                return None
    return found


def _three(M: Array) -> tuple[Vector3, Vector3, Vector3]:
    (a, b, c), (d, e, f), (g, h, i) = (M + 0.0).tolist()
    return (a, b, c), (d, e, f), (g, h, i)

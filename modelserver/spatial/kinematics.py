"""How one frame moves in another: pose, velocity and acceleration together, chained as poses are. Pure.

All vectors of `RigidMotion` X_FT are of T's origin relative to F, along the axes of F, as seen by one who rides on F.
Chaining them is the kinematics of rigid bodies (e.g. R. Featherstone, "Rigid Body Dynamics Algorithms", 2008, ch. 2).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Vector3, cross

ZERO: Vector3 = (0.0, 0.0, 0.0)
UNKNOWN: Vector3 = (math.nan, math.nan, math.nan)


class RigidMotion(NamedTuple):
    """The pose of T in F, and how it changes: m/s, rad/s, m/s2, rad/s2. nan where nobody knows."""

    pose: Pose
    velocity: Vector3 = ZERO
    rate: Vector3 = ZERO
    acceleration: Vector3 = ZERO
    turn_acceleration: Vector3 = ZERO

    def then(self, other: RigidMotion) -> RigidMotion:
        """Return X_FT @ X_TU with its motion."""
        q = self.pose.wxyz
        r = so3.rotate(q, other.pose.xyz)
        v, w = so3.rotate(q, other.velocity), so3.rotate(q, other.rate)
        a, t = so3.rotate(q, other.acceleration), so3.rotate(q, other.turn_acceleration)
        omega = self.rate
        swung = cross(omega, r)
        return RigidMotion(
            self.pose @ other.pose,
            _sum(self.velocity, swung, v),
            _sum(omega, w),
            _sum(
                self.acceleration,
                cross(self.turn_acceleration, r),
                cross(omega, swung),
                _scaled(2.0, cross(omega, v)),
                a,
            ),
            _sum(self.turn_acceleration, t, cross(omega, w)),
        )

    def inverse(self) -> RigidMotion:
        """Return X_TF with its motion: how F moves, seen by one who rides on T.

        p_TF = -R' p with R' = -R'[w]x, and so u = -v + w x p is its velocity before R' turns it, and du - w x u its
        acceleration.
        """
        q = so3.conjugate(self.pose.wxyz)
        p, w = self.pose.xyz, self.rate
        u = _sum(_scaled(-1.0, self.velocity), cross(w, p))
        du = _sum(_scaled(-1.0, self.acceleration), cross(self.turn_acceleration, p), cross(w, self.velocity))
        return RigidMotion(
            self.pose.inverse(),
            so3.rotate(q, u),
            so3.rotate(q, _scaled(-1.0, w)),
            so3.rotate(q, _sum(du, _scaled(-1.0, cross(w, u)))),
            so3.rotate(q, _scaled(-1.0, self.turn_acceleration)),
        )


def _sum(*vectors: Vector3) -> Vector3:
    x = y = z = 0.0
    for a, b, c in vectors:
        x, y, z = x + a, y + b, z + c
    return (x, y, z)


def _scaled(factor: float, v: Vector3) -> Vector3:
    return (factor * v[0], factor * v[1], factor * v[2])

"""Rigid-body kinematics: pose, velocity and acceleration composed along a chain. Pure.

All vectors of `RigidMotion` X_FT are of T's origin relative to F, along the axes of F, as observed in F. Composition
and inversion are the kinematics of rigid bodies (R. Featherstone, "Rigid Body Dynamics Algorithms", 2008, ch. 2).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3, add, cross, scale

ZERO: Vector3 = (0.0, 0.0, 0.0)
UNKNOWN: Vector3 = (math.nan, math.nan, math.nan)


class RigidMotion(NamedTuple):
    """The pose of T in F and its derivatives: m/s, rad/s, m/s2, rad/s2; nan where unknown."""

    pose: Pose
    velocity: Vector3 = ZERO
    angular_velocity: Vector3 = ZERO
    acceleration: Vector3 = ZERO
    angular_acceleration: Vector3 = ZERO

    def compose(self, other: RigidMotion) -> RigidMotion:
        """Return X_FT @ X_TU with its motion."""
        q = self.pose.wxyz
        r = so3.rotate(q, other.pose.xyz)
        v, w = so3.rotate(q, other.velocity), so3.rotate(q, other.angular_velocity)
        a, t = so3.rotate(q, other.acceleration), so3.rotate(q, other.angular_acceleration)
        omega = self.angular_velocity
        tangential = cross(omega, r)
        return RigidMotion(
            self.pose @ other.pose,
            add(self.velocity, tangential, v),
            add(omega, w),
            add(
                self.acceleration,
                cross(self.angular_acceleration, r),
                cross(omega, tangential),
                scale(2.0, cross(omega, v)),
                a,
            ),
            add(self.angular_acceleration, t, cross(omega, w)),
        )

    def inverse(self) -> RigidMotion:
        """Return X_TF with its motion: the motion of F as observed in T.

        p_TF = -R' p and d(R')/dt = -R' [w]x. With u = -v + w x p the velocity is R' u, the acceleration R' (du/dt - w x
        u).
        """
        q = so3.conjugate(self.pose.wxyz)
        p, w = self.pose.xyz, self.angular_velocity
        u = add(scale(-1.0, self.velocity), cross(w, p))
        du = add(scale(-1.0, self.acceleration), cross(self.angular_acceleration, p), cross(w, self.velocity))
        return RigidMotion(
            self.pose.inverse(),
            so3.rotate(q, u),
            so3.rotate(q, scale(-1.0, w)),
            so3.rotate(q, add(du, scale(-1.0, cross(w, u)))),
            so3.rotate(q, scale(-1.0, self.angular_acceleration)),
        )

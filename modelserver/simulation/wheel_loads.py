"""Loads of the wheels in a simulated drive, from the dynamics of the vehicle: its slip depends on them.

The vehicle moves as one rigid body, its joints at fixed positions. Along the axes of the rolling frame the contacts
balance the force f = m R'(g - a) at the center of mass and the moment -(I w' + w x I w); how four and more share it is
stated in `dynamics.stability`. A wheel's slip is its traction over its load (the linear part of a tire's curve), the
traction shared evenly: a wheel with half of the mean load slips twice as much.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from modelserver.dynamics import Dynamics
from modelserver.dynamics.stability import SupportPolygon, compute_loads
from modelserver.simulation.trajectory import TrajectoryMotion
from modelserver.transforms import so3

MAX_SLIP_FACTOR = 5.0
"""Slip of a wheel relative to that at the mean load, at the most: one that has lifted spins freely."""


class WheelLoads:
    """Normal forces at the wheels' contacts during a drive.

    `dynamics` has the rolling frame as its root; `contacts` names the frame of each wheel's contact point. `joints` are
    the positions of its coordinates, by default the defaults. Raises as `SupportPolygon.of`.
    """

    def __init__(self, dynamics: Dynamics, contacts: Mapping[str, str], joints: Mapping[str, float] | None = None):
        root = dynamics.tree.root
        X_RW = dynamics.frame_pose(joints or {}, root).inverse()
        center = dynamics.center_of_mass(joints or {}, frame=root)
        self._mass, self._center = center.mass, center.position
        points = {name: (X_RW @ X).position for name, X in zip(
            contacts, dynamics.frame_poses(joints or {}, contacts.values()), strict=True
        )}  # fmt: skip
        self._polygon = SupportPolygon.of(points, self._center)
        arm = so3.skew(self._center)
        about_root = dynamics.inertia(joints or {}, root)[3:, 3:]
        self._inertia = about_root + self._mass * arm @ arm
        self._gravity = np.array([0.0, 0.0, -dynamics.gravitational_acceleration])

    def compute(self, motion: TrajectoryMotion) -> dict[str, float]:
        """Return the load of each wheel at an instant, newtons; nan where the vehicle would tip."""
        if motion.attitude is None:
            w, dw = (0.0, 0.0, motion.yaw_rate), (0.0, 0.0, motion.yaw_acceleration)
        else:
            w, dw = motion.attitude.rate, motion.attitude.acceleration
        R = np.array(so3.matrix_rows(motion.orientation()))
        a = np.array(motion.acceleration_at(so3.to_vector3(self._center.tolist())))
        force = self._mass * R.T @ (self._gravity - a)
        moment = -(self._inertia @ np.array(dw) + np.cross(w, self._inertia @ np.array(w)))
        loads = compute_loads(self._polygon, self._center, force, moment)
        return dict(zip(self._polygon.names, loads.tolist(), strict=True))

    def compute_slip_factors(self, motion: TrajectoryMotion) -> dict[str, float]:
        """Return the slip of each wheel relative to that at the mean load."""
        loads = self.compute(motion)
        mean = math.fsum(loads.values()) / len(loads)
        return {
            name: min(mean / load, MAX_SLIP_FACTOR) if load > 0.0 else MAX_SLIP_FACTOR for name, load in loads.items()
        }

"""Tip-over stability: the force-angle measure, and the loads of the contacts.

E. Papadopoulos and D. Rey, "A new measure of tipover stability margin for mobile manipulators" (ICRA 1996). With the
contact points p_i around the support polygon, counterclockwise seen from above, the tip-over axes are its edges
a_i = p_(i+1) - p_i. With the center of mass c and the net force f and moment n on it (gravity and inertia),

    l_i  = (1 - a a')(p_(i+1) - c)                    from c, normal to the axis
    f_i* = (1 - a a') f + (l_i x a a' n) / |l_i|^2    what tips about this axis; the moment as a force at c
    theta_i                                           the angle from l_i to f_i* about a_i, positive inside

The margin is the least theta_i, radians; negative: the vehicle tips about that edge. The measure of the paper is
alpha = |f| theta, newton-radians: it falls with the load too. For a vehicle at rest theta is the angle by which the
ground may tilt further about that edge. Static: f = m g alone. Dynamic: f = m g - p', n = -h', with the rates of linear
and angular momentum about c, so that the motion of joints counts as well as that of the vehicle.

Loads: the normal forces N_i >= 0 at the contacts balance force and moment. Four and more are not determined by that;
they are those of equal springs under a stiff vehicle, N_i linear in the position, a contact without load left out.

Sigma of theta: first order, by central differences in c and f. Limits: contacts are points on a plane (a mean one is
taken), do not slip, and cannot pull; where they are is taken as exact.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from modelserver.dynamics.multibody import CenterOfMass, Dynamics, Values
from modelserver.errors import MalformedRequestError
from modelserver.geometry.names import format_names
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array

STEP: Final = 1e-5
"""Meters, and share of the weight, over which the margin is differenced."""


class TipOver(NamedTuple):
    """The tip-over margin about the weakest edge of the support polygon.

    `margin` is theta, radians; `sigma` its standard deviation, nan where it is not known; `measure` |f| theta, N rad;
    `edge` names the two contacts; `loads` are the normal forces by contact, N, nan where the vehicle tips.
    """

    margin: float
    sigma: float
    measure: float
    edge: tuple[str, str]
    loads: Mapping[str, float]


class Stability(NamedTuple):
    """Tip-over at rest, and in motion (None where that is not known); the center of mass is in the root frame."""

    static: TipOver
    dynamic: TipOver | None
    center: CenterOfMass


class SupportPolygon(NamedTuple):
    """Contacts on a plane: all points (k, 3), the unit normal (3) towards the center of mass, and the order of those
    that are corners, counterclockwise seen from above.
    """

    names: tuple[str, ...]
    points: Array
    normal: Array
    corners: tuple[int, ...]

    @classmethod
    def of(cls, contacts: Mapping[str, Array], center: Array) -> SupportPolygon:
        """Return the polygon of contact points (3) by name. Raises MalformedRequestError where they span no area."""
        names, points = tuple(contacts), np.array(list(contacts.values()), dtype=float).reshape(-1, 3)
        mean = points.mean(axis=0) if len(points) else np.zeros(3)
        spread = np.linalg.svd(points - mean)[1] if len(points) >= 3 else np.zeros(3)
        if not spread[1] > 1e-6 * max(spread[0], 1e-3):
            raise MalformedRequestError(
                f"the contacts {format_names(names)} span no area; a support polygon needs three that are not on a line"
            )
        axes = np.linalg.svd(points - mean)[2]
        x, normal = axes[0], axes[2]
        if (center - mean) @ normal < 0.0:
            normal = -normal
        y = np.cross(normal, x)
        return cls(names, points, normal, _find_hull((points - mean) @ np.column_stack((x, y))))


def compute_margin(polygon: SupportPolygon, center: Array, force: Array, moment: Array) -> tuple[float, int]:
    """Return the margin theta, and the number of its edge: that from the corner of this number to the next."""
    angles = [compute_edge_angle(polygon, n, center, force, moment) for n in range(len(polygon.corners))]
    number = min(range(len(angles)), key=angles.__getitem__)
    return angles[number], number


def compute_edge_angle(polygon: SupportPolygon, number: int, center: Array, force: Array, moment: Array) -> float:
    """Return theta about the edge from the corner `number` to the next one."""
    start, end = (polygon.points[polygon.corners[n % len(polygon.corners)]] for n in (number, number + 1))
    a = (end - start) / np.linalg.norm(end - start)
    arm = end - center
    arm = arm - a * (a @ arm)
    tipping = force - a * (a @ force) + np.cross(arm, a * (a @ moment)) / (arm @ arm)
    return math.atan2(float(a @ np.cross(arm, tipping)), float(arm @ tipping))


def compute_loads(polygon: SupportPolygon, center: Array, force: Array, moment: Array) -> Array:
    """Return the normal forces (k,) of the contacts, newtons; nan where they cannot balance without pulling."""
    mean = polygon.points.mean(axis=0)
    x = np.linalg.svd(polygon.points - mean)[2][0]
    axes = np.vstack((x, np.cross(polygon.normal, x)))
    # about a point of the contact plane, where the friction has no moment along the plane
    about = moment + np.cross(center - mean, force)
    # the moment of a load N at x, y about the two axes of the plane is N y, -N x
    A = np.vstack((np.ones(len(polygon.points)), axes @ (polygon.points - mean).T))
    wanted = np.array([-polygon.normal @ force, axes[1] @ about, -axes[0] @ about])
    active = list(range(len(polygon.points)))
    loads = np.full(len(polygon.points), math.nan)
    while len(active) >= 3:
        part = A[:, active]
        gram = part @ part.T
        if np.linalg.matrix_rank(gram) < 3:
            break
        found = part.T @ np.linalg.solve(gram, wanted)
        if found.min() >= -1e-9 * abs(wanted[0]):
            loads[:] = 0.0
            loads[active] = np.maximum(found, 0.0)
            break
        del active[int(found.argmin())]
    return loads


def compute_tip_over(
    contacts: Mapping[str, Array],
    center: Array,
    force: Array,
    moment: Array,
    center_covariance: Array | None = None,
    force_covariance: Array | None = None,
) -> TipOver:
    """Return the tip-over margin of contact points (3), with the net force (3) and moment (3) on the center of mass.

    All along the same axes. The moment of gravity is zero. Raises MalformedRequestError where the contacts span no
    area, and without a force.
    """
    polygon = SupportPolygon.of(contacts, center)
    size = float(np.linalg.norm(force))
    if not size > 0.0:
        raise MalformedRequestError("no force presses the vehicle on its contacts; the margin needs gravity")
    margin, number = compute_margin(polygon, center, force, moment)
    sigma = math.nan
    if center_covariance is not None and force_covariance is not None:
        J = np.zeros(6)
        for n in range(6):
            step = np.zeros(6)
            step[n] = STEP if n < 3 else STEP * size
            ahead, behind = (
                compute_edge_angle(polygon, number, center + sign * step[:3], force + sign * step[3:], moment)
                for sign in (1.0, -1.0)
            )
            J[n] = (ahead - behind) / (2.0 * step[n])
        P = np.zeros((6, 6))
        P[:3, :3], P[3:, 3:] = center_covariance, force_covariance
        sigma = math.sqrt(max(float(J @ P @ J), 0.0))
    order = polygon.corners
    edge = (polygon.names[order[number]], polygon.names[order[(number + 1) % len(order)]])
    loads = compute_loads(polygon, center, force, moment)
    return TipOver(margin, sigma, size * margin, edge, dict(zip(polygon.names, loads.tolist(), strict=True)))


def assess_stability(
    dynamics: Dynamics,
    q: Values,
    contacts: Sequence[str],
    v: Values | None = None,
    a: Values | None = None,
    *,
    sigma: Values | None = None,
    tilt_covariance: Array | None = None,
    acceleration_covariance: Array | None = None,
) -> Stability:
    """Return the tip-over margins of a vehicle on the contact frames, in a state of its coordinates.

    Parameters
    ----------
    dynamics
        With a floating base, whose coordinates hold the attitude; with a fixed one the root frame is taken as level.
    q, v, a
        Coordinates, their rates and accelerations; without v and a there is no dynamic margin.
    contacts
        Frames at the contact points with the ground, three at least.
    sigma
        Standard deviations of the coordinates of the joints; without them the margins have no sigma.
    tilt_covariance, acceleration_covariance
        (3, 3) of the attitude, rad2, and of the acceleration of the center of mass, along the axes of the world; by
        default exact.
    """
    c = dynamics.center_of_mass(q)
    root = dynamics.tree.root
    center = dynamics.center_of_mass(q, frame=root, sigma=sigma)
    R = dynamics.frame_pose(q, root).rotation
    points = {name: dynamics.frame_pose(q, name).position for name in contacts}
    P_c = None if center.covariance is None else R @ center.covariance @ R.T
    weight = dynamics.mass * np.array([0.0, 0.0, -dynamics.gravitational_acceleration])
    P_f = np.zeros((3, 3))
    if tilt_covariance is not None:
        # a tilt of the vehicle by d turns the force in it by -d
        G = so3.skew(weight)
        P_f = G @ tilt_covariance @ G.T
    static = compute_tip_over(points, c.position, weight, np.zeros(3), P_c, P_f)
    dynamic = None
    if v is not None and a is not None:
        _, rate = dynamics.momentum(q, v, a)
        if acceleration_covariance is not None:
            P_f = P_f + dynamics.mass**2 * acceleration_covariance
        if np.isfinite(rate).all():
            dynamic = compute_tip_over(points, c.position, weight - rate[:3], -rate[3:], P_c, P_f)
    return Stability(static, dynamic, center)


def _find_hull(points: Array) -> tuple[int, ...]:
    """Return the corners of the convex hull of points (k, 2), counterclockwise (A. Andrew's monotone chain, 1979)."""
    order = sorted(range(len(points)), key=lambda n: (points[n][0], points[n][1]))

    def half(numbers: Sequence[int]) -> list[int]:
        chain: list[int] = []
        for n in numbers:
            while len(chain) >= 2:
                (ax, ay), (bx, by) = points[chain[-1]] - points[chain[-2]], points[n] - points[chain[-1]]
                if ax * by - ay * bx > 1e-12:
                    break
                chain.pop()
            chain.append(n)
        return chain

    return (*half(order)[:-1], *half(order[::-1])[:-1])

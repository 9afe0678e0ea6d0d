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

Sigma of theta: first order, by central differences in c and f, with c relative to the body of the first contact.
Limits: contacts are points on a plane (a mean one is taken), do not slip, and cannot pull; where they are on their body
counts as exact.

`DynamicsSettings` is the section `dynamics` of the vehicle file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import chain
from typing import Final, NamedTuple

import numpy as np

from modelserver.dynamics.multibody import CenterOfMass, Dynamics, Values
from modelserver.errors import MalformedRequestError
from modelserver.geometry.model import Model
from modelserver.geometry.names import format_names
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Vector3

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
    """Contacts on a plane: all points (k, 3), their mean (3), axes x, y, normal (3, 3), and the corners.

    The normal points towards the center of mass; the corners are numbers of points, counterclockwise seen from there.
    """

    names: tuple[str, ...]
    points: Array
    mean: Array
    axes: Array
    corners: tuple[int, ...]

    @classmethod
    def of(cls, contacts: Mapping[str, Array], center: Array) -> SupportPolygon:
        """Return the polygon of contact points (3) by name. Raises MalformedRequestError where they span no area."""
        names, points = tuple(contacts), np.array(list(contacts.values()), dtype=float).reshape(-1, 3)
        mean = points.mean(axis=0) if len(points) else np.zeros(3)
        _, spread, axes = np.linalg.svd(points - mean) if len(points) >= 3 else (None, np.zeros(3), np.eye(3))
        if not spread[1] > 1e-6 * max(spread[0], 1e-3):
            raise MalformedRequestError(
                f"the contacts {format_names(names)} span no area; a support polygon needs three that are not on a line"
            )
        normal = axes[2] if (center - mean) @ axes[2] >= 0.0 else -axes[2]
        axes = np.vstack((axes[0], np.cross(normal, axes[0]), normal))
        return cls(names, points, mean, axes, _find_hull(((points - mean) @ axes[:2].T).tolist()))


def compute_edge_angle(polygon: SupportPolygon, number: int, center: Array, force: Array, moment: Array) -> float:
    """Return theta about the edge from the corner `number` to the next one."""
    # plain floats: numpy costs ten times as much for three numbers
    corners, points = polygon.corners, polygon.points
    start, end = points[corners[number]].tolist(), points[corners[(number + 1) % len(corners)]].tolist()
    c, f = so3.to_vector3(center.tolist()), so3.to_vector3(force.tolist())
    along = (end[0] - start[0], end[1] - start[1], end[2] - start[2])
    a = so3.scale(1.0 / math.hypot(*along), along)
    arm = _reject((end[0] - c[0], end[1] - c[1], end[2] - c[2]), a)
    turning = _dot(a, so3.to_vector3(moment.tolist())) / _dot(arm, arm)
    tipping = so3.add(_reject(f, a), so3.cross(arm, so3.scale(turning, a)))
    return math.atan2(_dot(a, so3.cross(arm, tipping)), _dot(arm, tipping))


def _dot(a: Vector3, b: Vector3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _reject(v: Vector3, unit: Vector3) -> Vector3:
    return so3.add(v, so3.scale(-_dot(v, unit), unit))


def compute_loads(polygon: SupportPolygon, center: Array, force: Array, moment: Array) -> Array:
    """Return the normal forces (k,) of the contacts, newtons; nan where they cannot balance without pulling."""
    x, y, normal = polygon.axes
    # about a point of the contact plane, where the friction has no moment along the plane
    about = moment + np.cross(center - polygon.mean, force)
    # the moment of a load N at x, y is N y about x, -N x about y
    A = np.vstack((np.ones(len(polygon.points)), polygon.axes[:2] @ (polygon.points - polygon.mean).T))
    wanted = np.array([-normal @ force, y @ about, -x @ about])
    active = list(range(len(polygon.points)))
    loads = np.full(len(polygon.points), math.nan)
    while len(active) >= 3:
        part = A[:, active]
        gram = part @ part.T
        # three on a line balance nothing beside it
        if not abs(np.linalg.det(gram)) > 1e-12 * np.trace(gram) ** 3:
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
    angles = [compute_edge_angle(polygon, n, center, force, moment) for n in range(len(polygon.corners))]
    margin, number = min((angle, n) for n, angle in enumerate(angles))
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


def find_contacts(model: Model, patterns: Sequence[str]) -> tuple[str, ...]:
    """Return the frames that match names or patterns (`Cart:*Wheel`); a pattern that matches none is a name."""
    frames = [each.full_name for body in model.bodies for each in body]
    matched = ([name for name in frames if fnmatchcase(name, pattern)] or [pattern] for pattern in patterns)
    return tuple(dict.fromkeys(chain.from_iterable(matched)))


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
    root = dynamics.tree.root
    center = dynamics.center_of_mass(q, frame=root)
    X_WR, *placed = dynamics.frame_poses(q, (root, *contacts))
    c = X_WR.transform(center.position)
    points = {name: X.position for name, X in zip(contacts, placed, strict=True)}
    P_c = None
    if sigma is not None and contacts:
        P = dynamics.center_covariance(q, sigma, contacts[0], is_frame_exact=True)
        R = placed[0].rotation
        P_c = None if P is None else R @ P @ R.T
    weight = dynamics.mass * np.array([0.0, 0.0, -dynamics.gravitational_acceleration])
    P_f = np.zeros((3, 3))
    if tilt_covariance is not None:
        # a tilt of the vehicle by d turns the force in it by -d
        G = so3.skew(weight)
        P_f = G @ tilt_covariance @ G.T
    static = compute_tip_over(points, c, weight, np.zeros(3), P_c, P_f)
    dynamic = None
    if v is not None and a is not None:
        _, rate = dynamics.momentum(q, v, a)
        if acceleration_covariance is not None:
            P_f = P_f + dynamics.mass**2 * acceleration_covariance
        if np.isfinite(rate).all():
            dynamic = compute_tip_over(points, c, weight - rate[:3], -rate[3:], P_c, P_f)
    return Stability(static, dynamic, center)


def _find_hull(points: Sequence[Sequence[float]]) -> tuple[int, ...]:
    """Return the corners of the convex hull of points (k, 2), counterclockwise (A. Andrew's monotone chain, 1979)."""
    order = sorted(range(len(points)), key=lambda n: tuple(points[n]))

    def half(numbers: Sequence[int]) -> list[int]:
        chain: list[int] = []
        for n in numbers:
            while len(chain) >= 2:
                (ax, ay), (bx, by), (cx, cy) = points[chain[-2]], points[chain[-1]], points[n]
                if (bx - ax) * (cy - by) - (by - ay) * (cx - bx) > 1e-12:
                    break
                chain.pop()
            chain.append(n)
        return chain

    return (*half(order)[:-1], *half(order[::-1])[:-1])


MAX_CONTACTS = 16
"""Contacts with the ground: as many as a health report holds."""


@dataclass(frozen=True, slots=True)
class DynamicsSettings:
    """Dynamics of the vehicle. With this section the service loads Pinocchio and answers PLATFORM_GET_DYNAMICS."""

    allow_massless: bool = False
    """Whether bodies without inertia count as massless; else they are an error."""
    cut_loops: bool = False
    """Whether constraints that close loops are left out; else they are an error."""
    mass_sigma: float = 0.05
    """Standard deviation of each body's mass, as a fraction of it."""
    center_sigma: float = 0.02
    """Standard deviation of each body's center of mass along each axis, meters."""
    contacts: tuple[str, ...] = ()
    """Frames at the contacts with the ground, three or more: then health reports have the tip-over margin."""
    margin_limit: float = 0.1
    """Tip-over margin below which the service warns, radians."""

    def __post_init__(self) -> None:
        problems = [
            f"{key} is between 0 and 1, got {value:g}"
            for key, value in (("mass_sigma", self.mass_sigma), ("center_sigma", self.center_sigma))
            if not 0.0 <= value <= 1.0
        ]
        if not 0.0 <= self.margin_limit <= math.pi / 2:
            problems.append(f"margin_limit is between 0 and 1.57 radians, got {self.margin_limit:g}")
        if self.contacts and not 3 <= len(set(self.contacts)) == len(self.contacts) <= MAX_CONTACTS:
            problems.append(f"contacts names 3 to {MAX_CONTACTS} different frames, got {len(self.contacts)}")
        if problems:
            raise ValueError("\n".join(problems))

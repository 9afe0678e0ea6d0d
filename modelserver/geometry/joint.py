"""Joints: how a constraint lets its two frames move, as an immutable value.

A joint has coordinates: one for a revolute or prismatic one (radians or metres along its axis), three for a spherical
one (a rotation vector), three for a planar one (two lengths in the plane, an angle about its normal), six for a
floating one (a position, a rotation vector). Each coordinate is driven by a name of its own: that of the constraint
where there is one, `NAME.x`, `NAME.rz` and so on where there are several.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

import numpy as np

from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array, Quaternion, Vector3

Coordinates = tuple[float, ...]


class JointType(StrEnum):
    """How a constraint lets its two frames move."""

    FIXED = "fixed"
    REVOLUTE = "revolute"
    PRISMATIC = "prismatic"
    SPHERICAL = "spherical"
    PLANAR = "planar"
    FLOATING = "floating"


SUFFIXES: Final[dict[JointType, tuple[str, ...]]] = {
    JointType.FIXED: (),
    JointType.REVOLUTE: ("",),
    JointType.PRISMATIC: ("",),
    JointType.SPHERICAL: (".rx", ".ry", ".rz"),
    JointType.PLANAR: (".x", ".y", ".turn"),
    JointType.FLOATING: (".x", ".y", ".z", ".rx", ".ry", ".rz"),
}
"""What stands behind the constraint's name in the names of a joint's coordinates."""

ANGLES: Final[dict[JointType, tuple[bool, ...]]] = {
    JointType.FIXED: (),
    JointType.REVOLUTE: (True,),
    JointType.PRISMATIC: (False,),
    JointType.SPHERICAL: (True, True, True),
    JointType.PLANAR: (False, False, True),
    JointType.FLOATING: (False, False, False, True, True, True),
}
"""Whether a coordinate is an angle, radians, or a length, metres."""

AXIAL: Final = (JointType.REVOLUTE, JointType.PRISMATIC, JointType.PLANAR)
"""The types that an axis belongs to; a planar joint's is the normal of its plane."""

ROUNDING: Final = 1e-9
"""Radians or metres; a joint that is told to stand on its limit is not beyond it."""

_ORIGIN: Final[Vector3] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Mimic:
    """A joint that follows another: its position is `multiplier` times the other's, plus `offset`."""

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.multiplier) and math.isfinite(self.offset)):
            raise ValueError(f"a mimic's multiplier and offset are finite, got {self.multiplier} and {self.offset}")


@dataclass(frozen=True, slots=True)
class Joint:
    """How the `to` frame moves from where the constraint's pose puts it.

    `axis` is the unit vector, in the coordinates that the constraint's pose leads to, about or along which it moves.
    `lower`, `upper`, `rate_limit`, `default` and `sigma` have one number for each coordinate, or are empty for no
    limit, no stated default (which is 0) and no stated sigma: radians and metres, and a second. `sigma` is the standard
    deviation of a position whose message states none. A joint that follows another stands where that one takes it, and
    what it has as its default is where that is at rest (see `drives.at_rest`).

    Raises ValueError for an unknown type, an axis of no length, limits in the wrong order, a default beyond them, and
    what is not finite or negative where it may not be.
    """

    type: JointType = JointType.FIXED
    axis: Vector3 = (0.0, 0.0, 1.0)
    lower: Coordinates = ()
    upper: Coordinates = ()
    rate_limit: Coordinates = ()
    default: Coordinates = ()
    sigma: Coordinates = ()
    mimic: Mimic | None = None
    count: int = field(init=False, repr=False, compare=False, hash=False)
    """How many coordinates it has."""
    span: tuple[float, float] | None = field(init=False, repr=False, compare=False, hash=False)
    """Of a joint with one coordinate its limits, widened by rounding."""
    _plane: tuple[Vector3, Vector3] = field(init=False, repr=False, compare=False, hash=False)

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "type", JointType(self.type))
        put(self, "count", len(SUFFIXES[self.type]))
        put(self, "axis", _unit(self.axis) if self.type in AXIAL else (0.0, 0.0, 1.0))
        put(self, "_plane", _plane(self.axis))
        count = self.count
        for what in ("lower", "upper", "rate_limit", "default", "sigma"):
            values = tuple([float(value) + 0.0 for value in getattr(self, what)])
            put(self, what, values)
            if values and len(values) != count:
                plural = "" if count == 1 else "s"
                raise ValueError(f"a {self.type} joint has {count} coordinate{plural}, and its {what} {len(values)}")
        for what in ("lower", "upper"):
            if any(map(math.isnan, getattr(self, what))):
                raise ValueError(f"the {what} limit is a number")
        for low, high in zip(self.lower or (-math.inf,) * count, self.upper or (math.inf,) * count, strict=True):
            if low > high:
                raise ValueError(f"the limits are reversed: lower {low:g} is above upper {high:g}")
        for what in ("rate_limit", "sigma"):
            for value in getattr(self, what):
                # a covariance holds the squares of sigmas
                if not value >= 0.0 or (what == "sigma" and not math.isfinite(value * value)):
                    finite = "finite and " if what == "sigma" else ""
                    raise ValueError(f"a {what.replace('_', ' ')} is {finite}not negative, got {value}")
        for what, none in (("lower", -math.inf), ("upper", math.inf), ("rate_limit", math.inf)):
            # no limit is written in one way, so that equal joints are equal
            if all(value == none for value in getattr(self, what)):
                put(self, what, ())
        low = self.lower[0] - ROUNDING if self.lower else -math.inf
        high = self.upper[0] + ROUNDING if self.upper else math.inf
        put(self, "span", (low, high) if count == 1 else None)
        if not all(map(math.isfinite, self.default)):
            raise ValueError(f"a default is finite, got {_listed(self.default)}")
        # where a leader takes its followers is a matter for the builder, which can name both
        if self.default and self.mimic is None and self.out_of_limits(self.default):
            raise ValueError(f"the default {_listed(self.default)} is out of the joint's own limits")
        if self.mimic is not None and count != 1:
            raise ValueError(
                f"only a joint with one coordinate can follow another; a {self.type} one has {count or 'none'}"
            )

    @property
    def moves(self) -> bool:
        """Whether it has any."""
        return self.type is not JointType.FIXED

    @property
    def is_angle(self) -> tuple[bool, ...]:
        """For each coordinate whether it is an angle."""
        return ANGLES[self.type]

    @property
    def rest(self) -> Coordinates:
        """Where it is taken to stand while nobody tells: the default, else 0, else the limit next to 0."""
        if self.default:
            return self.default
        rest = [0.0] * self.count
        for number in range(self.count):
            if self.lower:
                rest[number] = max(rest[number], self.lower[number])
            if self.upper:
                rest[number] = min(rest[number], self.upper[number])
        return tuple(rest)

    def out_of_limits(self, position: Sequence[float]) -> bool:
        """Return whether a coordinate is beyond its limits by more than rounding."""
        # loops, not any(): this is asked for each joint of each lookup
        for value, low in zip(position, self.lower, strict=False):
            if value < low - ROUNDING:
                return True
        for value, high in zip(position, self.upper, strict=False):  # noqa: SIM110
            if value > high + ROUNDING:
                return True
        return False

    def motion(self, position: Sequence[float]) -> Pose:
        """Return where the joint's coordinates put the `to` frame, seen from where it stands with all of them 0."""
        match self.type:
            case JointType.REVOLUTE:
                return Pose._of(_ORIGIN, self.turned(position[0]))
            case JointType.PRISMATIC:
                x, y, z = self.axis
                return Pose._of((x * position[0], y * position[0], z * position[0]), so3.IDENTITY)
            case JointType.SPHERICAL:
                return Pose._of(_ORIGIN, so3.exponential((position[0], position[1], position[2])))
            case JointType.PLANAR:
                (ux, uy, uz), (vx, vy, vz) = self._plane
                u, v, turn = position
                return Pose._of((ux * u + vx * v, uy * u + vy * v, uz * u + vz * v), self.turned(turn))
            case JointType.FLOATING:
                x, y, z, rx, ry, rz = position
                return Pose._of((x, y, z), so3.exponential((rx, ry, rz)))
            case _:
                return Pose.identity()

    def turned(self, angle: float) -> Quaternion:
        """Return the rotation by an angle about the axis."""
        x, y, z = self.axis
        half = math.remainder(angle, math.tau) / 2.0
        s = math.sin(half)
        return so3.normalized((math.cos(half), x * s, y * s, z * s))

    def jacobian(self, position: Sequence[float]) -> Array:
        """Return (6, n): how the place and the orientation that `motion` gives change with the coordinates.

        Rows are x, y, z, about x, about y, about z along the axes that motion starts from; a rate of the coordinates
        times it is the linear and angular velocity of the `to` frame. For a rotation vector v the angular velocity is
        J_l(v) v', with the left Jacobian of SO(3) (Sola, "Quaternion kinematics", 2017, eq. 183).
        """
        J = np.zeros((6, self.count))
        match self.type:
            case JointType.REVOLUTE:
                J[3:, 0] = self.axis
            case JointType.PRISMATIC:
                J[:3, 0] = self.axis
            case JointType.SPHERICAL:
                J[3:, :] = left_jacobian((position[0], position[1], position[2]))
            case JointType.PLANAR:
                J[:3, 0], J[:3, 1] = self._plane
                J[3:, 2] = self.axis
            case JointType.FLOATING:
                J[:3, :3] = np.eye(3)
                J[3:, 3:] = left_jacobian((position[3], position[4], position[5]))
        return J


def left_jacobian(v: Vector3) -> Array:
    """Return the left Jacobian (3, 3) of SO(3) at a rotation vector: exp(v + dv) = exp(J dv) exp(v) to first order."""
    angle = math.hypot(*v)
    K = so3.skew(v)
    if angle < 1e-4:
        return np.asarray(np.eye(3) + K / 2.0 + K @ K / 6.0)
    square = angle * angle
    return np.asarray(
        np.eye(3) + (1.0 - math.cos(angle)) / square * K + (angle - math.sin(angle)) / (square * angle) * (K @ K)
    )


def coordinate_names(constraint: str, joint: Joint) -> tuple[str, ...]:
    """Return the names that drive the coordinates of a constraint's joint."""
    return tuple([constraint + suffix for suffix in SUFFIXES[joint.type]])


def _unit(axis: Sequence[float]) -> Vector3:
    x, y, z = (float(value) for value in axis)
    length = math.hypot(x, y, z)
    if not (math.isfinite(length) and length > 1e-9):
        raise ValueError(f"the axis of a joint is 3 numbers, finite and not all 0, got {_listed(tuple(axis))}")
    if abs(length - 1.0) < 1e-15:
        return (x + 0.0, y + 0.0, z + 0.0)
    return (x / length + 0.0, y / length + 0.0, z / length + 0.0)


def _plane(normal: Vector3) -> tuple[Vector3, Vector3]:
    """Return the two unit vectors of a plane: x and y of the axes turned the shortest way from z to its normal."""
    x, y, z = normal
    if z > 0.0:
        k = 1.0 / (1.0 + z)
    else:
        # the same number, without the difference of two that are nearly equal
        square = x * x + y * y
        if square < 1e-200:
            return (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)
        k = (1.0 - z) / square
    return (1.0 - k * x * x, -k * x * y, -x), (-k * x * y, 1.0 - k * y * y, -y)


def _listed(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)


FIXED: Final = Joint()

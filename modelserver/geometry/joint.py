"""Joints: how a constraint lets its two frames move, as an immutable value.

Coordinates: one for a revolute or prismatic joint (radians or meters along its axis), three for a spherical one (a
rotation vector), three for a planar one (two lengths in the plane, an angle about its normal), six for a floating one
(a position, a rotation vector). Each has a name of its own: that of the constraint where it is the only one, `NAME.x`,
`NAME.rz` and so on where there are several.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

import numpy as np

from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array, Quaternion, Vector3

Coordinates = tuple[float, ...]


class JointType(StrEnum):
    """The type of a joint: which motions it allows between the two frames of a constraint."""

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
"""Suffixes to the constraint's name in the names of a joint's coordinates."""

ANGLES: Final[dict[JointType, tuple[bool, ...]]] = {
    JointType.FIXED: (),
    JointType.REVOLUTE: (True,),
    JointType.PRISMATIC: (False,),
    JointType.SPHERICAL: (True, True, True),
    JointType.PLANAR: (False, False, True),
    JointType.FLOATING: (False, False, False, True, True, True),
}
"""Whether a coordinate is an angle, radians, or a length, meters."""

TYPES_WITH_AXIS: Final = (JointType.REVOLUTE, JointType.PRISMATIC, JointType.PLANAR)
"""The types that have an axis; a planar joint's is the normal of its plane."""

LIMIT_TOLERANCE: Final = 1e-9
"""Radians or meters; a joint at its limit within rounding is not beyond it."""

_ORIGIN: Final[Vector3] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Mimic:
    """A joint follows another: its position is `multiplier` times the other's, plus `offset`."""

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.multiplier) and math.isfinite(self.offset)):
            raise ValueError(f"a mimic's multiplier and offset are finite, got {self.multiplier} and {self.offset}")


@dataclass(frozen=True, slots=True)
class Joint:
    """The joint of a constraint: it moves the `to` frame from the constraint's pose.

    `axis` is the unit vector, in the frame that the constraint's pose leads to, about or along which it moves. `lower`,
    `upper`, `rate_limit`, `default` and `sigma` have one number for each coordinate, in radians or meters (per second),
    or are empty for no limit, default 0, and no stated sigma. `sigma` is the standard deviation of positions whose
    message states none. The default of a mimic joint follows from its leader's (`parts.apply_mimic_defaults`).

    Raises ValueError for an unknown type, an axis of no length, limits in the wrong order, a default beyond them, and
    numbers that are not finite, or negative where they may not be.
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
    """Number of coordinates."""
    limits: tuple[float, float] | None = field(init=False, repr=False, compare=False, hash=False)
    """Limits of a joint with one coordinate, widened by the tolerance; None for other joints."""
    _plane: tuple[Vector3, Vector3] = field(init=False, repr=False, compare=False, hash=False)

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "type", JointType(self.type))
        put(self, "count", len(SUFFIXES[self.type]))
        put(self, "axis", _normalize_axis(self.axis) if self.type in TYPES_WITH_AXIS else (0.0, 0.0, 1.0))
        put(self, "_plane", _plane_axes(self.axis))
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
            # a single representation of "no limit", so that equal joints compare equal
            if all(value == none for value in getattr(self, what)):
                put(self, what, ())
        low = self.lower[0] - LIMIT_TOLERANCE if self.lower else -math.inf
        high = self.upper[0] + LIMIT_TOLERANCE if self.upper else math.inf
        put(self, "limits", (low, high) if count == 1 else None)
        if not all(map(math.isfinite, self.default)):
            raise ValueError(f"a default is finite, got {_format_numbers(self.default)}")
        # the builder checks the defaults of mimic joints: it can name both joints
        if self.default and self.mimic is None and self.is_out_of_limits(self.default):
            raise ValueError(f"the default {_format_numbers(self.default)} is out of the joint's own limits")
        if self.mimic is not None and count != 1:
            raise ValueError(
                f"only a joint with one coordinate can follow another; a {self.type} one has {count or 'none'}"
            )

    @property
    def is_movable(self) -> bool:
        """Whether it has any coordinate."""
        return self.type is not JointType.FIXED

    @property
    def angle_flags(self) -> tuple[bool, ...]:
        """For each coordinate whether it is an angle."""
        return ANGLES[self.type]

    @property
    def default_position(self) -> Coordinates:
        """Position assumed until one is received: the default, else 0, else the limit next to 0."""
        if self.default:
            return self.default
        lower, upper = self.lower or (-math.inf,) * self.count, self.upper or (math.inf,) * self.count
        return tuple([min(max(0.0, low), high) for low, high in zip(lower, upper, strict=True)])

    def is_out_of_limits(self, position: Sequence[float]) -> bool:
        """Return whether a coordinate is beyond its limits by more than rounding."""
        # loops, not any(): this runs for each joint of each lookup
        for value, low in zip(position, self.lower, strict=False):
            if value < low - LIMIT_TOLERANCE:
                return True
        for value, high in zip(position, self.upper, strict=False):  # noqa: SIM110
            if value > high + LIMIT_TOLERANCE:
                return True
        return False

    def compute_pose(self, position: Sequence[float]) -> Pose:
        """Return the pose of the `to` frame, relative to its pose with all coordinates 0."""
        match self.type:
            case JointType.REVOLUTE:
                return Pose._of(_ORIGIN, self.axis_rotation(position[0]))
            case JointType.PRISMATIC:
                x, y, z = self.axis
                return Pose._of((x * position[0], y * position[0], z * position[0]), so3.IDENTITY)
            case JointType.SPHERICAL:
                return Pose._of(_ORIGIN, so3.exponential((position[0], position[1], position[2])))
            case JointType.PLANAR:
                (ux, uy, uz), (vx, vy, vz) = self._plane
                u, v, turn = position
                return Pose._of((ux * u + vx * v, uy * u + vy * v, uz * u + vz * v), self.axis_rotation(turn))
            case JointType.FLOATING:
                x, y, z, rx, ry, rz = position
                return Pose._of((x, y, z), so3.exponential((rx, ry, rz)))
            case _:
                return Pose.identity()

    def axis_rotation(self, angle: float) -> Quaternion:
        """Return the rotation by an angle about the axis."""
        x, y, z = self.axis
        half = math.remainder(angle, math.tau) / 2.0
        s = math.sin(half)
        return so3.normalize((math.cos(half), x * s, y * s, z * s))

    def jacobian(self, position: Sequence[float]) -> Array:
        """Return the Jacobian (6, n) of `compute_pose` with respect to the coordinates.

        Rows are x, y, z, about x, about y, about z along the axes at coordinates 0; J times the coordinates' rates is
        the linear and angular velocity of the `to` frame. For a rotation vector v the angular velocity is J_l(v) v',
        with the left Jacobian of SO(3) (Sola, "Quaternion kinematics", 2017, eq. 183).
        """
        J = np.zeros((6, self.count))
        match self.type:
            case JointType.REVOLUTE:
                J[3:, 0] = self.axis
            case JointType.PRISMATIC:
                J[:3, 0] = self.axis
            case JointType.SPHERICAL:
                J[3:, :] = so3.left_jacobian((position[0], position[1], position[2]))
            case JointType.PLANAR:
                J[:3, 0], J[:3, 1] = self._plane
                J[3:, 2] = self.axis
            case JointType.FLOATING:
                J[:3, :3] = np.eye(3)
                J[3:, 3:] = so3.left_jacobian((position[3], position[4], position[5]))
        return J


def coordinate_names(constraint: str, joint: Joint) -> tuple[str, ...]:
    return tuple([constraint + suffix for suffix in SUFFIXES[joint.type]])


def _normalize_axis(axis: Sequence[float]) -> Vector3:
    x, y, z = (float(value) for value in axis)
    length = math.hypot(x, y, z)
    if not (math.isfinite(length) and length > 1e-9):
        raise ValueError(f"the axis of a joint is 3 numbers, finite and not all 0, got {_format_numbers(tuple(axis))}")
    if abs(length - 1.0) < 1e-15:
        return (x + 0.0, y + 0.0, z + 0.0)
    return (x / length + 0.0, y / length + 0.0, z / length + 0.0)


def _plane_axes(normal: Vector3) -> tuple[Vector3, Vector3]:
    """Return two unit vectors of a plane: x and y, rotated the shortest way from z to the normal."""
    x, y, z = normal
    if z > 0.0:
        k = 1.0 / (1.0 + z)
    else:
        # the same without cancellation
        square = x * x + y * y
        if square < 1e-200:
            return (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)
        k = (1.0 - z) / square
    return (1.0 - k * x * x, -k * x * y, -x), (-k * x * y, 1.0 - k * y * y, -y)


def _format_numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)


FIXED: Final = Joint()

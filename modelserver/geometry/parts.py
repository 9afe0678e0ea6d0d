"""Bodies, frames, constraints and shapes as immutable values (report 4.2 to 4.4).

Shapes and materials are for viewers, and not used in answers; mesh files are not opened. A mimic joint follows another,
also through chains of joints that follow each other: `resolve_mimics` finds the coordinates that drive each joint.

Inertia: mass, center of mass and inertia tensor of a rigid body; spatial inertia (6x6), parallel axis theorem included.

The spatial inertia maps a body's motion to its momentum, both at the body's origin and along the body's axes. Rows and
columns are ordered x, y, z, then about x, about y, about z; the 2005 report leaves the order open. With mass m, center
of mass c and inertia I about it (R. Featherstone, "Rigid Body Dynamics Algorithms", 2008, eq. 2.63, blocks exchanged):

    [   m 1       -m [c]x          ]
    [ m [c]x   I - m [c]x [c]x     ]

Kilograms, meters, kg m2.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final, NamedTuple

import numpy as np

from modelserver.errors import UnknownFrameError, find_nearest_names, find_suggestion, quote
from modelserver.geometry import names
from modelserver.geometry.joint import FIXED, Joint, Mimic, coordinate_names
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array, Vector3
from modelserver.transforms.transformation import make_covariance


class ShapeKind(StrEnum):
    """The kind of a shape."""

    BOX = "box"
    CYLINDER = "cylinder"
    SPHERE = "sphere"
    MESH = "mesh"


DIMENSIONS: Final[dict[ShapeKind, tuple[str, ...]]] = {
    ShapeKind.BOX: ("x", "y", "z"),
    ShapeKind.CYLINDER: ("radius", "length"),
    ShapeKind.SPHERE: ("radius",),
    ShapeKind.MESH: ("x", "y", "z"),
}
"""The numbers of a shape's `size`, meters; those of a mesh are scale factors."""


@dataclass(frozen=True, slots=True)
class Material:
    """A named material: color as red, green, blue and opacity from 0 to 1, and the name of a texture file.

    Raises ValueError for a name that is empty or not printable, or a color out of its range.
    """

    name: str
    color: tuple[float, float, float, float] | None = None
    texture: str = ""

    def __post_init__(self) -> None:
        _check_text("a material's name", self.name, required=True)
        _check_text("a texture's file", self.texture)
        if self.color is not None:
            values = tuple([float(value) + 0.0 for value in self.color])
            if len(values) != 4 or not all(0.0 <= value <= 1.0 for value in values):
                raise ValueError("a color is red, green, blue and opacity, each from 0 to 1")
            object.__setattr__(self, "color", values)


@dataclass(frozen=True, slots=True)
class Shape:
    """A shape on a body: `pose` is that of its center, or of the mesh's origin, in body coordinates.

    `size` is ordered as in `DIMENSIONS`; the axis of a cylinder is z. `file` names a mesh's file and is empty for other
    kinds. Raises ValueError for sizes that are missing, not finite, or, except for a mesh, negative.
    """

    kind: ShapeKind
    size: tuple[float, ...]
    pose: Pose = field(default_factory=Pose.identity)
    file: str = ""
    name: str = ""
    material: Material | None = None

    def __post_init__(self) -> None:
        wanted = DIMENSIONS[self.kind]
        size = tuple([float(value) + 0.0 for value in self.size])
        if len(size) != len(wanted):
            raise ValueError(
                f"the size of a {self.kind} is {', '.join(wanted)}: {len(wanted)} numbers, got {len(size)}"
            )
        for what, value in zip(wanted, size, strict=True):
            # a mesh is mirrored by a negative scale
            if not math.isfinite(value) or (value < 0.0 and self.kind is not ShapeKind.MESH):
                raise ValueError(f"the {what} of a {self.kind} is finite and not negative, got {value:g}")
        object.__setattr__(self, "size", size)
        _check_text("a mesh's file", self.file, required=self.kind is ShapeKind.MESH)
        if self.file and self.kind is not ShapeKind.MESH:
            raise ValueError(f"a {self.kind} has no file")
        _check_text("a shape's name", self.name)


def _check_text(what: str, text: str, required: bool = False) -> None:
    if required and not text:
        raise ValueError(f"{what} is missing")
    if not text.isprintable() or text != text.strip():
        raise ValueError(f"{what} is printable and has no white space around it, got {quote(text)}")


@dataclass(frozen=True, slots=True)
class Sigma:
    """Standard deviations of a surveyed pose, along the axes of the parent frame.

    `position` in meters, `rotation` in radians. Raises ValueError for a negative or non-finite one.
    """

    position: Vector3 = (0.0, 0.0, 0.0)
    rotation: Vector3 = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for what in ("position", "rotation"):
            values = tuple([float(value) for value in getattr(self, what)])
            if len(values) != 3:
                raise ValueError(f"the {what} sigma is 3 numbers, got {len(values)}")
            for value in values:
                if not math.isfinite(value * value) or value < 0:
                    raise ValueError(f"a sigma is finite and not negative, got {value}")
            object.__setattr__(self, what, values)

    @property
    def is_zero(self) -> bool:
        """Whether the pose is stated as exact."""
        return not any(self.position) and not any(self.rotation)

    @property
    def covariance(self) -> Array:
        """The diagonal covariance (6, 6)."""
        return make_covariance(self.position, self.rotation)


@dataclass(frozen=True, slots=True)
class BodyFrame:
    """A frame on a body: `pose` is its pose in body coordinates (the report's A_ij).

    The body's own coordinates are its origin; a frame named Origin is usually there. `body` is the name of the body
    that the frame is on, set by `Body`; it is not compared: the same frame on two bodies is equal.
    """

    name: str
    pose: Pose = field(default_factory=Pose.identity)
    description: str = ""
    sigma: Sigma | None = None
    body: str = field(default="", compare=False)

    @property
    def full_name(self) -> str:
        return names.join(self.body, self.name) if self.body else self.name


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


@dataclass(frozen=True, slots=True)
class Body:
    """A rigid body: named frames around one origin.

    `pose` is the optional transform of the whole body that a 2005 file may have; it is stored and written back, and not
    used in relations between frames. `inertia` is the 6x6 spatial inertia in body coordinates, rows of 6 (the report's
    InertiaMatrix), or None; see the module. `visuals` and `collisions` are its shapes, for viewers.
    `with_name` copies a body. Raises ValueError for two frames of one name, or an inertia that is not 6x6 and finite.
    """

    name: str
    frames: tuple[BodyFrame, ...] = ()
    description: str = ""
    pose: Pose | None = None
    inertia: tuple[tuple[float, ...], ...] | None = None
    visuals: tuple[Shape, ...] = ()
    collisions: tuple[Shape, ...] = ()
    _by_name: dict[str, BodyFrame] = field(init=False, repr=False, compare=False, hash=False)

    def __post_init__(self) -> None:
        if any(frame.body != self.name for frame in self.frames):
            mine = [frame if frame.body == self.name else replace(frame, body=self.name) for frame in self.frames]
            object.__setattr__(self, "frames", tuple(mine))
        by_name: dict[str, BodyFrame] = {}
        for frame in self.frames:
            if frame.name in by_name:
                raise ValueError(f"body {self.name} has two frames named {frame.name}")
            by_name[frame.name] = frame
        object.__setattr__(self, "_by_name", by_name)
        if self.inertia is not None:
            rows = tuple([tuple([float(value) for value in row]) for row in self.inertia])
            if [len(row) for row in rows] != [6] * 6 or not all(map(math.isfinite, sum(rows, ()))):
                raise ValueError(f"the inertia of body {self.name} is not 6 rows of 6 finite numbers")
            object.__setattr__(self, "inertia", rows)

    @property
    def rigid_inertia(self) -> RigidInertia | None:
        """Mass, center of mass and inertia; None where no inertia is stated, or one that is not a rigid body's."""
        return None if self.inertia is None else from_spatial_inertia(self.inertia)

    @property
    def mass(self) -> float | None:
        """The mass in kilograms; None as for `rigid_inertia`."""
        return None if (found := self.rigid_inertia) is None else found.mass

    @property
    def center_of_mass(self) -> Vector3 | None:
        """The center of mass in body coordinates, meters; None as for `rigid_inertia`."""
        return None if (found := self.rigid_inertia) is None else found.center

    def frame(self, name: str) -> BodyFrame:
        """Return the frame of that name. Raises UnknownFrameError with the nearest names, or with all."""
        found = self._by_name.get(name)
        if found is None:
            near = find_nearest_names(name, self._by_name)
            others = "" if near else f"; its frames are {names.format_names([each.full_name for each in self])}"
            raise UnknownFrameError(
                f"body {self.name} has no frame {quote(name)}{others}", (names.join(self.name, each) for each in near)
            )
        return found

    def has_frame(self, frame: str | BodyFrame) -> bool:
        """Return whether the body has a frame of that name, or exactly that frame (the report's verifyBodyFrame)."""
        if isinstance(frame, str):
            return frame in self._by_name
        return frame.body == self.name and self._by_name.get(frame.name) == frame

    def with_frame(self, frame: BodyFrame) -> Body:
        """Return this body with a further frame. Raises ValueError for a name that exists."""
        return replace(self, frames=(*self.frames, frame))

    def without_frame(self, name: str) -> Body:
        """Return this body without the frame of that name. Raises UnknownFrameError."""
        removed = self.frame(name)
        return replace(self, frames=tuple(frame for frame in self.frames if frame is not removed))

    def with_name(self, name: str) -> Body:
        """Return a copy under another name, with all its frames, e.g. a second camera."""
        return replace(self, name=name)

    def __iter__(self) -> Iterator[BodyFrame]:
        return iter(self.frames)


@dataclass(frozen=True, slots=True)
class Constraint:
    """A fixed connection or joint between two frames: `pose` is that of frame `to` in frame `from_` (the report's T_k).

    `from_` and `to` are full names, `Body:Frame`. Crossing it from `to` to `from_` takes the inverse. For a movable
    joint, `pose` is that of `to` with all coordinates 0, and `sigma` its uncertainty.
    """

    name: str
    from_: str
    to: str
    pose: Pose = field(default_factory=Pose.identity)
    description: str = ""
    sigma: Sigma | None = None
    joint: Joint = FIXED

    @property
    def is_static(self) -> bool:
        """Whether the two frames are fixed to each other; the report's pose type, static or dynamic."""
        return not self.joint.is_movable

    @property
    def default_pose(self) -> Pose:
        """The pose of `to` in `from_` with a movable joint at its default position; else `pose`."""
        return self.pose @ self.joint.compute_pose(self.joint.default_position) if self.joint.is_movable else self.pose

    def other_end(self, frame: str) -> str:
        """Return the full name of the frame at the other end. Raises ValueError for a frame not in it."""
        if frame == self.from_:
            return self.to
        if frame == self.to:
            return self.from_
        raise ValueError(f"constraint {self.name} does not join {frame}")


def suggest_frame(name: str, bodies: Mapping[str, Body]) -> str:
    """Return the frame that a misspelled full name probably means; "" where that is not clear.

    At most one of its two names may be misspelled.
    """
    try:
        body, frame = names.split(name)
    except ValueError:
        return find_suggestion(name, (names.join(each.name, frame.name) for each in bodies.values() for frame in each))
    if body in bodies:
        if any(each.has_frame(frame) for each in bodies.values()):
            # a name that other bodies have is not misspelled
            return ""
        near = find_suggestion(frame, (each.name for each in bodies[body]))
        return names.join(body, near) if near else ""
    near = find_suggestion(body, (each for each in bodies if bodies[each].has_frame(frame)))
    return names.join(near, frame) if near else ""


class JointDrive(NamedTuple):
    """The position of a joint: `multiplier` times the coordinates `names` of its `leader`, plus `offset`.

    For a chain of mimic joints, multiplier and offset are those of the whole chain.
    """

    names: tuple[str, ...]
    leader: str
    multiplier: float = 1.0
    offset: float = 0.0


def resolve_mimics(joints: Iterable[Constraint]) -> dict[str, JointDrive]:
    """Return the drive of each joint by its constraint's name.

    Mimic chains end at a joint that follows none; `ModelBuilder` rejects those that do not.
    """
    by_name = {each.name: each for each in joints}
    found: dict[str, JointDrive] = {}
    for each in by_name.values():
        links: list[tuple[str, Mimic]] = []
        while each.name not in found and (mimic := each.joint.mimic) is not None:
            links.append((each.name, mimic))
            each = by_name[mimic.joint]
        drive = found.setdefault(each.name, JointDrive(coordinate_names(each.name, each.joint), each.name))
        for name, mimic in reversed(links):
            offset = mimic.multiplier * drive.offset + mimic.offset
            drive = JointDrive(drive.names, drive.leader, mimic.multiplier * drive.multiplier, offset)
            found[name] = drive
    return {name: found[name] for name in by_name}


def apply_mimic_defaults(constraints: Iterable[Constraint]) -> tuple[Constraint, ...]:
    """Return the constraints with the default of each mimic joint computed from its leader's default position.

    Every mimic chain must end at a joint that follows none. Raises ValueError where a position is not finite.
    """
    constraints = tuple(constraints)
    moving = {each.name: each for each in constraints if each.joint.is_movable}
    drives = resolve_mimics(moving.values())
    result = []
    for each in constraints:
        if each.joint.mimic is not None:
            drive = drives[each.name]
            (leader,) = moving[drive.leader].joint.default_position
            each = replace(each, joint=replace(each.joint, default=(drive.multiplier * leader + drive.offset,)))
        result.append(each)
    return tuple(result)

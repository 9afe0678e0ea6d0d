"""What a `ModelBuilder` collects and a `Review` examines: bodies and constraints with the places they come from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from modelserver.errors import Location, Problem
from modelserver.geometry.parts import BodyFrame, Constraint, Sigma
from modelserver.geometry.shape import Shape
from modelserver.spatial.pose import Pose

NOWHERE: Final = Location()


@dataclass(slots=True)
class BodyBuilder:
    """Collects one body; made by `ModelBuilder.body`."""

    name: str
    source: Location = NOWHERE
    description: str = ""
    pose: Pose | None = None
    inertia: tuple[tuple[float, ...], ...] | None = None
    frames: list[tuple[BodyFrame, Location]] = field(default_factory=list)
    visuals: tuple[Shape, ...] = ()
    collisions: tuple[Shape, ...] = ()

    def frame(
        self,
        name: str,
        pose: Pose | None = None,
        description: str = "",
        sigma: Sigma | None = None,
        source: Location = NOWHERE,
    ) -> BodyBuilder:
        """Add a frame at `pose` in body coordinates; return this body, to go on."""
        self.frames.append((BodyFrame(name, pose or Pose.identity(), description, sigma, self.name), source))
        return self


@dataclass(slots=True, eq=False)
class Draft:
    """A model before it is checked.

    strict: hold to the rule of 2005 that a frame has one constraint at most. problems: those met while reading.
    unclear_joints: constraints whose joint a file states in a way that could not be read; they are added as fixed.
    loose_ends: constraint, sense (From or To) and frame of ends whose other end is missing; they are examined too.
    """

    name: str = ""
    description: str = ""
    strict: bool = False
    problems: list[Problem] = field(default_factory=list)
    unclear_joints: set[str] = field(default_factory=set)
    loose_ends: list[tuple[str, str, str, Location]] = field(default_factory=list)
    bodies: list[BodyBuilder] = field(default_factory=list)
    constraints: list[tuple[Constraint, Location]] = field(default_factory=list)

"""The unchecked model that a `ModelBuilder` collects and a `ModelReview` examines, with source locations."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from modelserver.errors import Location, Problem
from modelserver.geometry.parts import BodyFrame, Constraint, Sigma
from modelserver.geometry.shape import Shape
from modelserver.transforms.pose import Pose

NO_LOCATION: Final = Location()


@dataclass(slots=True)
class BodyBuilder:
    """Collects one body; created by `ModelBuilder.add_body`."""

    name: str
    source: Location = NO_LOCATION
    description: str = ""
    pose: Pose | None = None
    inertia: tuple[tuple[float, ...], ...] | None = None
    frames: list[tuple[BodyFrame, Location]] = field(default_factory=list)
    visuals: tuple[Shape, ...] = ()
    collisions: tuple[Shape, ...] = ()

    def add_frame(
        self,
        name: str,
        pose: Pose | None = None,
        description: str = "",
        sigma: Sigma | None = None,
        source: Location = NO_LOCATION,
    ) -> BodyBuilder:
        """Add a frame at `pose` in body coordinates; return this body."""
        self.frames.append((BodyFrame(name, pose or Pose.identity(), description, sigma, self.name), source))
        return self


@dataclass(slots=True, eq=False)
class ModelDraft:
    """A model before it is checked.

    strict: apply the 2005 rule that a frame has one constraint at most. problems: those met while reading.
    unreadable_joints: constraints whose joint could not be read; they are added as fixed. unresolved_ends: constraint,
    end (From or To) and frame of constraints with one end missing; the other end is checked too.
    """

    name: str = ""
    description: str = ""
    strict: bool = False
    problems: list[Problem] = field(default_factory=list)
    unreadable_joints: set[str] = field(default_factory=set)
    unresolved_ends: list[tuple[str, str, str, Location]] = field(default_factory=list)
    bodies: list[BodyBuilder] = field(default_factory=list)
    constraints: list[tuple[Constraint, Location]] = field(default_factory=list)

"""Edges of a path between two frames: frames of bodies, constraints, and joints that move."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from modelserver.geometry.joint import Joint
from modelserver.geometry.parts import BodyFrame, Sigma
from modelserver.geometry.topology import Crossing
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array


class EdgeKind(StrEnum):
    """What an edge of a path is."""

    FRAME = "frame"
    """From a body's origin to one of its frames."""
    CONSTRAINT = "constraint"
    """From the `from` frame of a constraint to its `to` frame; of a joint that moves, the place where it is mounted."""
    JOINT = "joint"
    """How far a joint has moved."""
    VEHICLE = "vehicle"
    """From a world frame to the vehicle."""


class Edge(NamedTuple):
    """One edge of a path: passed from its near to its far end where `forward`.

    `pose` is that of the far in the near end; for a joint that moves it is the identity, and `joint` says how. `sigma`
    is that of a survey, None where none is stated. `leader` is the joint whose coordinates place one that follows,
    empty for one that does not.
    """

    kind: EdgeKind
    name: str
    forward: bool
    pose: Pose
    sigma: Sigma | None = None
    joint: Joint | None = None
    leader: str = ""

    @property
    def is_unstated(self) -> bool:
        """Whether a fixed edge states no sigma; two frames that are one by definition are so exactly."""
        return self.sigma is None and self.pose != _IDENTITY

    @property
    def survey_factor(self) -> Array | None:
        """The factor (6, n) of a fixed edge's covariance; None where a pose that is none states no sigma."""
        if self.sigma is not None:
            return np.diag((*self.sigma.position, *self.sigma.rotation))
        return None if self.is_unstated else _EXACT


def edges_along(
    path: Iterable[Crossing],
    frame: Callable[[str], BodyFrame],
    frame_of_interest: str,
    frame_of_reference: str,
) -> list[Edge]:
    """Return the edges of a path from one frame to another: frames of bodies, constraints, and joints that move.

    `frame` gives a frame by its full name. A frame that stands at its body's origin by definition is no edge.
    """
    edges: list[Edge] = []
    inside, name = frame(frame_of_reference), frame_of_reference

    def within(leaving: BodyFrame, leaving_name: str) -> None:
        if leaving is not inside:
            for each, full, forward in ((inside, name, False), (leaving, leaving_name, True)):
                if each.pose != _IDENTITY or each.sigma is not None:
                    edges.append(Edge(EdgeKind.FRAME, full, forward, each.pose, each.sigma))

    for crossing in path:
        within(frame(crossing.enters), crossing.enters)
        each = crossing.constraint
        crossed = [Edge(EdgeKind.CONSTRAINT, each.name, crossing.forward, each.pose, each.sigma)]
        if each.joint.moves:
            moved = Edge(EdgeKind.JOINT, each.name, crossing.forward, _IDENTITY, joint=each.joint)
            crossed.insert(1 if crossing.forward else 0, moved)
        edges += crossed
        inside, name = frame(crossing.leaves), crossing.leaves
    within(frame(frame_of_interest), frame_of_interest)
    return edges


_IDENTITY = Pose.identity()
_EXACT = np.zeros((6, 1))

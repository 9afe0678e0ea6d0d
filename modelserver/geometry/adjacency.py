"""Adjacency: constraints at a frame, the frames at their other ends, and what is wrong at a frame (report 4.3, 4.4).

The report's BodyFrame holds a pointer to its constraint. Frames are values here, so the model answers instead: a frame
knows the name of its body, and the model knows which constraints name it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from modelserver.errors import (
    Location,
    MalformedRequestError,
    NotConnectedError,
    Problem,
    Severity,
    UnknownFrameError,
    nearest_names,
    shown,
)
from modelserver.geometry.parts import BodyFrame, Constraint
from modelserver.geometry.topology import Crossing
from modelserver.geometry.wording import few
from modelserver.spatial.pose import Pose


class Neighbor(NamedTuple):
    """The frame at the other end of a constraint, and the constraint as it is crossed to get there."""

    frame: BodyFrame
    crossing: Crossing

    @property
    def constraint(self) -> Constraint:
        """The constraint that joins the two frames."""
        return self.crossing.constraint

    @property
    def pose(self) -> Pose:
        """The neighbor's pose in the frame it was reached from, the sense kept; a moving joint at its default."""
        return self.crossing.pose


def select_one(frame: str, found: Sequence[Neighbor], constraint: str) -> Neighbor:
    """Return the neighbor across the constraint of that name, or the only one where `constraint` is empty.

    Raises NotConnectedError where there is none, MalformedRequestError where there are several and none is named.
    """
    known = [each.constraint.name for each in found]
    if constraint:
        for each in found:
            if each.constraint.name == constraint:
                return each
        there = f"it has {few(known)}" if known else "it has none"
        raise NotConnectedError(
            f"frame {frame} has no constraint {shown(constraint)}; {there}", nearest_names(constraint, known)
        )
    if not found:
        raise NotConnectedError(f"frame {frame} has no constraint, so no frame is next to it")
    if len(found) > 1:
        raise MalformedRequestError(f"frame {frame} has {len(found)} constraints, {few(known)}; name the one to cross")
    return found[0]


def full_name(frame: str | BodyFrame) -> str:
    """Return the full name of a frame given by it or as a value. Raises UnknownFrameError for one on no body."""
    if isinstance(frame, str):
        return frame
    if not frame.body:
        raise UnknownFrameError(f"frame {shown(frame.name)} is on no body; add it to one, or give its name Body:Frame")
    return frame.full_name


def find_problems(
    name: str, found: Sequence[Neighbor], is_other: bool, is_orphan: bool, root: str
) -> tuple[Problem, ...]:
    """Return what is wrong at a frame: it is not the model's, its body is an orphan, or it has several constraints."""
    problems = []
    source = Location(element=f"frame {name}")
    if is_other:
        problems.append(
            Problem(
                Severity.ERROR,
                "the model's frame of this name differs from this one",
                source,
                "take the frame from this model, or build a model with this frame in it",
            )
        )
    if is_orphan:
        body = name.partition(":")[0]
        problems.append(
            Problem(
                Severity.WARNING,
                f"body {body} is an orphan: no constraints lead to the root body {root}",
                source,
                f"add a constraint that joins it to {root} or to what is mounted there",
            )
        )
    if len(found) > 1:
        problems.append(
            Problem(
                Severity.NOTE,
                f"the frame has {len(found)} constraints, {few([each.constraint.name for each in found])}; "
                "a strict model allows one",
                source,
                "give each constraint a frame of its own, if the file has to load with strict",
            )
        )
    return tuple(problems)

"""Place a frame or a constraint where two frames coincide.

The report's users wanted to point at two frames that are the same place instead of computing the constraint between
their bodies. With a joint in between, positions are its default. Everything here is in the coordinates in which a file
states a pose: those of the body for a frame, those of the frame `from` for a constraint.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from modelserver.errors import quote
from modelserver.geometry import names
from modelserver.geometry.model import Model
from modelserver.geometry.parts import BodyFrame, Constraint, Sigma
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array
from modelserver.transforms.transformation import compose_covariance, invert_covariance


class PlacementError(ValueError):
    """The frames do not determine a pose."""


class Placement(NamedTuple):
    """A pose, and its standard deviations; None where a pose on the way states none."""

    pose: Pose
    sigma: Sigma | None


def locate_on_body(model: Model, body: str, frame: str, avoid: str = "") -> tuple[Pose, Array | None]:
    """Return the pose of any frame in the coordinates of a body, and its covariance (6, 6), None if it is unknown.

    Raises PlacementError if the way there leads through the frame `avoid`, which is to be placed; QueryError for an
    unknown frame, or one that is not connected.
    """
    if names.split(frame)[0] == body:
        found = model.frame(frame)
        return found.pose, _get_covariance(found)
    way = model.find_path(frame, model.body(body).frames[0].full_name)
    near = way[0].near_frame
    if near == avoid:
        raise PlacementError(f"{frame} is joined to the body through {avoid} itself, and moves with it")
    start = model.frame(near)
    rest = model.get_transformation(frame, near)
    pose = start.pose @ rest.pose
    own = _get_covariance(start)
    if own is None or rest.covariance is None:
        return pose, None
    return pose, compose_covariance(start.pose, own, rest.pose, rest.covariance)


def _get_covariance(frame: BodyFrame) -> Array | None:
    """Return the covariance of a frame on its body: none stated is exact at the body's origin, else unknown."""
    if frame.sigma is not None:
        return frame.sigma.covariance
    return np.zeros((6, 6)) if frame.pose == Pose.identity() else None


def place_frame(model: Model, frame: str, target: str) -> Placement:
    """Return where a frame stands on its body if it coincides with another frame. Raises as `locate_on_body`."""
    if frame == target:
        raise PlacementError("a frame coincides with itself anywhere")
    pose, found = locate_on_body(model, names.split(frame)[0], target, avoid=frame)
    return Placement(pose, _to_sigma(found))


def place_constraint(model: Model, constraint: str, frame: str, target: str) -> Placement:
    """Return the pose of a constraint for which two frames coincide, one on each side of it.

    X_FT = X_FG inverse(X_TM) inverse(X_J): F and T are the ends, G and M the frames on the sides of F and T, and X_J
    the motion of the joint at its default. Raises PlacementError if the frames are on one side; QueryError as
    `Model.get_transformation`.
    """
    part = next((each for each in model.constraints if each.name == constraint), None)
    if part is None:
        raise PlacementError(f"there is no constraint {quote(constraint)}")
    if not _is_beyond(model, part, frame):
        frame, target = target, frame
    if not _is_beyond(model, part, frame) or _is_beyond(model, part, target):
        raise PlacementError(f"{frame} and {target} are on one side of {constraint}: moving it moves both or none")
    X_FG, X_TM = model.get_transformation(target, part.from_), model.get_transformation(frame, part.to)
    X_J = part.joint.compute_pose(part.joint.default_position)
    X_MT = X_TM.pose.inverse()
    found: Array | None = None
    if X_FG.covariance is not None and X_TM.covariance is not None:
        found = compose_covariance(X_FG.pose, X_FG.covariance, X_MT, invert_covariance(X_TM.pose, X_TM.covariance))
    pose = X_FG.pose @ X_MT @ X_J.inverse()
    return Placement(pose, _to_sigma(found))


def _is_beyond(model: Model, constraint: Constraint, frame: str) -> bool:
    """Return whether a frame is on the side of the end `to` of a constraint."""
    start, end = names.split(constraint.to)[0], names.split(constraint.from_)[0]
    body = names.split(frame)[0]
    if body in (start, end):
        return body == start
    return all(crossing.constraint.name != constraint.name for crossing in model.find_path(frame, constraint.to))


def _to_sigma(found: Array | None) -> Sigma | None:
    """Return the standard deviations of a covariance."""
    if found is None:
        return None
    deviations = np.sqrt(np.maximum(np.diag(found), 0.0))
    return Sigma(so3.to_vector3(deviations[:3]), so3.to_vector3(deviations[3:]))

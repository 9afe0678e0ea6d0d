"""Place a frame or a constraint by what was measured: two frames that coincide, or distances from other frames.

The report's users wanted to point at two frames that are the same place instead of computing the constraint between
their bodies. With a joint in between, positions are its default. Everything here is in the coordinates in which a file
states a pose: those of the body for a frame, those of the frame `from` for a constraint.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from modelserver.errors import quote
from modelserver.geometry import names
from modelserver.geometry.model import Model
from modelserver.geometry.parts import BodyFrame, Constraint, Sigma
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array, Vector3
from modelserver.transforms.transformation import compose_covariance, invert_covariance

MAX_ITERATIONS: Final = 100
COLLINEAR: Final = 1e-3
"""Frames whose width, beside the line through them, is a smaller part of their length do not determine a position."""

MIN_HEIGHT: Final = 0.05
"""Height above the plane through the points, as a part of the mean distance, from which the first order holds."""

SAME_CHI_SQUARE: Final = 9.0
"""A second solution is reported if its weighted sum of squares exceeds that of the best by no more."""


class PlacementError(ValueError):
    """The measurements do not determine a pose."""


class Placement(NamedTuple):
    """A pose, and its standard deviations; None where a pose on the way states none."""

    pose: Pose
    sigma: Sigma | None


class DistanceFit(NamedTuple):
    """The position that fits distances best.

    `covariance` (3, 3), m2; `residuals` (n,), measured less computed distances, meters; `mirrored` is the second
    position that fits as well, on the other side of the plane through the frames; None if there is none.
    """

    position: Vector3
    covariance: Array
    residuals: Array
    mirrored: Vector3 | None


# --- frames that coincide


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


def place_frame(model: Model, frame: str, target: str, position_only: bool = False) -> Placement:
    """Return where a frame stands on its body if it coincides with another frame. Raises as `locate_on_body`."""
    if frame == target:
        raise PlacementError("a frame coincides with itself anywhere")
    pose, found = locate_on_body(model, names.split(frame)[0], target, avoid=frame)
    if position_only:
        pose = Pose(pose.xyz, model.frame(frame).pose.wxyz)
    return Placement(pose, _to_sigma(found, model.frame(frame).sigma, position_only))


def place_constraint(model: Model, constraint: str, frame: str, target: str, position_only: bool = False) -> Placement:
    """Return the pose of a constraint for which two frames coincide, one on each side of it.

    X_FT = X_FG inverse(X_TM) inverse(X_J): F and T are the ends, G and M the frames on the sides of F and T, and X_J
    the motion of the joint at its default. With `position_only` the rotation stays. Raises PlacementError if the frames
    are on one side; QueryError as `Model.get_transformation`.
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
    if position_only:
        moved = part.pose @ X_J @ X_TM.pose
        pose = Pose(
            [p + g - m for p, g, m in zip(part.pose.xyz, X_FG.pose.xyz, moved.xyz, strict=True)], part.pose.wxyz
        )
    else:
        pose = X_FG.pose @ X_MT @ X_J.inverse()
    return Placement(pose, _to_sigma(found, part.sigma, position_only))


def _is_beyond(model: Model, constraint: Constraint, frame: str) -> bool:
    """Return whether a frame is on the side of the end `to` of a constraint."""
    start, end = names.split(constraint.to)[0], names.split(constraint.from_)[0]
    body = names.split(frame)[0]
    if body in (start, end):
        return body == start
    return all(crossing.constraint.name != constraint.name for crossing in model.find_path(frame, constraint.to))


def _to_sigma(found: Array | None, old: Sigma | None, position_only: bool) -> Sigma | None:
    """Return the standard deviations of a covariance; the rotation's are the old ones if only the position is new."""
    if found is None:
        return None
    deviations = np.sqrt(np.maximum(np.diag(found), 0.0))
    rotation = so3.to_vector3(deviations[3:])
    if position_only:
        rotation = old.rotation if old is not None else (0.0, 0.0, 0.0)
    return Sigma(so3.to_vector3(deviations[:3]), rotation)


# --- distances


def locate_by_distances(
    points: Array, distances: Array, sigmas: Array, start: Vector3, point_covariances: Array | None = None
) -> DistanceFit:
    """Return the position that fits distances from known points best, by weighted least squares.

    Parameters
    ----------
    points : (n, 3), n at least 3, meters; not on a line
    distances, sigmas : (n,) measured distances and their standard deviations, meters
    start : where it is expected: of two positions, mirrored at the plane through the points, the nearer one is returned
    point_covariances : (n, 3, 3) of the points, m2; None for exact ones

    The weight of a distance is 1 / (s2 + u' P u), u the direction to the point. Gauss-Newton from both sides of the
    plane (Foy, "Position-location solutions by Taylor-series estimation", 1976).

    Raises PlacementError for fewer than three points, points on a line, and numbers that are no distances.
    """
    if len(points) < 3:
        raise PlacementError(f"a position needs distances from three frames, got {len(points)}")
    if not (np.isfinite(points).all() and np.isfinite(distances).all() and (distances > 0.0).all()):
        raise PlacementError("distances are positive numbers")
    if not (np.isfinite(sigmas).all() and (sigmas > 0.0).all()):
        raise PlacementError("standard deviations of distances are positive")
    center = points.mean(axis=0)
    _, extents, axes = np.linalg.svd(points - center)
    if extents[1] < COLLINEAR * extents[0] or extents[0] == 0.0:
        raise PlacementError("the frames are on a line, and the position could be anywhere around it")
    P = np.zeros((len(points), 3, 3)) if point_covariances is None else point_covariances
    found = [_refine(points, distances, sigmas, P, each) for each in _find_starts(points, distances, center, axes)]
    costs = [_compute_cost(points, distances, sigmas, P, x) for x in found]
    offsets = [math.dist(x, start) for x in found]
    # the mirrored one counts as a solution if it fits about as well
    fitting = [n for n in range(2) if costs[n] <= min(costs) + SAME_CHI_SQUARE]
    best = min(fitting, key=lambda n: offsets[n])
    x, other = found[best], found[1 - best]
    is_double = len(fitting) == 2 and math.dist(x, other) > 1e-6
    return DistanceFit(
        so3.to_vector3(x),
        _compute_covariance(points, distances, sigmas, P, x, axes[2] if len(fitting) == 2 else None),
        distances - np.linalg.norm(x - points, axis=1),
        so3.to_vector3(other) if is_double else None,
    )


def _compute_covariance(
    points: Array, distances: Array, sigmas: Array, P: Array, x: Array, normal: Array | None
) -> Array:
    """Return the covariance (3, 3) of a position; `normal` is that of the plane at which another one is mirrored.

    Near that plane the distances hardly change across it, and the first order does not hold. What they determine is h2,
    the square of the height above it, with a standard deviation s = 2 h s_h that hardly depends on the height: where
    h2 < 4 s, the position may be in the plane as well, and the variance across it is the larger of h2 and s.
    """
    weights, J = _linearize(points, sigmas, P, x)
    if normal is None:
        return np.asarray(np.linalg.inv(J.T @ (weights[:, None] * J)))
    height = float(normal @ (x - points.mean(axis=0)))
    lifted = max(abs(height), MIN_HEIGHT * float(distances.mean()))
    raised = x + normal * (math.copysign(lifted, height) - height)
    weights, J = _linearize(points, sigmas, P, raised)
    found = np.linalg.inv(J.T @ (weights[:, None] * J))
    s = 2.0 * lifted * math.sqrt(float(normal @ found @ normal))
    if height * height >= 4.0 * s:
        return np.asarray(found)
    inside = np.eye(3) - np.outer(normal, normal)
    return np.asarray(inside @ found @ inside + np.outer(normal, normal) * max(height * height, s))


def _find_starts(points: Array, distances: Array, center: Array, axes: Array) -> tuple[Array, Array]:
    """Return a position on each side of the plane through the points, by the differences of squared distances."""
    plane = (points - center) @ axes[:2].T
    A = 2.0 * (plane[1:] - plane[0])
    squares = (plane**2).sum(axis=1) - distances**2
    inside = np.linalg.lstsq(A, squares[1:] - squares[0], rcond=None)[0]
    height = math.sqrt(max(float(np.mean(distances**2 - ((plane - inside) ** 2).sum(axis=1))), 0.0))
    # in the plane itself the derivative across it is zero
    height = max(height, 1e-3 * float(np.mean(distances)))
    middle = center + inside @ axes[:2]
    return middle + height * axes[2], middle - height * axes[2]


def _linearize(points: Array, sigmas: Array, P: Array, x: Array) -> tuple[Array, Array]:
    """Return the weights (n,) of the distances, and their derivatives (n, 3), at a position."""
    away = x - points
    J = away / np.maximum(np.linalg.norm(away, axis=1), 1e-12)[:, None]
    return 1.0 / (sigmas**2 + np.einsum("ni,nij,nj->n", J, P, J)), J


def _compute_cost(points: Array, distances: Array, sigmas: Array, P: Array, x: Array) -> float:
    weights, _ = _linearize(points, sigmas, P, x)
    return float(weights @ (distances - np.linalg.norm(x - points, axis=1)) ** 2)


def _refine(points: Array, distances: Array, sigmas: Array, P: Array, x: Array) -> Array:
    """Return the position nearby with the least weighted squares, by damped Gauss-Newton."""
    cost, damping = _compute_cost(points, distances, sigmas, P, x), 1e-6
    for _ in range(MAX_ITERATIONS):
        weights, J = _linearize(points, sigmas, P, x)
        H = J.T @ (weights[:, None] * J)
        step = np.linalg.solve(
            H + damping * np.trace(H) * np.eye(3),
            J.T @ (weights * (distances - np.linalg.norm(x - points, axis=1))),
        )
        moved = _compute_cost(points, distances, sigmas, P, x + step)
        if moved <= cost:
            x, cost, damping = x + step, moved, max(damping / 10.0, 1e-12)
            if float(np.abs(step).max()) < 1e-12:
                break
        else:
            damping = damping * 10.0
            if damping > 1e6:
                break
    return x


def list_measured_points(model: Model, frame: str, others: Sequence[str]) -> tuple[Array, Array]:
    """Return positions (n, 3) and covariances (n, 3, 3) of frames in the coordinates of another frame's body.

    A frame whose uncertainty is unknown counts as exact. Raises as `locate_on_body`.
    """
    body = names.split(frame)[0]
    if frame in others:
        raise PlacementError(f"{frame} has no distance from itself")
    if len(set(others)) < len(others):
        raise PlacementError("a frame is given twice")
    found = [locate_on_body(model, body, each, avoid=frame) for each in others]
    positions = np.array([pose.xyz for pose, _ in found]).reshape(-1, 3)
    blocks = [np.zeros((3, 3)) if P is None else P[:3, :3] for _, P in found]
    return positions, np.array(blocks).reshape(-1, 3, 3)

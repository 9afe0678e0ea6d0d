"""The graph of frames and constraints: adjacency, searches, loop closures, and the edges of a path.

A `Crossing` is a constraint passed in one sense. Paths are found breadth-first (the shortest) or depth-first as in the
report (4.6.1, 4.6.2). In the report a BodyFrame holds a pointer to its constraint; here frames are values, and the
model finds the constraints at a frame (report 4.3, 4.4). `list_edges` turns a path into its edges: frames of bodies,
constraints, and movable joints.

Loop misclosure: the error around a loop, and its significance given the uncertainty of the surveys.

A loop of exactly surveyed constraints closes. The misclosure, a pose error (6), is tested against the covariance of the
path around the loop: the squared Mahalanobis distance is chi-square distributed, with as many degrees of freedom as the
covariance has uncertain directions. It is reported as the number of standard deviations at which a single normal
variable is equally improbable, so that 3 means the same for every loop.

Assumption: joints are exactly at their default positions; what is tested is the survey. First-order covariance.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from modelserver.errors import LimitError, UnknownFrameError, quote
from modelserver.geometry import names
from modelserver.geometry.joint import Joint
from modelserver.geometry.parts import Body, BodyFrame, Constraint, Sigma
from modelserver.transforms import chain, so3
from modelserver.transforms.chain import ChainLink
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array
from modelserver.transforms.transformation import chi_square_survival

DEPTH_FIRST_VISITS = 1_000_000
"""Limit of a depth-first search, in frames: its cost grows exponentially with the loops of a model."""


@dataclass(frozen=True, slots=True)
class Crossing:
    """One constraint passed on a path. `forward` is the sense From to To; backward takes the inverse."""

    constraint: Constraint
    forward: bool

    @property
    def near_frame(self) -> str:
        """The frame by which the path leaves a body."""
        return self.constraint.from_ if self.forward else self.constraint.to

    @property
    def far_frame(self) -> str:
        """The frame by which the path enters the next body."""
        return self.constraint.to if self.forward else self.constraint.from_

    @property
    def near_body(self) -> str:
        return self.near_frame.partition(":")[0]

    @property
    def far_body(self) -> str:
        return self.far_frame.partition(":")[0]

    @property
    def pose(self) -> Pose:
        """The pose of the far frame in the near one, with a movable joint at its default position."""
        X_FT = self.constraint.default_pose
        return X_FT if self.forward else X_FT.inverse()


class LoopClosure(NamedTuple):
    """A constraint that joins two bodies which are joined already: the path around the loop, the constraint first."""

    path: tuple[Crossing, ...]

    @property
    def constraint(self) -> str:
        return self.path[0].constraint.name

    @property
    def bodies(self) -> tuple[str, ...]:
        return tuple([crossing.far_body for crossing in reversed(self.path)])


class Topology:
    """The graph of bodies and constraints, all names valid (see `ModelBuilder`)."""

    __slots__ = ("_bodies", "_by_body", "_by_frame", "assemblies")

    def __init__(self, bodies: tuple[Body, ...], constraints: tuple[Constraint, ...]):
        self._bodies = {body.name: body for body in bodies}
        self._by_frame: dict[str, list[Crossing]] = {}
        for constraint in constraints:
            self._by_frame.setdefault(constraint.from_, []).append(Crossing(constraint, forward=True))
            self._by_frame.setdefault(constraint.to, []).append(Crossing(constraint, forward=False))
        self._by_body: dict[str, list[Crossing]] = {body.name: [] for body in bodies}
        for body in bodies:
            for frame in body:
                self._by_body[body.name] += self._by_frame.get(names.join(body.name, frame.name), ())
        self.assemblies = self._find_assemblies()
        """Groups of bodies that constraints join, each in breadth-first order; the root's comes first."""

    def _find_assemblies(self) -> tuple[tuple[str, ...], ...]:
        seen: set[str] = set()
        assemblies = []
        for start in self._bodies:
            if start not in seen:
                assembly = (start, *(crossing.far_body for crossing in self.traverse_breadth_first(start)))
                seen.update(assembly)
                assemblies.append(assembly)
        return tuple(assemblies)

    def traverse_breadth_first(self, start: str) -> Iterator[Crossing]:
        """Traverse the bodies breadth-first from `start`; yield the crossing to each."""
        seen = {start}
        queue = deque([start])
        while queue:
            for crossing in self._by_body[queue.popleft()]:
                if crossing.far_body not in seen:
                    seen.add(crossing.far_body)
                    queue.append(crossing.far_body)
                    yield crossing

    def crossings(self, frame: str) -> tuple[Crossing, ...]:
        """Return the constraints at a frame, given by its full name, each in the sense that leads away from it."""
        return tuple(self._by_frame.get(frame, ()))

    def find_loop_closures(self) -> tuple[LoopClosure, ...]:
        """Return the constraints that are not in the breadth-first spanning tree."""
        closures = []
        for assembly in self.assemblies:
            reached = {each.far_body: each for each in self.traverse_breadth_first(assembly[0])}
            used = {crossing.constraint.name for crossing in reached.values()}
            for body in assembly:
                for crossing in self._by_body[body]:
                    if crossing.constraint.name not in used:
                        used.add(crossing.constraint.name)
                        closures.append(LoopClosure((crossing, *_tree_path(reached, crossing.far_body, body))))
        return tuple(closures)

    def find_shortest_path(self, body: str, target: str) -> tuple[Crossing, ...] | None:
        """Return the crossings of a shortest path from one body to another, None where there is none."""
        reached: dict[str, Crossing] = {}
        for crossing in self.traverse_breadth_first(body) if body != target else ():
            reached[crossing.far_body] = crossing
            if crossing.far_body == target:
                return tuple(reversed(_climb(reached, target)))
        return () if body == target else None

    def find_path_depth_first(self, body: str, frame: str, target: str) -> tuple[Crossing, ...] | None:
        """Return the path that the report's search finds (4.6.2), None where there is none.

        From `body:frame`, each frame of the body is compared with `target` (a full name). A constrained frame that does
        not match is pushed on the path stack, its constraint is crossed, and the frames of the next body are examined.
        A frame that is on the stack closes a cycle, and its branch is left. Order is that of the file, so the path need
        not be the shortest. Raises LimitError after `DEPTH_FIRST_VISITS` frames.
        """
        if names.join(body, frame) == target:
            return ()
        path: list[Crossing] = []
        on_path: set[str] = set()
        stack = [self._iterate_crossings(body)]
        visits = 0
        while stack:
            visits += 1
            if visits > DEPTH_FIRST_VISITS:
                raise LimitError(
                    f"the depth-first search gave up after {DEPTH_FIRST_VISITS} frames: the model has too many "
                    "loops for it; use the breadth-first search"
                )
            step = next(stack[-1], None)
            if step is None:
                stack.pop()
                if path:
                    on_path.discard(path.pop().near_frame)
                continue
            name, crossing = step
            if name == target:
                return tuple(path)
            if crossing is None or name in on_path or crossing.far_frame in on_path:
                continue
            path.append(crossing)
            if crossing.far_frame == target:
                return tuple(path)
            on_path.add(name)
            stack.append(self._iterate_crossings(crossing.far_body))
        return None

    def _iterate_crossings(self, body: str) -> Iterator[tuple[str, Crossing | None]]:
        """Yield a body's frames in order by full name, each with None first and then with its crossings."""
        for frame in self._bodies[body].frames:
            name = names.join(body, frame.name)
            yield name, None
            for crossing in self._by_frame.get(name, ()):
                yield name, crossing


def _climb(reached: Mapping[str, Crossing], body: str) -> list[Crossing]:
    """Return the crossings of a spanning tree that lead to a body, the last first."""
    line = []
    while body in reached:
        line.append(reached[body])
        body = line[-1].near_body
    return line


def _tree_path(reached: Mapping[str, Crossing], start: str, target: str) -> tuple[Crossing, ...]:
    rising, falling = _climb(reached, start), _climb(reached, target)
    while rising and falling and rising[-1] is falling[-1]:
        rising.pop()
        falling.pop()
    return (*[Crossing(each.constraint, not each.forward) for each in rising], *reversed(falling))


class Neighbor(NamedTuple):
    """The frame at the other end of a constraint, and the crossing that leads to it."""

    frame: BodyFrame
    crossing: Crossing

    @property
    def constraint(self) -> Constraint:
        """The constraint that joins the two frames."""
        return self.crossing.constraint

    @property
    def pose(self) -> Pose:
        """The neighbor's pose in the frame that it was reached from; a movable joint at its default position."""
        return self.crossing.pose


def full_name(frame: str | BodyFrame) -> str:
    """Return the full name of a frame given by name or value. Raises UnknownFrameError for a value on no body."""
    if isinstance(frame, str):
        return frame
    if not frame.body:
        raise UnknownFrameError(f"frame {quote(frame.name)} is on no body; add it to one, or give its name Body:Frame")
    return frame.full_name


class EdgeKind(StrEnum):
    """The kind of an edge of a path."""

    FRAME = "frame"
    """From a body's origin to one of its frames."""
    CONSTRAINT = "constraint"
    """From the `from` frame of a constraint to its `to` frame, with a movable joint at 0."""
    JOINT = "joint"
    """The displacement of a joint."""
    VEHICLE = "vehicle"
    """From a world frame to the vehicle."""


class Edge(NamedTuple):
    """One edge of a path: passed from its near to its far end where `forward`.

    `pose` is that of the far in the near end; for a movable joint it is the identity, and `joint` gives the
    displacement. `sigma` is that of a survey, None where none is stated. `leader` is the joint that a mimic joint
    follows, else "".
    """

    kind: EdgeKind
    name: str
    forward: bool
    pose: Pose
    sigma: Sigma | None = None
    joint: Joint | None = None
    leader: str = ""

    @property
    def step(self) -> Pose:
        """The pose of the end that is reached in the end that is left."""
        return self.pose if self.forward else self.pose.inverse()

    @property
    def is_sigma_missing(self) -> bool:
        """Whether a fixed edge states no sigma; an identity pose is exact by definition."""
        return self.sigma is None and self.pose != _IDENTITY

    @property
    def survey_factor(self) -> Array | None:
        """The factor (6, n) of a fixed edge's covariance; None where its sigma is missing."""
        if self.sigma is not None:
            return np.diag((*self.sigma.position, *self.sigma.rotation))
        return None if self.is_sigma_missing else _EXACT


def list_edges(
    path: Iterable[Crossing],
    frame: Callable[[str], BodyFrame],
    frame_of_interest: str,
    frame_of_reference: str,
) -> list[Edge]:
    """Return the edges of a path from one frame to another: frames of bodies, constraints, and movable joints.

    `frame` returns a frame by its full name. A frame at its body's origin by definition is no edge.
    """
    edges: list[Edge] = []
    inside, name = frame(frame_of_reference), frame_of_reference

    def add_frame_edges(leaving: BodyFrame, leaving_name: str) -> None:
        if leaving is not inside:
            for each, full, forward in ((inside, name, False), (leaving, leaving_name, True)):
                if each.pose != _IDENTITY or each.sigma is not None:
                    edges.append(Edge(EdgeKind.FRAME, full, forward, each.pose, each.sigma))

    for crossing in path:
        add_frame_edges(frame(crossing.near_frame), crossing.near_frame)
        edges += list_crossing_edges(crossing)
        inside, name = frame(crossing.far_frame), crossing.far_frame
    add_frame_edges(frame(frame_of_interest), frame_of_interest)
    return edges


def list_crossing_edges(crossing: Crossing, leader: str = "") -> list[Edge]:
    """Return the edge of a constraint, and that of its movable joint, which follows the joint `leader`, if any."""
    each, forward = crossing.constraint, crossing.forward
    edges = [Edge(EdgeKind.CONSTRAINT, each.name, forward, each.pose, each.sigma)]
    if each.joint.is_movable:
        joint = Edge(EdgeKind.JOINT, each.name, forward, _IDENTITY, joint=each.joint, leader=leader)
        edges.insert(1 if forward else 0, joint)
    return edges


_IDENTITY = Pose.identity()
_EXACT = np.zeros((6, 1))


EXACT_TOLERANCE = 1e-6
"""Meters and radians below which a loop counts as closed."""

FIRST_ORDER = 0.1
"""Radians; up to this angle the second-order terms that the covariance neglects are tolerated."""

MAX_SIGMAS = 30.0
"""Limit of the significance: the probability itself is near the smallest float there."""

_ROUNDING = 1e-12
"""Eigenvalues this much smaller than the largest are rounding."""


class LoopMisclosure(NamedTuple):
    """The misclosure of a loop, with movable joints at their default positions.

    `meters` and `radians` are its size; `sigmas` its significance: inf where it has a component in a direction stated
    as exact, None where `missing_sigmas`, names of frames and constraints, is not empty. `joints` are the movable
    joints.
    """

    meters: float
    radians: float
    sigmas: float | None
    missing_sigmas: tuple[str, ...]
    joints: tuple[str, ...]

    @property
    def is_exact(self) -> bool:
        return self.meters < EXACT_TOLERANCE and self.radians < EXACT_TOLERANCE


def compute_misclosure(path: Sequence[Crossing], frame: Callable[[str], BodyFrame]) -> LoopMisclosure:
    """Return the misclosure of a path that ends in the body that it starts from.

    `frame` returns a frame by its full name.
    """
    start = path[0].near_frame
    links: list[ChainLink] = []
    missing: list[str] = []
    joints: list[str] = []
    for edge in list_edges(path, frame, start, start):
        source = (edge.kind, edge.name)
        if edge.joint is not None:
            joints.append(edge.name)
            links.append(ChainLink(edge.joint.compute_pose(edge.joint.default_position), edge.forward, _EXACT, source))
            continue
        factor = edge.survey_factor
        if factor is None:
            missing.append(edge.name)
        links.append(ChainLink(edge.pose, edge.forward, factor, source))
    places = chain.frame_poses(links)
    around = places[-1]
    meters, radians = around.distance(Pose.identity())
    with np.errstate(over="ignore", invalid="ignore"):
        covariance = chain.covariance(links)
    # the covariance neglects the second order in the rotation, lever arm times square of the angle: tolerate as much
    second = 2.0 * min(radians, FIRST_ORDER) ** 2
    farthest = max(math.hypot(*place.xyz) for place in places)
    tolerance = np.repeat((second * farthest, second), 3)
    residual = np.array((*around.xyz, *so3.logarithm(around.wxyz)))
    sigmas = None if covariance is None else residual_significance(residual, covariance, tolerance)
    return LoopMisclosure(meters, radians, sigmas, tuple(missing), tuple(joints))


def residual_significance(residual: Array, covariance: Array, tolerance: Array | float = 0.0) -> float:
    """Return the significance of a residual (6), in standard deviations of a single normal variable.

    `covariance` (6, 6) may be singular: a direction with a sigma below `EXACT_TOLERANCE` counts as exact. `tolerance`,
    meters and radians, is allowed in exact directions and is added to the variance in the others. inf where the
    residual in an exact direction is larger; at most `MAX_SIGMAS` otherwise.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = covariance / EXACT_TOLERANCE**2
    if not np.isfinite(scaled).all():
        # sigmas whose squares overflow exclude nothing
        return 0.0
    values, vectors = np.linalg.eigh(scaled)
    along = vectors.T @ residual / EXACT_TOLERANCE
    allowed = (vectors.T * np.broadcast_to(np.asarray(tolerance, dtype=float), 6) / EXACT_TOLERANCE) ** 2
    slack = allowed.sum(axis=1)
    exact = values <= max(1.0, _ROUNDING * float(values[-1]))
    if (np.abs(along[exact]) > 1.0 + np.sqrt(slack[exact])).any():
        return math.inf
    uncertain = ~exact
    squares = along[uncertain] ** 2 / (values[uncertain] + slack[uncertain])
    return chi_square_to_sigmas(float(np.sum(squares)), int(np.sum(uncertain)))


def chi_square_to_sigmas(square: float, degrees: int) -> float:
    """Return the standard deviations at which a normal variable is as improbable as a chi-square value.

    For one degree of freedom that is the square root.
    """
    if degrees < 1:
        return 0.0
    if square > 1.5 * MAX_SIGMAS**2:
        # more than MAX_SIGMAS for up to six degrees of freedom; the probability underflows from 1480 on
        return MAX_SIGMAS
    probability = chi_square_survival(square, degrees)
    return min(MAX_SIGMAS, max(0.0, -NormalDist().inv_cdf(probability / 2.0)))

"""Model: bodies and constraints as an immutable graph that answers where a frame is in another."""

from __future__ import annotations

import hashlib
import json
import math
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import astuple
from enum import StrEnum
from functools import partial
from typing import Any, TypeVar

from modelserver import errors
from modelserver.geometry import names
from modelserver.geometry.joint import Coordinates, Joint, Mimic
from modelserver.geometry.kinematic_path import FrameNode, FrameTree, KinematicPath
from modelserver.geometry.names import format_names
from modelserver.geometry.parts import Body, BodyFrame, Constraint, Sigma, resolve_mimics
from modelserver.geometry.topology import Crossing, Edge, Neighbor, Topology, full_name, list_edges
from modelserver.plugins import load_object
from modelserver.transforms import chain
from modelserver.transforms.pose import Pose
from modelserver.transforms.transformation import Transformation

T = TypeVar("T")

CACHE_SIZE = 16384
"""Transformations cached, about 1 kB each; the oldest is dropped when full."""


PATH_CACHE_SIZE = 1024
"""Kinematic paths cached; building one from the frame tree takes some 10 us."""


class Search(StrEnum):
    """How a path is searched: the shortest one, or the report's own search (4.6.2)."""

    BREADTH_FIRST = "breadth_first"
    DEPTH_FIRST = "depth_first"


class Model:
    """The geometry of a vehicle. Build one with `ModelBuilder` or `modelserver.load_model`.

    `bodies`, `constraints`, `problems` are tuples in the order of the file; the first body is the root. `joints` are
    the constraints with movable joints, by name; `drives` gives for each of them the coordinates that determine its
    position. `revision` is a hash of everything that can change an answer or a list. Immutable. Raises ValueError for
    two bodies or two constraints of one name, which `ModelBuilder` reports with their locations.
    """

    def __init__(
        self,
        bodies: tuple[Body, ...],
        constraints: tuple[Constraint, ...],
        name: str = "",
        description: str = "",
        problems: tuple[errors.Problem, ...] = (),
    ):
        self.bodies = bodies
        self.constraints = constraints
        self.name = name
        self.description = description
        self.problems = problems
        self.revision = _revision(bodies, constraints)
        _check_unique("body", [body.name for body in bodies])
        _check_unique("constraint", [each.name for each in constraints])
        self._bodies = {body.name: body for body in bodies}
        self._topology = Topology(bodies, constraints)
        self.assemblies = self._topology.assemblies
        """Groups of bodies joined by constraints; the root's comes first, the others are orphans."""
        # An OrderedDict drops its oldest in constant time; a dict passes over all entries dropped before.
        self._transformations: OrderedDict[tuple[str, str], Transformation] = OrderedDict()
        self._paths: OrderedDict[tuple[str, str], KinematicPath] = OrderedDict()
        self.joints = {each.name: each for each in constraints if each.joint.is_movable}
        self.drives = resolve_mimics(self.joints.values())
        drives = self.drives  # not the model: no value has a reference cycle
        self._tree = FrameTree(self._bodies, self._topology, lambda name: drives[name].leader)
        closures = self._topology.find_loop_closures()
        assembly_of = {body: number for number, bodies in enumerate(self.assemblies) for body in bodies}
        self._assemblies_with_loops = frozenset(assembly_of[closing.bodies[0]] for closing in closures)
        # the loops of all closing constraints contain every constraint that is in any loop
        self._in_loops = frozenset(each.constraint.name for closing in closures for each in closing.path)

    @property
    def root(self) -> Body:
        return self.bodies[0]

    def body(self, name: str) -> Body:
        """Return the body of that name. Raises UnknownBodyError with the nearest names."""
        found = self._bodies.get(name)
        if found is None:
            raise errors.UnknownBodyError(
                f"the model has no body {errors.quote(name)}", errors.find_nearest_names(name, self._bodies)
            )
        return found

    def frame(self, name: str) -> BodyFrame:
        """Return the frame of a full name. Raises UnknownBodyError or UnknownFrameError with the nearest names."""
        body, frame = self._split(name)
        return body.frame(frame.name)

    def constraints_of(self, frame: str | BodyFrame) -> tuple[Constraint, ...]:
        """Return the constraints at a frame, in the order of the file. Raises as `neighbors`."""
        return tuple([each.constraint for each in self.neighbors(frame)])

    def neighbors(self, frame: str | BodyFrame) -> tuple[Neighbor, ...]:
        """Return the frames at the other ends of a frame's constraints, with the crossing to each.

        `frame` is a full name, `Body:Frame`, or a frame of this model. Raises UnknownBodyError or UnknownFrameError
        with the nearest names.
        """
        name = full_name(frame)
        self.frame(name)
        return tuple([Neighbor(self.frame(each.far_frame), each) for each in self._topology.crossings(name)])

    def next(self, frame: str | BodyFrame, constraint: str = "") -> Neighbor:
        """Cross a frame's constraint to the partner frame (the report's nextBodyFrame).

        `constraint` names the one to cross where the frame has several. Raises as `neighbors`, and NotConnectedError
        where the frame has no such constraint, MalformedRequestError where it has several and none is named.
        """
        found = [each for each in self.neighbors(frame) if constraint in ("", each.constraint.name)]
        if len(found) == 1:
            return found[0]
        name, known = full_name(frame), [each.name for each in self.constraints_of(frame)]
        if constraint:
            there = f"it has {format_names(known)}" if known else "it has none"
            near = errors.find_nearest_names(constraint, known)
            raise errors.NotConnectedError(f"frame {name} has no constraint {errors.quote(constraint)}; {there}", near)
        if not found:
            raise errors.NotConnectedError(f"frame {name} has no constraint, so no frame is next to it")
        several = f"{len(found)} constraints, {format_names(known)}"
        raise errors.MalformedRequestError(f"frame {name} has {several}; name the one to cross")

    def spanning_tree(self, body: str) -> tuple[Crossing, ...]:
        """Return the constraints that lead from a body to all that is joined to it, breadth-first.

        Raises UnknownBodyError.
        """
        return tuple(self._topology.traverse_breadth_first(self.body(body).name))

    def dynamics(self, base: str = "floating", root: str = "", **options: Any) -> Any:
        """Return the model's `modelserver.dynamics.Dynamics`: mass matrix, bias vector, forward dynamics (eq. 7-10).

        Arguments as there. Needs the extra `dynamics`; nothing of it is loaded before.
        """
        return load_object("modelserver.dynamics", "Dynamics")(self, base, root, **options)

    def verify(self, frame: str | BodyFrame) -> tuple[errors.Problem, ...]:
        """Return the problems of a frame, none where it is valid (the report's verifyConstraint).

        A frame value that differs from the model's is an error, an orphaned body a warning, several constraints a note:
        a strict model allows one. Raises as `neighbors`.
        """
        known = [each.name for each in self.constraints_of(frame)]
        name = full_name(frame)
        body, root, source = name.partition(":")[0], self.root.name, errors.Location(element=f"frame {name}")
        problems = []
        if not isinstance(frame, str) and self.frame(name) != frame:
            message = "the model's frame of this name differs from this one"
            fix = "take the frame from this model, or build a model with this frame in it"
            problems.append(errors.Problem(errors.Severity.ERROR, message, source, fix))
        if body not in self.assemblies[0]:
            message = f"body {body} is an orphan: no constraints lead to the root body {root}"
            fix = f"add a constraint that joins it to {root} or to what is mounted there"
            problems.append(errors.Problem(errors.Severity.WARNING, message, source, fix))
        if len(known) > 1:
            message = f"the frame has {len(known)} constraints, {format_names(known)}; a strict model allows one"
            fix = "give each constraint a frame of its own, if the file has to load with strict"
            problems.append(errors.Problem(errors.Severity.NOTE, message, source, fix))
        return tuple(problems)

    def is_static(self, frame_of_interest: str, frame_of_reference: str) -> bool:
        """Return whether no joint lies between two frames: the report's pose type, static or dynamic.

        Raises as `get_kinematic_path`.
        """
        return not self.get_kinematic_path(frame_of_interest, frame_of_reference).joints

    def get_body_list(self) -> list[str]:
        """Return the names of the bodies, root first."""
        return [body.name for body in self.bodies]

    def get_body_frame_list(self, body: str) -> list[str]:
        """Return the names of a body's frames. Raises UnknownBodyError."""
        return [frame.name for frame in self.body(body)]

    def get_transformation(self, frame_of_interest: str, frame_of_reference: str) -> Transformation:
        """Return the pose of `frame_of_interest` in `frame_of_reference` by the shortest path (eq. 11-13).

        Movable joints are at their default positions; `modelserver.query` knows the actual ones. Frames are named
        `Body:Frame`, or by a body alone its frame `Origin`. Raises UnknownBodyError, UnknownFrameError or
        NotConnectedError.
        """
        try:
            return self._transformations[frame_of_interest, frame_of_reference]
        except KeyError:
            return self._compute(*_complete(frame_of_interest, frame_of_reference))

    def get_kinematic_path(self, frame_of_interest: str, frame_of_reference: str) -> KinematicPath:
        """Return the shortest kinematic path from the frame of reference to the frame of interest, cached.

        Raises UnknownBodyError, UnknownFrameError or NotConnectedError.
        """
        found = self._paths.get((frame_of_interest, frame_of_reference))
        if found is None:
            frame_of_interest, frame_of_reference = _complete(frame_of_interest, frame_of_reference)
            interest, reference = self._get_end_nodes(frame_of_interest, frame_of_reference)
            if interest.assembly in self._assemblies_with_loops:
                path = self.find_path(frame_of_interest, frame_of_reference)
                in_loop = any(crossing.constraint.name in self._in_loops for crossing in path)
                found = KinematicPath.from_edges(self.get_edges(path, frame_of_interest, frame_of_reference), in_loop)
            else:
                found = self._tree.build_path(interest, reference)
            if len(self._paths) >= PATH_CACHE_SIZE:
                self._paths.popitem(last=False)
            self._paths[frame_of_interest, frame_of_reference] = found
        return found

    def rigid_transformation(self, frame_of_interest: str, frame_of_reference: str) -> Transformation | None:
        """Return `get_transformation`, or None where a joint is between the two or a loop around them.

        Raises UnknownBodyError, UnknownFrameError or NotConnectedError.
        """
        interest, reference = self._get_end_nodes(frame_of_interest, frame_of_reference)
        if interest.group is not reference.group or interest.assembly in self._assemblies_with_loops:
            return None
        known = self._transformations.get((frame_of_interest, frame_of_reference))
        return known or self._compute_rigid(frame_of_interest, frame_of_reference, interest, reference)

    def get_edges(self, path: Iterable[Crossing], frame_of_interest: str, frame_of_reference: str) -> list[Edge]:
        """Return the edges of a path of `find_path`: frames of bodies, constraints, and movable joints.

        A frame at its body's origin by definition is no edge.
        """
        edges = list_edges(path, self.frame, frame_of_interest, frame_of_reference)
        return [
            each._replace(leader=self.drives[each.name].leader)
            if each.joint is not None and each.joint.mimic is not None
            else each
            for each in edges
        ]

    def find_path(
        self, frame_of_interest: str, frame_of_reference: str, search: Search = Search.BREADTH_FIRST
    ) -> tuple[Crossing, ...]:
        """Return the constraints crossed from the frame of reference to the frame of interest.

        Raises UnknownBodyError, UnknownFrameError or NotConnectedError.
        """
        body, frame = self._split(frame_of_reference)
        target, _ = self._split(frame_of_interest)
        if search is Search.BREADTH_FIRST:
            path = self._topology.find_shortest_path(body.name, target.name)
        else:
            path = self._topology.find_path_depth_first(body.name, frame.name, frame_of_interest)
        if path is None:
            raise self._not_connected(target.name, body.name)
        return path

    def compose_path(self, path: Iterable[Crossing], frame_of_interest: str, frame_of_reference: str) -> Transformation:
        """Return the transformation along a path of `find_path`, edge by edge (eq. 12 and 13).

        Joints are at their default positions. The covariance is that of the edges' sigmas, None where one is missing.
        """
        folded = KinematicPath.from_edges(self.get_edges(path, frame_of_interest, frame_of_reference))
        positions = folded.default_positions
        links = folded.build_links(positions, [self._get_joint_sigma(joint.name) for joint in folded.joints])
        return Transformation(
            frame_of_interest,
            frame_of_reference,
            folded.compute_pose(positions),
            chain.covariance(links),
            model_revision=self.revision,
        )

    def _get_joint_sigma(self, name: str) -> Coordinates:
        """Return the stated sigma of a joint's position, nan where there is none; see `KinematicPath.build_links`."""
        drive = self.drives[name]
        leader = self.joints[drive.leader].joint
        return tuple([drive.multiplier * value for value in leader.sigma or (math.nan,) * leader.count])

    def _split(self, name: str) -> tuple[Body, BodyFrame]:
        everything = (names.join(body.name, frame.name) for body in self.bodies for frame in body)
        try:
            body_name, frame_name = names.split(names.complete(name))
        except ValueError as error:
            raise errors.UnknownFrameError(str(error), errors.find_nearest_names(name, everything)) from None
        found = self._bodies.get(body_name)
        if found is None:
            near = [
                names.join(body, frame_name) if self._bodies[body].has_frame(frame_name) else body
                for body in errors.find_nearest_names(body_name, self._bodies)
            ]
            if frame_name == names.ORIGIN:  # perhaps what is given is a frame without its body
                of_bodies = [names.join(body.name, body_name) for body in self.bodies if body.has_frame(body_name)]
                near += of_bodies[: names.MAX_LISTED] or errors.find_nearest_names(body_name, everything)
            raise errors.UnknownBodyError(f"the model has no body {errors.quote(body_name)}", dict.fromkeys(near))
        return found, found.frame(frame_name)

    def _get_end_nodes(self, frame_of_interest: str, frame_of_reference: str) -> tuple[FrameNode, FrameNode]:
        """Return the nodes of two frames of one assembly. Raises as `get_kinematic_path`."""
        nodes = self._tree.nodes
        try:
            reference, interest = nodes[frame_of_reference], nodes[frame_of_interest]
        except KeyError:
            # raises for the unknown one
            self._split(frame_of_reference)
            self._split(frame_of_interest)
            raise
        if interest.assembly != reference.assembly:
            raise self._not_connected(interest.body, reference.body)
        return interest, reference

    def _compute(self, frame_of_interest: str, frame_of_reference: str) -> Transformation:
        interest, reference = self._get_end_nodes(frame_of_interest, frame_of_reference)
        if interest.group is reference.group and interest.assembly not in self._assemblies_with_loops:
            return self._compute_rigid(frame_of_interest, frame_of_reference, interest, reference)
        path = self.get_kinematic_path(frame_of_interest, frame_of_reference)
        positions = path.default_positions

        def compute_covariance() -> tuple[float, ...] | None:
            return path.compute_covariance(positions, [self._get_joint_sigma(joint.name) for joint in path.joints])

        return self._cache(frame_of_interest, frame_of_reference, path.compute_pose(positions), compute_covariance)

    def _compute_rigid(
        self, frame_of_interest: str, frame_of_reference: str, interest: FrameNode, reference: FrameNode
    ) -> Transformation:
        # exact for a frame in itself
        pose = Pose.identity() if interest is reference else reference.X_NG @ interest.X_GN
        covariance = partial(FrameTree.rigid_covariance, interest, reference)
        return self._cache(frame_of_interest, frame_of_reference, pose, covariance)

    def _cache(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        pose: Pose,
        covariance: Callable[[], tuple[float, ...] | None],
    ) -> Transformation:
        answer = Transformation(frame_of_interest, frame_of_reference, pose, covariance, model_revision=self.revision)
        if len(self._transformations) >= CACHE_SIZE:
            self._transformations.popitem(last=False)
        self._transformations[frame_of_interest, frame_of_reference] = answer
        return answer

    def _not_connected(self, body_I: str, body_R: str) -> errors.NotConnectedError:
        def assembly(body: str) -> str:
            mates = next(each for each in self._topology.assemblies if body in each)
            return ", ".join(mates[:6]) + (", ..." if len(mates) > 6 else "")

        return errors.NotConnectedError(
            f"no constraints lead from {body_R} to {body_I}: {body_R} is joined with [{assembly(body_R)}], "
            f"{body_I} with [{assembly(body_I)}]"
        )

    def __setattr__(self, name: str, value: object) -> None:
        if hasattr(self, "_in_loops"):  # the last that __init__ sets
            raise AttributeError("a Model is immutable; build a new one")
        object.__setattr__(self, name, value)

    def __delattr__(self, name: str) -> None:
        raise AttributeError("a Model is immutable; build a new one")

    def __reduce__(self) -> tuple[type[Model], tuple[object, ...]]:
        return (Model, (self.bodies, self.constraints, self.name, self.description, self.problems))

    def __repr__(self) -> str:
        frames = sum(len(body.frames) for body in self.bodies)
        return (
            f"<Model {self.name or 'unnamed'}: {len(self.bodies)} bodies, {frames} frames, "
            f"{len(self.constraints)} constraints, revision {self.revision}>"
        )


def _complete(interest: str, reference: str) -> tuple[str, str]:
    """Return two names of frames in full; most are."""
    if ":" in interest and ":" in reference:
        return interest, reference
    return names.complete(interest), names.complete(reference)


def _check_unique(what: str, given: list[str]) -> None:
    """Raise ValueError for a name that is given twice (report 4.2, 4.4)."""
    if len(set(given)) < len(given):
        twice = next(name for name in given if given.count(name) > 1)
        raise ValueError(f"the {what} name {errors.quote(twice)} is given twice; names are unique in a model")


def _revision(bodies: tuple[Body, ...], constraints: tuple[Constraint, ...]) -> str:
    """Return 16 hex digits of a SHA-256 over all that answers and lists contain; floats enter exactly."""
    content = (
        [
            (
                body.name,
                body.description,
                body.pose,
                body.inertia,
                [(frame.name, frame.pose, frame.description, frame.sigma) for frame in body],
            )
            for body in bodies
        ],
        [(each.name, each.from_, each.to, each.pose, each.joint, each.sigma) for each in constraints],
    )
    text = json.dumps(content, separators=(",", ":"), default=_get_content)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _get_content(value: Pose | Sigma | Joint | Mimic) -> object:
    if isinstance(value, Pose):
        return value.xyz, value.wxyz
    if not isinstance(value, Joint):
        return astuple(value)
    numbers = (value.axis, value.lower, value.upper, value.rate_limit, value.default, value.sigma)
    return (value.type, numbers, value.mimic) if value.is_movable else value.type


# --- what changes from one model to another ---------------------------------------------------------------------------

MIN_METERS = 1e-9
MIN_RADIANS = 1e-9
"""A pose that moved by less is equal within the rounding of a file."""


def describe_changes(old: Model, new: Model) -> tuple[str, ...]:
    """Return what is added, removed or changed, a line each; empty where both models give the same answers."""
    bodies = [{each.name: each for each in model.bodies} for model in (old, new)]
    lines = _list_additions("body", *bodies)
    for name, before, after in _pair(*bodies):
        frames = [{names.join(name, each.name): each for each in body} for body in (before, after)]
        lines += _list_additions("frame", *frames)
        for full, was, now in _pair(*frames):
            lines += _compare_poses(f"frame {full}", was.pose, now.pose)
            if was.sigma != now.sigma:
                lines.append(f"frame {full} states another sigma")
        if before.inertia != after.inertia:
            lines.append(f"body {name} has another inertia")
    constraints = [{each.name: each for each in model.constraints} for model in (old, new)]
    lines += _list_additions("constraint", *constraints)
    for name, first, second in _pair(*constraints):
        if (first.from_, first.to) != (second.from_, second.to):
            lines.append(
                f"constraint {name} joins {second.from_} and {second.to}, it joined {first.from_} and {first.to}"
            )
        lines += _compare_poses(f"constraint {name}", first.pose, second.pose)
        if first.sigma != second.sigma:
            lines.append(f"constraint {name} states another sigma")
        if first.joint != second.joint:
            is_other = first.joint.type != second.joint.type
            how = f"is {second.joint.type}, it was {first.joint.type}" if is_other else "has other numbers"
            lines.append(f"the joint of constraint {name} {how}")
    if old.root.name != new.root.name:
        lines.append(f"the root body is {new.root.name}, it was {old.root.name}")
    if not lines and old.revision != new.revision:
        lines.append("descriptions or the order of what is listed")
    return tuple(lines)


def _list_additions(what: str, was: dict[str, T], now: dict[str, T]) -> list[str]:
    lines = [f"{what} {name} is removed" for name in was if name not in now]
    return lines + [f"{what} {name} is new" for name in now if name not in was]


def _pair(was: dict[str, T], now: dict[str, T]) -> Iterator[tuple[str, T, T]]:
    return ((name, was[name], each) for name, each in now.items() if name in was)


def _compare_poses(what: str, old: Pose, new: Pose) -> list[str]:
    meters, radians = old.distance(new)
    if meters < MIN_METERS and radians < MIN_RADIANS:
        return []
    return [f"{what} moves by {meters * 1e3:.4g} mm and {math.degrees(radians):.4g} deg"]

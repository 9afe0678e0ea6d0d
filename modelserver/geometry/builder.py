"""ModelBuilder: collects bodies and constraints with their source locations, checks every rule, builds the model.

A file reader fills one and adds the problems that it met; a program may do the same by hand:

    builder = ModelBuilder("cart")
    cart = builder.add_body("Cart")
    cart.add_frame("Origin")
    cart.add_frame("Mast", Pose((0.2, 0.0, 1.1)))
    camera = builder.add_body("Camera")
    camera.add_frame("Origin")
    builder.add_constraint("CameraFixed", "Cart:Mast", "Camera:Origin")
    model = builder.build()
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from modelserver.errors import (
    GeometryError,
    Location,
    NotConnectedError,
    Problem,
    Severity,
    Suggestion,
    has_error,
    quote,
    suggest_name,
)
from modelserver.geometry import names, parts
from modelserver.geometry.joint import FIXED, Joint, coordinate_names
from modelserver.geometry.model import Model
from modelserver.geometry.names import MAX_LISTED, format_first_location, format_names
from modelserver.geometry.topology import MAX_SIGMAS, LoopMisclosure, Topology, compute_misclosure, full_name
from modelserver.transforms.pose import Pose

MAX_LOOP_SIGMAS = 3.0
"""A loop misclosure of more standard deviations is a warning: one in 370 correct surveys exceeds it."""

MAX_SUGGESTIONS = 100
"""Constraint ends for which the nearest names are searched, which is slow."""


MAX_POSITION = 1e9
"""Meters or radians; beyond it the rounding of sums exceeds a micrometer."""


MAX_ANGLE = 2.0 * math.tau
"""Radians; an angle beyond two turns is probably one in degrees."""

LocatedConstraint = tuple[parts.Constraint, Location]
"""A constraint and its source location."""

NO_LOCATION: Final = Location()


@dataclass(slots=True)
class BodyBuilder:
    """Collects one body; created by `ModelBuilder.add_body`."""

    name: str
    source: Location = NO_LOCATION
    description: str = ""
    pose: Pose | None = None
    inertia: tuple[tuple[float, ...], ...] | None = None
    frames: list[tuple[parts.BodyFrame, Location]] = field(default_factory=list)
    visuals: tuple[parts.Shape, ...] = ()
    collisions: tuple[parts.Shape, ...] = ()

    def add_frame(
        self,
        name: str,
        pose: Pose | None = None,
        description: str = "",
        sigma: parts.Sigma | None = None,
        source: Location = NO_LOCATION,
    ) -> BodyBuilder:
        self.frames.append((parts.BodyFrame(name, pose or Pose.identity(), description, sigma, self.name), source))
        return self


@dataclass(slots=True, eq=False)
class ModelBuilder:
    """Collects a model; `build` checks it. See the module's example.

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
    constraints: list[tuple[parts.Constraint, Location]] = field(default_factory=list)

    @classmethod
    def from_model(cls, model: Model, strict: bool = False) -> ModelBuilder:
        """Return a builder with the content of a model, to change it: models are immutable."""
        builder = cls(model.name, model.description, strict)
        for body in model.bodies:
            builder.copy_body(body)
        builder.constraints = [(constraint, NO_LOCATION) for constraint in model.constraints]
        return builder

    @property
    def is_empty(self) -> bool:
        return not self.bodies and not self.constraints

    def add_body(
        self,
        name: str,
        description: str = "",
        pose: Pose | None = None,
        inertia: tuple[tuple[float, ...], ...] | None = None,
        source: Location = NO_LOCATION,
    ) -> BodyBuilder:
        """Add a body; return its builder, to add frames. The first body added is the root."""
        body = BodyBuilder(name, source, description, pose, inertia)
        self.bodies.append(body)
        return body

    def copy_body(self, body: parts.Body, source: Location = NO_LOCATION) -> BodyBuilder:
        """Add a copy of a body, e.g. `camera.with_name("RearCamera")`; return its builder."""
        draft = self.add_body(body.name, body.description, body.pose, body.inertia, source)
        draft.frames.extend((frame, source) for frame in body)
        draft.visuals, draft.collisions = body.visuals, body.collisions
        return draft

    def add_constraint(
        self,
        name: str,
        from_: str,
        to: str,
        pose: Pose | None = None,
        description: str = "",
        sigma: parts.Sigma | None = None,
        joint: Joint = FIXED,
        source: Location = NO_LOCATION,
    ) -> ModelBuilder:
        """Join two frames, named `Body:Frame`, rigidly or by a joint; return self.

        `pose` is the pose of `to` in `from_`, for a movable joint with all coordinates 0.
        """
        constraint = parts.Constraint(name, from_, to, pose or Pose.identity(), description, sigma, joint)
        self.constraints.append((constraint, source))
        return self

    def remove_constraints(self, frame: str | parts.BodyFrame, constraint: str = "") -> tuple[str, ...]:
        """Remove the constraints at a frame, or the one of that name; return the names of those removed.

        `build` then applies the rules again: bodies no longer joined to the root are orphans, reported in the model's
        `problems` and removed with `repair`; a joint that follows a removed one is an error. Raises NotConnectedError
        where the frame has no such constraint, UnknownFrameError for a frame value on no body.
        """
        name = full_name(frame)
        removed = tuple(
            each.name for each, _ in self.constraints if name in (each.from_, each.to) and constraint in ("", each.name)
        )
        if not removed:
            raise NotConnectedError(f"frame {name} has no constraint" + (f" {quote(constraint)}" if constraint else ""))
        self.constraints = [item for item in self.constraints if item[0].name not in removed]
        return removed

    def add_problem(
        self,
        severity: Severity,
        message: str,
        source: Location = NO_LOCATION,
        fix: str = "",
        nearest: tuple[str, ...] = (),
    ) -> None:
        """Record a problem that was met while reading."""
        self.problems.append(Problem(severity, message, source, fix, nearest))

    def add_error(
        self, message: str, source: Location = NO_LOCATION, fix: str = "", nearest: tuple[str, ...] = ()
    ) -> None:
        """Record a problem that makes the model unusable."""
        self.add_problem(Severity.ERROR, message, source, fix, nearest)

    def add_warning(
        self, message: str, source: Location = NO_LOCATION, fix: str = "", nearest: tuple[str, ...] = ()
    ) -> None:
        """Record a problem that leaves the model usable."""
        self.add_problem(Severity.WARNING, message, source, fix, nearest)

    def build_bodies(self) -> Model | None:
        """Return a model of the well-formed bodies alone, also where there are errors; None where there is no body.

        It answers whether a frame exists, and nothing else: it has no constraints.
        """
        bodies = _ModelReview(self, repair=True).check_bodies()
        return Model(tuple(bodies.values()), (), self.name, self.description) if bodies else None

    @property
    def constraint_names(self) -> tuple[str, ...]:
        return tuple(constraint.name for constraint, _ in self.constraints)

    def build(self, repair: bool = False) -> Model:
        """Check every rule and return the model; its `problems` hold the warnings and notes.

        Raises GeometryError with every problem where there is an error. With `repair`, badly formed elements and bodies
        not traceable to the root are dropped with a warning each, as the 2005 server did; only an unreadable file, or
        one of which nothing is left, still raises.
        """
        model, problems = self.check(repair)
        if model is None:
            raise GeometryError(problems)
        return model

    def check(self, repair: bool = False) -> tuple[Model | None, tuple[Problem, ...]]:
        """Return the model, or None where there is an error, and every problem in the order of the file."""
        review = _ModelReview(self, repair)
        bodies = review.check_bodies()
        bodies, constraints = review.check_connections(bodies, review.check_joints(review.check_constraints(bodies)))
        problems = tuple(
            problem for _, problem in sorted(enumerate(review.problems), key=lambda item: (item[1].line, item[0]))
        )
        if has_error(problems):
            return None, problems
        return Model(tuple(bodies.values()), constraints, self.name, self.description, problems), problems


class _ModelReview:
    """One pass over a model (report 4.5): finds problems, and returns what is left when the invalid is dropped."""

    def __init__(self, draft: ModelBuilder, repair: bool):
        self.draft = draft
        self.repair = repair
        self.problems = list(draft.problems)
        self.locations: dict[str, Location] = {}
        self.suggestion_count = 0

    def report(self, message: str, source: Location, fix: str, nearest: tuple[str, ...] = ()) -> None:
        """Report something invalid: an error, or with repair the warning that it was removed."""
        severity, removed = (Severity.WARNING, "; removed") if self.repair else (Severity.ERROR, "")
        self.problems.append(Problem(severity, message + removed, source, fix, nearest))

    def add_problem(self, severity: Severity, message: str, source: Location, fix: str = "") -> None:
        self.problems.append(Problem(severity, message, source, fix))

    @property
    def has_errors(self) -> bool:
        return has_error(self.problems)

    def _is_new_name(
        self, label: str, name: str, source: Location, seen: dict[str, Location], example: str, fix: str = ""
    ) -> bool:
        """Return whether a name is valid and not among those `seen`, to which it is added; otherwise report it."""
        if fault := names.find_problem(name):
            self.report(f"{label}: {fault}", source, f"give it a plain name, e.g. {example}")
        elif name in seen:
            twice = f"{label} is defined twice{format_first_location(seen[name])}"
            self.report(twice, source, fix or "rename one of the two")
        else:
            seen[name] = source
            return True
        return False

    def check_bodies(self) -> dict[str, parts.Body]:
        valid: dict[str, parts.Body] = {}
        fix = "rename one; to duplicate a device, give the copy a name of its own"
        for draft in self.draft.bodies:
            label = f"body {quote(draft.name)}"
            if draft.name in names.RESERVED_BODIES:
                self.report(f"{label}: this name is reserved for the server's world frames", draft.source, "rename it")
                continue
            if not self._is_new_name(label, draft.name, draft.source, self.locations, "FrontCamera", fix):
                continue
            frames = self._check_frames(draft)
            if not frames:
                self.report(
                    f"{label} has no frame; a body needs at least one", draft.source, "add a frame, e.g. Origin"
                )
                if self.repair:
                    del self.locations[draft.name]
                    continue
            body = parts.Body(draft.name, frames, draft.description, draft.pose, None, draft.visuals, draft.collisions)
            try:
                body = replace(body, inertia=draft.inertia)
            except ValueError as error:
                self.report(f"{label}: {error}", draft.source, "write 6 rows of 6 numbers, or leave it out")
            if (rigid := body.rigid_inertia) is not None and (fault := rigid.find_error()):
                self.report(
                    f"{label}: {fault}", draft.source, "look for a wrong sign or digit, or leave the inertia out"
                )
                body = replace(body, inertia=None)
            valid[draft.name] = body
        if not valid and not self.has_errors:
            # not after an error: it is the cause
            fix = "a model has two bodies or more, each with a frame"
            self.add_problem(Severity.ERROR, "there is no body", NO_LOCATION, fix)
        elif len(valid) == 1:
            (only,) = valid
            message = f"there is one body, {only}; most models join two or more"
            fix = "add the bodies mounted on it, or leave it if the vehicle is one rigid body"
            self.add_problem(Severity.NOTE, message, self.locations[only], fix)
        return valid

    def _check_frames(self, draft: BodyBuilder) -> tuple[parts.BodyFrame, ...]:
        seen: dict[str, Location] = {}
        return tuple(
            frame
            for frame, source in draft.frames
            if self._is_new_name(
                f"frame {quote(frame.name)} of body {quote(draft.name)}", frame.name, source, seen, "ImagePlane"
            )
        )

    def check_constraints(self, bodies: dict[str, parts.Body]) -> tuple[LocatedConstraint, ...]:
        """Return the well-formed constraints: both ends exist and differ; in strict mode, one for each frame."""
        valid: list[LocatedConstraint] = []
        by_name: dict[str, Location] = {}
        by_frame: dict[str, tuple[str, Location]] = {}
        for constraint, source in self.draft.constraints:
            label = f"constraint {quote(constraint.name)}"
            if not self._is_new_name(label, constraint.name, source, by_name, "DigiclopsFixed"):
                continue
            ends = (("From", constraint.from_), ("To", constraint.to))
            # a list, so that both ends are checked
            exist = [self._check_end(label, *end, bodies, source) for end in ends]
            if not all(exist):
                continue
            if constraint.from_ == constraint.to:
                fix = "a constraint joins two different frames; name the partner in To"
                self.report(f"{label}: From equals To ({constraint.from_})", source, fix)
                continue
            if names.split(constraint.from_)[0] == names.split(constraint.to)[0]:
                self.report(
                    f"{label} joins two frames of one body, {constraint.from_} and {constraint.to}",
                    source,
                    "frames of a body are already fixed to each other; remove it, or move one frame to another body",
                )
                continue
            taken = [(end, *by_frame[end]) for _, end in ends if self.draft.strict and end in by_frame]
            for end, other, place in taken:
                first = f"frame {end} already has constraint {other}{format_first_location(place)}"
                own = f"add a frame of its own to body {names.split(end)[0]} for this constraint, or leave strict out"
                self.report(f"{label}: {first}; a frame has one at most", source, own)
            if not taken:
                by_frame |= {end: (constraint.name, source) for _, end in ends}
                valid.append((constraint, source))
        for name, sense, end, source in self.draft.unresolved_ends:
            self._check_end(f"constraint {quote(name)}", sense, end, bodies, source)
        return tuple(valid)

    def _check_end(self, label: str, sense: str, end: str, bodies: dict[str, parts.Body], source: Location) -> bool:
        listed = format_names([*bodies][: MAX_LISTED + 1])
        fix = f"write it as Body:Frame; bodies are: {listed}" if bodies else "write it as Body:Frame"
        try:
            body, frame = names.split(end)
        except ValueError:
            problem = f"{quote(end)} is not of the form Body:Frame"
        else:
            if body not in bodies:
                problem = f"names body {quote(body)}, which does not exist"
            elif not bodies[body].has_frame(frame):
                problem = f"names frame {quote(frame)}, which body {body} does not have"
                known = [each.name for each in bodies[body].frames[: MAX_LISTED + 1]]
                fix = (
                    f"body {body} has: {format_names(known)}" if known else f"add {frame} to the frames of body {body}"
                )
            else:
                return True
        near = self._suggest_end(end, bodies)
        self.report(f"{label}: {sense} {problem}", source, f"write {near[0]}" if near else fix, near)
        return False

    def check_joints(self, placed: Sequence[LocatedConstraint]) -> tuple[LocatedConstraint, ...]:
        """Return the constraints whose joints are valid, with the defaults of mimic joints applied."""
        placed = self._drop_invalid_mimics(self._drop_duplicate_coordinates(placed))
        # a joint that follows one out of range cannot stay
        return self._apply_defaults(self._drop_invalid_mimics(self._drop_out_of_range(placed)))

    def _drop_duplicate_coordinates(self, placed: Sequence[LocatedConstraint]) -> list[LocatedConstraint]:
        valid: list[LocatedConstraint] = []
        taken: dict[str, LocatedConstraint] = {}
        for constraint, source in placed:
            mine = coordinate_names(constraint.name, constraint.joint)
            clash = next((name for name in mine if name in taken), None)
            if clash is not None:
                other, place = taken[clash]
                self.report(
                    f"constraint {quote(constraint.name)}: a coordinate of its joint is called {quote(clash)}, as is "
                    f"one of constraint {other.name}{format_first_location(place)}",
                    source,
                    "rename one of the two constraints",
                )
                continue
            taken.update((name, (constraint, source)) for name in mine)
            valid.append((constraint, source))
        return valid

    def _drop_invalid_mimics(self, placed: Sequence[LocatedConstraint]) -> list[LocatedConstraint]:
        """Return the constraints without the joints whose mimic chains end at none that can be followed.

        Of a chain only its last joint is reported, and a cycle once; what follows them is reported with `repair`.
        """
        joints = {constraint.name: constraint for constraint, _ in placed if constraint.joint.is_movable}
        sources = {constraint.name: source for constraint, source in placed}
        is_valid: dict[str, bool] = {}
        for constraint, source in placed:
            chain: dict[str, parts.Constraint] = {}
            each: parts.Constraint | None = constraint
            while each is not None and each.joint.mimic is not None and each.name not in chain | is_valid:
                chain[each.name] = each
                each = joints.get(each.joint.mimic.joint)
            if not chain:
                continue
            if each is not None and is_valid.get(each.name, each.name not in chain and each.joint.count == 1):
                is_valid |= dict.fromkeys(chain, True)
                continue
            followers = list(chain.values())
            if each is constraint:
                self._report_cycle(list(chain), source)
                followers = []
            elif each is not None and each.name in chain:
                # the cycle is reported where this loop comes to the first of it
                followers = followers[: list(chain).index(each.name)]
                chain = {follower.name: follower for follower in followers}
            elif (each is None or each.name not in is_valid) and self._report_leader(followers[-1], joints, sources):
                followers.pop()
            for follower in followers:
                self._report_follower(follower, sources[follower.name])
            is_valid |= dict.fromkeys(chain, False)
        return [item for item in placed if is_valid.get(item[0].name, True)]

    def _report_cycle(self, chain: list[str], source: Location) -> None:
        label = f"constraint {quote(chain[0])}"
        if len(chain) == 1:
            self.report(f"{label}: its joint follows itself", source, "name another joint, or remove mimic")
            return
        cycle = " follows ".join([*chain, chain[0]][:MAX_LISTED])
        more = " follows ..." if len(chain) >= MAX_LISTED else ""
        message = f"{label}: joints follow each other in a cycle: {cycle}{more}"
        self.report(message, source, "remove the mimic of one of them")

    def _report_leader(
        self, constraint: parts.Constraint, joints: Mapping[str, parts.Constraint], sources: Mapping[str, Location]
    ) -> bool:
        """Report that a joint follows one that cannot be followed; return whether the fault is its own."""
        assert constraint.joint.mimic is not None
        name, near = constraint.joint.mimic.joint, Suggestion()
        if (leader := joints.get(name)) is not None:
            what = f"{name}, a {leader.joint.type} one with {leader.joint.count} coordinates"
            fix = "follow a joint with one coordinate, revolute or prismatic"
        elif name in sources and name not in self.draft.unreadable_joints:
            what, fix = f"{name}, which does not move", "follow a joint that moves, or remove mimic"
        elif name in self.draft.constraint_names:
            return False
        else:
            near = suggest_name(name, joints)
            what = f"{quote(name)}, and there is no constraint of that name"
            fix = f"write {near[0]}" if near else f"joints here are: {format_names(list(joints))}"
        message = f"constraint {quote(constraint.name)}: its joint follows {what}"
        self.report(message, sources[constraint.name], fix, near)
        return True

    def _report_follower(self, constraint: parts.Constraint, source: Location) -> None:
        """Report a follower of a dropped joint; without `repair` nothing is dropped, and the first report is enough."""
        if self.repair and constraint.joint.mimic is not None:
            message = f"constraint {quote(constraint.name)}: its joint follows {constraint.joint.mimic.joint}"
            self.report(f"{message}, which was removed", source, "fix that one")

    def _warn(self, constraint: parts.Constraint, message: str, source: Location, fix: str) -> None:
        self.add_problem(Severity.WARNING, f"constraint {quote(constraint.name)}: {message}", source, fix)

    def _apply_defaults(self, placed: Sequence[LocatedConstraint]) -> tuple[LocatedConstraint, ...]:
        self._check_degrees(placed)
        applied = parts.apply_mimic_defaults(constraint for constraint, _ in placed)
        for (stated, source), each in zip(placed, applied, strict=True):
            joint, mimic = each.joint, each.joint.mimic
            if mimic is None:
                continue
            unused = f"is not used, because it follows {mimic.joint}"
            if stated.joint.default not in ((), joint.default):
                fix = f"remove it, or state the default of {mimic.joint}"
                self._warn(each, f"the default of its joint {unused}", source, fix)
            if stated.joint.sigma:
                fix = f"remove it, or state the sigma of {mimic.joint}: their errors are common"
                self._warn(each, f"the sigma of its joint {unused}", source, fix)
            if joint.is_out_of_limits(joint.default):
                (value,) = joint.default
                at = f"{math.degrees(value):.4g} deg" if joint.angle_flags[0] else f"{value:.4g} m"
                fix = "fix the multiplier or offset of mimic, the limits, or the default of the joint it follows"
                self._warn(
                    each, f"at the default of {mimic.joint}, its joint is at {at}, out of its limits", source, fix
                )
        return tuple((each, source) for (_, source), each in zip(placed, applied, strict=True))

    def _check_degrees(self, placed: Sequence[LocatedConstraint]) -> None:
        """Warn of angles so large that they look like degrees written as radians."""
        for constraint, source in placed:
            joint = constraint.joint
            for key in ("lower", "upper", "default"):
                turns = [
                    value
                    for value, angle in zip(getattr(joint, key), joint.angle_flags, strict=False)
                    if angle and MAX_ANGLE < abs(value) < math.inf
                ]
                if turns:
                    what = "default" if key == "default" else f"{key} limit"
                    size = f"{turns[0]:.6g} rad, {abs(turns[0]) / math.tau:.3g} turns"
                    fix = "where that is degrees, name them so (limits_deg, default_deg); a winch may turn that far"
                    self._warn(constraint, f"the {what} of its joint is {size}", source, fix)
                    break

    def _drop_out_of_range(self, placed: Sequence[LocatedConstraint]) -> list[LocatedConstraint]:
        """Return those whose default positions are in range; report the others."""
        joints = {constraint.name: constraint for constraint, _ in placed if constraint.joint.is_movable}
        drives = parts.resolve_mimics(joints.values())
        valid = []
        for constraint, source in placed:
            if constraint.joint.mimic is not None:
                drive = drives[constraint.name]
                (leader_default,) = joints[drive.leader].joint.default_position
                if not abs(drive.multiplier * leader_default + drive.offset) <= MAX_POSITION:
                    self.report(
                        f"constraint {quote(constraint.name)}: following {constraint.joint.mimic.joint} puts its "
                        f"joint beyond {MAX_POSITION:g}",
                        source,
                        "fix the multipliers and offsets of the mimic chain",
                    )
                    continue
            valid.append((constraint, source))
        return valid

    def _suggest_end(self, end: str, bodies: dict[str, parts.Body]) -> Suggestion:
        """Return a suggestion for an end of a constraint that does not exist.

        None where several constraints name the missing body and none the suggested one: then the latter is misspelled.
        """
        self.suggestion_count += 1
        if self.suggestion_count > MAX_SUGGESTIONS or not (near := parts.suggest_frame(end, bodies)):
            return Suggestion()
        wrong, _, _ = end.partition(":")
        right, _, _ = near.partition(":")
        named = [each.partition(":")[0] for other, _ in self.draft.constraints for each in (other.from_, other.to)]
        if wrong != right and named.count(wrong) > 1 and right not in named:
            return Suggestion()
        return Suggestion.of(end, near)

    def check_connections(
        self, bodies: dict[str, parts.Body], placed: tuple[LocatedConstraint, ...]
    ) -> tuple[dict[str, parts.Body], tuple[parts.Constraint, ...]]:
        """Report orphans and loops; return what is left: with repair, only what is traceable to the root."""
        constraints = tuple(constraint for constraint, _ in placed)
        if self.has_errors or not bodies:
            # orphans are a consequence of invalid constraints
            return bodies, constraints
        topology = Topology(tuple(bodies.values()), constraints)
        sources = {constraint.name: source for constraint, source in placed}
        root, *orphaned = topology.assemblies
        for assembly in orphaned:
            for body in assembly:
                end = "removed" if self.repair else "it answers only inside its own assembly"
                message = f"body {body} is an orphan: no constraints lead to the root body {root[0]}; {end}"
                fix = f"add a constraint that joins it to {root[0]} or to what is mounted there"
                self.add_problem(Severity.WARNING, message, self.locations[body], fix)
        closures = tuple(topology.find_loop_closures())
        full_frames = {each.full_name: each for body in bodies.values() for each in body} if closures else {}
        for closing in closures:
            found = compute_misclosure(closing.path, lambda full: full_frames[full])
            bad = not found.is_exact and (found.sigmas is None or found.sigmas > MAX_LOOP_SIGMAS)
            self.add_problem(
                Severity.WARNING if bad else Severity.NOTE,
                f"constraint {closing.constraint} closes a loop through {format_names(closing.bodies)}; "
                f"{_describe_misclosure(found)}; answers take the shortest path",
                sources[closing.constraint],
                _suggest_fix(found) if bad else "",
            )
        # what closes a loop begins anywhere
        for crossing in () if closures else topology.traverse_breadth_first(root[0]):
            each, far, near = crossing.constraint, crossing.far_body, crossing.near_body
            if crossing.forward or each.pose.is_close(Pose.identity()):
                continue
            # on a new part, the offset would be measured from there
            self.add_problem(
                Severity.WARNING,
                f"constraint {each.name} goes from {far} to {near}, which is nearer to {root[0]}: its pose is measured "
                f"from {far}",
                sources[each.name],
                "exchange From and To if it was measured from the vehicle",
            )
        if self.repair:
            valid = set(root)
            bodies = {name: body for name, body in bodies.items() if name in valid}
            constraints = tuple(each for each in constraints if names.split(each.from_)[0] in valid)
        return bodies, constraints


def _describe_misclosure(found: LoopMisclosure) -> str:
    if found.is_exact:
        return "it closes exactly" + (", with joints at their defaults" if found.joints else "")
    joints = ", with joints at their defaults," if found.joints else ""
    text = f"its misclosure{joints} is {found.meters * 1e3:.3g} mm and {math.degrees(found.radians):.3g} deg"
    if found.sigmas is None:
        return f"{text}, and no sigma is stated for {format_names(found.missing_sigmas)}"
    if math.isinf(found.sigmas):
        return f"{text}, in a direction that the surveys state as exact"
    more = "more than " if found.sigmas >= MAX_SIGMAS else ""
    return f"{text}, {more}{found.sigmas:.1f} sigma of the surveys"


def _suggest_fix(found: LoopMisclosure) -> str:
    if found.sigmas is None:
        missing = format_names(found.missing_sigmas)
        return f"state sigma: of {missing}, remove one constraint of the loop, or fix the survey"
    rest = " or the default of a joint" if found.joints else ""
    return f"remove one constraint of the loop, or fix the survey of its frames{rest}"

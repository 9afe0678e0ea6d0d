"""The rules of a model (report 4.5): checks what a builder collected, and drops what is invalid."""

from __future__ import annotations

import math

from modelserver.errors import Location, Problem, Severity, Suggestion, quote
from modelserver.geometry import loop_closure as loops
from modelserver.geometry import names
from modelserver.geometry.draft import NO_LOCATION, BodyBuilder, ModelDraft
from modelserver.geometry.joint_rules import JointRules, LocatedConstraint
from modelserver.geometry.loop_closure import MAX_SIGMAS, LoopMisclosure
from modelserver.geometry.names import MAX_LISTED, format_first_location, format_names
from modelserver.geometry.parts import Body, BodyFrame, Constraint, suggest_frame
from modelserver.geometry.topology import Topology

MAX_LOOP_SIGMAS = 3.0
"""A loop misclosure of more standard deviations is a warning: one in 370 correct surveys exceeds it."""

MAX_SUGGESTIONS = 100
"""Constraint ends for which the nearest names are searched, which is slow."""


class ModelReview:
    """One pass over a draft: finds problems, and returns what is left when the invalid is dropped."""

    def __init__(self, draft: ModelDraft, repair: bool):
        self.draft = draft
        self.repair = repair
        self.problems = list(draft.problems)
        self.locations: dict[str, Location] = {}
        self.suggestion_count = 0

    def report(self, message: str, source: Location, fix: str, nearest: tuple[str, ...] = ()) -> None:
        """Report something invalid: an error, or with repair the warning that it was removed."""
        if self.repair:
            self.problems.append(Problem(Severity.WARNING, f"{message}; removed", source, fix, nearest))
        else:
            self.problems.append(Problem(Severity.ERROR, message, source, fix, nearest))

    def add_problem(self, severity: Severity, message: str, source: Location, fix: str = "") -> None:
        """Report a problem that leaves the model usable."""
        self.problems.append(Problem(severity, message, source, fix))

    def check_bodies(self) -> dict[str, Body]:
        """Return the bodies by name, each with its well-formed frames."""
        valid: dict[str, Body] = {}
        for draft in self.draft.bodies:
            label = f"body {quote(draft.name)}"
            if fault := names.find_problem(draft.name):
                self.report(f"{label}: {fault}", draft.source, "give it a plain name, e.g. FrontCamera")
                continue
            if draft.name in names.RESERVED_BODIES:
                self.report(f"{label}: this name is reserved for the server's world frames", draft.source, "rename it")
                continue
            if draft.name in valid:
                first = self.locations[draft.name]
                self.report(
                    f"{label} is defined twice{format_first_location(first)}",
                    draft.source,
                    "rename one; to duplicate a device, give the copy a name of its own",
                )
                continue
            self.locations[draft.name] = draft.source
            frames = self._check_frames(draft)
            if not frames:
                self.report(
                    f"{label} has no frame; a body needs at least one",
                    draft.source,
                    "add a frame, e.g. Origin",
                )
                if self.repair:
                    continue
            shapes = (draft.visuals, draft.collisions)
            try:
                valid[draft.name] = Body(draft.name, frames, draft.description, draft.pose, draft.inertia, *shapes)
            except ValueError as error:
                self.report(f"{label}: {error}", draft.source, "write 6 rows of 6 numbers, or leave it out")
                valid[draft.name] = Body(draft.name, frames, draft.description, draft.pose, None, *shapes)
        if not valid and not any(problem.severity is Severity.ERROR for problem in self.problems):
            # not after an error: it is the cause
            self.add_problem(
                Severity.ERROR,
                "there is no body",
                NO_LOCATION,
                "a model has two bodies or more, each with a frame",
            )
        elif len(valid) == 1:
            (only,) = valid
            self.add_problem(
                Severity.NOTE,
                f"there is one body, {only}; most models join two or more",
                self.locations[only],
                "add the bodies mounted on it, or leave it if the vehicle is one rigid body",
            )
        return valid

    def _check_frames(self, draft: BodyBuilder) -> tuple[BodyFrame, ...]:
        valid: dict[str, tuple[BodyFrame, Location]] = {}
        for frame, source in draft.frames:
            label = f"frame {quote(frame.name)} of body {quote(draft.name)}"
            if fault := names.find_problem(frame.name):
                self.report(f"{label}: {fault}", source, "give it a plain name, e.g. ImagePlane")
            elif frame.name in valid:
                self.report(
                    f"{label} is defined twice{format_first_location(valid[frame.name][1])}",
                    source,
                    "rename one of the two",
                )
            else:
                valid[frame.name] = (frame, source)
        return tuple(frame for frame, _ in valid.values())

    def check_constraints(self, bodies: dict[str, Body]) -> tuple[LocatedConstraint, ...]:
        """Return the well-formed constraints: both ends exist and differ; in strict mode, one for each frame."""
        valid: list[LocatedConstraint] = []
        by_name: dict[str, Location] = {}
        by_frame: dict[str, tuple[str, Location]] = {}
        for constraint, source in self.draft.constraints:
            label = f"constraint {quote(constraint.name)}"
            if fault := names.find_problem(constraint.name):
                self.report(f"{label}: {fault}", source, "give it a plain name, e.g. DigiclopsFixed")
                continue
            if constraint.name in by_name:
                self.report(
                    f"{label} is defined twice{format_first_location(by_name[constraint.name])}",
                    source,
                    "rename one of the two",
                )
                continue
            by_name[constraint.name] = source
            ends = (("From", constraint.from_), ("To", constraint.to))
            # a list, so that both ends are checked
            exist = [self._check_end(label, sense, end, bodies, source) for sense, end in ends]
            if not all(exist):
                continue
            if constraint.from_ == constraint.to:
                self.report(
                    f"{label}: From equals To ({constraint.from_})",
                    source,
                    "a constraint joins two different frames; name the partner in To",
                )
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
                self.report(
                    f"{label}: frame {end} already has constraint {other}{format_first_location(place)}; "
                    "a frame has one at most",
                    source,
                    f"add a frame of its own to body {names.split(end)[0]} for this constraint, or leave strict out",
                )
            if taken:
                continue
            for _, end in ends:
                by_frame[end] = (constraint.name, source)
            valid.append((constraint, source))
        for name, sense, end, source in self.draft.unresolved_ends:
            self._check_end(f"constraint {quote(name)}", sense, end, bodies, source)
        return tuple(valid)

    def _check_end(self, label: str, sense: str, end: str, bodies: dict[str, Body], source: Location) -> bool:
        try:
            body, frame = names.split(end)
        except ValueError:
            near = self._suggest_end(end, bodies)
            self.report(f"{label}: {sense} {quote(end)} is not of the form Body:Frame", source, _suggest(near), near)
            return False
        if body not in bodies:
            near = self._suggest_end(end, bodies)
            self.report(
                f"{label}: {sense} names body {quote(body)}, which does not exist", source, _suggest(near), near
            )
            return False
        if not bodies[body].has_frame(frame):
            known = [each.name for each in bodies[body].frames[: MAX_LISTED + 1]]
            near = self._suggest_end(end, bodies)
            self.report(
                f"{label}: {sense} names frame {quote(frame)}, which body {body} does not have",
                source,
                _suggest(near) if near else f"body {body} has: {format_names(known)}",
                near,
            )
            return False
        return True

    def check_joints(self, placed: tuple[LocatedConstraint, ...]) -> tuple[LocatedConstraint, ...]:
        """Return the constraints whose joints are valid, with the defaults of mimic joints applied."""
        known = [constraint.name for constraint, _ in self.draft.constraints]
        rules = JointRules(placed, known, self.draft.unreadable_joints, self.repair)
        for fault in rules.problems:
            self.report(fault.message, fault.source, fault.fix, fault.nearest)
        for warning in rules.warnings:
            self.add_problem(Severity.WARNING, warning.message, warning.source, warning.fix)
        return rules.constraints

    def _suggest_end(self, end: str, bodies: dict[str, Body]) -> Suggestion:
        """Return a suggestion for an end of a constraint that does not exist.

        None where several constraints name the missing body and none the suggested one: then the latter is misspelled.
        """
        self.suggestion_count += 1
        if self.suggestion_count > MAX_SUGGESTIONS or not (near := suggest_frame(end, bodies)):
            return Suggestion()
        wrong, _, _ = end.partition(":")
        right, _, _ = near.partition(":")
        named = [each.partition(":")[0] for other, _ in self.draft.constraints for each in (other.from_, other.to)]
        if wrong != right and named.count(wrong) > 1 and right not in named:
            return Suggestion()
        return Suggestion.of(end, near)

    def check_connections(
        self, bodies: dict[str, Body], placed: tuple[LocatedConstraint, ...]
    ) -> tuple[dict[str, Body], tuple[Constraint, ...]]:
        """Report orphans and loops; return what is left: with repair, only what is traceable to the root."""
        constraints = tuple(constraint for constraint, _ in placed)
        if any(problem.severity is Severity.ERROR for problem in self.problems) or not bodies:
            # orphans are a consequence of invalid constraints
            return bodies, constraints
        topology = Topology(tuple(bodies.values()), constraints)
        sources = {constraint.name: source for constraint, source in placed}
        root, *orphaned = topology.assemblies
        for assembly in orphaned:
            for body in assembly:
                self.add_problem(
                    Severity.WARNING,
                    f"body {body} is an orphan: no constraints lead to the root body {root[0]}"
                    + ("; removed" if self.repair else "; it answers only inside its own assembly"),
                    self.locations[body],
                    f"add a constraint that joins it to {root[0]} or to what is mounted there",
                )
        for closing in topology.find_loop_closures():
            found = loops.compute_misclosure(closing.path, lambda name: _frame_of(bodies, name))
            bad = not found.is_exact and (found.sigmas is None or found.sigmas > MAX_LOOP_SIGMAS)
            self.add_problem(
                Severity.WARNING if bad else Severity.NOTE,
                f"constraint {closing.constraint} closes a loop through {format_names(closing.bodies)}; "
                f"{_describe_misclosure(found)}; answers take the shortest path",
                sources[closing.constraint],
                _suggest_fix(found) if bad else "",
            )
        if self.repair:
            valid = set(root)
            bodies = {name: body for name, body in bodies.items() if name in valid}
            constraints = tuple(each for each in constraints if names.split(each.from_)[0] in valid)
        return bodies, constraints


def _frame_of(bodies: dict[str, Body], name: str) -> BodyFrame:
    body, frame = names.split(name)
    return bodies[body].frame(frame)


def _describe_misclosure(found: LoopMisclosure) -> str:
    """Return the misclosure of a loop as text."""
    if found.is_exact:
        return "it closes exactly" + (", with joints at their defaults" if found.joints else "")
    text = (
        f"its misclosure{', with joints at their defaults,' if found.joints else ''} is "
        f"{found.meters * 1e3:.3g} mm and "
        f"{math.degrees(found.radians):.3g} deg"
    )
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


def _suggest(near: tuple[str, ...]) -> str:
    return f"write {near[0]}" if near else "write it as Body:Frame, with the names in the file"

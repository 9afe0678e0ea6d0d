"""The rules of a model (report 4.5): one pass over what a builder holds, and what is left without the faulty."""

from __future__ import annotations

import math

from modelserver.errors import Location, Problem, Severity, Suggested, shown
from modelserver.geometry import loops, names
from modelserver.geometry.draft import NOWHERE, BodyBuilder, Draft
from modelserver.geometry.joint_rules import JointRules, Placed
from modelserver.geometry.loops import MOST_SIGMAS, Closure
from modelserver.geometry.parts import Body, BodyFrame, Constraint, meant_frame
from modelserver.geometry.topology import Topology
from modelserver.geometry.wording import LISTED, few, first_at

UNLIKELY = 3.0
"""A loop that misses by more standard deviations than this is warned of: one in 370 honest ones does."""

SUGGESTED = 100
"""Constraint ends for which nearest names are looked up; a file with more wrong has another illness."""


class Review:
    """One pass over a draft: finds problems, and what is left when the faulty is dropped."""

    def __init__(self, draft: Draft, repair: bool):
        self.draft = draft
        self.repair = repair
        self.problems = list(draft.problems)
        self.places: dict[str, Location] = {}
        self.suggested = 0

    def fault(self, message: str, source: Location, fix: str, nearest: tuple[str, ...] = ()) -> None:
        """Report something badly formed: an error, or with repair the warning that it was removed."""
        if self.repair:
            self.problems.append(Problem(Severity.WARNING, f"{message}; removed", source, fix, nearest))
        else:
            self.problems.append(Problem(Severity.ERROR, message, source, fix, nearest))

    def note(self, severity: Severity, message: str, source: Location, fix: str = "") -> None:
        """Report something that the model can live with."""
        self.problems.append(Problem(severity, message, source, fix))

    def bodies(self) -> dict[str, Body]:
        """Return the bodies by name, each with its well-formed frames."""
        kept: dict[str, Body] = {}
        for draft in self.draft.bodies:
            label = f"body {shown(draft.name)}"
            if fault := names.fault(draft.name):
                self.fault(f"{label}: {fault}", draft.source, "give it a plain name, e.g. FrontCamera")
                continue
            if draft.name in names.RESERVED_BODIES:
                self.fault(f"{label}: the service keeps this name for its world frames", draft.source, "rename it")
                continue
            if draft.name in kept:
                first = self.places[draft.name]
                self.fault(
                    f"{label} is defined twice{first_at(first)}",
                    draft.source,
                    "rename one; to duplicate a device, give the copy a name of its own",
                )
                continue
            self.places[draft.name] = draft.source
            frames = self._frames(draft)
            if not frames:
                self.fault(
                    f"{label} has no frame; a body needs at least one",
                    draft.source,
                    "add a frame, e.g. Origin",
                )
                if self.repair:
                    continue
            shapes = (draft.visuals, draft.collisions)
            try:
                kept[draft.name] = Body(draft.name, frames, draft.description, draft.pose, draft.inertia, *shapes)
            except ValueError as error:
                self.fault(f"{label}: {error}", draft.source, "write 6 rows of 6 numbers, or leave it out")
                kept[draft.name] = Body(draft.name, frames, draft.description, draft.pose, None, *shapes)
        if not kept and not any(problem.severity is Severity.ERROR for problem in self.problems):
            # where a file could not be read, that is the one thing worth saying
            self.note(
                Severity.ERROR,
                "there is no body",
                NOWHERE,
                "a model has two bodies or more, each with a frame",
            )
        elif len(kept) == 1:
            (only,) = kept
            self.note(
                Severity.NOTE,
                f"there is one body, {only}; most models join two or more",
                self.places[only],
                "add the bodies mounted on it, or leave it if the vehicle is one rigid body",
            )
        return kept

    def _frames(self, draft: BodyBuilder) -> tuple[BodyFrame, ...]:
        kept: dict[str, tuple[BodyFrame, Location]] = {}
        for frame, source in draft.frames:
            label = f"frame {shown(frame.name)} of body {shown(draft.name)}"
            if fault := names.fault(frame.name):
                self.fault(f"{label}: {fault}", source, "give it a plain name, e.g. ImagePlane")
            elif frame.name in kept:
                self.fault(
                    f"{label} is defined twice{first_at(kept[frame.name][1])}",
                    source,
                    "rename one of the two",
                )
            else:
                kept[frame.name] = (frame, source)
        return tuple(frame for frame, _ in kept.values())

    def constraints(self, bodies: dict[str, Body]) -> tuple[Placed, ...]:
        """Return the well-formed constraints: both ends exist and differ; where it is strict, one for each frame."""
        kept: list[Placed] = []
        by_name: dict[str, Location] = {}
        by_frame: dict[str, tuple[str, Location]] = {}
        for constraint, source in self.draft.constraints:
            label = f"constraint {shown(constraint.name)}"
            if fault := names.fault(constraint.name):
                self.fault(f"{label}: {fault}", source, "give it a plain name, e.g. DigiclopsFixed")
                continue
            if constraint.name in by_name:
                self.fault(
                    f"{label} is defined twice{first_at(by_name[constraint.name])}",
                    source,
                    "rename one of the two",
                )
                continue
            by_name[constraint.name] = source
            ends = (("From", constraint.from_), ("To", constraint.to))
            # a list, so that both ends are looked at
            exist = [self._end_exists(label, sense, end, bodies, source) for sense, end in ends]
            if not all(exist):
                continue
            if constraint.from_ == constraint.to:
                self.fault(
                    f"{label}: From equals To ({constraint.from_})",
                    source,
                    "a constraint joins two different frames; name the partner in To",
                )
                continue
            if names.split(constraint.from_)[0] == names.split(constraint.to)[0]:
                self.fault(
                    f"{label} joins two frames of one body, {constraint.from_} and {constraint.to}",
                    source,
                    "frames of a body are already fixed to each other; remove it, or move one frame to another body",
                )
                continue
            taken = [(end, *by_frame[end]) for _, end in ends if self.draft.strict and end in by_frame]
            for end, other, place in taken:
                self.fault(
                    f"{label}: frame {end} already has constraint {other}{first_at(place)}; a frame has one at most",
                    source,
                    f"add a frame of its own to body {names.split(end)[0]} for this constraint, or leave strict out",
                )
            if taken:
                continue
            for _, end in ends:
                by_frame[end] = (constraint.name, source)
            kept.append((constraint, source))
        for name, sense, end, source in self.draft.loose_ends:
            self._end_exists(f"constraint {shown(name)}", sense, end, bodies, source)
        return tuple(kept)

    def _end_exists(self, label: str, sense: str, end: str, bodies: dict[str, Body], source: Location) -> bool:
        try:
            body, frame = names.split(end)
        except ValueError:
            near = self._nearest(end, bodies)
            self.fault(f"{label}: {sense} {shown(end)} is not of the form Body:Frame", source, _use(near), near)
            return False
        if body not in bodies:
            near = self._nearest(end, bodies)
            self.fault(f"{label}: {sense} names body {shown(body)}, which does not exist", source, _use(near), near)
            return False
        if not bodies[body].has_frame(frame):
            known = [each.name for each in bodies[body].frames[: LISTED + 1]]
            near = self._nearest(end, bodies)
            self.fault(
                f"{label}: {sense} names frame {shown(frame)}, which body {body} does not have",
                source,
                _use(near) if near else f"body {body} has: {few(known)}",
                near,
            )
            return False
        return True

    def joints(self, placed: tuple[Placed, ...]) -> tuple[Placed, ...]:
        """Return the constraints whose joints can be told apart and placed; those that follow are settled at rest."""
        known = [constraint.name for constraint, _ in self.draft.constraints]
        rules = JointRules(placed, known, self.draft.unclear_joints, self.repair)
        for fault in rules.faults:
            self.fault(fault.message, fault.source, fault.fix, fault.nearest)
        for warning in rules.warnings:
            self.note(Severity.WARNING, warning.message, warning.source, warning.fix)
        return rules.kept

    def _nearest(self, end: str, bodies: dict[str, Body]) -> Suggested:
        """Return the end of a constraint that is meant by one that does not exist.

        Where several constraints name what does not exist and none names what is near, the latter is misspelled: no
        proposal.
        """
        self.suggested += 1
        if self.suggested > SUGGESTED or not (near := meant_frame(end, bodies)):
            return Suggested()
        wrong, _, _ = end.partition(":")
        right, _, _ = near.partition(":")
        named = [each.partition(":")[0] for other, _ in self.draft.constraints for each in (other.from_, other.to)]
        if wrong != right and named.count(wrong) > 1 and right not in named:
            return Suggested()
        return Suggested.of(end, near)

    def connections(
        self, bodies: dict[str, Body], placed: tuple[Placed, ...]
    ) -> tuple[dict[str, Body], tuple[Constraint, ...]]:
        """Report orphans and loops; return what is left: with repair, only what is traceable to the root."""
        constraints = tuple(constraint for constraint, _ in placed)
        if any(problem.severity is Severity.ERROR for problem in self.problems) or not bodies:
            # what a broken constraint leaves unconnected is not worth a second complaint
            return bodies, constraints
        topology = Topology(tuple(bodies.values()), constraints)
        sources = {constraint.name: source for constraint, source in placed}
        root, *orphaned = topology.assemblies
        for assembly in orphaned:
            for body in assembly:
                self.note(
                    Severity.WARNING,
                    f"body {body} is an orphan: no constraints lead to the root body {root[0]}"
                    + ("; removed" if self.repair else "; it answers only inside its own assembly"),
                    self.places[body],
                    f"add a constraint that joins it to {root[0]} or to what is mounted there",
                )
        for closing in topology.loop_closures():
            found = loops.closure(closing.path, lambda name: _frame_of(bodies, name))
            bad = not found.is_exact and (found.sigmas is None or found.sigmas > UNLIKELY)
            self.note(
                Severity.WARNING if bad else Severity.NOTE,
                f"constraint {closing.constraint} closes a loop through {few(closing.bodies)}; "
                f"{_told(found)}; answers take the shortest path",
                sources[closing.constraint],
                _mending(found) if bad else "",
            )
        if self.repair:
            kept = set(root)
            bodies = {name: body for name, body in bodies.items() if name in kept}
            constraints = tuple(each for each in constraints if names.split(each.from_)[0] in kept)
        return bodies, constraints


def _frame_of(bodies: dict[str, Body], name: str) -> BodyFrame:
    body, frame = names.split(name)
    return bodies[body].frame(frame)


def _told(found: Closure) -> str:
    """Return what going round a loop comes to, in words."""
    if found.is_exact:
        return "it closes exactly" + (", with joints where they rest" if found.joints else "")
    going = "going round, with joints where they rest," if found.joints else "going round"
    misses = f"{going} misses by {found.metres * 1e3:.3g} mm and {math.degrees(found.radians):.3g} deg"
    if found.sigmas is None:
        return f"{misses}, and no sigmas are stated for {few(found.unstated)} to weigh that by"
    if math.isinf(found.sigmas):
        return f"{misses}, in a direction in which the surveys state no error at all"
    more = "more than " if found.sigmas >= MOST_SIGMAS else ""
    return f"{misses}, {more}{found.sigmas:.1f} sigma of what the surveys state"


def _mending(found: Closure) -> str:
    if found.sigmas is None:
        return f"state sigma: of {few(found.unstated)}, remove one constraint of the loop, or mend the survey"
    rest = " or the default of a joint" if found.joints else ""
    return f"remove one constraint of the loop, or mend the survey of its frames{rest}"


def _use(near: tuple[str, ...]) -> str:
    return f"write {near[0]}" if near else "write it as Body:Frame, with the names as they stand in the file"

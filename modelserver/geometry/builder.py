"""ModelBuilder: collects bodies and constraints with the places they came from, checks every rule, builds.

A file format fills one and adds the problems it met on the way; a program may do the same by hand:

    builder = ModelBuilder("cart")
    cart = builder.body("Cart")
    cart.frame("Origin")
    cart.frame("Mast", Pose((0.2, 0.0, 1.1)))
    camera = builder.body("Camera")
    camera.frame("Origin")
    builder.constraint("CameraFixed", "Cart:Mast", "Camera:Origin")
    model = builder.build()
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from modelserver.errors import GeometryError, Problem, Severity, Source, nearest_names, shown
from modelserver.geometry import names
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Body, BodyFrame, Constraint, JointType, Sigma
from modelserver.geometry.topology import Topology
from modelserver.spatial.pose import Pose

NOWHERE = Source()

LOOP_METRES = 1e-6
LOOP_RADIANS = 1e-6
"""A loop that closes better than this is said to close exactly."""

LISTED = 12
"""Names that a message lists at most."""

SUGGESTED = 100
"""Constraint ends for which nearest names are looked up; a file with more wrong has another illness."""


@dataclass(slots=True)
class BodyBuilder:
    """Collects one body; made by `ModelBuilder.body`."""

    owner: ModelBuilder
    name: str
    source: Source = NOWHERE
    description: str = ""
    pose: Pose | None = None
    inertia: tuple[tuple[float, ...], ...] | None = None
    frames: list[tuple[BodyFrame, Source]] = field(default_factory=list)

    def frame(
        self,
        name: str,
        pose: Pose | None = None,
        description: str = "",
        sigma: Sigma | None = None,
        source: Source = NOWHERE,
    ) -> BodyBuilder:
        """Add a frame at `pose` in body coordinates; return this body, to go on."""
        self.frames.append((BodyFrame(name, pose or Pose.identity(), description, sigma), source))
        return self


class ModelBuilder:
    """Collects a model; `build` checks it. See the module's example."""

    def __init__(self, name: str = "", description: str = ""):
        self.name = name
        self.description = description
        self.problems: list[Problem] = []
        self._bodies: list[BodyBuilder] = []
        self._constraints: list[tuple[Constraint, Source]] = []

    @property
    def is_empty(self) -> bool:
        """Whether neither a body nor a constraint was added."""
        return not self._bodies and not self._constraints

    def body(
        self,
        name: str,
        description: str = "",
        pose: Pose | None = None,
        inertia: tuple[tuple[float, ...], ...] | None = None,
        source: Source = NOWHERE,
    ) -> BodyBuilder:
        """Add a body; return its builder, to add frames. The first body added is the root."""
        body = BodyBuilder(self, name, source, description, pose, inertia)
        self._bodies.append(body)
        return body

    def add(self, body: Body, source: Source = NOWHERE) -> BodyBuilder:
        """Add a body that exists already, e.g. `camera.renamed("RearCamera")`; return its builder."""
        draft = self.body(body.name, body.description, body.pose, body.inertia, source)
        draft.frames.extend((frame, source) for frame in body)
        return draft

    def constraint(
        self,
        name: str,
        from_: str,
        to: str,
        pose: Pose | None = None,
        description: str = "",
        sigma: Sigma | None = None,
        joint: JointType = JointType.FIXED,
        source: Source = NOWHERE,
    ) -> ModelBuilder:
        """Join two frames, named `Body:Frame`; `pose` is the place of `to` in `from_`. Return self, to go on."""
        constraint = Constraint(name, from_, to, pose or Pose.identity(), description, sigma, joint)
        self._constraints.append((constraint, source))
        return self

    def problem(
        self,
        severity: Severity,
        message: str,
        source: Source = NOWHERE,
        fix: str = "",
        nearest: tuple[str, ...] = (),
    ) -> None:
        """Note a problem that was met while reading."""
        self.problems.append(Problem(severity, message, source, fix, nearest))

    def error(self, message: str, source: Source = NOWHERE, fix: str = "", nearest: tuple[str, ...] = ()) -> None:
        """Note a problem that makes the model unusable."""
        self.problem(Severity.ERROR, message, source, fix, nearest)

    def warning(self, message: str, source: Source = NOWHERE, fix: str = "", nearest: tuple[str, ...] = ()) -> None:
        """Note a problem that the model can live with."""
        self.problem(Severity.WARNING, message, source, fix, nearest)

    def build(self, repair: bool = False) -> Model:
        """Check every rule and return the model; its `problems` hold the warnings and notes.

        Raises GeometryError with every problem where there is an error. With `repair`, does what the 2005
        server did instead: drops what is badly formed, and bodies not traceable to the root, and reports
        each as a warning; only a file that cannot be read, or of which nothing is left, still raises.
        """
        model, problems = self.check(repair)
        if model is None:
            raise GeometryError(problems)
        return model

    def check(self, repair: bool = False) -> tuple[Model | None, tuple[Problem, ...]]:
        """Return the model, or None where there is an error, and every problem, in the order of the file."""
        review = _Review(self, repair)
        bodies = review.bodies()
        bodies, constraints = review.connections(bodies, review.constraints(bodies))
        problems = tuple(
            problem for _, problem in sorted(enumerate(review.problems), key=lambda item: (item[1].line, item[0]))
        )
        if any(problem.severity is Severity.ERROR for problem in problems):
            return None, problems
        return Model(tuple(bodies.values()), constraints, self.name, self.description, problems), problems


class _Review:
    """One pass over what a builder holds: finds problems, and what is left when the faulty is dropped."""

    def __init__(self, builder: ModelBuilder, repair: bool):
        self.builder = builder
        self.repair = repair
        self.problems = list(builder.problems)
        self.places: dict[str, Source] = {}
        self.suggested = 0

    def fault(self, message: str, source: Source, fix: str, nearest: tuple[str, ...] = ()) -> None:
        """Report something badly formed: an error, or with repair the warning that it was removed."""
        if self.repair:
            self.problems.append(Problem(Severity.WARNING, f"{message}; removed", source, fix, nearest))
        else:
            self.problems.append(Problem(Severity.ERROR, message, source, fix, nearest))

    def note(self, severity: Severity, message: str, source: Source, fix: str = "") -> None:
        self.problems.append(Problem(severity, message, source, fix))

    def bodies(self) -> dict[str, Body]:
        """Return the bodies by name, each with its well-formed frames."""
        kept: dict[str, Body] = {}
        for draft in self.builder._bodies:
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
                    f"{label} is defined twice{_first_at(first)}",
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
            try:
                kept[draft.name] = Body(draft.name, frames, draft.description, draft.pose, draft.inertia)
            except ValueError as error:
                self.fault(f"{label}: {error}", draft.source, "write 6 rows of 6 numbers, or leave it out")
                kept[draft.name] = Body(draft.name, frames, draft.description, draft.pose)
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
                Severity.WARNING,
                f"there is one body, {only}; a model joins two or more",
                self.places[only],
                "add the bodies mounted on it, or leave it if the vehicle is one rigid body",
            )
        return kept

    def _frames(self, draft: BodyBuilder) -> tuple[BodyFrame, ...]:
        kept: dict[str, tuple[BodyFrame, Source]] = {}
        for frame, source in draft.frames:
            label = f"frame {shown(frame.name)} of body {shown(draft.name)}"
            if fault := names.fault(frame.name):
                self.fault(f"{label}: {fault}", source, "give it a plain name, e.g. ImagePlane")
            elif frame.name in kept:
                self.fault(
                    f"{label} is defined twice{_first_at(kept[frame.name][1])}",
                    source,
                    "rename one of the two",
                )
            else:
                kept[frame.name] = (frame, source)
        return tuple(frame for frame, _ in kept.values())

    def constraints(self, bodies: dict[str, Body]) -> tuple[tuple[Constraint, Source], ...]:
        """Return the well-formed constraints: both ends exist and differ, one for each frame."""
        kept: list[tuple[Constraint, Source]] = []
        by_name: dict[str, Source] = {}
        by_frame: dict[str, tuple[str, Source]] = {}
        for constraint, source in self.builder._constraints:
            label = f"constraint {shown(constraint.name)}"
            if fault := names.fault(constraint.name):
                self.fault(f"{label}: {fault}", source, "give it a plain name, e.g. DigiclopsFixed")
                continue
            if constraint.name in by_name:
                self.fault(
                    f"{label} is defined twice{_first_at(by_name[constraint.name])}",
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
            taken = [(end, *by_frame[end]) for _, end in ends if end in by_frame]
            for end, other, place in taken:
                self.fault(
                    f"{label}: frame {end} already has constraint {other}{_first_at(place)}; a frame has one at most",
                    source,
                    f"add a frame of its own to body {names.split(end)[0]} for this constraint",
                )
            if taken:
                continue
            for _, end in ends:
                by_frame[end] = (constraint.name, source)
            kept.append((constraint, source))
        return tuple(kept)

    def _end_exists(self, label: str, sense: str, end: str, bodies: dict[str, Body], source: Source) -> bool:
        try:
            body, frame = names.split(end)
        except ValueError:
            everything = (names.joined(body.name, frame.name) for body in bodies.values() for frame in body)
            near = self._nearest(end, everything)
            self.fault(f"{label}: {sense} {shown(end)} is not of the form Body:Frame", source, _use(near), near)
            return False
        if body not in bodies:
            near = tuple(
                names.joined(name, frame) if bodies[name].has_frame(frame) else name
                for name in self._nearest(body, bodies)
            )
            self.fault(f"{label}: {sense} names body {shown(body)}, which does not exist", source, _use(near), near)
            return False
        if not bodies[body].has_frame(frame):
            known = [each.name for each in bodies[body].frames[: LISTED + 1]]
            frames = (each.name for each in bodies[body])
            near = tuple(names.joined(body, name) for name in self._nearest(frame, frames))
            self.fault(
                f"{label}: {sense} names frame {shown(frame)}, which body {body} does not have",
                source,
                _use(near) if near else f"body {body} has: {_few(known)}",
                near,
            )
            return False
        return True

    def _nearest(self, name: str, known: Iterable[str]) -> tuple[str, ...]:
        self.suggested += 1
        return nearest_names(name, known) if self.suggested <= SUGGESTED else ()

    def connections(
        self, bodies: dict[str, Body], placed: tuple[tuple[Constraint, Source], ...]
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
            metres, radians = closing.error
            exact = metres < LOOP_METRES and radians < LOOP_RADIANS
            self.note(
                Severity.WARNING,
                f"constraint {closing.constraint} closes a loop through {_few(closing.bodies)}; "
                + (
                    "it closes exactly"
                    if exact
                    else f"going round misses by {metres * 1e3:.3g} mm and {radians * 57.29577951308232:.3g} deg"
                )
                + "; answers take the shortest path",
                sources[closing.constraint],
                "remove one constraint of the loop, or mend the survey of its frames",
            )
        if self.repair:
            kept = set(root)
            bodies = {name: body for name, body in bodies.items() if name in kept}
            constraints = tuple(each for each in constraints if names.split(each.from_)[0] in kept)
        return bodies, constraints


def _first_at(place: Source) -> str:
    return f" (first at {place})" if str(place) else ""


def _few(several: Sequence[str]) -> str:
    """Return the first of several names: a file of 10,000 frames must not make a message of 10,000 names."""
    return ", ".join(several[:LISTED]) + (f", ... ({len(several)} in all)" if len(several) > LISTED else "")


def _use(near: tuple[str, ...]) -> str:
    return f"write {near[0]}" if near else "write it as Body:Frame, with the names as they stand in the file"

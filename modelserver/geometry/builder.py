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

from modelserver.errors import GeometryError, Location, NotConnectedError, Problem, Severity, shown
from modelserver.geometry.adjacency import full_name
from modelserver.geometry.draft import NOWHERE, BodyBuilder, Draft
from modelserver.geometry.joint import FIXED, Joint
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Body, BodyFrame, Constraint, Sigma
from modelserver.geometry.review import Review
from modelserver.spatial.pose import Pose


class ModelBuilder(Draft):
    """Collects a model; `build` checks it. See the module's example."""

    @classmethod
    def from_model(cls, model: Model, strict: bool = False) -> ModelBuilder:
        """Return a builder that holds what a model holds, to change it: models are immutable."""
        builder = cls(model.name, model.description, strict)
        for body in model.bodies:
            builder.add(body)
        builder.constraints = [(constraint, NOWHERE) for constraint in model.constraints]
        return builder

    @property
    def is_empty(self) -> bool:
        """Whether neither a body nor a constraint was added."""
        return not self.bodies and not self.constraints

    def body(
        self,
        name: str,
        description: str = "",
        pose: Pose | None = None,
        inertia: tuple[tuple[float, ...], ...] | None = None,
        source: Location = NOWHERE,
    ) -> BodyBuilder:
        """Add a body; return its builder, to add frames. The first body added is the root."""
        body = BodyBuilder(name, source, description, pose, inertia)
        self.bodies.append(body)
        return body

    def add(self, body: Body, source: Location = NOWHERE) -> BodyBuilder:
        """Add a body that exists already, e.g. `camera.renamed("RearCamera")`; return its builder."""
        draft = self.body(body.name, body.description, body.pose, body.inertia, source)
        draft.frames.extend((frame, source) for frame in body)
        draft.visuals, draft.collisions = body.visuals, body.collisions
        return draft

    def constraint(
        self,
        name: str,
        from_: str,
        to: str,
        pose: Pose | None = None,
        description: str = "",
        sigma: Sigma | None = None,
        joint: Joint = FIXED,
        source: Location = NOWHERE,
    ) -> ModelBuilder:
        """Join two frames, named `Body:Frame`, rigidly or by a joint; `pose` is the place of `to` in `from_`.

        Of a joint that moves, that is its place with all coordinates 0. Return self, to go on.
        """
        constraint = Constraint(name, from_, to, pose or Pose.identity(), description, sigma, joint)
        self.constraints.append((constraint, source))
        return self

    def unconstrain(self, frame: str | BodyFrame, constraint: str = "") -> tuple[str, ...]:
        """Remove the constraints at a frame, or the one of that name; return the names of those removed.

        `build` then applies the rules again: bodies that no constraint joins to the root any more are orphans, reported
        in the model's `problems`, and removed with `repair`; a joint that follows a removed one is an error. Raises
        NotConnectedError where the frame has no such constraint, UnknownFrameError for a frame value on no body.
        """
        name = full_name(frame)
        removed = tuple(
            each.name for each, _ in self.constraints if name in (each.from_, each.to) and constraint in ("", each.name)
        )
        if not removed:
            raise NotConnectedError(f"frame {name} has no constraint" + (f" {shown(constraint)}" if constraint else ""))
        self.constraints = [item for item in self.constraints if item[0].name not in removed]
        return removed

    def problem(
        self,
        severity: Severity,
        message: str,
        source: Location = NOWHERE,
        fix: str = "",
        nearest: tuple[str, ...] = (),
    ) -> None:
        """Note a problem that was met while reading."""
        self.problems.append(Problem(severity, message, source, fix, nearest))

    def error(self, message: str, source: Location = NOWHERE, fix: str = "", nearest: tuple[str, ...] = ()) -> None:
        """Note a problem that makes the model unusable."""
        self.problem(Severity.ERROR, message, source, fix, nearest)

    def warning(self, message: str, source: Location = NOWHERE, fix: str = "", nearest: tuple[str, ...] = ()) -> None:
        """Note a problem that the model can live with."""
        self.problem(Severity.WARNING, message, source, fix, nearest)

    def stated(self) -> Model | None:
        """Return the well-formed bodies alone, also of a model with errors; None where there is none.

        Whether a frame exists can be looked at in it, while no answer can be: it has no constraints.
        """
        bodies = Review(self, repair=True).bodies()
        return Model(tuple(bodies.values()), (), self.name, self.description) if bodies else None

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """The names of all constraints, also of those with errors."""
        return tuple(constraint.name for constraint, _ in self.constraints)

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
        review = Review(self, repair)
        bodies = review.bodies()
        bodies, constraints = review.connections(bodies, review.joints(review.constraints(bodies)))
        problems = tuple(
            problem for _, problem in sorted(enumerate(review.problems), key=lambda item: (item[1].line, item[0]))
        )
        if any(problem.severity is Severity.ERROR for problem in problems):
            return None, problems
        return Model(tuple(bodies.values()), constraints, self.name, self.description, problems), problems

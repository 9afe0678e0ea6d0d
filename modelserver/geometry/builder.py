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

from modelserver.errors import GeometryError, Location, NotConnectedError, Problem, Severity, quote
from modelserver.geometry.joint import FIXED, Joint
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Body, BodyFrame, Constraint, Sigma
from modelserver.geometry.review import NO_LOCATION, BodyBuilder, ModelDraft, ModelReview
from modelserver.geometry.topology import full_name
from modelserver.transforms.pose import Pose


class ModelBuilder(ModelDraft):
    """Collects a model; `build` checks it. See the module's example."""

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
        """Whether neither a body nor a constraint was added."""
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

    def copy_body(self, body: Body, source: Location = NO_LOCATION) -> BodyBuilder:
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
        sigma: Sigma | None = None,
        joint: Joint = FIXED,
        source: Location = NO_LOCATION,
    ) -> ModelBuilder:
        """Join two frames, named `Body:Frame`, rigidly or by a joint; return self.

        `pose` is the pose of `to` in `from_`, for a movable joint with all coordinates 0.
        """
        constraint = Constraint(name, from_, to, pose or Pose.identity(), description, sigma, joint)
        self.constraints.append((constraint, source))
        return self

    def remove_constraints(self, frame: str | BodyFrame, constraint: str = "") -> tuple[str, ...]:
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
        bodies = ModelReview(self, repair=True).check_bodies()
        return Model(tuple(bodies.values()), (), self.name, self.description) if bodies else None

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """The names of all constraints, also of those with errors."""
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
        review = ModelReview(self, repair)
        bodies = review.check_bodies()
        bodies, constraints = review.check_connections(bodies, review.check_joints(review.check_constraints(bodies)))
        problems = tuple(
            problem for _, problem in sorted(enumerate(review.problems), key=lambda item: (item[1].line, item[0]))
        )
        if any(problem.severity is Severity.ERROR for problem in problems):
            return None, problems
        return Model(tuple(bodies.values()), constraints, self.name, self.description, problems), problems

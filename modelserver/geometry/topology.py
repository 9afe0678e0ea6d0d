"""Topology: which frames lead to which, and the two searches of the report (4.6.1, 4.6.2)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from modelserver.errors import LimitError
from modelserver.geometry import names
from modelserver.geometry.parts import Body, Constraint
from modelserver.spatial.pose import Pose

DEPTH_FIRST_VISITS = 1_000_000
"""A depth-first search gives up after so many frames: on densely looped models it grows exponentially."""


@dataclass(frozen=True, slots=True)
class Crossing:
    """One constraint passed on a path. `forward` is the sense From to To; backward takes the inverse."""

    constraint: Constraint
    forward: bool

    @property
    def enters(self) -> str:
        """The frame the path leaves a body by."""
        return self.constraint.from_ if self.forward else self.constraint.to

    @property
    def leaves(self) -> str:
        """The frame the path comes into the next body by."""
        return self.constraint.to if self.forward else self.constraint.from_

    @property
    def pose(self) -> Pose:
        """The pose of the far frame in the near one, with a joint that moves where it rests."""
        X_FT = self.constraint.at_rest
        return X_FT if self.forward else X_FT.inverse()


@dataclass(frozen=True, slots=True)
class LoopClosure:
    """A constraint that joins two bodies which are joined already: going round comes back with `error`.

    `bodies` are those of the loop, `path` the constraints crossed going round; `error` is metres and radians, with
    joints that move where they rest.
    """

    constraint: str
    bodies: tuple[str, ...]
    path: tuple[Crossing, ...]
    error: tuple[float, float]


class Topology:
    """The graph of bodies and constraints. Names in it are known to be good; see `ModelBuilder`."""

    __slots__ = ("_at", "_bodies", "_exits", "assemblies")

    def __init__(self, bodies: tuple[Body, ...], constraints: tuple[Constraint, ...]):
        self._bodies = {body.name: body for body in bodies}
        self._at: dict[str, list[Crossing]] = {}
        for constraint in constraints:
            self._at.setdefault(constraint.from_, []).append(Crossing(constraint, forward=True))
            self._at.setdefault(constraint.to, []).append(Crossing(constraint, forward=False))
        self._exits: dict[str, list[Crossing]] = {body.name: [] for body in bodies}
        for body in bodies:
            for frame in body:
                self._exits[body.name] += self._at.get(names.joined(body.name, frame.name), ())
        self.assemblies = self._find_assemblies()
        """Groups of bodies that constraints join, each in breadth-first order; the root's comes first."""

    def _find_assemblies(self) -> tuple[tuple[str, ...], ...]:
        seen: set[str] = set()
        assemblies = []
        for start in self._bodies:
            if start not in seen:
                assembly = (start, *(names.split(crossing.leaves)[0] for _, crossing in self.spread(start)))
                seen.update(assembly)
                assemblies.append(assembly)
        return tuple(assemblies)

    def spread(self, start: str) -> Iterator[tuple[str, Crossing]]:
        """Walk breadth first from body `start`; yield each newly met body's predecessor and the crossing to it."""
        seen = {start}
        queue = deque([start])
        while queue:
            body = queue.popleft()
            for crossing in self._exits[body]:
                entered = names.split(crossing.leaves)[0]
                if entered not in seen:
                    seen.add(entered)
                    queue.append(entered)
                    yield body, crossing

    def crossings(self, frame: str) -> tuple[Crossing, ...]:
        """Return the constraints at a frame, given by its full name, each in the sense that leads away from it."""
        return tuple(self._at.get(frame, ()))

    def loop_closures(self) -> tuple[LoopClosure, ...]:
        """Return the constraints that are left over when each body is reached by a shortest path."""
        closures = []
        for assembly in self.assemblies:
            start = assembly[0]
            reached: dict[str, tuple[str, Crossing]] = {}
            place = {start: Pose.identity()}
            used = set()
            for body, crossing in self.spread(start):
                entered = names.split(crossing.leaves)[0]
                reached[entered] = (body, crossing)
                place[entered] = place[body] @ self.step(crossing)
                used.add(crossing.constraint.name)
            for body in assembly:
                for crossing in self._exits[body]:
                    name = crossing.constraint.name
                    if name in used:
                        continue
                    used.add(name)
                    entered = names.split(crossing.leaves)[0]
                    error = (place[body] @ self.step(crossing)).distance(place[entered])
                    back = self._way_back(reached, entered, body)
                    closures.append(LoopClosure(name, _loop(reached, body, entered), (crossing, *back), error))
        return tuple(closures)

    @staticmethod
    def _way_back(reached: dict[str, tuple[str, Crossing]], start: str, target: str) -> tuple[Crossing, ...]:
        """Return the crossings from one body to another along the tree that says how each was reached."""

        def up(body: str) -> list[Crossing]:
            line = []
            while body in reached:
                body, crossing = reached[body]
                line.append(crossing)
            return line

        rising, falling = up(start), up(target)
        while rising and falling and rising[-1] is falling[-1]:
            rising.pop()
            falling.pop()
        return (*[Crossing(each.constraint, not each.forward) for each in rising], *reversed(falling))

    def step(self, crossing: Crossing) -> Pose:
        """Return the pose of the entered body's origin in the left body's origin."""
        body, frame = names.split(crossing.enters)
        next_body, next_frame = names.split(crossing.leaves)
        out = self._bodies[body].frame(frame).pose
        back = self._bodies[next_body].frame(next_frame).pose.inverse()
        return out @ crossing.pose @ back

    def breadth_first(self, body: str, target: str) -> tuple[Crossing, ...] | None:
        """Return the crossings of a shortest path from one body to another, None where there is none."""
        if body == target:
            return ()
        came_by: dict[str, tuple[str, Crossing]] = {}
        for previous, crossing in self.spread(body):
            entered = names.split(crossing.leaves)[0]
            came_by[entered] = (previous, crossing)
            if entered == target:
                return _unwind(came_by, body, target)
        return None

    def depth_first(self, body: str, frame: str, target: str) -> tuple[Crossing, ...] | None:
        """Return the path that the report's search finds (4.6.2), None where there is none.

        Starting at `body:frame`, each frame of the body is compared with `target` (a full name); one that
        does not match and is constrained goes on the path stack, its constraint is crossed and the attached
        frame examined, then those of its body; a frame that is on the stack already closes a cycle and its
        branch is left. Order is that of the file, so the path need not be the shortest. Raises LimitError
        after a million frames.
        """
        if names.joined(body, frame) == target:
            return ()
        path: list[Crossing] = []
        on_path: set[str] = set()
        stack = [self._ways_on(body)]
        visits = 0
        while stack:
            visits += 1
            if visits > DEPTH_FIRST_VISITS:
                raise LimitError(
                    f"the depth-first search gave up after {DEPTH_FIRST_VISITS} frames: the model has too many "
                    "loops for it; use the breadth-first search"
                )
            way = next(stack[-1], None)
            if way is None:
                stack.pop()
                if path:
                    on_path.discard(path.pop().enters)
                continue
            name, crossing = way
            if name == target:
                return tuple(path)
            if crossing is None or name in on_path or crossing.leaves in on_path:
                continue
            path.append(crossing)
            if crossing.leaves == target:
                return tuple(path)
            on_path.add(name)
            stack.append(self._ways_on(names.split(crossing.leaves)[0]))
        return None

    def _ways_on(self, body: str) -> Iterator[tuple[str, Crossing | None]]:
        """Yield a body's frames in order, by their full names, each with None first and then with its constraints."""
        for frame in self._bodies[body].frames:
            name = names.joined(body, frame.name)
            yield name, None
            for crossing in self._at.get(name, ()):
                yield name, crossing


def _unwind(came_by: dict[str, tuple[str, Crossing]], start: str, target: str) -> tuple[Crossing, ...]:
    path = []
    while target != start:
        target, crossing = came_by[target]
        path.append(crossing)
    return tuple(reversed(path))


def _loop(reached: dict[str, tuple[str, Crossing]], a: str, b: str) -> tuple[str, ...]:
    """Return the bodies of the loop that joining `a` and `b` closes, given how each was reached."""

    def ancestors(body: str) -> list[str]:
        line = [body]
        while body in reached:
            body = reached[body][0]
            line.append(body)
        return line

    line_a, line_b = ancestors(a), ancestors(b)
    above_b = set(line_b)
    shared = next(body for body in line_a if body in above_b)
    return (*line_a[: line_a.index(shared) + 1], *reversed(line_b[: line_b.index(shared)]))

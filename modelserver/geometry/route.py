"""Routes: the way from one frame to another, ready to be walked again and again as the joints on it move.

What is bolted together is folded into one pose before each joint, so that a lookup costs what moves and no more. The
edges are kept beside, for those who ask how sure an answer is, or what it rests on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, Self

import numpy as np

from modelserver.geometry.edges import Edge
from modelserver.geometry.joint import Coordinates, Joint, JointType
from modelserver.geometry.path_covariance import PathCovariance, Place
from modelserver.spatial import so3
from modelserver.spatial.chain import ChainLink
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Quaternion


class Leg(NamedTuple):
    """A joint on a route: `before` leads to it from the joint before, or from the frame of reference."""

    before: Pose
    name: str
    joint: Joint
    forward: bool
    span: tuple[float, float] | None = None
    """Of a joint with one coordinate its limits, widened by rounding."""
    turning: tuple[Quaternion, Quaternion] | None = None
    """Of a revolute joint the products of `before` with 1 and with its axis; cos and sin of half its angle mix them."""

    @classmethod
    def of(cls, before: Pose, edge: Edge) -> Leg:
        """Return the leg of the edge of a joint that moves."""
        assert edge.joint is not None
        return cls(before, edge.name, edge.joint, edge.forward, edge.joint.span, _turning(before, edge))


class Route:
    """The way from `frame_of_reference` to `frame_of_interest`; see the module. Immutable by habit: nothing here sets.

    `legs` are the joints on it that move, `last` leads from the last of them to the frame of interest. `closes_loop`:
    there is another way, and this is the shortest.
    """

    __slots__ = ("_bases", "_covariance", "_edges", "closes_loop", "last", "legs")

    legs: tuple[Leg, ...]
    last: Pose
    closes_loop: bool
    _bases: Sequence[Pose | None]
    _edges: tuple[Edge, ...] | Callable[[], tuple[Edge, ...]]
    _covariance: PathCovariance | Callable[[], PathCovariance]

    def __init__(self, edges: Sequence[Edge], closes_loop: bool = False):
        """Fold the edges of any path."""
        legs: list[Leg] = []
        pose = Pose.identity()
        for edge in edges:
            if edge.joint is not None:
                legs.append(Leg.of(pose, edge))
                pose = Pose.identity()
            else:
                pose = pose @ (edge.pose if edge.forward else edge.pose.inverse())
        self.closes_loop = closes_loop
        self.legs = tuple(legs)
        self.last = pose
        self._edges = tuple(edges)
        self._bases = (None,) * (len(legs) + 1)
        self._covariance = partial(PathCovariance.along, self._edges)

    @classmethod
    def assemble(
        cls,
        legs: Sequence[Leg],
        last: Pose,
        bases: Sequence[Pose | None],
        edges: Callable[[], tuple[Edge, ...]],
        covariance: Callable[[], PathCovariance],
    ) -> Self:
        """Return the route of what is known of it already.

        `bases` holds for each rigid segment the pose of its base in its first frame, None for the identity; `edges` and
        `covariance` make what few ask for, when it is first asked for.
        """
        self = cls.__new__(cls)
        self.closes_loop = False
        self.legs = tuple(legs)
        self.last = last
        self._bases = bases
        self._edges = edges
        self._covariance = covariance
        return self

    @property
    def edges(self) -> tuple[Edge, ...]:
        """The edges from the frame of reference to the frame of interest."""
        found = self._edges
        if not isinstance(found, tuple):
            found = self._edges = found()
        return found

    @property
    def rest(self) -> tuple[Coordinates, ...]:
        """Where the joints stand while nobody tells."""
        return tuple([leg.joint.rest for leg in self.legs])

    def places(self, positions: Sequence[Coordinates]) -> list[Place]:
        """Return where, in the frame of reference, the frame behind each leg's joint stands, itself first, and the end.

        Quaternions are of unit length up to rounding.
        """
        px, py, pz = 0.0, 0.0, 0.0
        q = so3.IDENTITY
        places: list[Place] = [((px, py, pz), q)]
        for leg, position in zip(self.legs, positions, strict=True):
            turning = leg.turning
            if q is so3.IDENTITY:
                # the first leg begins in the frame of reference itself
                px, py, pz = leg.before._p
            else:
                x, y, z = so3.rotate(q, leg.before._p)
                px, py, pz = px + x, py + y, pz + z
            if turning is not None:
                # most joints there are: before and turn are one product, a (cos) + b (sin)
                half = 0.5 * position[0]
                c, s = math.cos(half), math.sin(half)
                (aw, ax, ay, az), (bw, bx, by, bz) = turning
                turn = (aw * c + bw * s, ax * c + bx * s, ay * c + by * s, az * c + bz * s)
                q = turn if q is so3.IDENTITY else so3.multiply(q, turn)
            else:
                q = so3.multiply(q, leg.before._q)
                moved = leg.joint.motion(position)
                if not leg.forward:
                    moved = moved.inverse()
                x, y, z = so3.rotate(q, moved._p)
                px, py, pz = px + x, py + y, pz + z
                q = so3.multiply(q, moved._q)
            places.append(((px, py, pz), q))
        x, y, z = so3.rotate(q, self.last._p)
        places.append(((px + x, py + y, pz + z), so3.multiply(q, self.last._q)))
        return places

    def pose(self, positions: Sequence[Coordinates]) -> Pose:
        """Return the pose of the frame of interest in that of reference, with each leg's joint at its position."""
        if not self.legs:
            return self.last
        return self.end(self.places(positions))

    @staticmethod
    def end(places: Sequence[Place]) -> Pose:
        """Return the pose of the last of `places`."""
        (x, y, z), q = places[-1]
        return Pose._of((x + 0.0, y + 0.0, z + 0.0), so3.normalized(q))

    def covariance(
        self,
        positions: Sequence[Coordinates],
        sigmas: Sequence[Coordinates],
        unstated_is_exact: bool = False,
        places: Sequence[Place] | None = None,
    ) -> tuple[float, ...] | None:
        """Return the covariance of `pose`, that of `links`: 36 numbers, row by row; None where a part states none.

        With `unstated_is_exact` a survey that states none counts as exact; a joint never does.

        `sigmas` as in `links`; `places` spares working them out again.
        """
        path = self._covariance
        if not isinstance(path, PathCovariance):
            path = self._covariance = path()
        if not (unstated_is_exact or path.is_stated):
            return None
        # loops, not any(): this is asked for each lookup
        for leg in sigmas:
            for sigma in leg:
                if sigma != sigma:
                    return None
        if places is None:
            places = self.places(positions)
        bases: list[Place] = []
        for place, X_LB in zip(places, self._bases, strict=False):
            if X_LB is not None:
                (px, py, pz), q = place
                if q is so3.IDENTITY:
                    # the first segment begins in the frame of reference itself
                    bases.append((X_LB._p, X_LB._q))
                    continue
                x, y, z = so3.rotate(q, X_LB._p)
                place = ((px + x, py + y, pz + z), so3.multiply(q, X_LB._q))
            bases.append(place)
        return path.at(bases, places[-1][0], positions, sigmas)

    def links(self, positions: Sequence[Coordinates], sigmas: Sequence[Coordinates], stamp: int = 0) -> list[ChainLink]:
        """Return the chain of the route, link by link, with what each is unsure of.

        `sigmas` are those of the legs' coordinates, nan where nobody told; of a joint that follows, its multiplier
        times its leader's, sign and all: the two err as one. `stamp` is told apart in the sources of joints: what a
        joint measured at two instants are two errors, what was surveyed is one.
        """
        links = []
        number = 0
        for edge in self.edges:
            if edge.joint is None:
                links.append(ChainLink(edge.pose, edge.forward, edge.survey_factor, (edge.kind, edge.name)))
                continue
            position, sigma = positions[number], sigmas[number]
            number += 1
            factor = None
            if not any(map(np.isnan, sigma)):
                factor = edge.joint.jacobian(position) * np.array(sigma)
            source = (edge.kind, edge.leader or edge.name, stamp)
            links.append(ChainLink(edge.joint.motion(position), edge.forward, factor, source))
        return links


def _turning(before: Pose, edge: Edge) -> tuple[Quaternion, Quaternion] | None:
    if edge.joint is None or edge.joint.type is not JointType.REVOLUTE:
        return None
    x, y, z = edge.joint.axis
    axis = (0.0, x, y, z) if edge.forward else (0.0, -x, -y, -z)
    return before._q, so3.multiply(before._q, axis)


_IDENTITY = Pose.identity()

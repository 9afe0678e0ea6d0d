"""How sure a route is, again and again as its joints move: what `spatial.chain` says, in a few array operations.

A route falls into stretches that are bolted together, with a joint between each and the next. What is unsure of a
stretch is folded once, into the covariance of a small motion of all that comes behind it: the velocity of the stretch's
first origin, as it were, and the turn, along that frame's axes. A joint's error is such a motion too, of a frame that
is bolted to one of the two stretches beside it. So a lookup carries one matrix for each stretch, and a column for each
coordinate, to the far end: `dp_N = R v + (R w) x (p_N - p)`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from modelserver.geometry.joint import Coordinates, Joint
from modelserver.spatial import chain, so3
from modelserver.spatial.chain import Link
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array, Quaternion, Vector3

if TYPE_CHECKING:
    from modelserver.geometry.route import Edge

Place = tuple[Vector3, Quaternion]
"""Where a frame stands: position and orientation, as plain floats."""


class _Mover(NamedTuple):
    """A joint of a route: `carried` (6, 6) takes a small motion from its own frame to that of stretch `owner`."""

    joint: Joint
    owner: int
    carried: Array
    sign: float


class Sureness:
    """What is unsure of a route, folded for looking up; see the module. `stated`: whether every edge says how much."""

    __slots__ = ("_folded", "_movers", "_owners", "_shared", "_units", "stated")

    def __init__(self, edges: Sequence[Edge]):
        self.stated = True
        folded: list[Array] = []
        movers: list[_Mover] = []
        leaders: list[tuple[str, int]] = []
        stretch: list[Link] = []
        for edge in edges:
            joint = edge.joint
            if joint is None:
                factor = edge.survey_factor
                self.stated &= factor is not None
                stretch.append(Link(edge.pose, edge.forward, _EXACT if factor is None else factor, (edge.name,)))
                continue
            folded.append(_motion_covariance(stretch))
            owner = len(folded) - 1 if edge.forward else len(folded)
            carried = _carrying(chain.product(stretch)) if edge.forward else np.eye(6)
            movers.append(_Mover(joint, owner, carried, 1.0 if edge.forward else -1.0))
            leaders += [(edge.leader or edge.name, number) for number in range(joint.count)]
            stretch = []
        folded.append(_motion_covariance(stretch))
        self._folded = np.array(folded)
        self._movers = movers
        self._owners = np.array([each.owner for each in movers for _ in range(each.joint.count)], dtype=int)
        # where a joint has one coordinate its motion is along or about the same axis wherever it stands
        simple = all(each.joint.count == 1 for each in movers)
        self._units = np.array([_motions(each, (0.0,))[:, 0] for each in movers]) if simple else None
        # errors of one reading, of a joint and of those that follow it, are added before they are squared
        distinct = sorted(set(leaders))
        self._shared: Array | None = None
        if len(distinct) < len(leaders):
            self._shared = np.array([[float(leader == each) for each in distinct] for leader in leaders])

    def covariance(
        self, places: Sequence[Place], positions: Sequence[Coordinates], sigmas: Sequence[Coordinates]
    ) -> Array:
        """Return the covariance (6, 6) of the far end along the axes of the first frame; what states none is exact.

        `places` are those of the stretches' first frames, and of the far end; `sigmas` as in `Route.links`.
        """
        far = places[-1][0]
        J = np.array([chain.carried_rows(q, (far[0] - p[0], far[1] - p[1], far[2] - p[2])) for p, q in places[:-1]])
        flat = J.transpose(1, 0, 2).reshape(6, -1)
        total = (J @ self._folded).transpose(1, 0, 2).reshape(6, -1) @ flat.T
        if self._movers:
            units = self._units
            if units is None:
                units = np.hstack(
                    [_motions(each, where) for each, where in zip(self._movers, positions, strict=True)]
                ).T
            columns = (J[self._owners] @ units[:, :, None])[:, :, 0].T
            columns = columns * [0.0 if math.isnan(sigma) else sigma for leg in sigmas for sigma in leg]
            if self._shared is not None:
                columns = columns @ self._shared
            total += columns @ columns.T
        return np.asarray((total + total.T) / 2)


def _motion_covariance(stretch: Sequence[Link]) -> Array:
    """Return the covariance of the small motion of all behind a stretch, at its first origin and along its axes."""
    found = chain.covariance(stretch)
    assert found is not None
    shift = np.eye(6)
    shift[:3, 3:] = so3.skew(chain.product(stretch).xyz)
    return np.asarray(shift @ found @ shift.T)


def _carrying(X_AF: Pose) -> Array:
    """Return what takes a small motion told in F, at its origin, to the same told in A."""
    R = np.array(so3.matrix_rows(X_AF.wxyz))
    carrying = np.zeros((6, 6))
    carrying[:3, :3] = carrying[3:, 3:] = R
    carrying[:3, 3:] = so3.skew(X_AF.xyz) @ R
    return carrying


def _motions(mover: _Mover, position: Coordinates) -> Array:
    """Return (6, n): the small motion that each coordinate of a joint makes, told in its stretch."""
    J = mover.joint.jacobian(position)
    J[:3] += so3.skew(mover.joint.motion(position).xyz) @ J[3:]
    return np.asarray(mover.sign * mover.carried @ J)


_EXACT = np.zeros((6, 1))

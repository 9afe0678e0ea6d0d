"""Covariance of a path: how the uncertainty of surveys and joints adds up at its far end.

Theory of operation. A path consists of rigid segments with a joint between each and the next. A perturbation (dp,
dtheta) of an edge X_FT, along the axes of F, is a small motion of everything behind it. Written as the velocity at the
origin of the segment's base frame and the angular velocity, along the base's axes, it is

    v = R_F dp + p_T x (R_F dtheta),   w = R_F dtheta

with R_F the orientation of F in the base and p_T the position of T in it. Each fixed edge keeps this motion for its six
standard deviations as a block of six rows (v, w): `motion_factors`. At the far end N of the path, and along the axes of
the frame of reference, a motion of the base B is

    v_N = R_B v + (R_B w) x (p_N - p_B),   w_N = R_B w

so the covariance is the sum of the squares of all rows, transported (the same as `spatial.chain.covariance`, which
carries every edge by itself). The rows are summed before they are squared, never covariances of a common ancestor
subtracted: a long lever from the base to the edge cancels linearly, as it does in the poses, and not squared.

A joint's motion is written in the segment that contains its F frame, the frame that the motion starts from. The sign of
an edge that is passed backward matters only where two joints share an error (one follows the other): those are added
before they are squared.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from modelserver.geometry.joint import Coordinates, Joint
from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array, Quaternion, Vector3

if TYPE_CHECKING:
    from modelserver.geometry.parts import Sigma
    from modelserver.geometry.route import Edge

Place = tuple[Vector3, Quaternion]
"""Position and orientation of a frame, as plain floats."""

_NUMBERS: Final = struct.Struct("36d")


class FixedEdge(NamedTuple):
    """A fixed edge in its segment: `orientation` of F and `position` of T in the base, and the survey's sigmas."""

    orientation: Quaternion
    position: Vector3
    sigma: Sigma


class JointMotion(NamedTuple):
    """How a joint moves the segment behind it: `transport` (6, 6) takes a motion at F, along its axes, to the base.

    `block` (6, 6) is that of `at_position`, at any position where the joint has one coordinate.
    """

    joint: Joint
    transport: Array
    block: Array

    @classmethod
    def at(cls, joint: Joint, X_BF: Pose) -> JointMotion:
        """Return the motion of a joint whose F frame is at a pose in the base of its segment."""
        R = np.array(so3.matrix_rows(X_BF.wxyz))
        transport = np.zeros((6, 6))
        transport[:3, :3] = transport[3:, 3:] = R
        transport[:3, 3:] = so3.skew(X_BF.xyz) @ R
        found = cls(joint, transport, transport)
        return found._replace(block=found.at_position((0.0,) * joint.count))

    def at_position(self, position: Coordinates) -> Array:
        """Return a block (6, 6): row i is the motion (v, w) in the base that a unit of coordinate i makes, else 0."""
        J = self.joint.jacobian(position)
        J[:3] += so3.skew(self.joint.motion(position).xyz) @ J[3:]
        block = np.zeros((6, 6))
        block[: self.joint.count] = (self.transport @ J).T
        return block


class Crossing(NamedTuple):
    """A joint on a path: its motion, in the base of segment number `segment`; `sign` -1.0 where passed from T to F.

    `source` names where its error comes from: joints of one source err together.
    """

    motion: JointMotion
    segment: int
    sign: float
    source: str


class PathCovariance:
    """Covariance of the far end of a path, for any position of its joints; see the module.

    `blocks` (k + m, 6, 6) are those of `motion_factors` for the k fixed edges, each in the segment whose number is in
    `segments`, and those of the m joints, the `crossings`. `is_stated` is false where an edge states no sigma, and
    counts as exact here.
    """

    __slots__ = ("_blocks", "_constant", "_crossings", "_segments", "_shared", "is_stated")

    def __init__(
        self, blocks: Array, segments: Sequence[int], crossings: Sequence[Crossing] = (), is_stated: bool = True
    ):
        self.is_stated = is_stated
        self._blocks = blocks
        self._crossings = crossings
        self._segments = np.array([*segments, *[each.segment for each in crossings]], dtype=np.intp)
        self._constant = True
        self._shared: Array | None = None
        for each in crossings:
            self._constant &= each.motion.joint.count == 1
        if len(crossings) > 1:
            sources = [each.source for each in crossings]
            distinct = sorted(set(sources))
            if len(distinct) < len(sources):
                same = np.array([[float(mine == each) for mine in sources] for each in distinct])
                self._shared = np.kron(same, np.eye(6))

    @classmethod
    def along(cls, edges: Sequence[Edge]) -> PathCovariance:
        """Return that of a path given by its edges; each segment's base is its first frame."""
        fixed: list[FixedEdge] = []
        segments: list[int] = []
        crossings: list[Crossing] = []
        is_stated = True
        number = 0
        pose = Pose.identity()
        for edge in edges:
            behind = pose if edge.joint is not None else pose @ (edge.pose if edge.forward else edge.pose.inverse())
            if edge.joint is not None:
                segment = number if edge.forward else number + 1
                # the frame that the motion starts from is the last of this segment, or the first of the next
                motion = JointMotion.at(edge.joint, pose if edge.forward else Pose.identity())
                crossings.append(Crossing(motion, segment, 1.0 if edge.forward else -1.0, edge.leader or edge.name))
                number += 1
                behind = Pose.identity()
            elif edge.sigma is not None:
                X_F, X_T = (pose, behind) if edge.forward else (behind, pose)
                fixed.append(FixedEdge(X_F.wxyz, X_T.xyz, edge.sigma))
                segments.append(number)
            elif edge.is_unstated:
                is_stated = False
            pose = behind
        blocks = np.concatenate((motion_factors(fixed), *[each.motion.block[None] for each in crossings]))
        return cls(blocks, segments, crossings, is_stated)

    def at(
        self, bases: Sequence[Place], far: Vector3, positions: Sequence[Coordinates], sigmas: Sequence[Coordinates]
    ) -> Array:
        """Return the covariance (6, 6) of the far end, along the axes of the frame of reference.

        Parameters: `bases` are the places of the segments' bases in the frame of reference, `far` the position of the
        far end there; `positions` and `sigmas` those of the joints' coordinates, nan counts as exact.
        """
        x, y, z = far
        # half the cost of np.array of nested tuples
        numbers = [_NUMBERS.pack(*transport_columns(q, (x - p[0], y - p[1], z - p[2]))) for p, q in bases]
        transports = np.frombuffer(b"".join(numbers)).reshape(-1, 6, 6)
        blocks = self._blocks
        if len(numbers) == 1:
            rows = blocks.reshape(-1, 6) @ transports[0]
            return np.asarray(rows.T @ rows)
        fixed = len(blocks) - len(self._crossings)
        if not self._constant:
            moved = [each.motion.at_position(where) for each, where in zip(self._crossings, positions, strict=True)]
            blocks = np.concatenate((blocks[:fixed], moved))
        # here, not in the blocks: the sigmas are those of the readings
        scales = []
        for crossing, leg in zip(self._crossings, sigmas, strict=True):
            sign = crossing.sign
            scale = [0.0 if sigma != sigma else sign * sigma for sigma in leg]
            scales += scale + [0.0] * (6 - len(scale))
        rows = (blocks @ transports.take(self._segments, axis=0)).reshape(-1, 6)
        rows[6 * fixed :] *= np.array(scales)[:, None]
        if self._shared is not None:
            rows = np.concatenate((rows[: 6 * fixed], self._shared @ rows[6 * fixed :]))
        return np.asarray(rows.T @ rows)


def motion_factors(edges: Sequence[FixedEdge]) -> Array:
    """Return for each edge its block (6, 6): row i is the motion (v, w) that standard deviation i makes in the base."""
    blocks = np.zeros((len(edges), 6, 6))
    if edges:
        # (n, 3, 3), axes of F as rows
        axes = np.array([so3.matrix_rows(each.orientation) for each in edges]).transpose(0, 2, 1)
        p_T = np.array([each.position for each in edges])
        turns = axes * np.array([each.sigma.rotation for each in edges])[:, :, None]
        blocks[:, :3, :3] = axes * np.array([each.sigma.position for each in edges])[:, :, None]
        blocks[:, 3:, :3] = np.cross(p_T[:, None], turns)
        blocks[:, 3:, 3:] = turns
    return blocks


def transport_columns(q: Quaternion, r: Vector3) -> tuple[float, ...]:
    """Return the 36 numbers of the transposed [[R, -[r]x R], [0, R]]: takes rows (v, w) to the far end `r` from B."""
    (a, b, c), (d, e, f), (g, h, i) = so3.matrix_rows(q)
    x, y, z = r
    # fmt: off
    return (
        a, d, g, 0.0, 0.0, 0.0,
        b, e, h, 0.0, 0.0, 0.0,
        c, f, i, 0.0, 0.0, 0.0,
        z * d - y * g, x * g - z * a, y * a - x * d, a, d, g,
        z * e - y * h, x * h - z * b, y * b - x * e, b, e, h,
        z * f - y * i, x * i - z * c, y * c - x * f, c, f, i,
    )
    # fmt: on

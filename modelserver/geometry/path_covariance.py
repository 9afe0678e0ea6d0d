"""Covariance of a path: how the uncertainty of surveys and joints adds up at its far end.

Theory of operation. A path consists of rigid segments with a joint between each and the next. A perturbation (dp,
dtheta) of an edge X_FT, along the axes of F, is a small motion of everything behind it: at the far end N of the path

    v = R_F dp + (R_F dtheta) x (p_N - p_T),   w = R_F dtheta

with R_F the orientation of F and p_T the position of T in the base frame of the segment. Each fixed edge keeps p_T,
P = R_F diag(sigma_p^2) R_F' and W = R_F diag(sigma_r^2) R_F' in the base: `EdgeCovariance`. With r = p_N - p_T, its
share is

    cov(v) = P + [r]x W [r]x',   cov(v, w) = -[r]x W,   cov(w) = W

These are summed over the edges of a segment, then turned to the axes of the frame of reference. Every edge has its own
lever, so nothing of a common ancestor is subtracted and no long lever to a distant base cancels after it was squared.
The result is that of `spatial.chain.covariance`, which carries every edge by itself from frame to frame.

A joint's motion is written in the segment that contains its F frame, the frame that the motion starts from. The sign of
an edge that is passed backward matters only where two joints share an error (one follows the other): those are added
before they are squared.

All of it is plain floats. A service sleeps between two requests and runs with cold caches, where a call of numpy on 6x6
costs 5 to 8 us, and a hundred multiplications in Python 2 us (measured).
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import add
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from modelserver.geometry.joint import Coordinates, Joint
from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array, Quaternion, Vector3

if TYPE_CHECKING:
    from modelserver.geometry.parts import Sigma
    from modelserver.geometry.route import Edge

Place: TypeAlias = tuple[Vector3, Quaternion]
"""Position and orientation of a frame, as plain floats."""

EdgeCovariance: TypeAlias = tuple[Vector3, tuple[float, ...], float | tuple[float, ...]]
"""p_T (3), and the upper triangles (6) of P and W, of a fixed edge in the base of its segment.

W is one variance where it is the same about all axes, as most surveys state it: half the work.
"""

Twists: TypeAlias = list[tuple[Vector3, Vector3]]
"""Small motions (v, w)."""


class JointMotion(NamedTuple):
    """How a joint moves the segment behind it; `X_BF` is the pose of its F frame in the base of its segment.

    `twists` are those of a joint with one coordinate, the same at every position.
    """

    joint: Joint
    X_BF: Pose
    twists: Twists

    @classmethod
    def at(cls, joint: Joint, X_BF: Pose) -> JointMotion:
        """Return the motion of a joint at a pose."""
        found = cls(joint, X_BF, [])
        return found._replace(twists=found.at_position((0.0,) * joint.count))

    def at_position(self, position: Coordinates) -> Twists:
        """Return for each coordinate the motion that a unit of it makes, at the base's origin and along its axes."""
        J = self.joint.jacobian(position)
        x, y, z = self.X_BF.xyz
        mx, my, mz = so3.rotate(self.X_BF.wxyz, self.joint.motion(position).xyz)
        twists = []
        for column in J.T.tolist():
            v = so3.rotate(self.X_BF.wxyz, (column[0], column[1], column[2]))
            w = so3.rotate(self.X_BF.wxyz, (column[3], column[4], column[5]))
            # the Jacobian is that of the place where the joint has moved to
            a, b, c = so3.cross((x + mx, y + my, z + mz), w)
            twists.append(((v[0] + a, v[1] + b, v[2] + c), w))
        return twists


class JointCrossing(NamedTuple):
    """A joint on a path: its motion, in the base of segment number `segment`; `sign` -1.0 where passed from T to F.

    `source` names where its error comes from: joints of one source err together.
    """

    motion: JointMotion
    segment: int
    sign: float
    source: str


class PathCovariance:
    """Covariance of the far end of a path, for any position of its joints; see the module.

    `segments` holds the fixed edges of each rigid segment, `crossings` the joints between them. `is_stated` is false
    where an edge states no sigma, and counts as exact here.
    """

    __slots__ = ("_joints", "_segments", "_shared", "is_stated")

    def __init__(
        self,
        segments: Sequence[Sequence[EdgeCovariance]],
        crossings: Sequence[JointCrossing] = (),
        is_stated: bool = True,
    ):
        self.is_stated = is_stated
        self._segments = segments
        # the joints of each segment with their numbers on the path
        self._joints: list[list[tuple[int, JointCrossing]]] = [[] for _ in segments]
        for number, each in enumerate(crossings):
            self._joints[each.segment].append((number, each))
        sources = [each.source for each in crossings]
        self._shared = {source for source in sources if sources.count(source) > 1}

    @classmethod
    def along(cls, edges: Sequence[Edge]) -> PathCovariance:
        """Return that of a path given by its edges; each segment's base is its first frame."""
        segments: list[list[EdgeCovariance]] = [[]]
        crossings: list[JointCrossing] = []
        is_stated = True
        pose = Pose.identity()
        for edge in edges:
            if edge.joint is not None:
                number = len(crossings)
                # the frame that the motion starts from is the last of this segment, or the first of the next
                motion = JointMotion.at(edge.joint, pose if edge.forward else Pose.identity())
                at, sign = (number, 1.0) if edge.forward else (number + 1, -1.0)
                crossings.append(JointCrossing(motion, at, sign, edge.leader or edge.name))
                segments.append([])
                pose = Pose.identity()
                continue
            behind = pose @ (edge.pose if edge.forward else edge.pose.inverse())
            if edge.sigma is not None:
                X_F, X_T = (pose, behind) if edge.forward else (behind, pose)
                segments[-1].append(edge_covariance(X_F.wxyz, X_T.xyz, edge.sigma))
            is_stated &= not edge.is_unstated
            pose = behind
        return cls(segments, crossings, is_stated)

    def at(
        self, bases: Sequence[Place], far: Vector3, positions: Sequence[Coordinates], sigmas: Sequence[Coordinates]
    ) -> tuple[float, ...]:
        """Return the covariance of the far end along the axes of the frame of reference: 36 numbers, row by row.

        Parameters: `bases` are the places of the segments' bases in the frame of reference, `far` the position of the
        far end there; `positions` and `sigmas` those of the joints' coordinates, nan counts as exact.
        """
        total = _ZERO
        shared: dict[tuple[str, int], tuple[float, ...]] = {}
        for edges, joints, ((x, y, z), q) in zip(self._segments, self._joints, bases, strict=True):
            if not edges and not joints:
                continue
            x, y, z = far[0] - x, far[1] - y, far[2] - z
            R = so3.matrix_rows(q)
            (a, b, c), (d, e, f), (g, h, i) = R
            # the far end in the base
            p_N = (a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z)
            numbers = sum_at(edges, p_N) if edges else _ZERO
            for index, crossing in joints:
                motion, sign, source = crossing.motion, crossing.sign, crossing.source
                twists = motion.twists if motion.joint.count == 1 else motion.at_position(positions[index])
                for coordinate, ((vx, vy, vz), w) in enumerate(twists):
                    s = sigmas[index][coordinate] * sign
                    if s != s:
                        continue
                    wx, wy, wz = w
                    a, b, c = so3.cross(w, p_N)
                    v, w = (s * (vx + a), s * (vy + b), s * (vz + c)), (s * wx, s * wy, s * wz)
                    if source not in self._shared:
                        numbers = add_square(numbers, (*v, *w))
                        continue
                    # along the axes of the reference, where it meets the others of its source
                    twist = (*so3.rotate(q, v), *so3.rotate(q, w))
                    known = shared.get((source, coordinate))
                    shared[source, coordinate] = twist if known is None else tuple(map(add, known, twist))
            numbers = rotate_axes(numbers, R)
            total = numbers if total is _ZERO else tuple(map(add, total, numbers))
        for sum_of_source in shared.values():
            total = add_square(total, sum_of_source)
        return expand(total)


def edge_covariance(q_F: Quaternion, p_T: Vector3, sigma: Sigma) -> EdgeCovariance:
    """Return what a fixed edge keeps: orientation of F and position of T are those in the base of its segment."""
    R = np.array(so3.matrix_rows(q_F))
    upper = np.triu_indices(3)
    P, W = ((R * np.square(each)) @ R.T for each in (sigma.position, sigma.rotation))
    about_x, about_y, about_z = sigma.rotation
    same = about_x == about_y == about_z
    return p_T, tuple(P[upper].tolist()), about_x * about_x if same else tuple(W[upper].tolist())


def sum_at(edges: Sequence[EdgeCovariance], far: Vector3) -> tuple[float, ...]:
    """Return the sum of the edges' shares at a point of their base, along its axes: 21 numbers.

    They are the upper triangle of cov(v), all of cov(v, w) row by row, and the upper triangle of cov(w).
    """
    px, py, pz = far
    vxx = vxy = vxz = vyy = vyz = vzz = 0.0
    cxx = cxy = cxz = cyx = cyy = cyz = czx = czy = czz = 0.0
    wxx = wxy = wxz = wyy = wyz = wzz = 0.0
    for (x, y, z), (Pxx, Pxy, Pxz, Pyy, Pyz, Pzz), W in edges:
        x, y, z = px - x, py - y, pz - z
        if not isinstance(W, tuple):
            xW, yW, zW = x * W, y * W, z * W
            vxx += Pxx + y * yW + z * zW
            vxy += Pxy - x * yW
            vxz += Pxz - x * zW
            vyy += Pyy + x * xW + z * zW
            vyz += Pyz - y * zW
            vzz += Pzz + x * xW + y * yW
            cxy += zW
            cxz -= yW
            cyx -= zW
            cyz += xW
            czx += yW
            czy -= xW
            wxx += W
            wyy += W
            wzz += W
            continue
        a, b, c, d, e, f = W
        # [r]x W
        sxx, sxy, sxz = y * c - z * b, y * e - z * d, y * f - z * e
        syx, syy, syz = z * a - x * c, z * b - x * e, z * c - x * f
        szx, szy, szz = x * b - y * a, x * d - y * b, x * e - y * c
        vxx += Pxx + y * sxz - z * sxy
        vxy += Pxy + z * sxx - x * sxz
        vxz += Pxz + x * sxy - y * sxx
        vyy += Pyy + z * syx - x * syz
        vyz += Pyz + x * syy - y * syx
        vzz += Pzz + x * szy - y * szx
        cxx -= sxx
        cxy -= sxy
        cxz -= sxz
        cyx -= syx
        cyy -= syy
        cyz -= syz
        czx -= szx
        czy -= szy
        czz -= szz
        wxx += a
        wxy += b
        wxz += c
        wyy += d
        wyz += e
        wzz += f
    return (
        vxx, vxy, vxz, vyy, vyz, vzz, cxx, cxy, cxz, cyx, cyy, cyz, czx, czy, czz, wxx, wxy, wxz, wyy, wyz, wzz
    )  # fmt: skip


def rotate_axes(numbers: tuple[float, ...], R: tuple[Vector3, Vector3, Vector3]) -> tuple[float, ...]:
    """Return the 21 numbers of `sum_at` along other axes: R cov R' for each block, R from the old to the new."""
    (a, b, c), (d, e, f), (g, h, i) = R
    vxx, vxy, vxz, vyy, vyz, vzz, cxx, cxy, cxz, cyx, cyy, cyz, czx, czy, czz, wxx, wxy, wxz, wyy, wyz, wzz = numbers
    # R times each block
    v0, v1, v2 = a * vxx + b * vxy + c * vxz, a * vxy + b * vyy + c * vyz, a * vxz + b * vyz + c * vzz
    v3, v4, v5 = d * vxx + e * vxy + f * vxz, d * vxy + e * vyy + f * vyz, d * vxz + e * vyz + f * vzz
    v6, v7, v8 = g * vxx + h * vxy + i * vxz, g * vxy + h * vyy + i * vyz, g * vxz + h * vyz + i * vzz
    c0, c1, c2 = a * cxx + b * cyx + c * czx, a * cxy + b * cyy + c * czy, a * cxz + b * cyz + c * czz
    c3, c4, c5 = d * cxx + e * cyx + f * czx, d * cxy + e * cyy + f * czy, d * cxz + e * cyz + f * czz
    c6, c7, c8 = g * cxx + h * cyx + i * czx, g * cxy + h * cyy + i * czy, g * cxz + h * cyz + i * czz
    w0, w1, w2 = a * wxx + b * wxy + c * wxz, a * wxy + b * wyy + c * wyz, a * wxz + b * wyz + c * wzz
    w3, w4, w5 = d * wxx + e * wxy + f * wxz, d * wxy + e * wyy + f * wyz, d * wxz + e * wyz + f * wzz
    w6, w7, w8 = g * wxx + h * wxy + i * wxz, g * wxy + h * wyy + i * wyz, g * wxz + h * wyz + i * wzz
    # fmt: off
    return (
        v0 * a + v1 * b + v2 * c, v0 * d + v1 * e + v2 * f, v0 * g + v1 * h + v2 * i,
        v3 * d + v4 * e + v5 * f, v3 * g + v4 * h + v5 * i, v6 * g + v7 * h + v8 * i,
        c0 * a + c1 * b + c2 * c, c0 * d + c1 * e + c2 * f, c0 * g + c1 * h + c2 * i,
        c3 * a + c4 * b + c5 * c, c3 * d + c4 * e + c5 * f, c3 * g + c4 * h + c5 * i,
        c6 * a + c7 * b + c8 * c, c6 * d + c7 * e + c8 * f, c6 * g + c7 * h + c8 * i,
        w0 * a + w1 * b + w2 * c, w0 * d + w1 * e + w2 * f, w0 * g + w1 * h + w2 * i,
        w3 * d + w4 * e + w5 * f, w3 * g + w4 * h + w5 * i, w6 * g + w7 * h + w8 * i,
    )
    # fmt: on


def add_square(numbers: tuple[float, ...], twist: tuple[float, ...]) -> tuple[float, ...]:
    """Return the 21 numbers with those of the small motion (v, w) that one standard deviation makes added."""
    a, b, c, d, e, f = twist
    vxx, vxy, vxz, vyy, vyz, vzz, cxx, cxy, cxz, cyx, cyy, cyz, czx, czy, czz, wxx, wxy, wxz, wyy, wyz, wzz = numbers
    # fmt: off
    return (
        vxx + a * a, vxy + a * b, vxz + a * c, vyy + b * b, vyz + b * c, vzz + c * c,
        cxx + a * d, cxy + a * e, cxz + a * f,
        cyx + b * d, cyy + b * e, cyz + b * f,
        czx + c * d, czy + c * e, czz + c * f,
        wxx + d * d, wxy + d * e, wxz + d * f, wyy + e * e, wyz + e * f, wzz + f * f,
    )
    # fmt: on


def expand(numbers: tuple[float, ...]) -> tuple[float, ...]:
    """Return all 36 numbers of the covariance whose 21 `sum_at` gives."""
    vxx, vxy, vxz, vyy, vyz, vzz, cxx, cxy, cxz, cyx, cyy, cyz, czx, czy, czz, wxx, wxy, wxz, wyy, wyz, wzz = numbers
    # fmt: off
    return (
        vxx, vxy, vxz, cxx, cxy, cxz,
        vxy, vyy, vyz, cyx, cyy, cyz,
        vxz, vyz, vzz, czx, czy, czz,
        cxx, cyx, czx, wxx, wxy, wxz,
        cxy, cyy, czy, wxy, wyy, wyz,
        cxz, cyz, czz, wxz, wyz, wzz,
    )
    # fmt: on


def as_array(numbers: tuple[float, ...]) -> Array:
    """Return 36 numbers as a matrix (6, 6)."""
    return np.array(numbers).reshape(6, 6)


_ZERO: Final[tuple[float, ...]] = (0.0,) * 21

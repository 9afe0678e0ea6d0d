"""Covariance of a kinematic path: the sum of the uncertainties of surveys and joints at its far end.

A path consists of rigid segments with a joint between each and the next. A perturbation (dp, dtheta) of an edge X_FT,
along the axes of F, is a small motion of everything behind it; at the far end N of the path

    v = R_F dp + (R_F dtheta) x (p_N - p_T),   w = R_F dtheta

with R_F the orientation of F and p_T the position of T in the base frame of the segment. Each fixed edge stores p_T,
P = R_F diag(sigma_p^2) R_F' and W = R_F diag(sigma_r^2) R_F' in the base: `EdgeCovariance`. With the lever arm
r = p_N - p_T, its share is

    cov(v) = P + [r]x W [r]x',   cov(v, w) = -[r]x W,   cov(w) = W

These are summed over the edges of a segment, along the axes of the frame of reference. Every edge has its own lever
arm, so nothing is subtracted, and no precision is lost where the base is far away. The result is that of
`transforms.chain.covariance`, which transports the covariance of every edge from frame to frame.

Most surveys state one variance for all axes. Such a P or W is the same along any axes; only r has to be rotated. With a
scalar W, cov(v, w) = -W [r]x is a vector, and the sum over such edges is 10 numbers (`Isotropic`) instead of 21.

A joint's Jacobian is expressed in the segment that contains its F frame. The twists of one source (mimic joints share
it) are added, with their signs, along the axes of the reference before they are squared.

All of it is plain floats: after a server wakes with cold caches, a numpy call on 6x6 costs 5 to 8 us, and a hundred
multiplications in Python 2 us (measured).
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import add
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from modelserver.geometry.joint import Coordinates, Joint
from modelserver.geometry.parts import Sigma
from modelserver.geometry.topology import Edge
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array, Quaternion, Vector3

PlainPose: TypeAlias = tuple[Vector3, Quaternion]
"""Position and orientation of a frame, as plain floats."""

Variance: TypeAlias = float | tuple[float, ...]
"""Covariance (3, 3): a scalar where it is the same along all axes, else its upper triangle (6)."""

EdgeCovariance: TypeAlias = tuple[Vector3, Variance, Variance]
"""p_T (3), P and W of a fixed edge in the base of its segment."""

Isotropic: TypeAlias = tuple[float, ...]
"""Sum over edges whose rotation variance W is a scalar: 10 numbers.

They are the upper triangle of cov(v), s = sum of W r with cov(v, w) = -[s]x, and w = sum of W with cov(w) = w I.
"""

Twists: TypeAlias = list[tuple[Vector3, Vector3]]
"""Small motions (v, w)."""


class JointJacobian(NamedTuple):
    """The Jacobian of a joint at the base of its segment; `X_BF` is the pose of its F frame in the base.

    `twists` are those of a joint with one coordinate, the same at every position.
    """

    joint: Joint
    X_BF: Pose
    twists: Twists

    @classmethod
    def at(cls, joint: Joint, X_BF: Pose) -> JointJacobian:
        found = cls(joint, X_BF, [])
        return found._replace(twists=found.compute_twists((0.0,) * joint.count))

    def compute_twists(self, position: Coordinates) -> Twists:
        """Return for each coordinate the twist at unit rate, at the base's origin and along its axes."""
        J = self.joint.jacobian(position)
        x, y, z = self.X_BF.xyz
        mx, my, mz = so3.rotate(self.X_BF.wxyz, self.joint.compute_pose(position).xyz)
        twists = []
        for column in J.T.tolist():
            v = so3.rotate(self.X_BF.wxyz, (column[0], column[1], column[2]))
            w = so3.rotate(self.X_BF.wxyz, (column[3], column[4], column[5]))
            # the Jacobian is that of the displaced origin
            a, b, c = so3.cross((x + mx, y + my, z + mz), w)
            twists.append(((v[0] + a, v[1] + b, v[2] + c), w))
        return twists


class PathCovariance:
    """Covariance of the far end of a path, for any position of its joints; see the module.

    Edges and joints are added in the order of the path. `is_complete` is false where an edge states no sigma, and
    counts as exact here.
    """

    __slots__ = ("_joints", "_segments", "is_complete")

    def __init__(self) -> None:
        self.is_complete = True
        self._segments: list[list[EdgeCovariance]] = [[]]
        # for each segment number, Jacobian, sign and source of the joints whose F frame is in it
        self._joints: list[list[tuple[int, JointJacobian, float, str]]] = [[]]

    def add_edge(self, covariance: EdgeCovariance) -> None:
        """Add a fixed edge, with its covariance in the base of the last segment."""
        self._segments[-1].append(covariance)

    def add_joint(self, jacobian: JointJacobian, edge: Edge) -> None:
        """Add a joint and the segment behind it. Joints that follow one leader have common errors."""
        number = len(self._segments) - 1
        self._segments.append([])
        self._joints.append([])
        # F is before the joint where it is passed forward, else behind it, where it has the opposite sign
        segment, sign = (number, 1.0) if edge.forward else (number + 1, -1.0)
        self._joints[segment].append((number, jacobian, sign, edge.leader or edge.name))

    @classmethod
    def from_edges(cls, edges: Sequence[Edge]) -> PathCovariance:
        """Return that of a path given by its edges; each segment's base is its first frame."""
        found = cls()
        pose = Pose.identity()
        for edge in edges:
            if edge.joint is not None:
                found.add_joint(JointJacobian.at(edge.joint, pose if edge.forward else Pose.identity()), edge)
                pose = Pose.identity()
                continue
            behind = pose @ edge.step
            if edge.sigma is not None:
                X_F, X_T = (pose, behind) if edge.forward else (behind, pose)
                found.add_edge(edge_covariance(X_F.wxyz, X_T.xyz, edge.sigma))
            found.is_complete &= not edge.is_sigma_missing
            pose = behind
        return found

    def compute(
        self, bases: Sequence[PlainPose], far: Vector3, positions: Sequence[Coordinates], sigmas: Sequence[Coordinates]
    ) -> tuple[float, ...]:
        """Return the covariance of the far end along the axes of the frame of reference: 36 numbers, row by row.

        Parameters
        ----------
        bases : poses of the segments' bases in the frame of reference
        far : position of the far end there, meters
        positions, sigmas : of the joints' coordinates; a sigma of nan counts as exact
        """
        isotropic = _NONE
        others: tuple[float, ...] | None = None
        twists: dict[tuple[str, int], tuple[float, ...]] = {}
        for edges, joints, (base, q) in zip(self._segments, self._joints, bases, strict=True):
            # from the base to the far end, along the axes of the reference
            lever = (far[0] - base[0], far[1] - base[1], far[2] - base[2])
            if edges:
                isotropic, rest = add_edges(isotropic, edges, lever, q)
                if rest is not None:
                    others = rest if others is None else tuple(map(add, others, rest))
            for index, motion, sign, source in joints:
                units = motion.twists if motion.joint.count == 1 else motion.compute_twists(positions[index])
                for coordinate, (v, w) in enumerate(units):
                    s = sigmas[index][coordinate] * sign
                    if s != s:
                        continue
                    vx, vy, vz = so3.rotate(q, v)
                    wx, wy, wz = w = so3.rotate(q, w)
                    a, b, c = so3.cross(w, lever)
                    twist: tuple[float, ...] = (s * (vx + a), s * (vy + b), s * (vz + c), s * wx, s * wy, s * wz)
                    known = twists.get((source, coordinate))
                    twists[source, coordinate] = twist if known is None else tuple(map(add, known, twist))
        numbers = to_upper_triangle(isotropic)
        if others is not None:
            numbers = tuple(map(add, numbers, others))
        for twist in twists.values():
            numbers = add_square(numbers, twist)
        return expand(numbers)


def edge_covariance(q_F: Quaternion, p_T: Vector3, sigma: Sigma) -> EdgeCovariance:
    """Return the stored covariance of a fixed edge, from the pose of its frames in the base of its segment."""
    R = np.array(so3.matrix_rows(q_F))
    return p_T, _variance(sigma.position, R), _variance(sigma.rotation, R)


def _variance(sigma: Vector3, R: Array) -> Variance:
    x, y, z = sigma
    if x == y == z:
        return x * x
    numbers: list[float] = ((R * np.square(sigma)) @ R.T)[np.triu_indices(3)].tolist()
    return tuple(numbers)


def covariance_at(edges: Sequence[EdgeCovariance], lever: Vector3, q: Quaternion) -> tuple[float, ...]:
    """Return the covariance that the edges make at a point: 36 numbers; parameters as in `add_edges`."""
    isotropic, others = add_edges(_NONE, edges, lever, q)
    numbers = to_upper_triangle(isotropic)
    return expand(numbers if others is None else tuple(map(add, numbers, others)))


def add_edges(
    isotropic: Isotropic, edges: Sequence[EdgeCovariance], lever: Vector3, q: Quaternion
) -> tuple[Isotropic, tuple[float, ...] | None]:
    """Return the sum plus the shares of a segment's edges, and the sum of those with a matrix W.

    `lever` leads from the base to the far end along the axes of the reference, `q` rotates from the base's axes to
    them. The second is None where there is no such edge, else 21 numbers: see `sum_anisotropic`.
    """
    (a, b, c), (d, e, f), (g, h, i) = R = so3.matrix_rows(q)
    lx, ly, lz = lever
    vxx, vxy, vxz, vyy, vyz, vzz, sx, sy, sz, w = isotropic
    others: list[EdgeCovariance] = []
    for edge in edges:
        (x, y, z), P, W = edge
        if isinstance(W, tuple):
            others.append(edge)
            continue
        x, y, z = lx - a * x - b * y - c * z, ly - d * x - e * y - f * z, lz - g * x - h * y - i * z
        xW, yW, zW = x * W, y * W, z * W
        sx += xW
        sy += yW
        sz += zW
        w += W
        vxy -= x * yW
        vxz -= x * zW
        vyz -= y * zW
        xx, yy, zz = x * xW, y * yW, z * zW
        if isinstance(P, tuple):
            Pxx, Pxy, Pxz, Pyy, Pyz, Pzz = rotate_symmetric(P, R)
            vxx += Pxx + yy + zz
            vyy += Pyy + xx + zz
            vzz += Pzz + xx + yy
            vxy += Pxy
            vxz += Pxz
            vyz += Pyz
        else:
            vxx += P + yy + zz
            vyy += P + xx + zz
            vzz += P + xx + yy
    isotropic = (vxx, vxy, vxz, vyy, vyz, vzz, sx, sy, sz, w)
    return isotropic, sum_anisotropic(others, lever, R) if others else None


def sum_anisotropic(
    edges: Sequence[EdgeCovariance], lever: Vector3, R: tuple[Vector3, Vector3, Vector3]
) -> tuple[float, ...]:
    """Return the sum of the shares of edges whose W is a matrix: 21 numbers; parameters as in `add_edges`.

    They are the upper triangle of cov(v), all of cov(v, w) row by row, and the upper triangle of cov(w).
    """
    vxx = vxy = vxz = vyy = vyz = vzz = 0.0
    cxx = cxy = cxz = cyx = cyy = cyz = czx = czy = czz = 0.0
    wxx = wxy = wxz = wyy = wyz = wzz = 0.0
    for (x, y, z), P, W in edges:
        Pxx, Pxy, Pxz, Pyy, Pyz, Pzz = rotate_symmetric(P, R) if isinstance(P, tuple) else (P, 0.0, 0.0, P, 0.0, P)
        a, b, c, d, e, f = rotate_symmetric(W, R) if isinstance(W, tuple) else (W, 0.0, 0.0, W, 0.0, W)
        x, y, z = (u - row[0] * x - row[1] * y - row[2] * z for u, row in zip(lever, R, strict=True))
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


def rotate_symmetric(numbers: tuple[float, ...], R: tuple[Vector3, Vector3, Vector3]) -> tuple[float, ...]:
    """Return R M R' of a symmetric M (3, 3), as upper triangles (6)."""
    (a, b, c), (d, e, f), (g, h, i) = R
    xx, xy, xz, yy, yz, zz = numbers
    # R M
    m0, m1, m2 = a * xx + b * xy + c * xz, a * xy + b * yy + c * yz, a * xz + b * yz + c * zz
    m3, m4, m5 = d * xx + e * xy + f * xz, d * xy + e * yy + f * yz, d * xz + e * yz + f * zz
    m6, m7, m8 = g * xx + h * xy + i * xz, g * xy + h * yy + i * yz, g * xz + h * yz + i * zz
    # fmt: off
    return (
        m0 * a + m1 * b + m2 * c, m0 * d + m1 * e + m2 * f, m0 * g + m1 * h + m2 * i,
        m3 * d + m4 * e + m5 * f, m3 * g + m4 * h + m5 * i, m6 * g + m7 * h + m8 * i,
    )
    # fmt: on


def to_upper_triangle(numbers: Isotropic) -> tuple[float, ...]:
    """Return an isotropic sum as the 21 numbers of `sum_anisotropic`."""
    vxx, vxy, vxz, vyy, vyz, vzz, sx, sy, sz, w = numbers
    # fmt: off
    return (
        vxx, vxy, vxz, vyy, vyz, vzz,
        0.0, sz, -sy,
        -sz, 0.0, sx,
        sy, -sx, 0.0,
        w, 0.0, 0.0, w, 0.0, w,
    )
    # fmt: on


def add_square(numbers: tuple[float, ...], twist: tuple[float, ...]) -> tuple[float, ...]:
    """Return the 21 numbers plus those of the outer product of the twist (v, w) at one standard deviation."""
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
    """Return all 36 numbers of the covariance given by the 21 of `sum_anisotropic`."""
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


_NONE: Final[Isotropic] = (0.0,) * 10

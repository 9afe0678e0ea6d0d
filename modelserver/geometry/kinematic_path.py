"""Kinematic paths between frames, and the frame tree that assembles them.

A `KinematicPath` folds everything rigid between two joints into one pose, so that the cost of a lookup depends on the
movable joints alone. It provides forward kinematics (`compute_joint_poses`), the covariance of the far end
(`PathCovariance`) and the single edges, for explanations.

The `FrameTree` makes the path between any pair of frames cheap. The bodies of an assembly are traversed breadth-first
from its first body. A body's origin, each of its frames that is not there by definition, and each far end of a
constraint or joint are nodes; the edge of a node leads down to it from its parent. Nodes with no movable joint between
them form a group, and each node stores its pose in the group's root node. The path between two frames climbs from both
to the lowest common ancestor. The transform between two frames of one group is a product of two stored poses; its
covariance is the sum over the edges between them, with the group's root as base. A path through joints has a segment
for each group.

The tree is built once for a model: memory and time are linear in its frames, and nothing is stored for pairs. Limit: in
an assembly with a loop shortest paths form no tree; there the model searches them (`Model.get_kinematic_path`).

The covariance is the sum of the uncertainties of surveys and joints at the far end of the path. A path consists of
rigid segments with a joint between each and the next. A perturbation (dp, dtheta) of an edge X_FT, along the axes of F,
is a small motion of everything behind it; at the far end N of the path

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

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import add
from typing import Final, NamedTuple, Self, TypeAlias

import numpy as np

from modelserver.geometry import names
from modelserver.geometry.joint import Coordinates, Joint, JointType
from modelserver.geometry.parts import Body, Sigma
from modelserver.geometry.topology import Crossing, Edge, EdgeKind, Topology, list_crossing_edges
from modelserver.transforms import so3
from modelserver.transforms.chain import ChainLink
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


# --- paths and the frame tree -----------------------------------------------------------------------------------------


class PathJoint(NamedTuple):
    """A joint on a path: `before` leads to it from the previous joint, or from the frame of reference."""

    before: Pose
    name: str
    joint: Joint
    forward: bool
    limits: tuple[float, float] | None = None
    """Limits of a joint with one coordinate, widened by the tolerance."""
    half_angle_factors: tuple[Quaternion, Quaternion] | None = None
    """For a revolute joint a, b, so that `before` times the rotation by t is a cos(t / 2) + b sin(t / 2)."""

    @classmethod
    def of(cls, before: Pose, edge: Edge) -> PathJoint:
        """Return the path joint of the edge of a movable joint."""
        assert edge.joint is not None
        factors = None
        if edge.joint.type is JointType.REVOLUTE:
            x, y, z = edge.joint.axis
            axis = (0.0, x, y, z) if edge.forward else (0.0, -x, -y, -z)
            factors = (before._q, so3.multiply(before._q, axis))
        return cls(before, edge.name, edge.joint, edge.forward, edge.joint.limits, factors)


class KinematicPath:
    """The path from `frame_of_reference` to `frame_of_interest`; immutable by convention.

    `joints` are the movable joints on it, `last` leads from the last of them to the frame of interest. `is_in_loop`:
    there is another path, and this is the shortest.
    """

    __slots__ = ("_bases", "_covariance", "_edges", "is_in_loop", "joints", "last")

    def __init__(
        self,
        joints: Sequence[PathJoint],
        last: Pose,
        bases: Sequence[Pose | None],
        edges: Callable[[], tuple[Edge, ...]],
        covariance: Callable[[], PathCovariance],
        is_in_loop: bool = False,
    ):
        """Create a path from its parts; `from_edges` does from the edges of any path.

        `bases` holds for each rigid segment the pose of its base in its first frame, None for the identity; `edges` and
        `covariance` are called when first needed.
        """
        self.is_in_loop = is_in_loop
        self.joints = tuple(joints)
        self.last = last
        self._bases = bases
        self._edges: tuple[Edge, ...] | Callable[[], tuple[Edge, ...]] = edges
        self._covariance: PathCovariance | Callable[[], PathCovariance] = covariance

    @classmethod
    def from_edges(cls, edges: Sequence[Edge], is_in_loop: bool = False) -> Self:
        """Return the path of some edges, folded."""
        joints: list[PathJoint] = []
        pose = Pose.identity()
        for edge in edges:
            if edge.joint is not None:
                joints.append(PathJoint.of(pose, edge))
                pose = Pose.identity()
            else:
                pose = pose @ edge.step
        bases = (None,) * (len(joints) + 1)
        return cls(joints, pose, bases, lambda: tuple(edges), partial(PathCovariance.from_edges, edges), is_in_loop)

    @property
    def edges(self) -> tuple[Edge, ...]:
        """The edges from the frame of reference to the frame of interest."""
        found = self._edges
        if not isinstance(found, tuple):
            found = self._edges = found()
        return found

    @property
    def default_positions(self) -> tuple[Coordinates, ...]:
        return tuple([item.joint.default_position for item in self.joints])

    def compute_joint_poses(self, positions: Sequence[Coordinates]) -> list[PlainPose]:
        """Compute the forward kinematics: poses of the reference, of the frame behind each joint, of the interest.

        All are in the frame of reference, with each joint at its position. Quaternions are of unit length up to
        rounding.
        """
        px, py, pz = 0.0, 0.0, 0.0
        q = so3.IDENTITY
        poses: list[PlainPose] = [((px, py, pz), q)]
        for item, position in zip(self.joints, positions, strict=True):
            factors = item.half_angle_factors
            if q is so3.IDENTITY:
                # the first joint starts from the frame of reference itself
                px, py, pz = item.before._p
            else:
                x, y, z = so3.rotate(q, item.before._p)
                px, py, pz = px + x, py + y, pz + z
            if factors is not None:
                # revolute joints are by far the most frequent
                half = 0.5 * position[0]
                c, s = math.cos(half), math.sin(half)
                (aw, ax, ay, az), (bw, bx, by, bz) = factors
                turn = (aw * c + bw * s, ax * c + bx * s, ay * c + by * s, az * c + bz * s)
                q = turn if q is so3.IDENTITY else so3.multiply(q, turn)
            else:
                q = so3.multiply(q, item.before._q)
                moved = item.joint.compute_pose(position)
                if not item.forward:
                    moved = moved.inverse()
                x, y, z = so3.rotate(q, moved._p)
                px, py, pz = px + x, py + y, pz + z
                q = so3.multiply(q, moved._q)
            poses.append(((px, py, pz), q))
        x, y, z = so3.rotate(q, self.last._p)
        poses.append(((px + x, py + y, pz + z), so3.multiply(q, self.last._q)))
        return poses

    def compute_pose(self, positions: Sequence[Coordinates]) -> Pose:
        """Return the pose of the frame of interest in the frame of reference, with each joint at its position."""
        if not self.joints:
            return self.last
        return self.to_pose(self.compute_joint_poses(positions))

    @staticmethod
    def to_pose(poses: Sequence[PlainPose]) -> Pose:
        """Return the last of the poses of `compute_joint_poses`, normalized."""
        (x, y, z), q = poses[-1]
        return Pose._of((x + 0.0, y + 0.0, z + 0.0), so3.normalize(q))

    def compute_covariance(
        self,
        positions: Sequence[Coordinates],
        sigmas: Sequence[Coordinates],
        unstated_is_exact: bool = False,
        joint_poses: Sequence[PlainPose] | None = None,
    ) -> tuple[float, ...] | None:
        """Return the covariance of `compute_pose`: 36 numbers, row by row; None where a sigma is missing.

        With `unstated_is_exact` a survey without a sigma counts as exact; a joint never does. `sigmas` as in
        `build_links`; `joint_poses` is the result of `compute_joint_poses`, where the caller has it already.
        """
        path = self._covariance
        if not isinstance(path, PathCovariance):
            path = self._covariance = path()
        if not (unstated_is_exact or path.is_complete):
            return None
        # loops, not any(): this runs for each lookup
        for joint_sigmas in sigmas:
            for sigma in joint_sigmas:
                if sigma != sigma:
                    return None
        if joint_poses is None:
            joint_poses = self.compute_joint_poses(positions)
        bases: list[PlainPose] = []
        for place, X_LB in zip(joint_poses, self._bases, strict=False):
            if X_LB is not None:
                (px, py, pz), q = place
                if q is so3.IDENTITY:
                    # the first segment starts from the frame of reference itself
                    bases.append((X_LB._p, X_LB._q))
                    continue
                x, y, z = so3.rotate(q, X_LB._p)
                place = ((px + x, py + y, pz + z), so3.multiply(q, X_LB._q))
            bases.append(place)
        return path.compute(bases, joint_poses[-1][0], positions, sigmas)

    def build_links(
        self, positions: Sequence[Coordinates], sigmas: Sequence[Coordinates], stamp: int = 0
    ) -> list[ChainLink]:
        """Return the chain of the path, link by link, with the covariance factor of each.

        `sigmas` are those of the joints' coordinates, nan where unknown; for a mimic joint, its multiplier times its
        leader's with its sign, since their errors are common. `stamp` distinguishes joint measurements of different
        instants, whose errors are independent; the errors of surveys are the same at all times.
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
            links.append(ChainLink(edge.joint.compute_pose(position), edge.forward, factor, source))
        return links


@dataclass(slots=True, eq=False, repr=False)
class FrameNode:
    """A frame, or the far end of an edge; immutable by convention after the tree is built.

    `edge` leads down to it from `parent`, `reverse_edge` is the same passed upward; a root's parent is the root itself.
    `X_GN` is its pose in the root `group` of its group, `X_NG` the inverse. `covariance` is that of a fixed edge, None
    where it is exact or, with `is_sigma_missing`, unknown; `jacobian` is that of the edge of a movable joint.
    """

    assembly: int
    body: str
    X_GN: Pose
    depth: int = 0
    edge: Edge | None = None
    reverse_edge: Edge | None = None
    covariance: EdgeCovariance | None = None
    is_sigma_missing: bool = False
    jacobian: JointJacobian | None = None
    parent: FrameNode = field(init=False)
    group: FrameNode = field(init=False)
    X_NG: Pose = field(init=False)

    def __post_init__(self) -> None:
        self.parent = self.group = self
        self.X_NG = self.X_GN.inverse()


class FrameTree:
    """The nodes of a model's frames by full name; see the module."""

    __slots__ = ("_leader", "nodes")

    def __init__(self, bodies: Mapping[str, Body], topology: Topology, leader: Callable[[str], str]):
        """Build the tree; `leader` returns the joint that a joint follows, itself where it follows none."""
        self._leader = leader
        self.nodes: dict[str, FrameNode] = {}
        for number, assembly in enumerate(topology.assemblies):
            root = assembly[0]
            self._add_frames(bodies[root], FrameNode(number, root, Pose.identity()))
            for crossing in topology.traverse_breadth_first(root):
                body = bodies[crossing.far_body]
                self._add_frames(body, self._cross(crossing, body), crossing.far_frame)

    def _add_frames(self, body: Body, entered: FrameNode, by: str = "") -> None:
        """Add the frames of a body that is entered at its origin, or by the frame of the full name `by`."""
        origin = entered
        if by:
            frame = body.frame(names.split(by)[1])
            if frame.pose != _IDENTITY or frame.sigma is not None:
                origin = self._add(entered, Edge(EdgeKind.FRAME, by, False, frame.pose, frame.sigma), body.name)
        for frame in body:
            full = names.join(body.name, frame.name)
            if full == by:
                self.nodes[full] = entered
            elif frame.pose == _IDENTITY and frame.sigma is None:
                # a frame that is at the origin by definition is the origin
                self.nodes[full] = origin
            else:
                edge = Edge(EdgeKind.FRAME, full, True, frame.pose, frame.sigma)
                self.nodes[full] = self._add(origin, edge, body.name)

    def _cross(self, crossing: Crossing, body: Body) -> FrameNode:
        """Add the edges of a constraint and of its movable joint; return the node in the body entered."""
        each = crossing.constraint
        leader = "" if each.joint.mimic is None else self._leader(each.name)
        node = self.nodes[crossing.near_frame]
        for edge in list_crossing_edges(crossing, leader):
            node = self._add(node, edge, body.name)
        return node

    def _add(self, parent: FrameNode, edge: Edge, body: str) -> FrameNode:
        back = edge._replace(forward=not edge.forward)
        depth = parent.depth + 1
        if edge.joint is not None:
            motion = JointJacobian.at(edge.joint, parent.X_GN if edge.forward else _IDENTITY)
            node = FrameNode(parent.assembly, body, _IDENTITY, depth, edge, back, jacobian=motion)
            node.parent = parent
            return node
        X_GN = parent.X_GN @ edge.step
        covariance = None
        if edge.sigma is not None and not edge.sigma.is_zero:
            X_F, X_T = (parent.X_GN, X_GN) if edge.forward else (X_GN, parent.X_GN)
            covariance = edge_covariance(X_F.wxyz, X_T.xyz, edge.sigma)
        node = FrameNode(parent.assembly, body, X_GN, depth, edge, back, covariance, edge.is_sigma_missing)
        node.parent, node.group = parent, parent.group
        return node

    @staticmethod
    def find_nodes(interest: FrameNode, reference: FrameNode) -> tuple[list[FrameNode], list[FrameNode]]:
        """Return the nodes whose edges are passed upward from the reference, then downward to the interest."""
        up: list[FrameNode] = []
        down: list[FrameNode] = []
        while reference is not interest:
            if reference.depth >= interest.depth:
                up.append(reference)
                reference = reference.parent
            else:
                down.append(interest)
                interest = interest.parent
        down.reverse()
        return up, down

    @staticmethod
    def rigid_covariance(interest: FrameNode, reference: FrameNode) -> tuple[float, ...] | None:
        """Return the covariance, 36 numbers, of a frame in another of its group; None where a sigma is missing."""
        q, far = reference.X_NG._q, interest.X_GN._p
        edges: list[EdgeCovariance] = []
        # as in `find_nodes`, without the lists
        while reference is not interest:
            if reference.depth >= interest.depth:
                node, reference = reference, reference.parent
            else:
                node, interest = interest, interest.parent
            if node.covariance is not None:
                edges.append(node.covariance)
            elif node.is_sigma_missing:
                return None
        return covariance_at(edges, so3.rotate(q, far), q)

    @classmethod
    def build_path(cls, interest: FrameNode, reference: FrameNode) -> KinematicPath:
        """Return the path from one frame to another of the same assembly."""
        up, down = cls.find_nodes(interest, reference)
        joints: list[PathJoint] = []
        bases: list[Pose | None] = [reference.X_NG]
        # the group's root in the frame behind the last joint, or in the reference
        X_LG = reference.X_NG
        for node in up:
            if node.jacobian is not None and node.reverse_edge is not None:
                # the near frame of a joint passed upward is its group's root
                joints.append(PathJoint.of(X_LG, node.reverse_edge))
                X_LG = node.parent.X_NG
                bases.append(X_LG)
        for node in down:
            if node.jacobian is not None and node.edge is not None:
                # the far frame of one passed downward is the next group's root
                X_GN = node.parent.X_GN
                joints.append(PathJoint.of(X_GN if X_LG is _IDENTITY else X_LG @ X_GN, node.edge))
                X_LG = _IDENTITY
                bases.append(None)
        last = interest.X_GN if X_LG is _IDENTITY else X_LG @ interest.X_GN
        return KinematicPath(
            joints, last, bases, partial(_collect_edges, up, down), partial(_build_covariance, up, down)
        )


def _build_covariance(up: Sequence[FrameNode], down: Sequence[FrameNode]) -> PathCovariance:
    found = PathCovariance()
    for node, edge in (*[(each, each.reverse_edge) for each in up], *[(each, each.edge) for each in down]):
        if node.covariance is not None:
            found.add_edge(node.covariance)
        elif node.is_sigma_missing:
            found.is_complete = False
        elif node.jacobian is not None and edge is not None:
            found.add_joint(node.jacobian, edge)
    return found


def _collect_edges(up: Sequence[FrameNode], down: Sequence[FrameNode]) -> tuple[Edge, ...]:
    return tuple(
        [edge for edge in (*[each.reverse_edge for each in up], *[each.edge for each in down]) if edge is not None]
    )


_IDENTITY: Final = Pose.identity()

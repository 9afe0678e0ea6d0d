"""Kinematic paths between frames, and the frame tree that assembles them.

A `KinematicPath` folds everything rigid between two joints into one pose, so that the cost of a lookup depends on the
movable joints alone. It provides forward kinematics (`compute_joint_poses`), the covariance of the far end (see
`path_covariance`) and the single edges, for explanations.

The `FrameTree` makes the path between any pair of frames cheap. The bodies of an assembly are traversed breadth-first
from its first body. A body's origin, each of its frames that is not there by definition, and each far end of a
constraint or joint are nodes; the edge of a node leads down to it from its parent. Nodes with no movable joint between
them form a group, and each node stores its pose in the group's root node. The path between two frames climbs from both
to the lowest common ancestor. The transform between two frames of one group is a product of two stored poses; its
covariance is the sum over the edges between them, with the group's root as base. A path through joints has a segment
for each group.

The tree is built once for a model: memory and time are linear in its frames, and nothing is stored for pairs. Limit: in
an assembly with a loop shortest paths form no tree; there the model searches them (`Model.get_kinematic_path`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final, NamedTuple, Self

import numpy as np

from modelserver.geometry import names
from modelserver.geometry.joint import Coordinates, Joint, JointType
from modelserver.geometry.parts import Body
from modelserver.geometry.path_covariance import (
    EdgeCovariance,
    JointJacobian,
    PathCovariance,
    PlainPose,
    covariance_at,
    edge_covariance,
)
from modelserver.geometry.topology import Crossing, Edge, EdgeKind, Topology, list_crossing_edges
from modelserver.transforms import so3
from modelserver.transforms.chain import ChainLink
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion


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

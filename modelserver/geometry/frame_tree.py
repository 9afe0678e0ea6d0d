"""Frame tree: every frame and every edge of a model as a node under its assembly's root, so that any pair is quick.

Theory of operation. The bodies of an assembly are spread from its first one (`Topology.spread`). A body's origin, each
of its frames that is not there by definition, and each far end of a constraint or joint are nodes; the edge of a node
leads down to it from its parent. Nodes with no moving joint between them form a group, and each knows its pose in the
group's root node. The path between two frames climbs from both to the lowest common ancestor. What two frames of one
group are to each other is one product of two poses that are kept, its covariance the sum over the edges between them
(`path_covariance`), whose base is the group's root. A path through joints has a segment for each group that it passes.

All is made once for a model: memory and time are linear in its frames, and nothing is kept for pairs. In an assembly
with a loop, shortest paths form no tree; the model searches them there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from modelserver.geometry import names
from modelserver.geometry.edges import Edge, EdgeKind
from modelserver.geometry.parts import Body
from modelserver.geometry.path_covariance import (
    EdgeCovariance,
    JointCrossing,
    JointMotion,
    PathCovariance,
    covariance_at,
    edge_covariance,
)
from modelserver.geometry.route import Leg, Route
from modelserver.geometry.topology import Crossing, Topology
from modelserver.spatial import so3
from modelserver.spatial.pose import Pose


@dataclass(slots=True, eq=False, repr=False)
class FrameNode:
    """A frame, or the far end of an edge. Immutable by habit: only the tree sets, while it is made.

    `edge` leads down to it from `parent`, `back` is the same passed upward; a root's parent is the root itself. `X_GN`
    is its pose in the root `group` of its group, `X_NG` the inverse. `covariance` is that of a fixed edge, None where
    it is exact or, as `is_unstated` says, states none; `motion` is that of the edge of a moving joint.
    """

    assembly: int
    body: str
    X_GN: Pose
    depth: int = 0
    edge: Edge | None = None
    back: Edge | None = None
    covariance: EdgeCovariance | None = None
    is_unstated: bool = False
    motion: JointMotion | None = None
    parent: FrameNode = field(init=False)
    group: FrameNode = field(init=False)
    X_NG: Pose = field(init=False)

    def __post_init__(self) -> None:
        self.parent = self.group = self
        self.X_NG = self.X_GN.inverse()


class FrameTree:
    """The nodes of a model's frames by full name, in `nodes`; see the module."""

    __slots__ = ("_leader", "nodes")

    def __init__(self, bodies: Mapping[str, Body], topology: Topology, leader: Callable[[str], str]):
        """Spread every assembly; `leader` gives the joint that places a joint, itself where it follows none."""
        self._leader = leader
        self.nodes: dict[str, FrameNode] = {}
        for number, assembly in enumerate(topology.assemblies):
            root = assembly[0]
            self._add_frames(bodies[root], FrameNode(number, root, Pose.identity()))
            for _, crossing in topology.spread(root):
                body = bodies[names.split(crossing.leaves)[0]]
                self._add_frames(body, self._cross(crossing, body), crossing.leaves)

    def _add_frames(self, body: Body, entered: FrameNode, by: str = "") -> None:
        """Add the frames of a body that is entered at its origin, or by the frame of that full name."""
        origin = entered
        if by:
            frame = body.frame(names.split(by)[1])
            if frame.pose != _IDENTITY or frame.sigma is not None:
                origin = self._add(entered, Edge(EdgeKind.FRAME, by, False, frame.pose, frame.sigma), body.name)
        for frame in body:
            full = names.joined(body.name, frame.name)
            if full == by:
                self.nodes[full] = entered
            elif frame.pose == _IDENTITY and frame.sigma is None:
                # a frame that is at the origin by definition is the origin
                self.nodes[full] = origin
            else:
                edge = Edge(EdgeKind.FRAME, full, True, frame.pose, frame.sigma)
                self.nodes[full] = self._add(origin, edge, body.name)

    def _cross(self, crossing: Crossing, body: Body) -> FrameNode:
        """Add the edges of a constraint, and of its joint where that moves; return the node in the body entered."""
        each, forward = crossing.constraint, crossing.forward
        edges = [Edge(EdgeKind.CONSTRAINT, each.name, forward, each.pose, each.sigma)]
        if each.joint.moves:
            leader = "" if each.joint.mimic is None else self._leader(each.name)
            joint = Edge(EdgeKind.JOINT, each.name, forward, _IDENTITY, joint=each.joint, leader=leader)
            edges.insert(1 if forward else 0, joint)
        node = self.nodes[crossing.enters]
        for edge in edges:
            node = self._add(node, edge, body.name)
        return node

    def _add(self, parent: FrameNode, edge: Edge, body: str) -> FrameNode:
        back = edge._replace(forward=not edge.forward)
        depth = parent.depth + 1
        if edge.joint is not None:
            motion = JointMotion.at(edge.joint, parent.X_GN if edge.forward else _IDENTITY)
            node = FrameNode(parent.assembly, body, _IDENTITY, depth, edge, back, motion=motion)
            node.parent = parent
            return node
        X_GN = parent.X_GN @ (edge.pose if edge.forward else edge.pose.inverse())
        covariance = None
        if edge.sigma is not None and not edge.sigma.is_zero:
            X_F, X_T = (parent.X_GN, X_GN) if edge.forward else (X_GN, parent.X_GN)
            covariance = edge_covariance(X_F.wxyz, X_T.xyz, edge.sigma)
        node = FrameNode(parent.assembly, body, X_GN, depth, edge, back, covariance, edge.is_unstated)
        node.parent, node.group = parent, parent.group
        return node

    @staticmethod
    def path(interest: FrameNode, reference: FrameNode) -> tuple[list[FrameNode], list[FrameNode]]:
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
        """Return the covariance, 36 numbers, of a frame in another of its group; None where an edge states none."""
        q, far = reference.X_NG._q, interest.X_GN._p
        edges: list[EdgeCovariance] = []
        # the path, without keeping it
        while reference is not interest:
            if reference.depth >= interest.depth:
                node, reference = reference, reference.parent
            else:
                node, interest = interest, interest.parent
            if node.covariance is not None:
                edges.append(node.covariance)
            elif node.is_unstated:
                return None
        return covariance_at(edges, so3.rotate(q, far), q)

    @classmethod
    def route(cls, interest: FrameNode, reference: FrameNode) -> Route:
        """Return the route from one frame to another of the same assembly."""
        up, down = cls.path(interest, reference)
        legs: list[Leg] = []
        bases: list[Pose | None] = [reference.X_NG]
        # the group's root in the frame behind the last joint, or in the reference
        X_LG = reference.X_NG
        for node in up:
            if node.motion is not None and node.back is not None:
                # the near frame of a joint passed upward is its group's root
                legs.append(Leg.of(X_LG, node.back))
                X_LG = node.parent.X_NG
                bases.append(X_LG)
        for node in down:
            if node.motion is not None and node.edge is not None:
                # the far frame of one passed downward is the next group's root
                X_GN = node.parent.X_GN
                legs.append(Leg.of(X_GN if X_LG is _IDENTITY else X_LG @ X_GN, node.edge))
                X_LG = _IDENTITY
                bases.append(None)
        last = interest.X_GN if X_LG is _IDENTITY else X_LG @ interest.X_GN
        return Route.assemble(legs, last, bases, partial(_edges, up, down), partial(_covariance, up, down))


def _covariance(up: Sequence[FrameNode], down: Sequence[FrameNode]) -> PathCovariance:
    segments: list[list[EdgeCovariance]] = [[]]
    crossings: list[JointCrossing] = []
    is_stated = True
    for nodes, is_upward in ((up, True), (down, False)):
        for node in nodes:
            if node.covariance is not None:
                segments[-1].append(node.covariance)
            elif node.is_unstated:
                is_stated = False
            elif node.motion is not None:
                edge = node.back if is_upward else node.edge
                assert edge is not None
                number = len(crossings)
                # the motion is written in the segment that F is in: the one before the joint, or behind it
                at, sign = (number, 1.0) if edge.forward else (number + 1, -1.0)
                crossings.append(JointCrossing(node.motion, at, sign, edge.leader or edge.name))
                segments.append([])
    return PathCovariance(segments, crossings, is_stated)


def _edges(up: Sequence[FrameNode], down: Sequence[FrameNode]) -> tuple[Edge, ...]:
    return tuple([edge for edge in (*[each.back for each in up], *[each.edge for each in down]) if edge is not None])


_IDENTITY: Final = Pose.identity()

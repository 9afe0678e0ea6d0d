"""The tree of joints and bodies that a model's dynamics is computed on.

A model is a graph of frames and constraints. From the root frame its bodies are traversed breadth-first, as for
kinematic paths; the joints on the way form a tree, listed depth-first (each before those behind it, a subtree in one
piece), as the algorithms need it. Everything rigid is folded into constant poses: a joint stores the pose of its near
frame in its parent's far frame, a body that of its origin in the far frame of the joint that moves it.

A constraint that closes a loop is not in the tree. If all of the loop is rigid, it adds nothing. Otherwise the loop's
forces would be unknowns beside the coordinates: an error, or with `cut_loops` the constraint is left out and the tree
moves as if it were open there.

Covariance of the center of mass, from the surveys, the joints, and the bodies' own masses.

The error (dp, dtheta) of an edge of the tree, along the axes of its near end F, is a small motion of all behind it (see
`geometry.path_covariance`). The center of mass c moves by that of the part behind the edge, with mass m_s of m and
center c_s; a frame K of interest moves only if it is behind the edge. In K, whose axes turn with it, c moves by

    m_s / m (dp + dtheta x (c_s - p_T)) - [K behind] (dp + dtheta x (p_K - p_T) + dtheta x (c - p_K))

The motions of one source (a survey that several branches share, joints that follow one leader) are added before they
are squared. A body of mass m_i with center c_i adds (c_i - c) / m for an error of its mass, m_i / m for one of c_i.
First order, as all covariances along paths.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from modelserver.errors import MalformedRequestError
from modelserver.geometry import names
from modelserver.geometry.joint import Coordinates, Joint, JointType, coordinate_names
from modelserver.geometry.model import Model
from modelserver.geometry.names import format_names
from modelserver.geometry.parts import RigidInertia
from modelserver.geometry.topology import Crossing, Edge, EdgeKind, list_crossing_edges
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array

GROUND = -1
"""Number of the parent of what no joint moves."""


class TreeJoint(NamedTuple):
    """A movable joint, passed from its near to its far frame, `forward` as its constraint is stated.

    `parent` is the number of the joint before it, `X_PN` the pose of the near frame in that one's far frame. `columns`
    are the numbers of its coordinates; a mimic joint has those of its leader, and its position is `multiplier` times
    them plus `offset`.
    """

    name: str
    joint: Joint
    forward: bool
    parent: int
    X_PN: Pose
    columns: tuple[int, ...]
    multiplier: float = 1.0
    offset: float = 0.0


class TreeLink(NamedTuple):
    """A body: the number of the joint that moves it, the pose of its origin in that one's far frame, its inertia."""

    body: str
    joint: int
    X_FB: Pose
    inertia: RigidInertia | None


class Tree(NamedTuple):
    """Joints and bodies of the assembly around `root`; `cut` names the constraints left out because of loops."""

    root: str
    is_floating: bool
    coordinates: tuple[str, ...]
    defaults: tuple[float, ...]
    joints: tuple[TreeJoint, ...]
    links: Mapping[str, TreeLink]
    cut: tuple[str, ...]

    @property
    def massless(self) -> tuple[str, ...]:
        return tuple(name for name, link in self.links.items() if link.inertia is None)


def build_tree(model: Model, root: str = "", floating: bool = True, cut_loops: bool = False) -> Tree:
    """Build the tree of the assembly around the frame `root`, by default the first frame of the model's root body.

    The six coordinates of a floating base come first and are named after the frame, e.g. `Raptor:CG.x`. Raises
    UnknownBodyError, UnknownFrameError; MalformedRequestError for a loop, and for an inertia that no rigid body has.
    """
    root = root or names.join(model.root.name, model.root.frames[0].name)
    base_frame = model.frame(root)
    base = root.partition(":")[0]
    crossings = model.spanning_tree(base)
    inside = {base, *(each.far_body for each in crossings)}
    used = {each.constraint.name for each in crossings}
    coordinates: list[str] = []
    defaults: list[float] = []
    columns: dict[str, tuple[int, ...]] = {}
    free = Joint(JointType.FLOATING)
    if floating:
        coordinates += coordinate_names(root, free)
        defaults += [0.0] * 6
    # in the order of the file, mimic joints without coordinates of their own
    for name, constraint in model.joints.items():
        if name in used and constraint.joint.mimic is None:
            columns[name] = tuple(range(len(coordinates), len(coordinates) + constraint.joint.count))
            coordinates += coordinate_names(name, constraint.joint)
            defaults += constraint.joint.default_position
    for name in sorted(used & model.joints.keys()):
        leader = model.drives[name].leader
        if leader not in columns:
            raise MalformedRequestError(
                f"joint {name} follows {leader}, which is not in the tree of {root}; join {leader} to it, or cut "
                "another constraint of the loop"
            )

    below: dict[str, list[Crossing]] = {body: [] for body in inside}
    for each in crossings:
        below[each.near_body].append(each)
    joints: list[TreeJoint] = []
    if floating:
        joints.append(TreeJoint(root, free, True, GROUND, Pose.identity(), tuple(range(6))))
    links: dict[str, TreeLink] = {}
    # a crossing, and the joint that moves the body it leaves, with that body's pose in the joint's far frame
    stack: list[tuple[Crossing | None, int, Pose]] = [(None, len(joints) - 1, base_frame.pose.inverse())]
    while stack:
        crossing, joint, X_FB = stack.pop()
        body = base
        if crossing is not None:
            body, constraint = crossing.far_body, crossing.constraint
            X_FN = X_FB @ model.frame(crossing.near_frame).pose
            X_FB = model.frame(crossing.far_frame).pose.inverse()
            if not constraint.joint.is_movable:
                X_FB = X_FN @ crossing.pose @ X_FB
            else:
                if crossing.forward:
                    X_FN = X_FN @ constraint.pose
                else:
                    X_FB = constraint.pose.inverse() @ X_FB
                drive = model.drives[constraint.name]
                moves = (columns[drive.leader], drive.multiplier, drive.offset)
                joints.append(TreeJoint(constraint.name, constraint.joint, crossing.forward, joint, X_FN, *moves))
                joint = len(joints) - 1
        links[body] = TreeLink(body, joint, X_FB, _get_inertia(model, body))
        stack += [(each, joint, X_FB) for each in reversed(below[body])]
    cut = tuple(_find_open_loops(model, links, used))
    if cut and not cut_loops:
        raise MalformedRequestError(
            f"the dynamics of a closed loop is not computed, and {format_names(cut)} "
            f"{'closes one' if len(cut) == 1 else 'close some'}; remove the constraint, or compute the tree that is "
            "left without it (cut_loops)"
        )
    return Tree(root, floating, tuple(coordinates), tuple(defaults), tuple(joints), links, cut)


def _get_inertia(model: Model, body: str) -> RigidInertia | None:
    found = model.body(body).rigid_inertia
    if found is None and model.body(body).inertia is not None:
        raise MalformedRequestError(
            f"body {body}: its 6x6 inertia is not that of a rigid body; state mass, center of mass and inertia instead"
        )
    return found


def _find_open_loops(model: Model, links: Mapping[str, TreeLink], used: set[str]) -> Iterator[str]:
    """Yield the constraints that close a loop in which something moves."""
    for each in model.constraints:
        if each.name not in used and each.from_.partition(":")[0] in links:
            near, far = (links[end.partition(":")[0]] for end in (each.from_, each.to))
            if each.joint.is_movable or near.joint != far.joint:
                yield each.name


EDGES_IN_STEP = 32
"""Edges between two steps: about half a millisecond."""


class MassUncertainty(NamedTuple):
    """Standard deviations of each body's mass, as a fraction of it, and center of mass along each axis, meters.

    With `unstated_is_exact` a survey without a sigma counts as exact; a joint never does.
    """

    mass: float = 0.0
    center: float = 0.0
    unstated_is_exact: bool = False


class _Passed(NamedTuple):
    """An edge in the tree: the pose of F, `end`, the origin of T, and the number of the crossing behind it."""

    edge: Edge
    X_RF: Pose
    end: Array
    behind: int


def iterate_center_covariance(
    model: Model,
    tree: Tree,
    frame: str,
    positions: Mapping[str, Coordinates],
    sigmas: Mapping[str, float],
    uncertainty: MassUncertainty,
    is_frame_exact: bool = False,
) -> Generator[None, None, Array | None]:
    """Return in steps the covariance (3, 3) of the center of mass in a frame, along its axes.

    None where a sigma is missing. The steps are for a caller that has other things to do between.

    With `is_frame_exact` the frame's own survey counts as exact: the covariance is that relative to its body.

    `positions` are those of the tree's joints, `sigmas` those of its coordinates, nan where unknown.
    """
    base = tree.root.partition(":")[0]
    crossings = model.spanning_tree(base)
    entered = {each.far_body: number + 1 for number, each in enumerate(crossings)}
    parents = [0, *(entered.get(each.near_body, 0) for each in crossings)]
    X_RB: dict[str, Pose] = {}
    passed: list[_Passed] = []
    for each in _iterate_edges(model, tree, crossings, positions, X_RB):
        passed.append(each)
        if len(passed) % EDGES_IN_STEP == 0:
            yield
    masses, moments = np.zeros(len(parents)), np.zeros((len(parents), 3))
    centers: list[tuple[float, Array]] = []
    for body, link in tree.links.items():
        if link.inertia is not None:
            at = X_RB[body].transform(np.array(link.inertia.center))
            centers.append((link.inertia.mass, at))
            number = entered.get(body, 0)
            masses[number] += link.inertia.mass
            moments[number] += link.inertia.mass * at
    for number in range(len(parents) - 1, 0, -1):
        masses[parents[number]] += masses[number]
        moments[parents[number]] += moments[number]
    total, c = float(masses[0]), moments[0] / masses[0]

    K = model.frame(frame)
    X_RK = X_RB[K.body] @ K.pose
    p_K = X_RK.position
    on_path = {0}
    number = entered.get(K.body, 0)
    while number:
        on_path.add(number)
        number = parents[number]
    own = len(parents)
    on_path.add(own)
    if not is_frame_exact:
        passed.append(_Passed(Edge(EdgeKind.FRAME, frame, True, K.pose, K.sigma), X_RB[K.body], p_K, own))

    motions: dict[tuple[str, ...], tuple[Array, Array]] = {}
    for number, (edge, X_RF, p_T, behind) in enumerate(passed, 1):
        if number % EDGES_IN_STEP == 0:
            yield
        share = 0.0 if behind == own else float(masses[behind]) / total
        is_behind = behind in on_path
        if share == 0.0 and not is_behind:
            continue
        if edge.joint is None:
            if edge.is_sigma_missing and not uncertainty.unstated_is_exact:
                return None
            if edge.sigma is None:
                continue
            source: tuple[str, ...] = (edge.kind, edge.name)
            J, sigma = np.eye(6), np.array((*edge.sigma.position, *edge.sigma.rotation))
        else:
            drive = model.drives[edge.name]
            source = (edge.kind, drive.leader)
            J = edge.joint.jacobian(positions[edge.name]) * drive.multiplier
            sigma = np.array([sigmas[name] for name in drive.names])
            if not np.isfinite(sigma).all():
                return None
        R = X_RF.rotation
        linear, turning = R @ J[:3], R @ J[3:]
        moved = np.zeros_like(linear)
        if share:
            moved += share * (linear - so3.skew(moments[behind] / masses[behind] - p_T) @ turning)
        if is_behind:
            moved -= linear - so3.skew(c - p_T) @ turning
        before = motions.get(source)
        sign = 1.0 if edge.forward else -1.0
        motions[source] = (sign * moved + (0.0 if before is None else before[0]), sigma)
    P = np.zeros((3, 3))
    for moved, sigma in motions.values():
        factor = moved * sigma
        P += factor @ factor.T
    for mass, at in centers:
        arm = (at - c) * (uncertainty.mass * mass / total)
        P += np.outer(arm, arm) + np.eye(3) * (uncertainty.center * mass / total) ** 2
    R = X_RK.rotation
    return np.asarray(R.T @ P @ R)


def _iterate_edges(
    model: Model,
    tree: Tree,
    crossings: Sequence[Crossing],
    positions: Mapping[str, Coordinates],
    X_RB: dict[str, Pose],
) -> Iterator[_Passed]:
    """Yield the edges of the tree; put the pose of each body's origin in the root frame into `X_RB`."""
    base, _ = names.split(tree.root)
    root = model.frame(tree.root)
    X_RB[base] = root.pose.inverse()
    yield _Passed(Edge(EdgeKind.FRAME, tree.root, False, root.pose, root.sigma), X_RB[base], np.zeros(3), 0)
    for number, crossing in enumerate(crossings, 1):
        near, far = model.frame(crossing.near_frame), model.frame(crossing.far_frame)
        edges = [
            Edge(EdgeKind.FRAME, crossing.near_frame, True, near.pose, near.sigma),
            *list_crossing_edges(crossing),
            Edge(EdgeKind.FRAME, crossing.far_frame, False, far.pose, far.sigma),
        ]
        X = X_RB[crossing.near_body]
        for edge in edges:
            X_FT = edge.pose if edge.joint is None else edge.joint.compute_pose(positions[edge.name])
            X_next = X @ (X_FT if edge.forward else X_FT.inverse())
            F, T = (X, X_next) if edge.forward else (X_next, X)
            yield _Passed(edge, F, T.position, number)
            X = X_next
        X_RB[crossing.far_body] = X

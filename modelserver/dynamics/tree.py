"""The tree of joints and bodies that a model's dynamics is computed on.

A model is a graph of frames and constraints. From the root frame its bodies are traversed breadth-first, as for
kinematic paths; the joints on the way form a tree, listed depth-first (each before those behind it, a subtree in one
piece), as the algorithms need it. Everything rigid is folded into constant poses: a joint stores the pose of its near
frame in its parent's far frame, a body that of its origin in the far frame of the joint that moves it.

A constraint that closes a loop is not in the tree. If all of the loop is rigid, it adds nothing. Otherwise the loop's
forces would be unknowns beside the coordinates: an error, or with `cut_loops` the constraint is left out and the tree
moves as if it were open there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from modelserver.errors import MalformedRequestError
from modelserver.geometry import names
from modelserver.geometry.inertia import RigidInertia, from_spatial_inertia
from modelserver.geometry.joint import Joint, JointType, coordinate_names
from modelserver.geometry.model import Model
from modelserver.geometry.names import format_names
from modelserver.geometry.topology import Crossing
from modelserver.transforms.pose import Pose

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
        """The bodies without mass."""
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
    stated = model.body(body).inertia
    if stated is None:
        return None
    found = from_spatial_inertia(stated)
    if found is None:
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

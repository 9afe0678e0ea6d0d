"""A model as a tree to be drawn: each body below the one that the shortest way from the root comes by."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from modelserver.geometry import names
from modelserver.geometry.joint import Joint, coordinate_names
from modelserver.geometry.loops import closure
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Constraint
from modelserver.geometry.topology import Crossing, LoopClosure, Topology


@dataclass(frozen=True, slots=True)
class BodyNode:
    """A body in the drawing: how deep it hangs, what joins it to the body above, and what closes a loop at it.

    `last` says for each level from the second on whether the branch there is the last one of its body.
    """

    body: str
    depth: int
    last: tuple[bool, ...]
    crossing: Crossing | None
    frames: tuple[str, ...]
    loops: tuple[str, ...]
    parent: int = -1
    """Number of the body above, -1 for none."""
    branches: bool = False
    """Whether bodies hang below it."""


def nodes(model: Model) -> list[list[BodyNode]]:
    """Return the bodies of each assembly in the order in which they are drawn; the root's assembly comes first."""
    topology = Topology(model.bodies, model.constraints)
    loops: dict[str, list[str]] = {}
    for each in topology.loop_closures():
        loops.setdefault(names.split(each.path[0].enters)[0], []).append(_loop(each, model))
    return [_assembly(model, topology, assembly[0], loops) for assembly in topology.assemblies]


def _assembly(model: Model, topology: Topology, root: str, loops: dict[str, list[str]]) -> list[BodyNode]:
    below: dict[str, list[Crossing]] = {}
    for body, onward in topology.spread(root):
        below.setdefault(body, []).append(onward)
    drawn: list[BodyNode] = []
    # a list, not recursion: a chain may be longer than Python's stack
    waiting: list[tuple[str, tuple[bool, ...], Crossing | None, int]] = [(root, (), None, -1)]
    while waiting:
        body, last, crossing, parent = waiting.pop()
        hanging = below.get(body, [])
        frames = tuple(model.get_body_frame_list(body))
        told = tuple(loops.get(body, ()))
        drawn.append(BodyNode(body, len(last), last, crossing, frames, told, parent, bool(hanging)))
        number = len(drawn) - 1
        for place, each in reversed(list(enumerate(hanging))):
            waiting.append((names.split(each.leaves)[0], (*last, place == len(hanging) - 1), each, number))
    return drawn


def _loop(closing: LoopClosure, model: Model) -> str:
    """Return in words which constraint closes a loop, to which body, and how far going round misses."""
    crossing = closing.path[0]
    found = closure(closing.path, model.frame)
    words = f"loop: {crossing.constraint.name} ({joint_words(crossing.constraint)}) to {crossing.leaves}, "
    if found.is_exact:
        return words + "closes exactly"
    words += f"misses by {found.metres * 1e3:.3g} mm and {math.degrees(found.radians):.3g} deg"
    if found.sigmas is not None:
        words += f", {found.sigmas:.1f} sigma"
    return words + (" with joints at rest" if found.joints else "")


def joint_words(constraint: Constraint) -> str:
    """Return the type of a constraint's joint, with its limits in degrees and metres."""
    joint = constraint.joint
    if not joint.moves:
        return "fixed"
    words = [str(joint.type)]
    if joint.mimic is not None:
        shift = f" {_number(joint.mimic.offset, joint, 0, signed=True)}" if joint.mimic.offset else ""
        words.append(f"follows {joint.mimic.joint} times {joint.mimic.multiplier:g}{shift}")
    limits = list(_limits(constraint.name, joint))
    return ", ".join(words + limits)


def _limits(name: str, joint: Joint) -> Iterator[str]:
    for number, coordinate in enumerate(coordinate_names(name, joint)):
        low = joint.lower[number] if joint.lower else -math.inf
        high = joint.upper[number] if joint.upper else math.inf
        rate = joint.rate_limit[number] if joint.rate_limit else math.inf
        which = f"{coordinate.rpartition('.')[2]} " if joint.count > 1 else ""
        if math.isfinite(low) and math.isfinite(high):
            yield f"{which}{_number(low, joint, number, unit=False)} to {_number(high, joint, number)}"
        elif math.isfinite(low):
            yield f"{which}from {_number(low, joint, number)}"
        elif math.isfinite(high):
            yield f"{which}up to {_number(high, joint, number)}"
        if math.isfinite(rate):
            yield f"{which}{_number(rate, joint, number)}/s at most"


def _number(value: float, joint: Joint, number: int, signed: bool = False, unit: bool = True) -> str:
    angle = joint.is_angle[number]
    shown = round(math.degrees(value), 9) if angle else value
    text = f"{shown:+.6g}" if signed else f"{shown:.6g}"
    return text + ((" deg" if angle else " m") if unit else "")


def crossing_words(crossing: Crossing) -> str:
    """Return by which constraint a body hangs on the one above, and how it may move."""
    turned = "" if crossing.forward else ", from here"
    return f"{crossing.constraint.name}: {joint_words(crossing.constraint)}{turned}"

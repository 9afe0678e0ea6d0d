"""What changes from one model to another, in words for the person who changed it."""

from __future__ import annotations

import math

from modelserver.geometry.model import Model
from modelserver.geometry.names import joined
from modelserver.geometry.parts import Constraint
from modelserver.spatial.pose import Pose

LEAST_METRES = 1e-9
LEAST_RADIANS = 1e-9
"""A pose that moved by less reads back from a file that way."""


def changes(old: Model, new: Model) -> tuple[str, ...]:
    """Return what is added, removed, moved or said otherwise, a line each; empty where answers stay the same."""
    lines = []
    before, after = ({body.name: body for body in model.bodies} for model in (old, new))
    lines += [f"body {name} is gone" for name in before if name not in after]
    lines += [f"body {name} is new" for name in after if name not in before]
    for name, body in after.items():
        if name not in before:
            continue
        was = {frame.name: frame for frame in before[name]}
        now = {frame.name: frame for frame in body}
        lines += [f"frame {joined(name, each)} is gone" for each in was if each not in now]
        lines += [f"frame {joined(name, each)} is new" for each in now if each not in was]
        for each, frame in now.items():
            if each in was:
                lines += _moved(f"frame {joined(name, each)}", was[each].pose, frame.pose)
                if was[each].sigma != frame.sigma:
                    lines.append(f"frame {joined(name, each)} states another sigma")
        if before[name].inertia != body.inertia:
            lines.append(f"body {name} has another inertia")
    lines += _constraints({each.name: each for each in old.constraints}, {each.name: each for each in new.constraints})
    if old.root.name != new.root.name:
        lines.append(f"the root body is {new.root.name}, it was {old.root.name}")
    if not lines and old.revision != new.revision:
        lines.append("descriptions or the order of what is listed")
    return tuple(lines)


def _constraints(was: dict[str, Constraint], now: dict[str, Constraint]) -> list[str]:
    lines = [f"constraint {name} is gone" for name in was if name not in now]
    lines += [f"constraint {name} is new" for name in now if name not in was]
    for name, each in now.items():
        if name not in was:
            continue
        old = was[name]
        if (old.from_, old.to) != (each.from_, each.to):
            lines.append(f"constraint {name} joins {each.from_} and {each.to}, it joined {old.from_} and {old.to}")
        lines += _moved(f"constraint {name}", old.pose, each.pose)
        if old.sigma != each.sigma:
            lines.append(f"constraint {name} states another sigma")
        if old.joint != each.joint:
            kind = f"is {each.joint.type}, it was {old.joint.type}" if old.joint.type != each.joint.type else "changes"
            lines.append(f"the joint of constraint {name} {kind}")
    return lines


def _moved(what: str, old: Pose, new: Pose) -> list[str]:
    metres, radians = old.distance(new)
    if metres < LEAST_METRES and radians < LEAST_RADIANS:
        return []
    return [f"{what} moves by {metres * 1e3:.4g} mm and {math.degrees(radians):.4g} deg"]

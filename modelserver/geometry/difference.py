"""Describe what changes from one model to another."""

from __future__ import annotations

import math

from modelserver.geometry.joint import Joint
from modelserver.geometry.model import Model
from modelserver.geometry.names import join
from modelserver.geometry.parts import Constraint
from modelserver.transforms.pose import Pose

MIN_METERS = 1e-9
MIN_RADIANS = 1e-9
"""A pose that moved by less is equal within the rounding of a file."""


def describe_changes(old: Model, new: Model) -> tuple[str, ...]:
    """Return what is added, removed or changed, a line each; empty where both models give the same answers."""
    lines = []
    before, after = ({body.name: body for body in model.bodies} for model in (old, new))
    lines += [f"body {name} is removed" for name in before if name not in after]
    lines += [f"body {name} is new" for name in after if name not in before]
    for name, body in after.items():
        if name not in before:
            continue
        was = {frame.name: frame for frame in before[name]}
        now = {frame.name: frame for frame in body}
        lines += [f"frame {join(name, each)} is removed" for each in was if each not in now]
        lines += [f"frame {join(name, each)} is new" for each in now if each not in was]
        for each, frame in now.items():
            if each in was:
                lines += _compare_poses(f"frame {join(name, each)}", was[each].pose, frame.pose)
                if was[each].sigma != frame.sigma:
                    lines.append(f"frame {join(name, each)} states another sigma")
        if before[name].inertia != body.inertia:
            lines.append(f"body {name} has another inertia")
    lines += _compare_constraints(
        {each.name: each for each in old.constraints}, {each.name: each for each in new.constraints}
    )
    if old.root.name != new.root.name:
        lines.append(f"the root body is {new.root.name}, it was {old.root.name}")
    if not lines and old.revision != new.revision:
        lines.append("descriptions or the order of what is listed")
    return tuple(lines)


def _compare_constraints(was: dict[str, Constraint], now: dict[str, Constraint]) -> list[str]:
    lines = [f"constraint {name} is removed" for name in was if name not in now]
    lines += [f"constraint {name} is new" for name in now if name not in was]
    for name, each in now.items():
        if name not in was:
            continue
        old = was[name]
        if (old.from_, old.to) != (each.from_, each.to):
            lines.append(f"constraint {name} joins {each.from_} and {each.to}, it joined {old.from_} and {old.to}")
        lines += _compare_poses(f"constraint {name}", old.pose, each.pose)
        if old.sigma != each.sigma:
            lines.append(f"constraint {name} states another sigma")
        if old.joint != each.joint:
            lines.append(f"the joint of constraint {name} {_compare_joints(old.joint, each.joint)}")
    return lines


def _compare_joints(old: Joint, new: Joint) -> str:
    if old.type != new.type:
        return f"is {new.type}, it was {old.type}"
    changes = []
    if old.axis != new.axis:
        changes.append(f"the axis {_format_numbers(new.axis)}, it was {_format_numbers(old.axis)}")
    for key, what in _QUANTITIES:
        values = [_format_values(each, getattr(each, key)) for each in (new, old)]
        if values[0] != values[1]:
            changes.append(f"{what} {values[0]}, it was {values[1]}")
    if old.mimic != new.mimic:
        changes.append(f"{_describe_mimic(new)}, {_describe_mimic(old)} before".replace("  ", " "))
    return "has " + "; ".join(changes) if changes else "changes by less than the digits shown"


_QUANTITIES = (
    ("lower", "the lower limit"),
    ("upper", "the upper limit"),
    ("rate_limit", "the rate limit"),
    ("default", "the default"),
    ("sigma", "sigma"),
)


def _format_values(joint: Joint, values: tuple[float, ...]) -> str:
    """Return the values of a joint's coordinates: angles in degrees, lengths in meters."""
    texts = [
        f"{math.degrees(value):.6g} deg" if angle else f"{value:.6g} m"
        for value, angle in zip(values, joint.angle_flags, strict=False)
    ]
    return ", ".join(texts) or "none"


def _format_numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:.6g}" for value in values)


def _describe_mimic(joint: Joint) -> str:
    mimic = joint.mimic
    if mimic is None:
        return "no joint that it follows"
    return f"{mimic.joint} to follow, times {mimic.multiplier:.6g} plus {mimic.offset:.6g}"


def _compare_poses(what: str, old: Pose, new: Pose) -> list[str]:
    meters, radians = old.distance(new)
    if meters < MIN_METERS and radians < MIN_RADIANS:
        return []
    return [f"{what} moves by {meters * 1e3:.4g} mm and {math.degrees(radians):.4g} deg"]

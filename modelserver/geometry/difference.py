"""Describe what changes from one model to another."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TypeVar

from modelserver.geometry.model import Model
from modelserver.geometry.names import join
from modelserver.transforms.pose import Pose

T = TypeVar("T")

MIN_METERS = 1e-9
MIN_RADIANS = 1e-9
"""A pose that moved by less is equal within the rounding of a file."""


def describe_changes(old: Model, new: Model) -> tuple[str, ...]:
    """Return what is added, removed or changed, a line each; empty where both models give the same answers."""
    bodies = [{each.name: each for each in model.bodies} for model in (old, new)]
    lines = _list_additions("body", *bodies)
    for name, before, after in _pair(*bodies):
        frames = [{join(name, each.name): each for each in body} for body in (before, after)]
        lines += _list_additions("frame", *frames)
        for full, was, now in _pair(*frames):
            lines += _compare_poses(f"frame {full}", was.pose, now.pose)
            if was.sigma != now.sigma:
                lines.append(f"frame {full} states another sigma")
        if before.inertia != after.inertia:
            lines.append(f"body {name} has another inertia")
    constraints = [{each.name: each for each in model.constraints} for model in (old, new)]
    lines += _list_additions("constraint", *constraints)
    for name, first, second in _pair(*constraints):
        if (first.from_, first.to) != (second.from_, second.to):
            lines.append(
                f"constraint {name} joins {second.from_} and {second.to}, it joined {first.from_} and {first.to}"
            )
        lines += _compare_poses(f"constraint {name}", first.pose, second.pose)
        if first.sigma != second.sigma:
            lines.append(f"constraint {name} states another sigma")
        if first.joint != second.joint:
            is_other = first.joint.type != second.joint.type
            how = f"is {second.joint.type}, it was {first.joint.type}" if is_other else "has other numbers"
            lines.append(f"the joint of constraint {name} {how}")
    if old.root.name != new.root.name:
        lines.append(f"the root body is {new.root.name}, it was {old.root.name}")
    if not lines and old.revision != new.revision:
        lines.append("descriptions or the order of what is listed")
    return tuple(lines)


def _list_additions(what: str, was: dict[str, T], now: dict[str, T]) -> list[str]:
    lines = [f"{what} {name} is removed" for name in was if name not in now]
    return lines + [f"{what} {name} is new" for name in now if name not in was]


def _pair(was: dict[str, T], now: dict[str, T]) -> Iterator[tuple[str, T, T]]:
    return ((name, was[name], each) for name, each in now.items() if name in was)


def _compare_poses(what: str, old: Pose, new: Pose) -> list[str]:
    meters, radians = old.distance(new)
    if meters < MIN_METERS and radians < MIN_RADIANS:
        return []
    return [f"{what} moves by {meters * 1e3:.4g} mm and {math.degrees(radians):.4g} deg"]

"""What places each joint: its own coordinates, or those of the joint that it follows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

from modelserver.geometry.joint import Mimic, coordinate_names
from modelserver.geometry.parts import Constraint


class JointDrive(NamedTuple):
    """A joint's position: `multiplier` times the coordinates of these names, plus `offset`.

    Where it follows another, which may follow a third, the numbers are those of the whole way.
    """

    names: tuple[str, ...]
    leader: str
    multiplier: float = 1.0
    offset: float = 0.0


def drives(joints: Iterable[Constraint]) -> dict[str, JointDrive]:
    """Return the drive of each joint by its constraint's name; those that follow lead to one that does not.

    Where they do not, `followed` says so; no model is built of those.
    """
    by_name = {each.name: each for each in joints}
    found: dict[str, JointDrive] = {}
    for each in by_name.values():
        way: list[tuple[str, Mimic]] = []
        while each.name not in found and (mimic := each.joint.mimic) is not None:
            way.append((each.name, mimic))
            each = by_name[mimic.joint]
        drive = found.setdefault(each.name, JointDrive(coordinate_names(each.name, each.joint), each.name))
        for name, mimic in reversed(way):
            offset = mimic.multiplier * drive.offset + mimic.offset
            drive = JointDrive(drive.names, drive.leader, mimic.multiplier * drive.multiplier, offset)
            found[name] = drive
    return {name: found[name] for name in by_name}


def at_rest(constraints: Iterable[Constraint]) -> tuple[Constraint, ...]:
    """Return the constraints, the default of each joint that follows another being where its leader's rest takes it.

    Every joint on the way must be there, and lead to one that follows none: see `followed`. Raises ValueError where
    one comes to no finite position.
    """
    constraints = tuple(constraints)
    moving = {each.name: each for each in constraints if each.joint.moves}
    placed_by = drives(moving.values())
    settled = []
    for each in constraints:
        if each.joint.mimic is not None:
            drive = placed_by[each.name]
            (leader,) = moving[drive.leader].joint.rest
            each = replace(each, joint=replace(each.joint, default=(drive.multiplier * leader + drive.offset,)))
        settled.append(each)
    return tuple(settled)


def followed(joint: Constraint, by_name: Mapping[str, Constraint]) -> tuple[str, ...]:
    """Return the joints on the way from one to its leader, itself first; where it goes round, up to the first twice."""
    way = {joint.name: None}
    while (mimic := joint.joint.mimic) is not None:
        if mimic.joint in way:
            return (*way, mimic.joint)
        way[mimic.joint] = None
        if mimic.joint not in by_name:
            break
        joint = by_name[mimic.joint]
    return tuple(way)

"""Mimic joints: resolve which coordinates drive each joint, through chains of joints that follow each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

from modelserver.geometry.joint import Mimic, coordinate_names
from modelserver.geometry.parts import Constraint


class JointDrive(NamedTuple):
    """The position of a joint: `multiplier` times the coordinates `names` of its `leader`, plus `offset`.

    For a chain of mimic joints, multiplier and offset are those of the whole chain.
    """

    names: tuple[str, ...]
    leader: str
    multiplier: float = 1.0
    offset: float = 0.0


def resolve_mimics(joints: Iterable[Constraint]) -> dict[str, JointDrive]:
    """Return the drive of each joint by its constraint's name.

    Mimic chains end at a joint that follows none; `find_mimic_chain` finds those that do not, and no model has them.
    """
    by_name = {each.name: each for each in joints}
    found: dict[str, JointDrive] = {}
    for each in by_name.values():
        links: list[tuple[str, Mimic]] = []
        while each.name not in found and (mimic := each.joint.mimic) is not None:
            links.append((each.name, mimic))
            each = by_name[mimic.joint]
        drive = found.setdefault(each.name, JointDrive(coordinate_names(each.name, each.joint), each.name))
        for name, mimic in reversed(links):
            offset = mimic.multiplier * drive.offset + mimic.offset
            drive = JointDrive(drive.names, drive.leader, mimic.multiplier * drive.multiplier, offset)
            found[name] = drive
    return {name: found[name] for name in by_name}


def apply_mimic_defaults(constraints: Iterable[Constraint]) -> tuple[Constraint, ...]:
    """Return the constraints with the default of each mimic joint computed from its leader's default position.

    Every mimic chain must end at a joint that follows none. Raises ValueError where a position is not finite.
    """
    constraints = tuple(constraints)
    moving = {each.name: each for each in constraints if each.joint.is_movable}
    drives = resolve_mimics(moving.values())
    result = []
    for each in constraints:
        if each.joint.mimic is not None:
            drive = drives[each.name]
            (leader,) = moving[drive.leader].joint.default_position
            each = replace(each, joint=replace(each.joint, default=(drive.multiplier * leader + drive.offset,)))
        result.append(each)
    return tuple(result)


def find_mimic_chain(joint: Constraint, by_name: Mapping[str, Constraint]) -> tuple[str, ...]:
    """Return the joints from one to its leader, itself first; in a cycle, up to the first that occurs twice."""
    chain = {joint.name: None}
    while (mimic := joint.joint.mimic) is not None:
        if mimic.joint in chain:
            return (*chain, mimic.joint)
        chain[mimic.joint] = None
        if mimic.joint not in by_name:
            break
        joint = by_name[mimic.joint]
    return tuple(chain)

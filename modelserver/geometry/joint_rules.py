"""Rules between joints: unique coordinate names, valid mimic chains, plausible positions.

A mimic joint follows another, also through chains of joints that follow each other: `resolve_mimics` finds the
coordinates that drive each joint.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from modelserver.errors import Location, Severity, quote, suggest_name
from modelserver.geometry.joint import Mimic, coordinate_names
from modelserver.geometry.names import MAX_LISTED, format_first_location, format_names
from modelserver.geometry.parts import Constraint

LocatedConstraint = tuple[Constraint, Location]
"""A constraint and its source location."""


MAX_POSITION = 1e9
"""Meters or radians; a default position beyond would cost the precision of millimeters."""


MAX_ANGLE = 2.0 * math.tau
"""Radians; an angle beyond two turns is probably one in degrees."""


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


@dataclass(frozen=True, slots=True)
class JointRules:
    """Checks the joints of constraints that are well formed otherwise.

    `report` and `add_problem` are called for what is invalid and for warnings. `known` are the names of all constraints
    of the file: a follower of a rejected joint is not reported again. `unclear` are those whose joint could not be
    read. With `repair` the followers of a dropped joint are dropped as well, and reported.
    """

    report: Callable[..., None]
    add_problem: Callable[..., None]
    known: Collection[str]
    unclear: Collection[str]
    repair: bool

    def apply(self, placed: Sequence[LocatedConstraint]) -> tuple[LocatedConstraint, ...]:
        """Return the constraints without those whose joints are invalid, with the defaults of mimic joints applied."""
        valid = self._drop_duplicate_coordinates(placed)
        while rejected := self._find_invalid_mimics(valid):
            valid = [each for each in valid if each[0].name not in rejected]
        return self._apply_defaults(valid)

    def _drop_duplicate_coordinates(self, placed: Sequence[LocatedConstraint]) -> list[LocatedConstraint]:
        valid: list[LocatedConstraint] = []
        taken: dict[str, LocatedConstraint] = {}
        for constraint, source in placed:
            mine = coordinate_names(constraint.name, constraint.joint)
            clash = next((name for name in mine if name in taken), None)
            if clash is not None:
                other, place = taken[clash]
                self.report(
                    f"constraint {quote(constraint.name)}: a coordinate of its joint is called {quote(clash)}, as is "
                    f"one of constraint {other.name}{format_first_location(place)}",
                    source,
                    "rename one of the two constraints",
                )
                continue
            taken.update((name, (constraint, source)) for name in mine)
            valid.append((constraint, source))
        return valid

    def _find_invalid_mimics(self, placed: Sequence[LocatedConstraint]) -> set[str]:
        """Return the joints with invalid mimic chains, and report each; a cycle is reported once."""
        joints = {constraint.name: constraint for constraint, _ in placed if constraint.joint.is_movable}
        present = {constraint.name for constraint, _ in placed if constraint.name not in self.unclear}
        rejected: set[str] = set()
        valid_names: set[str] = set()
        sources = {constraint.name: source for constraint, source in placed}
        for constraint, source in placed:
            mimic = constraint.joint.mimic
            if mimic is None or constraint.name in rejected or constraint.name in valid_names:
                continue
            label = f"constraint {quote(constraint.name)}"
            leader = joints.get(mimic.joint)
            if mimic.joint == constraint.name:
                self.report(f"{label}: its joint follows itself", source, "name another joint, or remove mimic")
            elif mimic.joint in rejected:
                self._report_follower(constraint, source)
            elif mimic.joint in valid_names:
                valid_names.add(constraint.name)
                continue
            elif leader is not None and leader.joint.count != 1:
                self.report(
                    f"{label}: its joint follows {leader.name}, a {leader.joint.type} one with "
                    f"{leader.joint.count} coordinates",
                    source,
                    "follow a joint with one coordinate, revolute or prismatic",
                )
            elif leader is not None:
                chain = find_mimic_chain(constraint, joints)
                last = joints.get(chain[-1])
                if chain[-1] != constraint.name:
                    if last is not None and last.joint.mimic is None and last.joint.count == 1:
                        valid_names.update(chain)
                        continue
                    # the problem is farther along the chain, and reported there
                    tail = chain[: chain.index(chain[-1])]
                    for name in tail if last is not None and last.joint.mimic is not None else tail[:-1]:
                        if name not in rejected:
                            self._report_follower(joints[name], sources[name])
                            rejected.add(name)
                    continue
                cycle = " follows ".join(chain[:MAX_LISTED]) + (" follows ..." if len(chain) > MAX_LISTED else "")
                self.report(
                    f"{label}: joints follow each other in a cycle: {cycle}",
                    source,
                    "remove the mimic of one of them",
                )
                rejected.update(chain)
            elif mimic.joint in present:
                fix = "follow a joint that moves, or remove mimic"
                self.report(f"{label}: its joint follows {mimic.joint}, which does not move", source, fix)
            elif mimic.joint in self.known:
                self._report_follower(constraint, source)
            else:
                near = suggest_name(mimic.joint, joints)
                self.report(
                    f"{label}: its joint follows {quote(mimic.joint)}, and there is no constraint of that name",
                    source,
                    f"write {near[0]}" if near else f"joints here are: {format_names(list(joints))}",
                    near,
                )
            rejected.add(constraint.name)
        return rejected

    def _report_follower(self, constraint: Constraint, source: Location) -> None:
        """Report a follower of a dropped joint; without `repair` nothing is dropped, and the first report is enough."""
        if self.repair and constraint.joint.mimic is not None:
            message = f"constraint {quote(constraint.name)}: its joint follows {constraint.joint.mimic.joint}"
            self.report(f"{message}, which was removed", source, "fix that one")

    def _warn(self, constraint: Constraint, message: str, source: Location, fix: str) -> None:
        self.add_problem(Severity.WARNING, f"constraint {quote(constraint.name)}: {message}", source, fix)

    def _apply_defaults(self, placed: Sequence[LocatedConstraint]) -> tuple[LocatedConstraint, ...]:
        placed = self._drop_out_of_range(placed)
        self._check_degrees(placed)
        applied = apply_mimic_defaults(constraint for constraint, _ in placed)
        for (stated, source), each in zip(placed, applied, strict=True):
            joint, mimic = each.joint, each.joint.mimic
            if mimic is None:
                continue
            unused = f"is not used, because it follows {mimic.joint}"
            if stated.joint.default not in ((), joint.default):
                fix = f"remove it, or state the default of {mimic.joint}"
                self._warn(each, f"the default of its joint {unused}", source, fix)
            if stated.joint.sigma:
                fix = f"remove it, or state the sigma of {mimic.joint}: their errors are common"
                self._warn(each, f"the sigma of its joint {unused}", source, fix)
            if joint.is_out_of_limits(joint.default):
                (value,) = joint.default
                at = f"{math.degrees(value):.4g} deg" if joint.angle_flags[0] else f"{value:.4g} m"
                fix = "fix the multiplier or offset of mimic, the limits, or the default of the joint it follows"
                self._warn(
                    each, f"at the default of {mimic.joint}, its joint is at {at}, out of its limits", source, fix
                )
        return tuple((each, source) for (_, source), each in zip(placed, applied, strict=True))

    def _check_degrees(self, placed: Sequence[LocatedConstraint]) -> None:
        """Warn of angles so large that they look like degrees written as radians."""
        for constraint, source in placed:
            joint = constraint.joint
            for key in ("lower", "upper", "default"):
                turns = [
                    value
                    for value, angle in zip(getattr(joint, key), joint.angle_flags, strict=False)
                    if angle and MAX_ANGLE < abs(value) < math.inf
                ]
                if turns:
                    what = "default" if key == "default" else f"{key} limit"
                    size = f"{turns[0]:.6g} rad, {abs(turns[0]) / math.tau:.3g} turns"
                    fix = "where that is degrees, name them so (limits_deg, default_deg); a winch may turn that far"
                    self._warn(constraint, f"the {what} of its joint is {size}", source, fix)
                    break

    def _drop_out_of_range(self, placed: Sequence[LocatedConstraint]) -> list[LocatedConstraint]:
        """Return those whose default positions are in range; report the others."""
        joints = {constraint.name: constraint for constraint, _ in placed if constraint.joint.is_movable}
        drives = resolve_mimics(joints.values())
        valid = []
        for constraint, source in placed:
            if constraint.joint.mimic is not None:
                drive = drives[constraint.name]
                (leader_default,) = joints[drive.leader].joint.default_position
                if not abs(drive.multiplier * leader_default + drive.offset) <= MAX_POSITION:
                    self.report(
                        f"constraint {quote(constraint.name)}: following {constraint.joint.mimic.joint} puts its "
                        f"joint beyond {MAX_POSITION:g}",
                        source,
                        "fix the multipliers and offsets of the mimic chain",
                    )
                    continue
            valid.append((constraint, source))
        return valid

"""The rules of joints among each other: coordinates with names of their own, and who may follow whom."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

from modelserver.errors import Location, shown, suggestions
from modelserver.geometry.drives import at_rest, drives, followed
from modelserver.geometry.joint import Joint, coordinate_names
from modelserver.geometry.parts import Constraint
from modelserver.geometry.wording import LISTED, few, first_at

Placed = tuple[Constraint, Location]
"""A constraint and where it came from."""


REACH = 1e9
"""Metres or radians; what rests beyond would lose the millimetres of everything else."""


MOST_TURNED = 2.0 * math.tau
"""Radians; an angle beyond two turns is rather one in degrees."""


class JointProblem(NamedTuple):
    """What is wrong with a joint, where, and what to do."""

    message: str
    source: Location
    fix: str
    nearest: tuple[str, ...] = ()


class JointRules:
    """Looks at the joints of constraints that are well formed otherwise.

    `known` are the names of all constraints of the file: what follows one that was refused is not refused again.
    `unclear` are those whose joint could not be read.
    `kept` are those left when the faulty are dropped, with each that follows another settled where its leader's rest
    takes it. With `repair` what followed one that was dropped is dropped as well, and reported.
    """

    def __init__(
        self, placed: Sequence[Placed], known: Iterable[str], unclear: Collection[str] = (), repair: bool = False
    ):
        self.faults: list[JointProblem] = []
        self.warnings: list[JointProblem] = []
        self._known = set(known)
        self._unclear = unclear
        self._repair = repair
        kept = self._with_names_of_their_own(placed)
        while refused := self._refused(kept):
            kept = [each for each in kept if each[0].name not in refused]
        self.kept = self._settled(kept)

    def _with_names_of_their_own(self, placed: Sequence[Placed]) -> list[Placed]:
        kept: list[Placed] = []
        taken: dict[str, Placed] = {}
        for constraint, source in placed:
            mine = coordinate_names(constraint.name, constraint.joint)
            clash = next((name for name in mine if name in taken), None)
            if clash is not None:
                other, place = taken[clash]
                self.faults.append(
                    JointProblem(
                        f"constraint {shown(constraint.name)}: a coordinate of its joint is called {shown(clash)}, as "
                        f"is one of constraint {other.name}{first_at(place)}",
                        source,
                        "rename one of the two constraints",
                    )
                )
                continue
            taken.update((name, (constraint, source)) for name in mine)
            kept.append((constraint, source))
        return kept

    def _refused(self, placed: Sequence[Placed]) -> set[str]:
        """Return the joints that cannot follow as they should, and report each; a circle is reported once."""
        joints = {constraint.name: constraint for constraint, _ in placed if constraint.joint.moves}
        present = {constraint.name for constraint, _ in placed if constraint.name not in self._unclear}
        refused: set[str] = set()
        sound: set[str] = set()
        sources = {constraint.name: source for constraint, source in placed}
        for constraint, source in placed:
            mimic = constraint.joint.mimic
            if mimic is None or constraint.name in refused or constraint.name in sound:
                continue
            label = f"constraint {shown(constraint.name)}"
            leader = joints.get(mimic.joint)
            if mimic.joint == constraint.name:
                self._refuse(f"{label}: its joint follows itself", source, "name another joint, or remove mimic")
            elif mimic.joint in refused:
                self._refuse_follower(constraint, source)
            elif mimic.joint in sound:
                sound.add(constraint.name)
                continue
            elif leader is not None and leader.joint.count != 1:
                self._refuse(
                    f"{label}: its joint follows {leader.name}, a {leader.joint.type} one with "
                    f"{leader.joint.count} coordinates",
                    source,
                    "follow a joint with one coordinate, revolute or prismatic",
                )
            elif leader is not None:
                way = followed(constraint, joints)
                last = joints.get(way[-1])
                if way[-1] != constraint.name:
                    if last is not None and last.joint.mimic is None and last.joint.count == 1:
                        sound.update(way)
                        continue
                    # the fault is farther on, and reported there: in a circle, or at the last that follows
                    tail = way[: way.index(way[-1])]
                    for name in tail if last is not None and last.joint.mimic is not None else tail[:-1]:
                        if name not in refused:
                            self._refuse_follower(joints[name], sources[name])
                            refused.add(name)
                    continue
                round_ = " follows ".join(way[:LISTED]) + (" follows ..." if len(way) > LISTED else "")
                self._refuse(
                    f"{label}: joints follow each other in a circle: {round_}",
                    source,
                    "remove the mimic of one of them",
                )
                refused.update(way)
            elif mimic.joint in present:
                fix = "follow a joint that moves, or remove mimic"
                self._refuse(f"{label}: its joint follows {mimic.joint}, which does not move", source, fix)
            elif mimic.joint in self._known:
                self._refuse_follower(constraint, source)
            else:
                near = suggestions(mimic.joint, joints)
                self._refuse(
                    f"{label}: its joint follows {shown(mimic.joint)}, and there is no constraint of that name",
                    source,
                    f"write {near[0]}" if near else f"joints here are: {few(list(joints))}",
                    near,
                )
            refused.add(constraint.name)
        return refused

    def _refuse_follower(self, constraint: Constraint, source: Location) -> None:
        """Report one that follows what is dropped; where nothing is, that was complaint enough."""
        if self._repair and constraint.joint.mimic is not None:
            message = f"constraint {shown(constraint.name)}: its joint follows {constraint.joint.mimic.joint}"
            self._refuse(f"{message}, which was removed", source, "mend that one")

    def _refuse(self, message: str, source: Location, fix: str, nearest: tuple[str, ...] = ()) -> None:
        self.faults.append(JointProblem(message, source, fix, nearest))

    def _settled(self, placed: Sequence[Placed]) -> tuple[Placed, ...]:
        placed = self._within_reach(placed)
        self._warn_of_degrees(placed)
        settled = at_rest(constraint for constraint, _ in placed)
        for (stated, source), each in zip(placed, settled, strict=True):
            joint, mimic = each.joint, each.joint.mimic
            if mimic is None:
                continue
            label = f"constraint {shown(each.name)}"
            if stated.joint.default not in ((), joint.default):
                self.warnings.append(
                    JointProblem(
                        f"{label}: the default of its joint counts for nothing, for it follows {mimic.joint}",
                        source,
                        f"remove it, or state the default of {mimic.joint}",
                    )
                )
            if stated.joint.sigma:
                self.warnings.append(
                    JointProblem(
                        f"{label}: the sigma of its joint counts for nothing, for it follows {mimic.joint}",
                        source,
                        f"remove it, or state the sigma of {mimic.joint}: a follower errs with its leader",
                    )
                )
            if joint.out_of_limits(joint.default):
                self.warnings.append(
                    JointProblem(
                        f"{label}: where {mimic.joint} rests, its joint is at {_measure(joint)}, out of its limits",
                        source,
                        "mend the multiplier or offset of mimic, the limits, or the default of the joint it follows",
                    )
                )
        return tuple((each, source) for (_, source), each in zip(placed, settled, strict=True))

    def _warn_of_degrees(self, placed: Sequence[Placed]) -> None:
        """Say where angles are so large that they look like degrees written as radians."""
        for constraint, source in placed:
            joint = constraint.joint
            for key in ("lower", "upper", "default"):
                turns = [
                    value
                    for value, angle in zip(getattr(joint, key), joint.is_angle, strict=False)
                    if angle and MOST_TURNED < abs(value) < math.inf
                ]
                if turns:
                    what = "default" if key == "default" else f"{key} limit"
                    self.warnings.append(
                        JointProblem(
                            f"constraint {shown(constraint.name)}: the {what} of its joint is {turns[0]:.6g} rad, "
                            f"{abs(turns[0]) / math.tau:.3g} turns",
                            source,
                            "where that is degrees, name them so (limits_deg, default_deg); a winch may turn that far",
                        )
                    )
                    break

    def _within_reach(self, placed: Sequence[Placed]) -> list[Placed]:
        """Return those whose positions at rest are numbers; what follows one that is none is none either."""
        joints = {constraint.name: constraint for constraint, _ in placed if constraint.joint.moves}
        placed_by = drives(joints.values())
        kept = []
        for constraint, source in placed:
            if constraint.joint.mimic is not None:
                drive = placed_by[constraint.name]
                (rest,) = joints[drive.leader].joint.rest
                if not abs(drive.multiplier * rest + drive.offset) <= REACH:
                    self._refuse(
                        f"constraint {shown(constraint.name)}: following {constraint.joint.mimic.joint} takes its "
                        "joint out of all reach",
                        source,
                        "mend the multipliers and offsets on the way",
                    )
                    continue
            kept.append((constraint, source))
        return kept


def _measure(joint: Joint) -> str:
    (value,) = joint.default
    return f"{math.degrees(value):.4g} deg" if joint.is_angle[0] else f"{value:.4g} m"

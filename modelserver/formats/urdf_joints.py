"""Joints of URDF: types, axes, limits, and which joint follows which."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

from modelserver.errors import Severity, Suggested, shown, suggestions
from modelserver.formats.spelling import label, nearest_keys
from modelserver.formats.urdf_shapes import Attributes
from modelserver.formats.xml_document import children, tag
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import FIXED, Coordinates, Joint, JointType, Mimic

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

UNLIMITED = 1e9
"""A limit as great as this is none: URDF demands numbers where a joint has no limits."""

SUGGESTED = 50
"""Unknown names for which nearest ones are looked up; a file with more wrong has another illness."""

_TYPES = {
    "revolute": JointType.REVOLUTE,
    "continuous": JointType.REVOLUTE,
    "prismatic": JointType.PRISMATIC,
    "fixed": JointType.FIXED,
    "floating": JointType.FLOATING,
    "planar": JointType.PLANAR,
}
_SINGLE = (JointType.REVOLUTE, JointType.PRISMATIC)


class JointReader(Attributes):
    """Reads how joints move. `note_type` is called for all joints before `motion` is for any."""

    def __init__(self, builder: ModelBuilder, file: str):
        super().__init__(builder, file)
        self.of_type: dict[str, JointType] = {}
        self.suggested = 0

    def note_type(self, element: Element) -> None:
        """Remember the type of a joint, for those that follow it."""
        kind = _TYPES.get((element.get("type") or "").strip())
        if kind is not None:
            self.of_type.setdefault((element.get("name") or "").strip(), kind)

    def nearest(self, name: str, known: Iterable[str]) -> Suggested:
        """Return the name that one which is not known misspells."""
        self.suggested += 1
        return suggestions(name, known) if self.suggested <= SUGGESTED else Suggested()

    def motion(self, element: Element, parts: dict[str, Element], place: str) -> Joint | None:
        """Return how a joint moves; None, with the error reported, where that cannot be said."""
        said = self.text(element, "type", place, f"add type, one of {', '.join(_TYPES)}")
        if said is None:
            return None
        kind = _TYPES.get(said)
        if kind is None:
            near = nearest_keys(said, tuple(_TYPES))
            self.error(
                f"type {shown(said)} is not known",
                element,
                place,
                f"write {near[0]}" if near else f"types are {', '.join(_TYPES)}",
                near,
            )
            return None
        if kind is JointType.FIXED:
            return FIXED
        axis = [1.0, 0.0, 0.0] if "axis" not in parts else self.numbers(parts["axis"], "xyz", 3, place, (1.0, 0.0, 0.0))
        limits = self.limits(element, said, parts.get("limit"), place)
        mimic = self.mimic(parts.get("mimic"), kind, place)
        if axis is None or limits is None:
            return None
        lower, upper, rate = limits
        try:
            return Joint(kind, (axis[0], axis[1], axis[2]), lower, upper, rate, mimic=mimic)
        except ValueError as error:
            where = parts.get("axis" if "axis" in str(error) else "limit", element)
            self.error(str(error), where, place, "write <axis> as a direction, and <limit> with lower below upper")
            return None

    def limits(
        self, element: Element, said: str, limit: Element | None, place: str
    ) -> tuple[Coordinates, Coordinates, Coordinates] | None:
        """Return lower, upper and the limit of the rate of a joint, each empty where there is none."""
        bounded = said in ("revolute", "prismatic")
        if limit is None:
            if bounded:
                more = ', or write type="continuous"' if said == "revolute" else ""
                fix = f'add <limit lower="..." upper="..." effort="..." velocity="..."/>{more}'
                self.error(f"a {said} joint needs a <limit>", element, place, fix)
            return None if bounded else ((), (), ())
        if said in ("planar", "floating"):
            self.builder.problem(
                Severity.NOTE,
                f"the limit of a {said} joint says not of which coordinate; passed over",
                self.at(limit, place),
            )
            return (), (), ()
        rate = self.number(limit, "velocity", place, UNLIMITED)
        if not bounded:
            return None if rate is None else ((), (), _bound(abs(rate)))
        if limit.get("lower") is None and limit.get("upper") is None:
            self.warning(
                "the limit has neither lower nor upper, which are 0 then: the joint cannot move",
                limit,
                place,
                "write lower and upper" + (', or type="continuous"' if said == "revolute" else ""),
            )
        lower, upper = self.number(limit, "lower", place, 0.0), self.number(limit, "upper", place, 0.0)
        if lower is None or upper is None or rate is None:
            return None
        if lower <= -UNLIMITED and upper >= UNLIMITED:
            return (), (), _bound(abs(rate))
        # one that is as good as none beside one that counts
        lower, upper = (-math.inf if lower <= -UNLIMITED else lower), (math.inf if upper >= UNLIMITED else upper)
        return (lower,), (upper,), _bound(abs(rate))

    def mimic(self, element: Element | None, kind: JointType, place: str) -> Mimic | None:
        """Return what a joint follows; None where it follows nothing, or wrongly, which is reported."""
        if element is None:
            return None
        leader = self.text(element, "joint", place)
        factor, offset = self.number(element, "multiplier", place, 1.0), self.number(element, "offset", place, 0.0)
        if leader is None or factor is None or offset is None:
            return None
        if kind not in _SINGLE:
            self.error(f"a {kind} joint has several coordinates and can follow none", element, place, "remove <mimic>")
            return None
        found = self.of_type.get(leader)
        if found is None:
            near = self.nearest(leader, self.of_type)
            self.error(
                f"mimic names joint {shown(leader)}, which does not exist",
                element,
                place,
                f"write {near[0]}" if near else "name a joint of this file",
                near,
            )
            return None
        if found not in _SINGLE:
            self.error(
                f"mimic names joint {label(leader)}, which is {found}",
                element,
                place,
                "name a revolute, continuous or prismatic joint",
            )
            return None
        return Mimic(leader, factor, offset)

    def report_efforts(self, joints: list[Element]) -> None:
        """Say once what joints state and a model does not hold."""
        said: dict[str, list[Element]] = {}
        for joint in joints:
            for child in children(joint):
                if tag(child) == "limit" and child.get("effort") is not None:
                    said.setdefault("effort limits", []).append(child)
                elif tag(child) in ("dynamics", "safety_controller", "calibration"):
                    said.setdefault(f"<{tag(child)}>", []).append(child)
        for what, found in said.items():
            count = f"{len(found)} joint{'' if len(found) == 1 else 's'}"
            self.builder.problem(Severity.NOTE, f"{what} of {count} passed over", self.at(found[0], ""))


def _bound(value: float) -> Coordinates:
    return () if value >= UNLIMITED else (value,)

"""The fields of a body, frame or constraint in the editor: numbers and texts that are set together."""

from __future__ import annotations

import math
import queue
from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import StrEnum
from typing import Any, Final

import numpy as np
import viser

from modelserver.errors import QueryError, quote
from modelserver.formats.common import format_number
from modelserver.geometry import names
from modelserver.geometry.joint import TYPES_WITH_AXIS, Joint, JointType, Mimic
from modelserver.geometry.model import Model
from modelserver.geometry.parts import BodyFrame, Constraint, Sigma
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3
from mstools.edit.document import GeometryDocument, GeometryItem, ItemKind
from mstools.edit.session import EditSession
from mstools.edit.yaml_text import EditError
from mstools.view.number_fields import PRECISION, NumberFields, parse_typed

SAME: Final = 10.0**-PRECISION
"""A number that differs by less from what a field was given was not changed in it."""

NO_LEADER: Final = "-"
_INFINITE: Final = {".inf": math.inf, "-.inf": -math.inf}

ChangeItem = Callable[[Callable[[GeometryDocument], GeometryDocument], GeometryItem | None], bool]
"""Makes a change and selects an item; returns whether it could be made."""


class Snap(StrEnum):
    """Steps to which the gizmo rounds."""

    NONE = "none"
    FINE = "1 mm, 1 deg"
    MEDIUM = "1 cm, 5 deg"
    COARSE = "5 cm, 15 deg"

    @property
    def steps(self) -> tuple[float, float]:
        """Meters and degrees; without snap what a hand can place."""
        return {Snap.NONE: (1e-4, 0.01), Snap.FINE: (1e-3, 1.0), Snap.MEDIUM: (0.01, 5.0)}.get(self, (0.05, 15.0))


def list_frames(document: GeometryDocument) -> list[str]:
    return [each.name for each in document.list_items() if each.kind is ItemKind.FRAME]


def find_part(model: Model | None, item: GeometryItem) -> BodyFrame | Constraint | None:
    """Return the frame or constraint of a model that an item is; None for a body, and for one that is not there."""
    if model is None or item.kind is ItemKind.BODY:
        return None
    if item.kind is ItemKind.CONSTRAINT:
        return next((each for each in model.constraints if each.name == item.name), None)
    try:
        return model.frame(item.name)
    except QueryError:
        return None


class ItemFields:
    """A form with the fields of what is selected; its button sets all of them as one change."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: EditSession,
        change: ChangeItem,
        actions: queue.SimpleQueue[Callable[[], None]],
    ):
        self._server = server
        self._gui = gui = server.gui
        self._session = session
        self._change = change
        self._actions = actions
        self._item: GeometryItem | None = None
        self._form: Any = None
        self._part: BodyFrame | Constraint | None = None
        self._fields: dict[str, Any] = {}
        self._given: dict[str, Any] = {}
        self._place = gui.add_folder("Values")

    # --- what is shown

    def show(self, item: GeometryItem) -> None:
        """Show the fields of an item."""
        self._item = item
        self._fields, self._given = {}, {}
        self._part = find_part(self._session.drawn, item)
        old = self._form
        with self._server.atomic():
            with self._place:
                self._form = self._gui.add_form(None)
            with self._form:
                self._add_fields(item)
            if old is not None:
                # last: a page hides a folder that was empty for a moment, and may never show it again
                old.remove()
        self._form.on_submit(lambda _: self._actions.put(self._submit))

    def _add_fields(self, item: GeometryItem) -> None:
        document = self._session.document
        self._add("name", self._gui.add_text("Name", item.name.rpartition(":")[2]))
        template = document.find_template(item)
        if template:
            users = ", ".join(document.list_users(template))
            hint = f"Else {item.name.partition(':')[0]} alone gets an entry of its own"
            self._add("template", self._gui.add_checkbox(f"For all of {template}: {users}", False, hint=hint))
        if isinstance(self._part, Constraint):
            self._add_ends(self._part)
        if self._part is not None:
            self._add_pose(self._part.pose, self._part.sigma)
        if isinstance(self._part, Constraint):
            self._add_joint(self._part.joint)
        self._add("description", self._gui.add_text("Description", self._get_description(item)))
        self._gui.add_button("Set").on_click(lambda _: self._actions.put(self._submit))

    def _get_description(self, item: GeometryItem) -> str:
        if self._part is not None:
            return self._part.description
        bodies = {each.name: each for each in self._session.drawn.bodies}
        return bodies[item.name].description if item.name in bodies else ""

    def _add(self, key: str, field: Any) -> None:
        self._fields[key], self._given[key] = field, field.value

    def _add_vector(self, key: str, labels: Sequence[str], values: Sequence[float]) -> None:
        self._add(key, NumberFields(self._gui, labels, values, self._actions))
        self._given[key] = tuple(values)

    def _add_pose(self, pose: Pose, sigma: Sigma | None) -> None:
        degrees = [math.degrees(each) for each in pose.rpy]
        self._add_vector("xyz", ("x (m)", "y (m)", "z (m)"), pose.xyz)
        self._add_vector("rpy", ("roll (deg)", "pitch (deg)", "yaw (deg)"), degrees)
        self._add(
            "has_sigma", self._gui.add_checkbox("Sigma", sigma is not None, hint="Standard deviations are stated")
        )
        known = sigma or Sigma()
        turns = np.degrees(known.rotation).tolist()
        self._add_vector("sigma_xyz", [f"sigma {axis} (m)" for axis in "xyz"], known.position)
        self._add_vector("sigma_rpy", [f"sigma {axis} (deg)" for axis in ("roll", "pitch", "yaw")], turns)

    def _add_ends(self, constraint: Constraint) -> None:
        frames = tuple(list_frames(self._session.document))
        for key, frame in (("from", constraint.from_), ("to", constraint.to)):
            self._add(key, self._gui.add_dropdown(key, frames, initial_value=frame if frame in frames else frames[0]))

    def _add_joint(self, joint: Joint) -> None:
        gui = self._gui
        self._add("joint", gui.add_dropdown("Joint", tuple(JointType), initial_value=joint.type))
        if not joint.is_movable:
            return
        if joint.type in TYPES_WITH_AXIS:
            self._add_vector("axis", [f"axis {axis}" for axis in "xyz"], joint.axis)
        if joint.count > 1:
            gui.add_markdown("Limits and more of a joint with several coordinates: under *As text*.")
            return
        unit = "deg" if joint.type is JointType.REVOLUTE else "m"
        scale = math.degrees(1.0) if unit == "deg" else 1.0
        limits = [*joint.lower, *joint.upper] if joint.lower and joint.upper else []
        if joint.lower and not joint.upper:
            limits = [joint.lower[0], math.inf]
        elif joint.upper and not joint.lower:
            limits = [-math.inf, joint.upper[0]]
        for key, label, values in (
            ("limits", f"limits ({unit})", limits),
            ("rate_limit", f"rate limit ({unit}/s)", joint.rate_limit),
            ("default", f"default ({unit})", joint.default),
            ("sigma", f"joint sigma ({unit})", joint.sigma),
        ):
            self._add(key, gui.add_text(label, _format_values(values, scale), hint="Empty: none is stated"))
        assert self._item is not None
        others = [each.name for each in self._session.document.list_items() if each.kind is ItemKind.CONSTRAINT]
        leaders = (NO_LEADER, *(each for each in others if each != self._item.name))
        mimic = joint.mimic
        leader = mimic.joint if mimic is not None and mimic.joint in leaders else NO_LEADER
        self._add("leader", gui.add_dropdown("follows", leaders, initial_value=leader))
        known = mimic or Mimic("")
        self._add("multiplier", gui.add_text("multiplier", format_number(known.multiplier)))
        self._add("offset", gui.add_text(f"offset ({unit})", _format_values([known.offset], scale)))

    @property
    def in_template(self) -> bool:
        """Whether all bodies of the template are to change."""
        return "template" in self._fields and bool(self._fields["template"].value)

    # --- what is set

    def _submit(self) -> None:
        self.set()

    def commit(self) -> bool:
        """Set what was typed, if anything was; return whether nothing is left that cannot be set."""
        return self._item is None or not self._is_typed() or self.set()

    def _is_typed(self) -> bool:
        try:
            return any(self._differs(key) for key in self._fields if key != "template")
        except EditError:
            return True

    def set(self) -> bool:
        """Set what was changed in the fields; return whether that could be done."""
        item = self._item
        assert item is not None
        plain = item.name.rpartition(":")[2]
        name = self._fields["name"].value.strip()
        new = GeometryItem(item.kind, item.name.removesuffix(plain) + name) if name != plain else None
        return self._change(lambda document: self._write(document, item, name if new is not None else ""), new)

    def _write(self, document: GeometryDocument, item: GeometryItem, name: str) -> GeometryDocument:
        in_template = self.in_template
        if self._is_changed("xyz", "rpy"):
            document = document.set_pose(item, self._read_vector("xyz"), self._read_vector("rpy"), in_template)
        if self._is_changed("has_sigma", "sigma_xyz", "sigma_rpy"):
            # numbers that are typed are meant, whatever the checkbox has
            is_stated = self._fields["has_sigma"].value or self._is_changed("sigma_xyz", "sigma_rpy")
            stated = [self._read_vector(key) if is_stated else None for key in ("sigma_xyz", "sigma_rpy")]
            document = document.set_sigma(item, stated[0], stated[1], in_template)
        if self._is_changed("description"):
            document = document.set_description(item, self._fields["description"].value.strip(), in_template)
        if isinstance(self._part, Constraint):
            if self._is_changed("from", "to"):
                document = document.set_ends(item.name, self._fields["from"].value, self._fields["to"].value)
            joint = self._read_joint(self._part.joint)
            if joint != self._part.joint:
                document = document.set_joint(item.name, self._part.joint, joint)
        return document.rename(item, name, in_template) if name else document

    def _is_changed(self, *keys: str) -> bool:
        """Return whether a field was changed; where the text has a wrong change of the item, all count as such."""
        assert self._item is not None
        present = [key for key in keys if key in self._fields]
        # the fields show the model that is drawn, not what the text has
        is_wrong = self._session.has_errors and not self._session.is_as_loaded(self._item)
        return any(is_wrong or self._differs(key) for key in present)

    def _differs(self, key: str) -> bool:
        given, value = self._given[key], self._fields[key].value
        if isinstance(given, tuple):
            return any(abs(a - b) > SAME for a, b in zip(given, value, strict=True))
        return bool(given != value)

    def _read_vector(self, key: str) -> Vector3:
        """Return the numbers of a field; those that were not changed are as exact as they were given."""
        pairs = zip(self._given[key], self._fields[key].value, strict=True)
        x, y, z = (float(old if abs(old - new) <= SAME else new) for old, new in pairs)
        return (x, y, z)

    def _read_joint(self, old: Joint) -> Joint:
        """Return the joint that the fields state. Raises EditError for a wrong number."""
        keys = ("joint", "axis", "limits", "rate_limit", "default", "sigma", "leader", "multiplier", "offset")
        if not any(key in self._fields and self._differs(key) for key in keys):
            return old
        kind = JointType(self._fields["joint"].value)
        axis = self._read_vector("axis") if "axis" in self._fields else (0.0, 0.0, 1.0)
        try:
            if kind is JointType.FIXED:
                return Joint()
            if kind is not old.type:
                # its numbers had other units
                return Joint(kind, axis)
            if "limits" not in self._fields:
                return replace(old, axis=axis)
            is_angle = kind is JointType.REVOLUTE
            limits = self._read_values("limits", 2, is_angle)
            if limits and limits[0] > limits[1]:
                raise EditError(f"limits: expected the lower one first, got {quote(self._fields['limits'].value, 40)}")
            mimic = None
            if self._fields["leader"].value != NO_LEADER:
                (multiplier,) = self._read_values("multiplier", 1, is_angle=False) or (1.0,)
                (offset,) = self._read_values("offset", 1, is_angle) or (0.0,)
                mimic = Mimic(self._fields["leader"].value, multiplier, offset)
            return Joint(
                kind,
                axis,
                limits[:1],
                limits[1:],
                self._read_values("rate_limit", 1, is_angle),
                self._read_values("default", 1, is_angle) if mimic is None else (),
                self._read_values("sigma", 1, is_angle),
                mimic,
            )
        except ValueError as error:
            raise EditError(str(error)) from None

    def _read_values(self, key: str, count: int, is_angle: bool) -> tuple[float, ...]:
        """Return the numbers in a text, none for an empty one, radians and meters."""
        text = self._fields[key].value.strip()
        if not text:
            return ()
        parts = [each.strip() for each in text.strip("[]").split(",")]
        if len(parts) != count:
            what = "two numbers, lower and upper" if count == 2 else "one number"
            raise EditError(f"{key.replace('_', ' ')}: expected {what}, got {quote(text, 40)}")
        if not self._differs(key):
            # as exact as it is in the file
            assert isinstance(self._part, Constraint)
            joint = self._part.joint
            exact = {
                "limits": joint.lower + joint.upper,
                "rate_limit": joint.rate_limit,
                "default": joint.default,
                "sigma": joint.sigma,
            }.get(key, ())
            if len(exact) == count:
                return exact
        try:
            numbers = [_INFINITE[each.lower()] if each.lower() in _INFINITE else parse_typed(each) for each in parts]
        except ValueError as error:
            raise EditError(f"{key.replace('_', ' ')}: {error}") from None
        return tuple([math.radians(each) if is_angle else each for each in numbers])

    # --- gizmo

    def find_place(self) -> tuple[str, Pose, Pose] | None:
        """Return the body on which the pose stands, that of its parent on it, and the pose; None for a body."""
        model, part = self._session.drawn, self._part
        if part is None or self._item is None:
            return None
        if isinstance(part, BodyFrame):
            return names.split(self._item.name)[0], Pose.identity(), part.pose
        return names.split(part.from_)[0], model.frame(part.from_).pose, part.pose

    def set_dragged(self, pose: Pose, snap: Snap, is_end: bool) -> None:
        """Show where the gizmo is; at the end of a drag set it. What was not moved, or not turned, stays exact."""
        if self._part is None:
            return
        meters, degrees = snap.steps
        moved, turned = self._part.pose.distance(pose)
        if moved > SAME:
            self._fields["xyz"].value = tuple([round(round(each / meters) * meters, PRECISION) for each in pose.xyz])
        if turned > SAME:
            rpy = [math.degrees(each) for each in so3.to_rpy(pose.wxyz)]
            self._fields["rpy"].value = tuple([round(round(each / degrees) * degrees, PRECISION) for each in rpy])
        if is_end:
            self.set()


def _format_values(values: Sequence[float], scale: float) -> str:
    """Return numbers as a text, angles in degrees."""
    known = {math.inf: ".inf", -math.inf: "-.inf"}
    return ", ".join(known.get(each) or format_number(round(each * scale, 9) + 0.0) for each in values)

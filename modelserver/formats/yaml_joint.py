"""Read joints of the YAML format: `joint: floating`, or a mapping with type, axis, limits and so on.

A key that ends in `_deg` is in degrees, one without it in meters and radians, as `rpy_deg` and `rpy` are. A joint with
one coordinate has plain values; one with several has a mapping by coordinate: `limits: {x: [-1, 1], turn_deg: [-90,
90]}`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from modelserver.errors import quote, suggest_name
from modelserver.formats.reading import MAX_POSITION
from modelserver.formats.yaml_nodes import NodeKind, NodeReader, YamlNode
from modelserver.geometry.joint import FIXED, SUFFIXES, TYPES_WITH_AXIS, Joint, JointType, Mimic
from modelserver.transforms.so3 import Vector3

_QUANTITIES = ("limits", "rate_limit", "default", "sigma")
_KEYS = ("type", "axis", *(f"{key}{unit}" for key in _QUANTITIES for unit in ("", "_deg")), "mimic")
_JOINT_TYPES = tuple(str(each) for each in JointType)
_INFINITE = {".inf": math.inf, "+.inf": math.inf, "-.inf": -math.inf}

_Values = tuple[float, ...]
_Read = Callable[[YamlNode, str, bool], _Values | None]
"""Reads the value of a key, given the key and whether it is in degrees; None, with an error, if it is wrong."""


def read_joint(reader: NodeReader, node: YamlNode, place: str) -> Joint | None:
    """Read the joint of a constraint; None, with an error, if it is wrong."""
    if node.kind is not NodeKind.MAPPING:
        kind = _read_type(reader, node, place, "joint")
        fields: dict[str, YamlNode] = {}
    else:
        place = f"{place}, joint"
        fields = reader.read_fields(node, place, _KEYS)
        if "type" not in fields:
            reader.error("type is missing", node, place, f"add type: with one of {', '.join(_JOINT_TYPES)}")
            return None
        kind = _read_type(reader, fields["type"], place, "type")
    return None if kind is None else _YamlJointReader(reader, node, place, kind, fields).read()


def _read_type(reader: NodeReader, node: YamlNode, place: str, key: str) -> JointType | None:
    text = reader.read_text(node, place, key)
    if node.kind is not NodeKind.SCALAR:
        return None
    if text in _JOINT_TYPES:
        return JointType(text)
    near = suggest_name(text, _JOINT_TYPES)
    fix = f"write {key}: {near[0]}" if near else f"joints are {', '.join(_JOINT_TYPES)}"
    reader.error(f"there is no joint {quote(text)}", node, place, fix, near)
    return None


class _YamlJointReader:
    def __init__(self, reader: NodeReader, node: YamlNode, place: str, kind: JointType, fields: dict[str, YamlNode]):
        self.reader = reader
        self.node = node
        self.place = place
        self.kind = kind
        self.fields = fields
        self.names = [suffix.removeprefix(".") for suffix in SUFFIXES[kind]]
        self.is_angle = dict(zip(self.names, Joint(kind).angle_flags, strict=True))
        self.has_errors = False

    def read(self) -> Joint | None:
        if self.kind is JointType.FIXED:
            for key, node in self.fields.items():
                if key != "type":
                    self.error(f"{key}: a fixed joint does not move", node, f"remove {key}, or write another type")
            return None if self.has_errors else FIXED
        axis = self.read_axis()
        limits = self.read_quantity("limits", self.read_limits, (-math.inf, math.inf))
        rates = self.read_quantity("rate_limit", self.read_non_negative, (math.inf,))
        defaults = self.read_quantity("default", self.read_default, (0.0,))
        sigmas = self.read_quantity("sigma", self.read_non_negative, None)
        mimic = self.read_mimic()
        for name, (value,) in defaults.items():
            low, high = limits.get(name, (-math.inf, math.inf))
            if not low - 1e-9 <= value <= high + 1e-9:
                of = f" of {name}" if name else ""
                self.error(f"the default{of} is out of the limits", self.find_node("default"), "put it within them")
        if self.has_errors:
            return None
        try:
            return Joint(
                self.kind,
                axis,
                tuple([low for low, _ in limits.values()]),
                tuple([high for _, high in limits.values()]),
                tuple([value for (value,) in rates.values()]),
                tuple([value for (value,) in defaults.values()]),
                tuple([value for (value,) in sigmas.values()]),
                mimic,
            )
        except ValueError as error:
            self.error(str(error), self.node, "see Joints in docs/geometry-files.md")
            return None

    def error(self, message: str, node: YamlNode, fix: str) -> None:
        self.has_errors = True
        self.reader.error(message, node, self.place, fix)

    def find_node(self, key: str) -> YamlNode:
        """Return the node of a quantity, in either unit; that of the joint if it is absent."""
        return self.fields.get(key) or self.fields.get(f"{key}_deg") or self.node

    def read_axis(self) -> Vector3:
        up = (0.0, 0.0, 1.0)
        node = self.fields.get("axis")
        if self.kind not in TYPES_WITH_AXIS:
            if node is not None:
                self.error(f"a {self.kind} joint has no axis", node, "remove axis")
            return up
        if node is None:
            if self.kind is not JointType.PLANAR:
                verb = "turns about" if self.kind is JointType.REVOLUTE else "slides along"
                fix = f"write joint: {{type: {self.kind}, axis: [0, 1, 0]}} with the direction that it {verb}"
                self.error(f"a {self.kind} joint needs an axis", self.node, fix)
            return up
        values = self.reader.read_numbers(node, 3, self.place, "axis", "")
        if values is None:
            self.has_errors = True
            return up
        length = math.hypot(*values)
        if not 1e-9 < length < math.inf:
            self.error("the axis has no direction", node, "write e.g. axis: [0, 1, 0]; its length does not matter")
            return up
        return (values[0], values[1], values[2])

    def read_quantity(self, key: str, read: _Read, omitted: _Values | None) -> dict[str, _Values]:
        """Read the value of a key for each coordinate; empty if the key is absent.

        A coordinate that a mapping omits has the value `omitted`; None if it must have all.
        """
        plain, degrees = self.fields.get(key), self.fields.get(f"{key}_deg")
        if plain is None and degrees is None:
            return {}
        if plain is not None and degrees is not None:
            self.error(f"{key} and {key}_deg are both given", degrees, "keep one of the two")
            return {}
        if len(self.names) == 1:
            return self.read_single(key, plain, degrees, read)
        if degrees is not None:
            first = next(name for name, angle in self.is_angle.items() if angle)
            fix = f"write {key}: {{{first}_deg: ...}}, by coordinate"
            self.error(f"{key}_deg: a {self.kind} joint has several coordinates", degrees, fix)
            return {}
        assert plain is not None
        return self.read_by_coordinate(key, plain, read, omitted)

    def read_single(
        self, key: str, plain: YamlNode | None, degrees: YamlNode | None, read: _Read
    ) -> dict[str, _Values]:
        if degrees is not None and not self.is_angle[""]:
            self.error(f"{key}_deg: a {self.kind} joint moves in meters", degrees, f"write {key}: in meters")
            return {}
        value = None
        if degrees is not None:
            value = read(degrees, f"{key}_deg", True)
        elif plain is not None:
            value = read(plain, key, False)
        self.has_errors |= value is None
        return {} if value is None else {"": value}

    def read_by_coordinate(self, key: str, node: YamlNode, read: _Read, omitted: _Values | None) -> dict[str, _Values]:
        keys = self.list_coordinate_keys()
        if node.kind is not NodeKind.MAPPING:
            example = ", ".join(f"{each}: ..." for each in list(keys)[: len(self.names)])
            self.error(
                f"{key} of a {self.kind} joint is a mapping by coordinate, got {node.kind.value}",
                node,
                f"write {key}: {{{example}}}",
            )
            return {}
        before = len(self.reader.builder.problems)
        fields = self.reader.read_fields(node, f"{self.place}, {key}", tuple(keys))
        self.has_errors |= len(self.reader.builder.problems) > before
        found: dict[str, _Values] = {}
        for each, inside in fields.items():
            name, is_degrees = keys[each]
            if is_degrees and not self.is_angle[name]:
                self.error(f"{key}: {each} is a length, not an angle", inside, f"write {name}: in meters")
            elif name in found:
                self.error(f"{name} and {name}_deg are both given", inside, "keep one of the two")
            value = read(inside, each, is_degrees)
            self.has_errors |= value is None
            found[name] = value or omitted or ()
        missing = [name for name in self.names if name not in found]
        if missing and omitted is None:
            self.error(f"{key} does not state {', '.join(missing)}", node, "state it of each coordinate; 0 is exact")
        return {name: found.get(name, omitted or ()) for name in self.names}

    def list_coordinate_keys(self) -> dict[str, tuple[str, bool]]:
        """Return the keys of a mapping by coordinate, each with the coordinate and whether it is in degrees.

        The usual keys come first. Lengths in degrees are included for an error of their own.
        """
        keys = {f"{name}_deg" if angle else name: (name, angle) for name, angle in self.is_angle.items()}
        keys |= {name: (name, False) for name in self.names}
        return keys | {f"{name}_deg": (name, True) for name in self.names}

    def read_joint_name(self, node: YamlNode, key: str) -> str:
        """Return the name of the joint that this one follows; empty, with an error, if there is none."""
        name = self.reader.read_text(node, self.place, key)
        if node.kind is NodeKind.SCALAR and not name:
            self.error(f"{key} names no joint", node, f"write {key}: NAME, of another constraint")
        self.has_errors |= not name
        return name

    def read_limits(self, node: YamlNode, key: str, is_degrees: bool) -> _Values | None:
        fix = f"write {key}: [lower, upper]; .inf is none"
        if node.kind is not NodeKind.LIST or len(node.items) != 2:
            self.error(f"{key} is a list of 2 numbers, lower and upper", node, fix)
            return None
        pair = []
        for item in node.items:
            value = _INFINITE.get(item.text.lower()) if item.is_plain else None
            if value is None:
                value = self.read_number(item, key, fix)
            if value is None:
                return None
            pair.append(value)
        low, high = pair
        if low > high or low == math.inf or high == -math.inf:
            self.error(f"{key} are reversed: lower {low:g}, upper {high:g}", node, f"write {key}: [{high:g}, {low:g}]")
            return None
        return (math.radians(low), math.radians(high)) if is_degrees else (low, high)

    def read_non_negative(self, node: YamlNode, key: str, is_degrees: bool) -> _Values | None:
        value = self.read_number(node, key, f"write {key}: number")
        if value is None:
            return None
        if value < 0.0:
            self.error(f"{key} is not negative, got {value:g}", node, f"write {key}: {-value:g}, if that was meant")
            return None
        return (math.radians(value) if is_degrees else value,)

    def read_default(self, node: YamlNode, key: str, is_degrees: bool) -> _Values | None:
        value = self.read_number(node, key, f"write {key}: number")
        return None if value is None else (math.radians(value) if is_degrees else value,)

    def read_number(self, node: YamlNode, key: str, fix: str) -> float | None:
        """Read one number that is not too large."""
        value = self.reader.read_number(node, self.place, key, fix)
        if value is not None and abs(value) > MAX_POSITION:
            self.error(f"{key}: {value:g} is out of reach; the limit is {MAX_POSITION:g}", node, fix)
            return None
        self.has_errors |= value is None
        return value

    def read_mimic(self) -> Mimic | None:
        node = self.fields.get("mimic")
        if node is None:
            return None
        if len(self.names) != 1:
            fix = "remove mimic; what follows another is revolute or prismatic"
            self.error(f"a {self.kind} joint has several coordinates and cannot follow another", node, fix)
            return None
        if node.kind is not NodeKind.MAPPING:
            name = self.read_joint_name(node, "mimic")
            return Mimic(name) if name else None
        place = f"{self.place}, mimic"
        before = len(self.reader.builder.problems)
        fields = self.reader.read_fields(node, place, ("joint", "multiplier", "offset", "offset_deg"))
        self.has_errors |= len(self.reader.builder.problems) > before
        name = self.read_joint_name(fields["joint"], "joint") if "joint" in fields else ""
        if "joint" not in fields:
            self.error("mimic does not name the joint that it follows", node, "write mimic: {joint: NAME}")
        numbers_ = {key: self.read_number(fields[key], key, f"write {key}: number") for key in fields if key != "joint"}
        multiplier, offset = numbers_.get("multiplier", 1.0), numbers_.get("offset", 0.0)
        if "offset_deg" in fields:
            degrees = numbers_["offset_deg"]
            offset = None if degrees is None else math.radians(degrees)
            if "offset" in fields:
                self.error("offset and offset_deg are both given", fields["offset_deg"], "keep one of the two")
            elif not self.is_angle[""]:
                fix = "write offset: in meters"
                self.error(f"offset_deg: a {self.kind} joint moves in meters", fields["offset_deg"], fix)
        if not name or multiplier is None or offset is None:
            return None
        return Mimic(name, multiplier, offset)

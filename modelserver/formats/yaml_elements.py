"""Read poses, sigmas, inertias and joints of the YAML geometry format from the nodes of a file.

A joint is `joint: floating`, or a mapping with type, axis, limits and so on. A key that ends in `_deg` is in degrees,
one without it in meters and radians, as `rpy_deg` and `rpy` are. A joint with one coordinate has plain values; one with
several has a mapping by coordinate: `limits: {x: [-1, 1], turn_deg: [-90, 90]}`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from modelserver.errors import has_error, quote, suggest_name
from modelserver.formats import common
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import FIXED, SUFFIXES, TYPES_WITH_AXIS, Joint, JointType, Mimic
from modelserver.geometry.parts import RigidInertia, Rows, Sigma
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion, Vector3
from modelserver.yaml_tree import NodeKind, YamlNode


class YamlMapping(common.ElementReader):
    """A mapping: its `pairs` (key text, key, value) in order, and the values of the `known` keys in `fields`.

    Null values are left out of the fields; unknown and duplicate keys are errors.
    """

    def __init__(self, builder: ModelBuilder, file: str, node: YamlNode, place: str, known: tuple[str, ...] = ()):
        super().__init__(builder, file, node.line, place)
        self.pairs: list[tuple[str, YamlNode, YamlNode]] = []
        self.fields: dict[str, YamlNode] = {}
        if not node.is_null and node.kind is not NodeKind.MAPPING:
            self.error(f"expected a mapping (key: value), got {node.kind.value}", "write key: value, one per line")
        for key, value in node.pairs:
            if key.kind is not NodeKind.SCALAR:
                self.error(f"a key is a name, got {key.kind.value}", "write name: value", key.line)
            elif key.text == "<<" and key.is_plain:
                fix = "use templates; see docs/geometry-files.md"
                self.error("merge keys (<<) are not supported", fix, key.line)
            else:
                self.pairs.append((key.text.strip(), key, value))
        if known:
            entries = [(name, value, key.line) for name, key, value in self.pairs]
            selected = self.select(entries, known, "key", is_strict=True)
            self.fields = {name: value for name, value in selected.items() if not value.is_null}

    def enter(self, node: YamlNode, place: str, known: tuple[str, ...] = ()) -> YamlMapping:
        return YamlMapping(self.builder, self.file, node, place, known)

    def line_of(self, key: str) -> int:
        return self.fields[key].line if key in self.fields else 0

    def read_text(self, key: str) -> str:
        """Return the trimmed text of a scalar, empty if it is absent or, with an error, no scalar."""
        node = self.fields.get(key)
        if node is None:
            return ""
        if node.kind is NodeKind.SCALAR:
            return node.text.strip()
        fix = f"write {key}: some text, in quotes if need be"
        self.error(f"{key} is a text, got {node.kind.value}", fix, node.line)
        return ""

    def read_numbers(self, node: YamlNode, count: int, key: str, unit: str = "") -> list[float] | None:
        """Read a list of `count` numbers; None, with an error, if it is wrong."""
        fix = f"write {key}: [{', '.join(['number'] * count)}]" + (f", in {unit}" if unit else "")
        if node.kind is not NodeKind.LIST:
            got = quote(node.text, 40) if node.kind is NodeKind.SCALAR else node.kind.value
            self.error(f"{key} is a list of {count} numbers, got {got}", fix, node.line)
            return None
        read = [self.read_number(item, key, fix) for item in node.items]
        values = [value for value in read if value is not None]
        if len(values) < len(read):
            return None
        if len(values) != count:
            plural = "" if len(values) == 1 else "s"
            self.error(f"{key} has {len(values)} number{plural}, not {count}", fix, node.line)
            return None
        return values

    def read_number(self, node: YamlNode, key: str, fix: str) -> float | None:
        """Read one number; None, with an error, if it is wrong."""
        if node.kind is not NodeKind.SCALAR:
            self.error(f"{key}: expected a number, got {node.kind.value}", fix, node.line)
            return None
        try:
            if not node.is_plain:
                raise ValueError(f"{quote(node.text, 40)} is a text in quotes, not a number")
            return common.parse_number(node.text)
        except ValueError as error:
            self.error(f"{key}: {error}", fix, node.line)
            return None

    def read_rows(self, key: str, shapes: tuple[int, ...], width: int) -> list[list[float]] | None:
        """Read rows of `width` numbers; their count is one of `shapes`."""
        node = self.fields[key]
        wanted = " or ".join(map(str, shapes))
        if node.kind is not NodeKind.LIST or len(node.items) not in shapes:
            what = f"has {len(node.items)} rows, not {wanted}"
            if node.kind is not NodeKind.LIST:
                what = f"is a list of rows, got {node.kind.value}"
            fix = f"write {key}: [[...], ...] with {wanted} rows of {width} numbers"
            self.error(f"{key} {what}", fix, node.line)
            return None
        rows = [self.read_numbers(item, width, f"{key} row {number}") for number, item in enumerate(node.items, 1)]
        read = [row for row in rows if row is not None]
        return read if len(read) == len(rows) else None


POSE_KEYS = ("xyz", "rpy_deg", "rpy", "quaternion", "rotation", "matrix")
"""`xyz` in meters with at most one of the rotations, or `matrix` alone."""

SIGMA_KEYS = ("xyz", "rpy_deg", "rpy")


@dataclass(frozen=True, slots=True)
class SigmaDefaults:
    """Defaults of the parts of a sigma, None for one that is not stated."""

    position: Vector3 | None = None
    rotation: Vector3 | None = None

    def complete(self, stated: SigmaDefaults | None = None) -> Sigma:
        """Return the sigma of a frame or constraint; a part that is not stated is the default, else 0."""
        stated, none = stated or SigmaDefaults(), (0.0, 0.0, 0.0)
        return Sigma(stated.position or self.position or none, stated.rotation or self.rotation or none)


def read_pose(at: YamlMapping) -> Pose | None:
    """Read the pose in a mapping; None if there is none, or, with an error, if it is wrong."""
    fields = at.fields
    given = [key for key in POSE_KEYS if key in fields]
    if not given:
        return None
    if "matrix" in given:
        if len(given) == 1:
            return _read_matrix(at)
        message = f"matrix holds the whole pose, and {given[0]} is given too"
        at.error(message, f"remove matrix or {given[0]}", given[0])
        return None
    turns = [key for key in given if key != "xyz"]
    if len(turns) > 1:
        message = f"the rotation is given twice, as {turns[0]} and as {turns[1]}"
        at.error(message, "keep one of the two", turns[1])
        return None
    position: list[float] | None = [0.0, 0.0, 0.0]
    if "xyz" in fields:
        position = at.read_numbers(fields["xyz"], 3, "xyz", "meters")
        if position is not None and not at.check_position(position, fields["xyz"].line):
            position = None
    turned = _read_rotation(at, turns[0]) if turns else so3.IDENTITY
    return None if position is None or turned is None else Pose(position, turned)


def _read_rotation(at: YamlMapping, key: str) -> Quaternion | None:
    node = at.fields[key]
    if key == "rotation":
        rows = at.read_rows(key, (3,), 3)
        return None if rows is None else at.repair_rotation(rows, "rotation", node.line)
    if key == "quaternion":
        values = at.read_numbers(node, 4, key, "order w, x, y, z")
        return None if values is None else at.repair_quaternion(values, node.line)
    degrees = key == "rpy_deg"
    angles = at.read_numbers(node, 3, key, "degrees" if degrees else "radians")
    if angles is None:
        return None
    check_unit(at, angles, key, node.line)
    roll, pitch, yaw = map(math.radians, angles) if degrees else angles
    return so3.from_rpy(roll, pitch, yaw)


def check_unit(at: YamlMapping, angles: Iterable[float], key: str, line: int) -> None:
    """Warn of angles that look like those of the other unit."""
    is_degrees = key.endswith("_deg")
    is_other = common.looks_like_radians if is_degrees else common.looks_like_degrees
    found = next((each for each in angles if math.isfinite(each) and is_other(each)), None)
    if found is None:
        return
    if is_degrees:
        fix = f"write {key.removesuffix('_deg')}, or {math.degrees(found):.6g}"
        at.warning(f"{key}: {found:g} deg looks like radians", fix, line)
    else:
        at.warning(f"{key}: {found:g} rad looks like degrees", f"write {key}_deg", line)


def _read_matrix(at: YamlMapping) -> Pose | None:
    rows = at.read_rows("matrix", (3, 4), 4)
    if rows is None:
        return None
    node = at.fields["matrix"]
    if len(rows) == 4 and rows[3] != [0.0, 0.0, 0.0, 1.0]:
        fix = "leave the fourth row out"
        at.error("the last row of a homogeneous transform is 0 0 0 1", fix, node.items[3].line)
        return None
    position = [row[3] for row in rows[:3]]
    turned = at.repair_rotation([row[:3] for row in rows[:3]], "matrix", node.line)
    return None if turned is None or not at.check_position(position, node.line) else Pose(position, turned)


def read_inertia(owner: YamlMapping) -> Rows | None:
    """Read the inertia in a mapping: 6 rows of 6, or mass, center and moments; None, with an error, if it is wrong."""
    node = owner.fields["inertia"]
    if node.kind is not NodeKind.MAPPING:
        rows = owner.read_rows("inertia", (6,), 6)
        return None if rows is None else tuple(map(tuple, rows))
    at = owner.enter(node, f"{owner.place}, inertia", ("mass", "center", "moments", "products"))
    missing = [key for key in ("mass", "moments") if key not in at.fields]
    if missing:
        at.error(
            f"{' and '.join(missing)} missing", "write inertia: {mass: kg, center: [x, y, z], moments: [xx, yy, zz]}"
        )
        return None
    mass = at.read_number(at.fields["mass"], "mass", "write mass: number, in kilograms")
    center, moments, products = (
        at.read_numbers(at.fields[key], 3, key, unit) if key in at.fields else [0.0] * 3
        for key, unit in (("center", "meters"), ("moments", "kg m2"), ("products", "kg m2"))
    )
    if mass is None or center is None or moments is None or products is None:
        return None
    (xx, yy, zz), (xy, xz, yz) = moments, products
    found = RigidInertia(mass, so3.to_vector3(center), ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
    matrix = found.matrix()
    problem = found.find_problem() if all(map(math.isfinite, sum(matrix, ()))) else "its numbers are out of reach"
    if problem:
        at.error(
            f"inertia: {problem}", "write mass in kg, center in meters, moments about the center in kg m2", node.line
        )
        return None
    return matrix


def read_sigma(owner: YamlMapping) -> SigmaDefaults | None:
    """Read the parts of the sigma in a mapping; None, with an error, if one is wrong."""
    at = owner.enter(owner.fields["sigma"], f"{owner.place}, sigma" if owner.place else "sigma", SIGMA_KEYS)
    if "rpy" in at.fields and "rpy_deg" in at.fields:
        at.error("rpy and rpy_deg are both given", "keep one of the two", "rpy")
        return None
    units = {"xyz": "meters", "rpy": "radians", "rpy_deg": "degrees"}
    found = {key: _read_deviations(at, node, key, units[key]) for key, node in at.fields.items()}
    if degrees := found.get("rpy_deg"):
        found["rpy"] = so3.to_vector3(map(math.radians, degrees))
    elif (turn := max(found.get("rpy") or (0.0,))) >= common.LARGEST_SURVEY_SIGMA:
        at.warning(
            f"rpy: a sigma of {turn:g} rad ({math.degrees(turn):.0f} deg)",
            "write rpy_deg where degrees are meant",
            at.line_of("rpy"),
        )
    return None if None in found.values() else SigmaDefaults(found.get("xyz"), found.get("rpy"))


def _read_deviations(at: YamlMapping, node: YamlNode, key: str, unit: str) -> Vector3 | None:
    """Read three standard deviations, given as three numbers or as one for all."""
    if node.kind is NodeKind.SCALAR:
        value = at.read_number(node, key, f"write {key}: number, or [number, number, number], in {unit}")
        values = None if value is None else [value] * 3
    else:
        values = at.read_numbers(node, 3, key, unit)
    # a covariance holds squares, so about the square root of the largest float
    wrong = next((value for value in values or () if not 0.0 <= value < 1e150), None)
    if wrong is not None:
        of = f"{wrong:g} is out of reach"
        message = (
            f"a standard deviation is not negative, got {wrong:g}" if wrong < 0 else f"a standard deviation of {of}"
        )
        at.error(f"{key}: {message}", f"write the uncertainty of the survey, in {unit}", node.line)
        return None
    return None if values is None else so3.to_vector3(values)


_QUANTITIES = ("limits", "rate_limit", "default", "sigma")
_KEYS = ("type", "axis", *(f"{key}{unit}" for key in _QUANTITIES for unit in ("", "_deg")), "mimic")
_JOINT_TYPES = tuple(str(each) for each in JointType)
_INFINITE = {".inf": math.inf, "+.inf": math.inf, "-.inf": -math.inf}

_Values = tuple[float, ...]
_Read = Callable[[YamlNode, str], _Values | None]
"""Reads the value of a key; None, with an error, if it is wrong."""


def read_joint(owner: YamlMapping) -> Joint | None:
    """Read the joint of a constraint; None, with an error, if it is wrong."""
    node = owner.fields["joint"]
    if node.kind is not NodeKind.MAPPING:
        kind = _read_type(owner, "joint")
        # a joint that is only a type has no keys, and problems of it are the constraint's
        at = YamlMapping(owner.builder, owner.file, YamlNode(NodeKind.MAPPING, node.line), owner.place)
    else:
        at = owner.enter(node, f"{owner.place}, joint", _KEYS)
        if "type" not in at.fields:
            at.error("type is missing", f"add type: with one of {', '.join(_JOINT_TYPES)}")
            return None
        kind = _read_type(at, "type")
    return None if kind is None else _YamlJointReader(at, kind).read()


def _read_type(at: YamlMapping, key: str) -> JointType | None:
    text = at.read_text(key)
    if at.fields[key].kind is not NodeKind.SCALAR:
        return None
    if text in _JOINT_TYPES:
        return JointType(text)
    near = suggest_name(text, _JOINT_TYPES)
    fix = f"write {key}: {near[0]}" if near else f"joints are {', '.join(_JOINT_TYPES)}"
    at.error(f"there is no joint {quote(text)}", fix, key, near)
    return None


class _YamlJointReader:
    def __init__(self, at: YamlMapping, kind: JointType):
        self.at = at
        self.kind = kind
        self.names = [suffix.removeprefix(".") for suffix in SUFFIXES[kind]]
        self.is_angle = dict(zip(self.names, Joint(kind).angle_flags, strict=True))
        self.problem_count = len(at.builder.problems)

    @property
    def has_errors(self) -> bool:
        return has_error(self.at.builder.problems[self.problem_count :])

    def read(self) -> Joint | None:
        at = self.at
        if self.kind is JointType.FIXED:
            for key, node in at.fields.items():
                if key != "type":
                    at.error(f"{key}: a fixed joint does not move", f"remove {key}, or write another type", node.line)
            return None if self.has_errors else FIXED
        axis = self.read_axis()
        limits = self.read_quantity("limits", self.read_limits, (-math.inf, math.inf))
        rates = self.read_quantity("rate_limit", self.read_non_negative, (math.inf,))
        defaults = self.read_quantity("default", self.read_value, (0.0,))
        sigmas = self.read_quantity("sigma", self.read_non_negative, None)
        mimic = self.read_mimic()
        for name, (value,) in defaults.items():
            low, high = limits.get(name, (-math.inf, math.inf))
            if not low - 1e-9 <= value <= high + 1e-9:
                of = f" of {name}" if name else ""
                key = "default" if "default" in at.fields else "default_deg"
                at.error(f"the default{of} is out of the limits", "put it within them", key)
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
            at.error(str(error), "see Joints in docs/geometry-files.md")
            return None

    def read_axis(self) -> Vector3:
        at, up = self.at, (0.0, 0.0, 1.0)
        node = at.fields.get("axis")
        if self.kind not in TYPES_WITH_AXIS:
            if node is not None:
                at.error(f"a {self.kind} joint has no axis", "remove axis", node.line)
            return up
        if node is None:
            if self.kind is not JointType.PLANAR:
                verb = "turns about" if self.kind is JointType.REVOLUTE else "slides along"
                fix = f"write joint: {{type: {self.kind}, axis: [0, 1, 0]}} with the direction that it {verb}"
                at.error(f"a {self.kind} joint needs an axis", fix)
            return up
        values = at.read_numbers(node, 3, "axis")
        if values is None:
            return up
        if not 1e-9 < math.hypot(*values) < math.inf:
            fix = "write e.g. axis: [0, 1, 0]; its length does not matter"
            at.error("the axis has no direction", fix, node.line)
            return up
        return (values[0], values[1], values[2])

    def read_quantity(self, key: str, read: _Read, omitted: _Values | None) -> dict[str, _Values]:
        """Read the value of a key for each coordinate; empty if the key is absent.

        A coordinate that a mapping omits has the value `omitted`; None if it must have all.
        """
        at = self.at
        given = [(name, at.fields[name]) for name in (key, f"{key}_deg") if name in at.fields]
        if not given:
            return {}
        name, node = given[-1]
        is_degrees, is_angle = name != key, self.is_angle.get("", False)
        if len(given) > 1:
            at.error(f"{key} and {name} are both given", "keep one of the two", node.line)
        elif len(self.names) > 1 and not is_degrees:
            return self.read_by_coordinate(key, node, read, omitted)
        elif len(self.names) > 1:
            first = next(each for each, angle in self.is_angle.items() if angle)
            fix = f"write {key}: {{{first}_deg: ...}}, by coordinate"
            at.error(f"{name}: a {self.kind} joint has several coordinates", fix, node.line)
        elif is_degrees and not is_angle:
            at.error(f"{name}: a {self.kind} joint moves in meters", f"write {key}: in meters", node.line)
        elif (value := read(node, name)) is not None:
            if is_degrees:
                check_unit(at, value, name, node.line)
                value = tuple(map(math.radians, value))
            if key == "sigma" and is_angle and value[0] >= common.LARGEST_SIGMA:
                size = f"{value[0]:g} rad ({math.degrees(value[0]):.0f} deg)"
                at.warning(f"a sigma of {size} of a joint", "write sigma_deg where degrees are meant", node.line)
            return {"": value}
        return {}

    def read_by_coordinate(self, key: str, node: YamlNode, read: _Read, omitted: _Values | None) -> dict[str, _Values]:
        at = self.at
        # the usual keys come first; lengths in degrees are among them for an error of their own
        keys = {f"{name}_deg" if angle else name: (name, angle) for name, angle in self.is_angle.items()}
        if node.kind is not NodeKind.MAPPING:
            fix = f"write {key}: {{{', '.join(f'{each}: ...' for each in keys)}}}"
            message = f"{key} of a {self.kind} joint is a mapping by coordinate, got {node.kind.value}"
            at.error(message, fix, node.line)
            return {}
        keys |= {name: (name, False) for name in self.names} | {f"{name}_deg": (name, True) for name in self.names}
        found: dict[str, _Values] = {}
        for each, inside in at.enter(node, f"{at.place}, {key}", tuple(keys)).fields.items():
            name, is_degrees = keys[each]
            if is_degrees and not self.is_angle[name]:
                at.error(f"{key}: {each} is a length, not an angle", f"write {name}: in meters", inside.line)
            elif name in found:
                at.error(f"{name} and {name}_deg are both given", "keep one of the two", inside.line)
            value = read(inside, each) or omitted or ()
            found[name] = tuple(map(math.radians, value)) if is_degrees else value
        missing = [name for name in self.names if name not in found]
        if missing and omitted is None:
            fix = "state it of each coordinate; 0 is exact"
            at.error(f"{key} does not state {', '.join(missing)}", fix, node.line)
        return {name: found.get(name, omitted or ()) for name in self.names}

    def read_limits(self, node: YamlNode, key: str) -> _Values | None:
        fix = f"write {key}: [lower, upper]; .inf is none"
        if node.kind is not NodeKind.LIST or len(node.items) != 2:
            self.at.error(f"{key} is a list of 2 numbers, lower and upper", fix, node.line)
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
            message = f"{key} are reversed: lower {low:g}, upper {high:g}"
            self.at.error(message, f"write {key}: [{high:g}, {low:g}]", node.line)
            return None
        return low, high

    def read_non_negative(self, node: YamlNode, key: str) -> _Values | None:
        found = self.read_value(node, key)
        if found is not None and found[0] < 0.0:
            message = f"{key} is not negative, got {found[0]:g}"
            self.at.error(message, f"write {key}: {-found[0]:g}, if that was meant", node.line)
            return None
        return found

    def read_value(self, node: YamlNode, key: str) -> _Values | None:
        value = self.read_number(node, key, f"write {key}: number")
        return None if value is None else (value,)

    def read_number(self, node: YamlNode, key: str, fix: str) -> float | None:
        value = self.at.read_number(node, key, fix)
        if value is not None and abs(value) > common.MAX_POSITION:
            self.at.error(f"{key}: {value:g} is out of reach; the limit is {common.MAX_POSITION:g}", fix, node.line)
            return None
        return value

    def read_mimic(self) -> Mimic | None:
        at, node = self.at, self.at.fields.get("mimic")
        if node is None:
            return None
        if len(self.names) != 1:
            fix = "remove mimic; what follows another is revolute or prismatic"
            at.error(f"a {self.kind} joint has several coordinates and cannot follow another", fix, node.line)
            return None
        inside, key = at, "mimic"
        if node.kind is NodeKind.MAPPING:
            inside = at.enter(node, f"{at.place}, mimic", ("joint", "multiplier", "offset", "offset_deg"))
            key = "joint"
        fields, name = inside.fields, inside.read_text(key)
        if key not in fields:
            at.error("mimic does not name the joint that it follows", "write mimic: {joint: NAME}", node.line)
        elif fields[key].kind is NodeKind.SCALAR and not name:
            at.error(f"{key} names no joint", f"write {key}: NAME, of another constraint", key)
        numbers = [each for each in ("multiplier", "offset", "offset_deg") if each in fields]
        read = {each: self.read_number(fields[each], each, f"write {each}: number") for each in numbers}
        multiplier, offset = read.get("multiplier", 1.0), read.get("offset", 0.0)
        if "offset_deg" in fields:
            line, degrees = fields["offset_deg"].line, read["offset_deg"]
            offset = None if degrees is None else math.radians(degrees)
            if "offset" in fields:
                at.error("offset and offset_deg are both given", "keep one of the two", line)
            elif not self.is_angle[""]:
                at.error(f"offset_deg: a {self.kind} joint moves in meters", "write offset: in meters", line)
        return None if not name or multiplier is None or offset is None else Mimic(name, multiplier, offset)

"""Write a model as YAML: readable for a person, and exact for the reader.

Every float is written in the shortest text that reads back as the same float. A rotation is written as roll, pitch, yaw
in degrees if these read back as the same quaternion to 1e-13, else as the quaternion. A text is written without quotes
if every YAML reader takes it for the same text.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import yaml

from modelserver.formats.writing import SavedModel, format_number
from modelserver.geometry.joint import SUFFIXES, Coordinates, Joint, JointType
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Body, BodyFrame, Constraint, Sigma
from modelserver.geometry.shape import DIMENSIONS, Shape, ShapeKind
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion, Vector3

WIDTH = 110
"""A frame that fits is written on one line."""

ROUNDING = 1e-15
"""Greatest change of a quaternion by writing short angles."""

ANGLE_TOLERANCE = 1e-13
"""Greatest change of a quaternion by writing angles in degrees at full precision."""

_PLAIN_TEXT = re.compile(r"[A-Za-z$](?:[^:#]*[^:# ])?")
"""Needs no quotes in a block, that is anywhere but in braces and brackets."""
_RESOLVER = yaml.resolver.Resolver()
_Z_AXIS = (0.0, 0.0, 1.0)


def save(model: Model, exact: bool = False) -> SavedModel:
    """Return the text of `model`. This format supports every feature of a model.

    With `exact`, rotations are written as quaternions at full precision, so that the revision of the model is the same
    when a program reads it back.
    """
    lines = ["modelserver: geometry/1"]
    if model.name:
        lines.append(f"name: {format_text(model.name)}")
    if model.description:
        lines.append(f"description: {format_text(model.description)}")
    lines += ["", "bodies:"]
    for number, body in enumerate(model.bodies):
        lines += ([""] if number else []) + _format_body(body, exact)
    if model.constraints:
        lines += ["", "constraints:"]
        for constraint in model.constraints:
            lines += _format_constraint(constraint, exact)
    return SavedModel("\n".join(lines) + "\n")


def _format_body(body: Body, exact: bool) -> list[str]:
    lines = [f"  {format_text(body.name)}:"]
    if body.description:
        lines.append(f"    description: {format_text(body.description)}")
    if body.pose is not None:
        lines.append(f"    transform: {{{', '.join(_format_pose(body.pose, exact) or ['xyz: [0, 0, 0]'])}}}")
    if body.inertia is not None:
        lines.append("    inertia:")
        lines += [f"      - {_format_list(row)}" for row in body.inertia]
    for key, shapes in (("visuals", body.visuals), ("collisions", body.collisions)):
        if shapes:
            lines.append(f"    {key}:")
            lines += [f"      {line}" for shape in shapes for line in _format_shape(shape, exact)]
    lines.append("    frames:")
    for frame in body.frames:
        lines += _format_frame(frame, exact)
    return lines


def _format_frame(frame: BodyFrame, exact: bool) -> list[str]:
    fields = _format_pose(frame.pose, exact) + _format_sigma(frame.sigma)
    head = f"      {format_text(frame.name)}:"
    short = f"{head} {{{', '.join(fields)}}}"
    if not frame.description and len(short) <= WIDTH:
        return [short]
    described = [f"description: {format_text(frame.description)}"] if frame.description else []
    return [head, *(f"        {each}" for each in described + fields)]


def _format_constraint(constraint: Constraint, exact: bool) -> list[str]:
    fields = [f"from: {_format_full_name(constraint.from_)}", f"to: {_format_full_name(constraint.to)}"]
    if constraint.description:
        fields.append(f"description: {format_text(constraint.description)}")
    fields += _format_pose(constraint.pose, exact) + _format_sigma(constraint.sigma) + _format_joint(constraint.joint)
    return [f"  {format_text(constraint.name)}:", *(f"    {each}" for each in fields)]


def _format_shape(shape: Shape, exact: bool) -> list[str]:
    values = _format_list(shape.size)
    if shape.kind is ShapeKind.MESH:
        lines = [f"mesh: {format_text(shape.file)}"]
        if shape.size != (1.0, 1.0, 1.0):
            lines.append(f"scale: {values}")
    elif shape.kind is ShapeKind.BOX:
        lines = [f"box: {values}"]
    else:
        sizes = zip(DIMENSIONS[shape.kind], shape.size, strict=True)
        lines = [f"{shape.kind}: {{{', '.join(f'{what}: {format_number(value)}' for what, value in sizes)}}}"]
    lines += _format_pose(shape.pose, exact)
    if shape.name:
        lines.append(f"name: {format_text(shape.name)}")
    if shape.material is not None:
        lines += ["material:", f"  name: {format_text(shape.material.name)}"]
        if shape.material.color is not None:
            lines.append(f"  color: {_format_list(shape.material.color)}")
        if shape.material.texture:
            lines.append(f"  texture: {format_text(shape.material.texture)}")
    return [f"- {lines[0]}", *(f"  {line}" for line in lines[1:])]


def _format_joint(joint: Joint) -> list[str]:
    if not joint.is_movable:
        return []
    fields = format_joint_fields(joint)
    if len(fields) == 1:
        return [f"joint: {joint.type}"]
    short = f"joint: {{{', '.join(fields)}}}"
    return [short] if len(short) <= WIDTH - 4 else ["joint:", *(f"  {field}" for field in fields)]


def format_joint_fields(joint: Joint) -> list[str]:
    """Return the entries `key: value` of a joint."""
    fields = [f"type: {joint.type}"]
    if joint.type in (JointType.REVOLUTE, JointType.PRISMATIC) or joint.axis != _Z_AXIS:
        fields.append(f"axis: {_format_list(joint.axis)}")
    if joint.lower or joint.upper:
        lower, upper = joint.lower or (-math.inf,) * joint.count, joint.upper or (math.inf,) * joint.count
        pairs = list(zip(lower, upper, strict=True))
        limits = [None if pair == (-math.inf, math.inf) else pair for pair in pairs]
        fields.append(_format_quantity("limits", joint, limits))
    if joint.rate_limit:
        rates = [None if value == math.inf else (value,) for value in joint.rate_limit]
        fields.append(_format_quantity("rate_limit", joint, rates))
    for key, values in (("default", joint.default if joint.mimic is None else ()), ("sigma", joint.sigma)):
        if values:
            fields.append(_format_quantity(key, joint, [(value,) for value in values]))
    if joint.mimic is not None:
        fields.append(_format_mimic(joint))
    return fields


def _format_quantity(key: str, joint: Joint, values: Sequence[Coordinates | None]) -> str:
    """Return `key: value`, for several coordinates a mapping without those that are None."""
    if joint.count == 1:
        (value,) = values
        assert value is not None
        return _format_entry(key, value, joint.angle_flags[0])
    names = [suffix.removeprefix(".") for suffix in SUFFIXES[joint.type]]
    inside = [
        _format_entry(name, value, is_angle)
        for name, value, is_angle in zip(names, values, joint.angle_flags, strict=True)
        if value is not None
    ]
    return f"{key}: {{{', '.join(inside)}}}"


def _format_entry(key: str, values: Coordinates, is_angle: bool) -> str:
    degrees = to_degrees(values) if is_angle else None
    if degrees is not None:
        key, values = f"{key}_deg", degrees
    written = [format_number(value) if math.isfinite(value) else ".inf" if value > 0 else "-.inf" for value in values]
    return f"{key}: {written[0]}" if len(written) == 1 else f"{key}: [{', '.join(written)}]"


def _format_mimic(joint: Joint) -> str:
    assert joint.mimic is not None
    name = joint.mimic.joint
    # in braces more texts need quotes than in a block
    if not name.replace("_", "").isalnum() or format_text(name) != name:
        name = quote_text(name)
    parts = [] if joint.mimic.multiplier == 1.0 else [f"multiplier: {format_number(joint.mimic.multiplier)}"]
    if joint.mimic.offset != 0.0:
        parts.append(_format_entry("offset", (joint.mimic.offset,), joint.angle_flags[0]))
    return f"mimic: {{{', '.join([f'joint: {name}', *parts])}}}" if parts else f"mimic: {name}"


def to_degrees(radians: Coordinates) -> Coordinates | None:
    """Return angles in degrees that read back as the same floats, rounded where possible; None if there are none."""
    degrees = tuple(map(math.degrees, radians))
    for decimals in (6, 12, 17):
        short = tuple([round(value, decimals) for value in degrees])
        if tuple(map(math.radians, short)) == radians:
            return short
    return None


def _format_pose(pose: Pose, exact: bool) -> list[str]:
    fields = [] if pose.xyz == (0.0, 0.0, 0.0) else [f"xyz: {_format_list(pose.xyz)}"]
    if pose.wxyz != so3.IDENTITY:
        degrees = None if exact else to_rpy_degrees(pose.wxyz)
        rotation = f"quaternion: {_format_list(pose.wxyz)}" if degrees is None else f"rpy_deg: {_format_list(degrees)}"
        fields.append(rotation)
    return fields


def to_rpy_degrees(wxyz: Quaternion) -> Vector3 | None:
    """Return roll, pitch, yaw in degrees that read back as the quaternion, None if the error exceeds the tolerance.

    Rounding errors are removed: -10 rather than -10.000000000000002.
    """
    roll, pitch, yaw = (math.degrees(angle) for angle in so3.to_rpy(wxyz))
    short = (_round_off(roll), _round_off(pitch), _round_off(yaw))
    if _quaternion_error(short, wxyz) <= ROUNDING:
        return short
    full = (roll, pitch, yaw)
    return full if _quaternion_error(full, wxyz) <= ANGLE_TOLERANCE else None


def _round_off(angle: float) -> float:
    rounded = round(angle, 9)
    # + 0.0 turns a negative zero into zero
    return (rounded if abs(angle - rounded) < 1e-12 else angle) + 0.0


def _quaternion_error(degrees: Vector3, wxyz: Quaternion) -> float:
    roll, pitch, yaw = (math.radians(angle) for angle in degrees)
    back = so3.from_rpy(roll, pitch, yaw)
    same = max(abs(a - b) for a, b in zip(back, wxyz, strict=True))
    # a half turn has two quaternions, of opposite sign, and rounding may yield either
    return min(same, max(abs(a + b) for a, b in zip(back, wxyz, strict=True)))


def _format_sigma(sigma: Sigma | None) -> list[str]:
    if sigma is None:
        return []
    degrees = to_degrees(sigma.rotation)
    key, angles = ("rpy", sigma.rotation) if degrees is None else ("rpy_deg", degrees)
    return [f"sigma: {{xyz: {format_scalar_or_list(sigma.position)}, {key}: {format_scalar_or_list(angles)}}}"]


def format_scalar_or_list(values: tuple[float, ...]) -> str:
    """Return three numbers as a list, or as one number where all are equal."""
    return format_number(values[0]) if values[0] == values[1] == values[2] else _format_list(values)


def _format_list(values: tuple[float, ...]) -> str:
    return f"[{', '.join(map(format_number, values))}]"


def _format_full_name(name: str) -> str:
    """Return a full name; its colon needs no quotes, because no space follows it."""
    body, _, frame = name.partition(":")
    safe = format_text(body) == body and format_text(frame) == frame
    return name if safe else quote_text(name)


def format_text(value: str) -> str:
    """Return a text as YAML, without quotes if every reader reads the same text."""
    if _PLAIN_TEXT.fullmatch(value) and value.isprintable() and _resolves_to_text(value):
        return value
    return quote_text(value)


def _resolves_to_text(value: str) -> bool:
    tag = _RESOLVER.resolve(yaml.ScalarNode, value, (True, False))  # type: ignore[no-untyped-call]
    return bool(tag == "tag:yaml.org,2002:str")


def quote_text(value: str) -> str:
    """Return a text in double quotes, with unprintable characters escaped."""
    return f'"{"".join(map(_escape, value))}"'


def _escape(character: str) -> str:
    if character in '"\\':
        return "\\" + character
    if character.isprintable():
        return character
    if character == "\n":
        return "\\n"
    code = ord(character)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"

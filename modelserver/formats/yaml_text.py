"""Writing a model in the YAML form, for a person to read on and a loader to read back exactly."""

from __future__ import annotations

import math
import re

import yaml

from modelserver.formats.saved import Saved, plain
from modelserver.formats.yaml_joint_text import in_degrees, joint_lines
from modelserver.formats.yaml_shapes_text import shape_lines
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Body, BodyFrame, Constraint, Sigma
from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Quaternion, Vector3

WIDTH = 110
"""A frame that fits goes on one line."""

ROUNDING = 1e-15

ANGLE_TOLERANCE = 1e-13
"""Angles in degrees are written where they read back to this; otherwise the quaternion is, at full precision."""

_PLAIN = re.compile(r"[A-Za-z$](?:[^:#]*[^:# ])?")
"""Safe without quotes where it stands in a block, which is everywhere but in braces and brackets."""
_RESOLVER = yaml.resolver.Resolver()


def save(model: Model, exact: bool = False) -> Saved:
    """Return the text of `model`. This form holds everything a model has.

    With `exact` rotations are written to the last bit, for a program to read back: the revision is the same then.
    """
    lines = ["modelserver: geometry/1"]
    if model.name:
        lines.append(f"name: {text(model.name)}")
    if model.description:
        lines.append(f"description: {text(model.description)}")
    lines += ["", "bodies:"]
    for number, body in enumerate(model.bodies):
        lines += ([""] if number else []) + _body(body, exact)
    if model.constraints:
        lines += ["", "constraints:"]
        for constraint in model.constraints:
            lines += _constraint(constraint, exact)
    return Saved("\n".join(lines) + "\n")


def _body(body: Body, exact: bool) -> list[str]:
    lines = [f"  {text(body.name)}:"]
    if body.description:
        lines.append(f"    description: {text(body.description)}")
    if body.pose is not None:
        lines.append(f"    transform: {{{', '.join(_pose(body.pose, exact) or ['xyz: [0, 0, 0]'])}}}")
    if body.inertia is not None:
        lines.append("    inertia:")
        lines += [f"      - {_list(row)}" for row in body.inertia]
    for key, shapes in (("visuals", body.visuals), ("collisions", body.collisions)):
        if shapes:
            lines.append(f"    {key}:")
            lines += [
                f"      {line}" for shape in shapes for line in shape_lines(shape, _pose(shape.pose, exact), text)
            ]
    lines.append("    frames:")
    for frame in body.frames:
        lines += _frame(frame, exact)
    return lines


def _frame(frame: BodyFrame, exact: bool) -> list[str]:
    fields = _pose(frame.pose, exact) + _sigma(frame.sigma)
    head = f"      {text(frame.name)}:"
    short = f"{head} {{{', '.join(fields)}}}"
    if not frame.description and len(short) <= WIDTH:
        return [short]
    described = [f"description: {text(frame.description)}"] if frame.description else []
    return [head, *(f"        {each}" for each in described + fields)]


def _constraint(constraint: Constraint, exact: bool) -> list[str]:
    fields = [f"from: {_full(constraint.from_)}", f"to: {_full(constraint.to)}"]
    if constraint.description:
        fields.append(f"description: {text(constraint.description)}")
    fields += _pose(constraint.pose, exact) + _sigma(constraint.sigma) + joint_lines(constraint.joint, text, WIDTH - 4)
    return [f"  {text(constraint.name)}:", *(f"    {each}" for each in fields)]


def _pose(pose: Pose, exact: bool) -> list[str]:
    fields = [] if pose.xyz == (0.0, 0.0, 0.0) else [f"xyz: {_list(pose.xyz)}"]
    if pose.wxyz != so3.IDENTITY:
        degrees = None if exact else degrees_of(pose.wxyz)
        fields.append(f"quaternion: {_list(pose.wxyz)}" if degrees is None else f"rpy_deg: {_list(degrees)}")
    return fields


def degrees_of(wxyz: Quaternion) -> Vector3 | None:
    """Return roll, pitch, yaw in degrees that read back as the quaternion; None where none do well enough.

    Angles that rounding took off a short number are put back: -10 rather than -10.000000000000002.
    """
    roll, pitch, yaw = (math.degrees(angle) for angle in so3.to_rpy(wxyz))
    short = (_short(roll), _short(pitch), _short(yaw))
    if _misses(short, wxyz) <= ROUNDING:
        return short
    full = (roll, pitch, yaw)
    return full if _misses(full, wxyz) <= ANGLE_TOLERANCE else None


def _short(angle: float) -> float:
    rounded = round(angle, 9)
    # + 0.0 turns a negative zero into zero
    return (rounded if abs(angle - rounded) < 1e-12 else angle) + 0.0


def _misses(degrees: Vector3, wxyz: Quaternion) -> float:
    roll, pitch, yaw = (math.radians(angle) for angle in degrees)
    back = so3.from_rpy(roll, pitch, yaw)
    same = max(abs(a - b) for a, b in zip(back, wxyz, strict=True))
    # a half turn has two quaternions, of opposite sign, and rounding may take either
    return min(same, max(abs(a + b) for a, b in zip(back, wxyz, strict=True)))


def _sigma(sigma: Sigma | None) -> list[str]:
    if sigma is None:
        return []
    degrees = in_degrees(sigma.rotation)
    rotation = f"rpy: {_one_or_list(sigma.rotation)}" if degrees is None else f"rpy_deg: {_one_or_list(degrees)}"
    return [f"sigma: {{xyz: {_one_or_list(sigma.position)}, {rotation}}}"]


def _one_or_list(values: tuple[float, ...]) -> str:
    return plain(values[0]) if values[0] == values[1] == values[2] else _list(values)


def _list(values: tuple[float, ...]) -> str:
    return f"[{', '.join(map(plain, values))}]"


def _full(name: str) -> str:
    """Return a full name; its colon needs no quotes, for no space follows it."""
    body, _, frame = name.partition(":")
    safe = text(body) == body and text(frame) == frame
    return name if safe else quoted(name)


def text(value: str) -> str:
    """Return a text as YAML, without quotes where every reader takes it for the same text."""
    if _PLAIN.fullmatch(value) and value.isprintable() and _resolves_to_text(value):
        return value
    return quoted(value)


def _resolves_to_text(value: str) -> bool:
    tag = _RESOLVER.resolve(yaml.ScalarNode, value, (True, False))  # type: ignore[no-untyped-call]
    return bool(tag == "tag:yaml.org,2002:str")


def quoted(value: str) -> str:
    """Return a text in double quotes, with all that is not printable escaped."""
    return f'"{"".join(map(_escaped, value))}"'


def _escaped(character: str) -> str:
    if character in '"\\':
        return "\\" + character
    if character.isprintable():
        return character
    if character == "\n":
        return "\\n"
    code = ord(character)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"

"""The YAML geometry format, the one to write by hand, read and written. docs/geometry-files.md describes it.

Templates are copied into the bodies that name them; a body's own keys and frames replace those of its template. Shapes
are lists, each entry with one shape and a pose:

visuals:
  - box: [0.9, 0.5, 0.1]                       # x, y, z
    xyz: [0, 0, 0.06]
  - cylinder: {radius: 0.165, length: 0.114}
    rpy_deg: [90, 0, 0]
  - sphere: {radius: 0.1}
  - mesh: meshes/hull.dae                      # named, never opened
    scale: [1, 1, 1]
    material: {name: black, color: [0, 0, 0, 1]}

The writer's text is readable for a person, and exact for the reader. Every float is written in the shortest text that
reads back as the same float. A rotation is written as roll, pitch, yaw in degrees if these read back as the same
quaternion to 1e-13, else as the quaternion. A text is written without quotes if every YAML reader takes it for the same
text.

A snapshot is the exact text with all that a mirror needs to answer queries by itself, as a message (model_snapshot_t).
"""

from __future__ import annotations

import json
import math
import re
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

import yaml

from modelserver.errors import (
    GeometryError,
    Location,
    Severity,
    Suggestion,
    SyntaxProblemError,
    WireError,
    has_error,
    quote,
    suggest_name,
)
from modelserver.formats import parse_model
from modelserver.formats.common import SavedModel, format_number, label, to_rpy_degrees
from modelserver.formats.yaml_elements import (
    POSE_KEYS,
    SigmaDefaults,
    YamlMapping,
    read_inertia,
    read_joint,
    read_pose,
    read_sigma,
)
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import FIXED, SUFFIXES, Coordinates, Joint, JointType
from modelserver.geometry.model import Model
from modelserver.geometry.parts import DIMENSIONS, Body, BodyFrame, Constraint, Material, Shape, ShapeKind, Sigma
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.yaml_tree import NodeKind, YamlNode, parse_yaml

_SHAPE_KINDS = tuple(str(kind) for kind in ShapeKind)
_SHAPE_KEYS = (*_SHAPE_KINDS, "scale", *POSE_KEYS, "name", "material")


def read_shapes(owner: YamlMapping, key: str) -> tuple[Shape, ...]:
    """Read a list of shapes; wrong ones are reported and left out."""
    node, place = owner.fields.get(key), f"{owner.place}, {key}"
    if node is None:
        return ()
    if node.kind is not NodeKind.LIST:
        message = f"expected a list of shapes, got {node.kind.value}"
        owner.builder.add_error(message, Location(owner.file, node.line, place), "begin each shape with - box: ...")
        return ()
    found = [_read_shape(owner.enter(item, f"{place} {n}", _SHAPE_KEYS)) for n, item in enumerate(node.items, 1)]
    return tuple(shape for shape in found if shape is not None)


def _read_shape(at: YamlMapping) -> Shape | None:
    kinds = [key for key in _SHAPE_KINDS if key in at.fields]
    if len(kinds) != 1:
        what = "both " + " and ".join(kinds) if kinds else "no shape"
        at.error(f"expected one shape, got {what}", f"write one of {', '.join(_SHAPE_KINDS)}")
        return None
    kind = ShapeKind(kinds[0])
    size: list[float] | None = [1.0, 1.0, 1.0]
    if kind is not ShapeKind.MESH:
        if "scale" in at.fields:
            at.error(f"a {kind} has no scale; only a mesh has", "write its size in meters", "scale")
        size = _read_size(at, kind)
    elif "scale" in at.fields:
        size = at.read_numbers(at.fields["scale"], 3, "scale", "factors")
    file = at.read_text("mesh") if kind is ShapeKind.MESH else ""
    pose = read_pose(at)
    material = _read_material(at) if "material" in at.fields else None
    if size is None:
        return None
    try:
        return Shape(kind, tuple(size), pose or Pose.identity(), file, at.read_text("name"), material)
    except ValueError as error:
        at.error(str(error), "see docs/geometry-files.md", kinds[0])
        return None


def _read_size(shape: YamlMapping, kind: ShapeKind) -> list[float] | None:
    node = shape.fields[str(kind)]
    if kind is ShapeKind.BOX:
        return shape.read_numbers(node, 3, "box", "meters")
    wanted = DIMENSIONS[kind]
    fix = f"write {kind}: {{{', '.join(f'{what}: number' for what in wanted)}}}, in meters"
    at = shape.enter(node, f"{shape.place}, {kind}", wanted)
    values = []
    for what in wanted:
        if what not in at.fields:
            at.error(f"{what} is missing", fix)
        elif (value := shape.read_number(at.fields[what], what, fix)) is not None:
            values.append(value)
    return values if len(values) == len(wanted) else None


def _read_material(shape: YamlMapping) -> Material | None:
    at = shape.enter(shape.fields["material"], f"{shape.place}, material", ("name", "color", "texture"))
    color = None
    if "color" in at.fields:
        values = at.read_numbers(at.fields["color"], 4, "color", "red, green, blue and opacity from 0 to 1")
        if values is None:
            return None
        color = (values[0], values[1], values[2], values[3])
    try:
        return Material(at.read_text("name"), color, at.read_text("texture"))
    except ValueError as error:
        at.error(str(error), "write material: {name: ..., color: [red, green, blue, opacity]}")
        return None


FORMAT_KEY = "modelserver"
FORMAT_VERSION = "geometry/1"
"""A file states `modelserver: geometry/1`; an incompatible format gets another number."""

MAX_FRAMES = 100_000
"""Frames, including those copied from templates."""

_TOP_KEYS = (FORMAT_KEY, "name", "description", "defaults", "templates", "bodies", "constraints")
_TEMPLATE_KEYS = ("description", "inertia", "visuals", "collisions", "frames")
_BODY_KEYS = ("template", "description", "transform", "inertia", "visuals", "collisions", "frames")
_FRAME_KEYS = (*POSE_KEYS, "description", "sigma")
_CONSTRAINT_KEYS = ("from", "to", *POSE_KEYS, "description", "sigma", "joint")

_Inertia = tuple[tuple[float, ...], ...]
_FrameNode = tuple[BodyFrame, YamlNode]


def load(content: bytes, builder: ModelBuilder, file: str) -> None:
    """Add the model in a YAML file, and its problems, to `builder`."""
    try:
        root = parse_yaml(content)
    except SyntaxProblemError as error:
        builder.add_error(str(error), Location(file, error.line), error.fix)
        return
    if root.kind is NodeKind.MAPPING:
        _GeometryReader(YamlMapping(builder, file, root, "", _TOP_KEYS)).read()
        return
    builder.add_error(
        f"the file is not a geometry: its top level is {root.kind.value}, not a mapping",
        Location(file, root.line),
        "begin with bodies:, as in docs/geometry-files.md",
    )


@dataclass(slots=True)
class _BodyParts:
    """What a template and a body have in common."""

    description: str
    inertia: _Inertia | None
    frames: list[_FrameNode]
    visuals: tuple[Shape, ...]
    collisions: tuple[Shape, ...]
    line: int
    is_used: bool = False


class _GeometryReader:
    def __init__(self, top: YamlMapping):
        self.top = top
        self.builder = top.builder
        self.defaults = SigmaDefaults()
        self.templates: dict[str, _BodyParts] = {}
        self.frame_count = 0
        self.template_uses: Counter[str] = Counter()
        """Number of bodies that name a template."""

    def read(self) -> None:
        top, builder, fields = self.top, self.builder, self.top.fields
        version, fix = top.read_text(FORMAT_KEY), f"{FORMAT_KEY}: {FORMAT_VERSION}"
        if FORMAT_KEY not in fields:
            top.note("the file does not state its format", f"add a first line, {fix}")
        elif version != FORMAT_VERSION:
            top.error(f"{FORMAT_KEY}: {quote(version)} is not supported", f"write {fix}", FORMAT_KEY)
        builder.name, builder.description = top.read_text("name"), top.read_text("description")
        if "defaults" in fields:
            defaults = top.enter(fields["defaults"], "defaults", ("sigma",))
            if "sigma" in defaults.fields:
                self.defaults = read_sigma(defaults) or SigmaDefaults()
        if "templates" in fields:
            self.read_templates(top.enter(fields["templates"], "templates"))
        if "bodies" in fields:
            bodies = [value for _, value in fields["bodies"].pairs]
            self.template_uses.update(
                v.text.strip() for body in bodies for k, v in body.pairs if k.text.strip() == "template"
            )
            for name, key, value in self.list_bodies(top.enter(fields["bodies"], "bodies")):
                self.read_body(name, key, value)
        elif not has_error(builder.problems):
            top.error("there are no bodies", "add bodies:, with a name and frames: for each")
        if "constraints" in fields:
            for name, key, value in top.enter(fields["constraints"], "constraints").pairs:
                self.read_constraint(name, key, value)
        for name, template in self.templates.items():
            if not template.is_used:
                source = Location(top.file, template.line, "templates")
                builder.add_problem(Severity.NOTE, f"no body uses template {label(name)}", source)

    def list_bodies(self, bodies: YamlMapping) -> list[tuple[str, YamlNode, YamlNode]]:
        """Return the bodies; a key of one that stands beside it, not within, is an error and read as the body's."""
        found: list[tuple[str, YamlNode, YamlNode]] = []
        for name, key, value in bodies.pairs:
            is_empty = bool(found) and (found[-1][2].is_null or found[-1][2].kind is NodeKind.MAPPING)
            if name not in ("frames", "inertia", "visuals", "collisions") or not is_empty:
                found.append((name, key, value))
                continue
            body, body_key, content = found[-1]
            whole = YamlNode(NodeKind.MAPPING, content.line)
            whole.pairs = [*content.pairs, (key, value)]
            found[-1] = (body, body_key, whole)
            self.builder.add_error(
                f"{name} stands beside the body {label(body)}, not within it",
                Location(bodies.file, key.line, f"body {label(body)}"),
                f"indent {name} and what is below it further than {label(body)}",
            )
        return found

    def read_templates(self, templates: YamlMapping) -> None:
        for name, key, value in templates.pairs:
            place = f"template {label(name)}"
            if name in self.templates:
                message = f"{place} is defined twice (first on line {self.templates[name].line})"
                self.builder.add_error(message, Location(templates.file, key.line, place), "rename one of the two")
                continue
            self.templates[name] = self.read_parts(templates.enter(value, place, _TEMPLATE_KEYS), key)

    def read_parts(self, at: YamlMapping, key: YamlNode) -> _BodyParts:
        inertia = read_inertia(at) if "inertia" in at.fields else None
        frames = at.enter(at.fields["frames"], f"{at.place}, frames").pairs if "frames" in at.fields else []
        return _BodyParts(
            at.read_text("description"),
            inertia,
            [
                (self.read_frame(name, at.enter(value, f"{at.place}, frame {label(name)}", _FRAME_KEYS)), frame_key)
                for name, frame_key, value in frames
            ],
            read_shapes(at, "visuals"),
            read_shapes(at, "collisions"),
            key.line,
        )

    def read_body(self, name: str, key: YamlNode, value: YamlNode) -> None:
        at = self.top.enter(value, f"body {label(name)}", _BODY_KEYS)
        template = self.find_template(at)
        parts = self.read_parts(at, key)
        frames, pose = parts.frames, None
        if "transform" in at.fields:
            pose = read_pose(at.enter(at.fields["transform"], f"{at.place}, transform", POSE_KEYS))
        if template is not None:
            frames = _override(template.frames, frames)
        self.frame_count += len(frames)
        source = at.locate(key.line)
        if self.frame_count > MAX_FRAMES >= self.frame_count - len(frames):
            message = f"the file, with its templates expanded, has more than {MAX_FRAMES} frames"
            self.builder.add_error(message, source, "split it into several models")
        if self.frame_count > MAX_FRAMES:
            return
        base = template or parts
        inertia = parts.inertia or base.inertia
        body = self.builder.add_body(name, parts.description or base.description, pose, inertia, source)
        body.visuals, body.collisions = parts.visuals or base.visuals, parts.collisions or base.collisions
        for frame, node in frames:
            place = f"{at.place}, frame {label(frame.name)}"
            body.frames.append((frame, Location(at.file, node.line, place)))

    def find_template(self, body: YamlMapping) -> _BodyParts | None:
        name = body.read_text("template")
        template = self.templates.get(name)
        if template is not None:
            template.is_used = True
        elif name:
            near = suggest_name(name, self.templates)
            if near and self.template_uses[name] > 1 and not self.template_uses[near[0]]:
                near = Suggestion()
            known = ", ".join(list(self.templates)[:8]) or "none"
            fix = f"write {near[0]}" if near else f"templates are: {known}"
            body.error(f"there is no template {quote(name)}", fix, "template", near)
        return template

    def read_frame(self, name: str, at: YamlMapping) -> BodyFrame:
        return BodyFrame(name, read_pose(at) or Pose.identity(), at.read_text("description"), self.read_sigma(at))

    def read_sigma(self, at: YamlMapping) -> Sigma | None:
        """Return the sigma of a frame or constraint.

        The defaults apply if it states a pose: a frame without one, like Origin, is there by definition, not by survey.
        """
        if "sigma" in at.fields:
            stated = read_sigma(at)
            return None if stated is None else self.defaults.complete(stated)
        if self.defaults == SigmaDefaults() or not any(key in at.fields for key in POSE_KEYS):
            return None
        return self.defaults.complete()

    def read_constraint(self, name: str, key: YamlNode, value: YamlNode) -> None:
        at = self.top.enter(value, f"constraint {label(name)}", _CONSTRAINT_KEYS)
        pose = read_pose(at)
        sigma = self.read_sigma(at)
        description = at.read_text("description")
        joint = read_joint(at) if "joint" in at.fields else FIXED
        if joint is None:
            self.builder.unreadable_joints.add(name)
            joint = FIXED
        from_, to = (self.read_end(at, end, key) for end in ("from", "to"))
        source = at.locate(key.line)
        if from_ and to:
            self.builder.add_constraint(name, from_, to, pose, description, sigma, joint, source)
        elif from_ or to:
            self.builder.unresolved_ends.append((name, "From" if from_ else "To", from_ or to, source))

    def read_end(self, at: YamlMapping, end: str, key: YamlNode) -> str:
        """Return the frame that a constraint names; empty, with an error, if it names none."""
        node = at.fields.get(end)
        if node is None:
            at.error(f"{end} is missing", f"add {end}: Body:Frame", key.line)
            return ""
        if node.kind is NodeKind.MAPPING and len(node.pairs) == 1:
            message = f"{end} is a mapping: there is a space after the colon"
            at.error(message, f"write {end}: Body:Frame, without a space", node.line)
            return ""
        return ":".join(part.strip() for part in at.read_text(end).split(":"))


def _override(base: list[_FrameNode], own: list[_FrameNode]) -> list[_FrameNode]:
    """Return the frames of the template, replaced by those of the body with the same name, then the others."""
    names = {frame.name for frame, _ in base}
    # of several with one name the first
    mine = {placed[0].name: placed for placed in reversed(own) if placed[0].name in names}
    extra = [placed for placed in own if mine.get(placed[0].name) is not placed]
    return [mine.get(placed[0].name, placed) for placed in base] + extra


WIDTH = 110
"""A frame that fits is written on one line."""

_PLAIN_TEXT = re.compile(r"[A-Za-z$](?:[^:#]*[^:# ])?")
"""Needs no quotes in a block, that is anywhere but in braces and brackets."""
_RESOLVER = yaml.resolver.Resolver()
_Z_AXIS = (0.0, 0.0, 1.0)


def save(model: Model, exact: bool = False) -> SavedModel:
    """Return the text of `model`. This format supports every feature of a model.

    With `exact`, rotations are written as quaternions at full precision, so that the revision of the model is the same
    when a program reads it back.
    """
    lines = ["modelserver: geometry/1", *_format_texts(name=model.name, description=model.description), "", "bodies:"]
    for number, body in enumerate(model.bodies):
        lines += ([""] if number else []) + _format_body(body, exact)
    if model.constraints:
        lines += ["", "constraints:"]
        for constraint in model.constraints:
            lines += _format_constraint(constraint, exact)
    return SavedModel("\n".join(lines) + "\n")


def _format_body(body: Body, exact: bool) -> list[str]:
    lines = [f"  {format_text(body.name)}:", *(f"    {each}" for each in _format_texts(description=body.description))]
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
    return [head, *(f"        {each}" for each in _format_texts(description=frame.description) + fields)]


def _format_constraint(constraint: Constraint, exact: bool) -> list[str]:
    fields = [f"from: {_format_full_name(constraint.from_)}", f"to: {_format_full_name(constraint.to)}"]
    fields += _format_texts(description=constraint.description) + _format_pose(constraint.pose, exact)
    fields += _format_sigma(constraint.sigma) + _format_joint(constraint.joint)
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
    lines += _format_pose(shape.pose, exact) + _format_texts(name=shape.name)
    if shape.material is not None:
        lines += ["material:", f"  name: {format_text(shape.material.name)}"]
        if shape.material.color is not None:
            lines.append(f"  color: {_format_list(shape.material.color)}")
        lines += [f"  {each}" for each in _format_texts(texture=shape.material.texture)]
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


def _format_texts(**texts: str) -> list[str]:
    """Return `key: text` for each text that is not empty."""
    return [f"{key}: {format_text(text)}" for key, text in texts.items() if text]


def _format_full_name(name: str) -> str:
    """Return a full name; its colon needs no quotes, because no space follows it."""
    body, _, frame = name.partition(":")
    safe = format_text(body) == body and format_text(frame) == frame
    return name if safe else quote_text(name)


def format_text(value: str) -> str:
    """Return a text as YAML, without quotes if every reader reads the same text."""
    if _PLAIN_TEXT.fullmatch(value) and value.isprintable():
        tag = _RESOLVER.resolve(yaml.ScalarNode, value, (True, False))  # type: ignore[no-untyped-call]
        if tag == "tag:yaml.org,2002:str":
            return value
    return quote_text(value)


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


MAX_SNAPSHOT_BYTES = 64 << 20
"""Greatest size of a decompressed snapshot."""


@dataclass(frozen=True, slots=True)
class ModelSnapshot:
    """The geometry of a vehicle, and the settings that a mirror of the service needs."""

    vehicle: str
    model: Model
    base_frame: str
    rolling_frame: str
    history_s: float
    joints_channel: str
    joints_latency_us: int = 0
    """Microseconds by which the stamps on `joints_channel` are later than the measurement."""


_KINDS: Final[dict[Any, Callable[[Any], Any]]] = {"str": str, "float": float, "int": int}
_SETTINGS: Final = {each.name: _KINDS[each.type] for each in fields(ModelSnapshot) if each.name != "model"}


def encode_snapshot(snapshot: ModelSnapshot) -> bytes:
    content = {key: getattr(snapshot, key) for key in _SETTINGS}
    content |= {"revision": snapshot.model.revision, "geometry": save(snapshot.model, exact=True).text}
    return zlib.compress(json.dumps(content, ensure_ascii=False).encode(), 9)


def decode_snapshot(data: bytes) -> ModelSnapshot:
    """Decode a snapshot. Raises WireError for other bytes, or a geometry of another revision."""
    unpacker = zlib.decompressobj()
    try:
        text = unpacker.decompress(data, MAX_SNAPSHOT_BYTES)
        if unpacker.unconsumed_tail:
            raise WireError("malformed", f"a snapshot decompresses to more than {MAX_SNAPSHOT_BYTES} bytes")
        content = json.loads(text)
        model = parse_model(content["geometry"].encode(), "the service's snapshot")
        settings = {key: kind(content[key]) for key, kind in _SETTINGS.items()}
        revision = str(content["revision"])
    except (zlib.error, ValueError, KeyError, TypeError, AttributeError, RecursionError, GeometryError) as error:
        raise WireError("malformed", f"not a snapshot of a geometry: {error}") from None
    if model.revision != revision:
        raise WireError("malformed", f"the snapshot states revision {revision}, but its geometry has {model.revision}")
    return ModelSnapshot(model=model, **settings)

"""Read the YAML geometry format, the one to write by hand. docs/geometry-files.md describes it with an example.

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
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from modelserver.errors import Severity, Suggestion, quote, suggest_name
from modelserver.formats import yaml_nodes
from modelserver.formats.reading import label
from modelserver.formats.yaml_joint import read_joint
from modelserver.formats.yaml_nodes import NodeKind, NodeReader, YamlNode
from modelserver.formats.yaml_pose import POSE_KEYS, SigmaDefaults, read_pose, read_sigma, read_sigma_parts
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import FIXED
from modelserver.geometry.parts import BodyFrame, Sigma
from modelserver.geometry.shape import DIMENSIONS, Material, Shape, ShapeKind
from modelserver.transforms.pose import Pose

_SHAPE_KINDS = tuple(str(kind) for kind in ShapeKind)
_SHAPE_KEYS = (*_SHAPE_KINDS, "scale", *POSE_KEYS, "name", "material")


def read_shapes(reader: NodeReader, node: YamlNode | None, place: str) -> tuple[Shape, ...]:
    """Read a list of shapes; wrong ones are reported and left out."""
    if node is None:
        return ()
    if node.kind is not NodeKind.LIST:
        reader.error(
            f"expected a list of shapes, got {node.kind.value}", node, place, "begin each shape with - box: ..."
        )
        return ()
    found = [_read_shape(reader, item, f"{place} {number}") for number, item in enumerate(node.items, 1)]
    return tuple(shape for shape in found if shape is not None)


def _read_shape(reader: NodeReader, node: YamlNode, place: str) -> Shape | None:
    fields = reader.read_fields(node, place, _SHAPE_KEYS)
    kinds = [key for key in _SHAPE_KINDS if key in fields]
    if len(kinds) != 1:
        what = "both " + " and ".join(kinds) if kinds else "no shape"
        reader.error(f"expected one shape, got {what}", node, place, f"write one of {', '.join(_SHAPE_KINDS)}")
        return None
    kind = ShapeKind(kinds[0])
    file = ""
    if kind is ShapeKind.MESH:
        file = reader.read_text(fields["mesh"], place, "mesh")
        size = (
            [1.0, 1.0, 1.0]
            if "scale" not in fields
            else reader.read_numbers(fields["scale"], 3, place, "scale", "factors")
        )
    else:
        if "scale" in fields:
            reader.error(f"a {kind} has no scale; only a mesh has", fields["scale"], place, "write its size in meters")
        size = _read_size(reader, kind, fields[kinds[0]], place)
    pose = read_pose(reader, fields, place)
    material = _read_material(reader, fields["material"], f"{place}, material") if "material" in fields else None
    if size is None:
        return None
    name = reader.read_text(fields.get("name"), place, "name")
    try:
        return Shape(kind, tuple(size), pose or Pose.identity(), file, name, material)
    except ValueError as error:
        reader.error(str(error), fields[kinds[0]], place, "see docs/geometry-files.md")
        return None


def _read_size(reader: NodeReader, kind: ShapeKind, node: YamlNode, place: str) -> list[float] | None:
    if kind is ShapeKind.BOX:
        return reader.read_numbers(node, 3, place, "box", "meters")
    wanted = DIMENSIONS[kind]
    fix = f"write {kind}: {{{', '.join(f'{what}: number' for what in wanted)}}}, in meters"
    inside = reader.read_fields(node, f"{place}, {kind}", wanted)
    values = []
    for what in wanted:
        if what not in inside:
            reader.error(f"{what} is missing", node, f"{place}, {kind}", fix)
        elif (value := reader.read_number(inside[what], place, what, fix)) is not None:
            values.append(value)
    return values if len(values) == len(wanted) else None


def _read_material(reader: NodeReader, node: YamlNode, place: str) -> Material | None:
    fields = reader.read_fields(node, place, ("name", "color", "texture"))
    color = None
    if "color" in fields:
        values = reader.read_numbers(fields["color"], 4, place, "color", "red, green, blue and opacity from 0 to 1")
        if values is None:
            return None
        color = (values[0], values[1], values[2], values[3])
    try:
        name = reader.read_text(fields.get("name"), place, "name")
        return Material(name, color, reader.read_text(fields.get("texture"), place, "texture"))
    except ValueError as error:
        reader.error(str(error), node, place, "write material: {name: ..., color: [red, green, blue, opacity]}")
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


def load(content: bytes, builder: ModelBuilder, file: str) -> ModelBuilder:
    """Add the model in a YAML file, and its problems, to `builder`."""
    root = yaml_nodes.parse_yaml(content, builder, file)
    if root is not None:
        _GeometryReader(NodeReader(builder, file)).read(root)
    return builder


@dataclass(slots=True)
class _BodyTemplate:
    description: str
    inertia: _Inertia | None
    frames: list[_FrameNode]
    node: YamlNode
    visuals: tuple[Shape, ...]
    collisions: tuple[Shape, ...]
    is_used: bool = field(default=False)


class _GeometryReader:
    def __init__(self, reader: NodeReader):
        self.reader = reader
        self.builder = reader.builder
        self.defaults = SigmaDefaults()
        self.templates: dict[str, _BodyTemplate] = {}
        self.frame_count = 0
        self.template_uses: Counter[str] = Counter()
        """Number of bodies that name a template."""

    def read(self, root: YamlNode) -> None:
        reader = self.reader
        if root.kind is not NodeKind.MAPPING:
            reader.error(
                f"the file is not a geometry: its top level is {root.kind.value}, not a mapping",
                root,
                "",
                "begin with bodies:, as in docs/geometry-files.md",
            )
            return
        fields = reader.read_fields(root, "", _TOP_KEYS)
        if FORMAT_KEY not in fields:
            self.builder.add_problem(
                Severity.NOTE,
                "the file does not state its format",
                reader.locate(root, ""),
                f"add a first line, {FORMAT_KEY}: {FORMAT_VERSION}",
            )
        elif (version := reader.read_text(fields[FORMAT_KEY], "", FORMAT_KEY)) != FORMAT_VERSION:
            reader.error(
                f"{FORMAT_KEY}: {quote(version)} is not supported",
                fields[FORMAT_KEY],
                "",
                f"write {FORMAT_KEY}: {FORMAT_VERSION}",
            )
        self.builder.name = reader.read_text(fields.get("name"), "", "name")
        self.builder.description = reader.read_text(fields.get("description"), "", "description")
        if "defaults" in fields:
            inside = reader.read_fields(fields["defaults"], "defaults", ("sigma",))
            if "sigma" in inside:
                self.defaults = read_sigma_parts(reader, inside["sigma"], "defaults") or SigmaDefaults()
        if "templates" in fields:
            self.read_templates(fields["templates"])
        if "bodies" in fields:
            bodies = [value for _, value in fields["bodies"].pairs]
            self.template_uses.update(
                v.text.strip() for body in bodies for k, v in body.pairs if k.text.strip() == "template"
            )
            for name, key, value in reader.read_pairs(fields["bodies"], "bodies"):
                self.read_body(name, key, value)
        elif not any(problem.severity is Severity.ERROR for problem in self.builder.problems):
            reader.error("there are no bodies", root, "", "add bodies:, with a name and frames: for each")
        if "constraints" in fields:
            for name, key, value in reader.read_pairs(fields["constraints"], "constraints"):
                self.read_constraint(name, key, value)
        for name, template in self.templates.items():
            if not template.is_used:
                self.builder.add_problem(
                    Severity.NOTE,
                    f"no body uses template {label(name)}",
                    reader.locate(template.node, "templates"),
                )

    def read_templates(self, node: YamlNode) -> None:
        for name, key, value in self.reader.read_pairs(node, "templates"):
            place = f"template {label(name)}"
            if name in self.templates:
                first = self.templates[name].node.line
                self.reader.error(
                    f"{place} is defined twice (first on line {first})", key, place, "rename one of the two"
                )
                continue
            fields = self.reader.read_fields(value, place, _TEMPLATE_KEYS)
            self.templates[name] = _BodyTemplate(
                self.reader.read_text(fields.get("description"), place, "description"),
                self.read_inertia(fields.get("inertia"), place),
                self.read_frames(fields.get("frames"), place),
                key,
                read_shapes(self.reader, fields.get("visuals"), f"{place}, visuals"),
                read_shapes(self.reader, fields.get("collisions"), f"{place}, collisions"),
            )

    def read_body(self, name: str, key: YamlNode, value: YamlNode) -> None:
        place = f"body {label(name)}"
        fields = self.reader.read_fields(value, place, _BODY_KEYS)
        template = self.find_template(fields.get("template"), place)
        description = self.reader.read_text(fields.get("description"), place, "description")
        inertia = self.read_inertia(fields.get("inertia"), place)
        frames = self.read_frames(fields.get("frames"), place)
        visuals = read_shapes(self.reader, fields.get("visuals"), f"{place}, visuals")
        collisions = read_shapes(self.reader, fields.get("collisions"), f"{place}, collisions")
        pose = None
        if "transform" in fields:
            inside = f"{place}, transform"
            pose = read_pose(self.reader, self.reader.read_fields(fields["transform"], inside, POSE_KEYS), inside)
        if template is not None:
            description = description or template.description
            inertia = inertia or template.inertia
            visuals, collisions = visuals or template.visuals, collisions or template.collisions
            frames = _override(template.frames, frames)
        self.frame_count += len(frames)
        if self.frame_count > MAX_FRAMES >= self.frame_count - len(frames):
            self.reader.error(
                f"the file, with its templates expanded, has more than {MAX_FRAMES} frames",
                key,
                place,
                "split it into several models",
            )
        if self.frame_count > MAX_FRAMES:
            return
        body = self.builder.add_body(name, description, pose, inertia, self.reader.locate(key, place))
        body.visuals, body.collisions = visuals, collisions
        for frame, node in frames:
            body.frames.append((frame, self.reader.locate(node, f"{place}, frame {label(frame.name)}")))

    def find_template(self, node: YamlNode | None, place: str) -> _BodyTemplate | None:
        if node is None:
            return None
        name = self.reader.read_text(node, place, "template")
        template = self.templates.get(name)
        if template is not None:
            template.is_used = True
        elif name:
            near = suggest_name(name, self.templates)
            if near and self.template_uses[name] > 1 and not self.template_uses[near[0]]:
                near = Suggestion()
            known = ", ".join(list(self.templates)[:8]) or "none"
            self.reader.error(
                f"there is no template {quote(name)}",
                node,
                place,
                f"write {near[0]}" if near else f"templates are: {known}",
                near,
            )
        return template

    def read_frames(self, node: YamlNode | None, place: str) -> list[_FrameNode]:
        if node is None:
            return []
        return [
            (self.read_frame(name, value, f"{place}, frame {label(name)}"), key)
            for name, key, value in self.reader.read_pairs(node, f"{place}, frames")
        ]

    def read_frame(self, name: str, node: YamlNode, place: str) -> BodyFrame:
        fields = self.reader.read_fields(node, place, _FRAME_KEYS)
        return BodyFrame(
            name,
            read_pose(self.reader, fields, place) or Pose.identity(),
            self.reader.read_text(fields.get("description"), place, "description"),
            self.read_sigma(fields, place),
        )

    def read_sigma(self, fields: dict[str, YamlNode], place: str) -> Sigma | None:
        """Return the sigma of a frame or constraint.

        The defaults apply if it states a pose: a frame without one, like Origin, is there by definition, not by survey.
        """
        if "sigma" in fields:
            return read_sigma(self.reader, fields["sigma"], place, self.defaults)
        position, rotation = self.defaults.position, self.defaults.rotation
        if (position is None and rotation is None) or not any(key in fields for key in POSE_KEYS):
            return None
        none = (0.0, 0.0, 0.0)
        return Sigma(position or none, rotation or none)

    def read_inertia(self, node: YamlNode | None, place: str) -> _Inertia | None:
        if node is None:
            return None
        rows = self.reader.read_rows(node, (6,), 6, place, "inertia")
        return None if rows is None else tuple(tuple(row) for row in rows)

    def read_constraint(self, name: str, key: YamlNode, value: YamlNode) -> None:
        place = f"constraint {label(name)}"
        fields = self.reader.read_fields(value, place, _CONSTRAINT_KEYS)
        pose = read_pose(self.reader, fields, place)
        sigma = self.read_sigma(fields, place)
        description = self.reader.read_text(fields.get("description"), place, "description")
        joint = read_joint(self.reader, fields["joint"], place) if "joint" in fields else FIXED
        if joint is None:
            self.builder.unreadable_joints.add(name)
            joint = FIXED
        from_, to = (self.read_end(end, fields, key, place) for end in ("from", "to"))
        if from_ and to:
            self.builder.add_constraint(
                name, from_, to, pose, description, sigma, joint, self.reader.locate(key, place)
            )
        elif from_ or to:
            self.builder.unresolved_ends.append(
                (name, "From" if from_ else "To", from_ or to, self.reader.locate(key, place))
            )

    def read_end(self, end: str, fields: dict[str, YamlNode], key: YamlNode, place: str) -> str:
        """Return the frame that a constraint names; empty, with an error, if it names none."""
        node = fields.get(end)
        if node is None:
            self.reader.error(f"{end} is missing", key, place, f"add {end}: Body:Frame")
            return ""
        if node.kind is NodeKind.MAPPING and len(node.pairs) == 1:
            self.reader.error(
                f"{end} is a mapping: there is a space after the colon",
                node,
                place,
                f"write {end}: Body:Frame, without a space",
            )
            return ""
        return ":".join(part.strip() for part in self.reader.read_text(node, place, end).split(":"))


def _override(base: list[_FrameNode], own: list[_FrameNode]) -> list[_FrameNode]:
    """Return the frames of the template, replaced by those of the body with the same name, then the others."""
    mine: dict[str, _FrameNode] = {}
    extra: list[_FrameNode] = []
    names = {frame.name for frame, _ in base}
    for placed in own:
        name = placed[0].name
        if name in names and name not in mine:
            mine[name] = placed
        else:
            extra.append(placed)
    return [mine.get(placed[0].name, placed) for placed in base] + extra

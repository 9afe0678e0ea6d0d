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
from dataclasses import dataclass

from modelserver.errors import Location, Severity, Suggestion, has_error, quote, suggest_name
from modelserver.formats.reading import label
from modelserver.formats.yaml_elements import POSE_KEYS, SigmaDefaults, read_inertia, read_joint, read_pose, read_sigma
from modelserver.formats.yaml_nodes import NodeKind, YamlMapping, YamlNode, parse_yaml
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import FIXED
from modelserver.geometry.parts import BodyFrame, Sigma
from modelserver.geometry.shape import DIMENSIONS, Material, Shape, ShapeKind
from modelserver.transforms.pose import Pose

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
    root = parse_yaml(content, builder, file)
    if root is None:
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

"""The YAML form: the one to write by hand. docs/geometry-files.md describes it with an example."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from modelserver.errors import Severity, Suggested, shown, suggestions
from modelserver.formats import yaml_nodes
from modelserver.formats.spelling import label
from modelserver.formats.yaml_joint import read_joint
from modelserver.formats.yaml_nodes import NodeKind, YamlNode
from modelserver.formats.yaml_pose import POSE_KEYS, Defaults, read_pose, read_sigma, read_sigma_parts
from modelserver.formats.yaml_reader import NodeReader
from modelserver.formats.yaml_shapes import read_shapes
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import FIXED
from modelserver.geometry.parts import BodyFrame, Sigma
from modelserver.geometry.shape import Shape
from modelserver.spatial.pose import Pose

FORM_KEY = "modelserver"
FORM = "geometry/1"
"""A file states `modelserver: geometry/1`; a later form that reads otherwise will state another number."""

GREATEST_FRAMES = 100_000
"""Frames with templates written out."""

_TOP = (FORM_KEY, "name", "description", "defaults", "templates", "bodies", "constraints")
_TEMPLATE = ("description", "inertia", "visuals", "collisions", "frames")
_BODY = ("template", "description", "transform", "inertia", "visuals", "collisions", "frames")
_FRAME = (*POSE_KEYS, "description", "sigma")
_CONSTRAINT = ("from", "to", *POSE_KEYS, "description", "sigma", "joint")

_Inertia = tuple[tuple[float, ...], ...]
_PlacedFrame = tuple[BodyFrame, YamlNode]


def load(content: bytes, builder: ModelBuilder, file: str) -> ModelBuilder:
    """Add what a YAML file holds to `builder`, and what is wrong with it."""
    root = yaml_nodes.parse(content, builder, file)
    if root is not None:
        _Form(NodeReader(builder, file)).read(root)
    return builder


@dataclass(slots=True)
class _Template:
    description: str
    inertia: _Inertia | None
    frames: list[_PlacedFrame]
    node: YamlNode
    visuals: tuple[Shape, ...]
    collisions: tuple[Shape, ...]
    used: bool = field(default=False)


class _Form:
    def __init__(self, reader: NodeReader):
        self.reader = reader
        self.builder = reader.builder
        self.defaults = Defaults()
        self.templates: dict[str, _Template] = {}
        self.frames = 0
        self.uses: Counter[str] = Counter()
        """How many bodies name a template."""

    def read(self, root: YamlNode) -> None:
        reader = self.reader
        if root.kind is not NodeKind.MAPPING:
            reader.error(
                f"the file is no geometry: its top level is {root.kind.value}, not a mapping",
                root,
                "",
                "begin with bodies:, as in docs/geometry-files.md",
            )
            return
        fields = reader.fields(root, "", _TOP)
        if FORM_KEY not in fields:
            self.builder.problem(
                Severity.NOTE,
                "the file does not say which form it is in",
                reader.at(root, ""),
                f"add a first line, {FORM_KEY}: {FORM}",
            )
        elif (form := reader.text(fields[FORM_KEY], "", FORM_KEY)) != FORM:
            reader.error(
                f"{FORM_KEY}: {shown(form)} is not read here", fields[FORM_KEY], "", f"write {FORM_KEY}: {FORM}"
            )
        self.builder.name = reader.text(fields.get("name"), "", "name")
        self.builder.description = reader.text(fields.get("description"), "", "description")
        if "defaults" in fields:
            inside = reader.fields(fields["defaults"], "defaults", ("sigma",))
            if "sigma" in inside:
                self.defaults = read_sigma_parts(reader, inside["sigma"], "defaults") or Defaults()
        if "templates" in fields:
            self.read_templates(fields["templates"])
        if "bodies" in fields:
            bodies = [value for _, value in fields["bodies"].pairs]
            self.uses.update(v.text.strip() for body in bodies for k, v in body.pairs if k.text.strip() == "template")
            for name, key, value in reader.named(fields["bodies"], "bodies"):
                self.read_body(name, key, value)
        elif not any(problem.severity is Severity.ERROR for problem in self.builder.problems):
            reader.error("there are no bodies", root, "", "add bodies:, with a name and frames: for each")
        if "constraints" in fields:
            for name, key, value in reader.named(fields["constraints"], "constraints"):
                self.read_constraint(name, key, value)
        for name, template in self.templates.items():
            if not template.used:
                self.builder.problem(
                    Severity.NOTE, f"no body uses template {label(name)}", reader.at(template.node, "templates")
                )

    def read_templates(self, node: YamlNode) -> None:
        for name, key, value in self.reader.named(node, "templates"):
            place = f"template {label(name)}"
            if name in self.templates:
                first = self.templates[name].node.line
                self.reader.error(
                    f"{place} is defined twice (first on line {first})", key, place, "rename one of the two"
                )
                continue
            fields = self.reader.fields(value, place, _TEMPLATE)
            self.templates[name] = _Template(
                self.reader.text(fields.get("description"), place, "description"),
                self.read_inertia(fields.get("inertia"), place),
                self.read_frames(fields.get("frames"), place),
                key,
                read_shapes(self.reader, fields.get("visuals"), f"{place}, visuals"),
                read_shapes(self.reader, fields.get("collisions"), f"{place}, collisions"),
            )

    def read_body(self, name: str, key: YamlNode, value: YamlNode) -> None:
        place = f"body {label(name)}"
        fields = self.reader.fields(value, place, _BODY)
        template = self.template_of(fields.get("template"), place)
        description = self.reader.text(fields.get("description"), place, "description")
        inertia = self.read_inertia(fields.get("inertia"), place)
        frames = self.read_frames(fields.get("frames"), place)
        visuals = read_shapes(self.reader, fields.get("visuals"), f"{place}, visuals")
        collisions = read_shapes(self.reader, fields.get("collisions"), f"{place}, collisions")
        pose = None
        if "transform" in fields:
            inside = f"{place}, transform"
            pose = read_pose(self.reader, self.reader.fields(fields["transform"], inside, POSE_KEYS), inside)
        if template is not None:
            description = description or template.description
            inertia = inertia or template.inertia
            visuals, collisions = visuals or template.visuals, collisions or template.collisions
            frames = _overridden(template.frames, frames)
        self.frames += len(frames)
        if self.frames > GREATEST_FRAMES >= self.frames - len(frames):
            self.reader.error(
                f"the file, with its templates written out, has more than {GREATEST_FRAMES} frames",
                key,
                place,
                "split it into several models",
            )
        if self.frames > GREATEST_FRAMES:
            return
        body = self.builder.body(name, description, pose, inertia, self.reader.at(key, place))
        body.visuals, body.collisions = visuals, collisions
        for frame, node in frames:
            body.frames.append((frame, self.reader.at(node, f"{place}, frame {label(frame.name)}")))

    def template_of(self, node: YamlNode | None, place: str) -> _Template | None:
        if node is None:
            return None
        name = self.reader.text(node, place, "template")
        template = self.templates.get(name)
        if template is not None:
            template.used = True
        elif name:
            near = suggestions(name, self.templates)
            if near and self.uses[name] > 1 and not self.uses[near[0]]:
                # several bodies name what does not exist and none what is near: that is what is misspelled
                near = Suggested()
            known = ", ".join(list(self.templates)[:8]) or "none"
            self.reader.error(
                f"there is no template {shown(name)}",
                node,
                place,
                f"write {near[0]}" if near else f"templates are: {known}",
                near,
            )
        return template

    def read_frames(self, node: YamlNode | None, place: str) -> list[_PlacedFrame]:
        if node is None:
            return []
        return [
            (self.read_frame(name, value, f"{place}, frame {label(name)}"), key)
            for name, key, value in self.reader.named(node, f"{place}, frames")
        ]

    def read_frame(self, name: str, node: YamlNode, place: str) -> BodyFrame:
        fields = self.reader.fields(node, place, _FRAME)
        return BodyFrame(
            name,
            read_pose(self.reader, fields, place) or Pose.identity(),
            self.reader.text(fields.get("description"), place, "description"),
            self.sigma_of(fields, place),
        )

    def sigma_of(self, fields: dict[str, YamlNode], place: str) -> Sigma | None:
        """Return the sigma of a frame or constraint.

        The defaults count for what states a pose: a frame that states none, like Origin, stands where it
        does by definition, not by survey.
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
        rows = self.reader.rows(node, (6,), 6, place, "inertia")
        return None if rows is None else tuple(tuple(row) for row in rows)

    def read_constraint(self, name: str, key: YamlNode, value: YamlNode) -> None:
        place = f"constraint {label(name)}"
        fields = self.reader.fields(value, place, _CONSTRAINT)
        pose = read_pose(self.reader, fields, place)
        sigma = self.sigma_of(fields, place)
        description = self.reader.text(fields.get("description"), place, "description")
        joint = read_joint(self.reader, fields["joint"], place) if "joint" in fields else FIXED
        if joint is None:
            self.builder.unclear_joints.add(name)
            joint = FIXED
        from_, to = (self.read_end(end, fields, key, place) for end in ("from", "to"))
        if from_ and to:
            self.builder.constraint(name, from_, to, pose, description, sigma, joint, self.reader.at(key, place))
        elif from_ or to:
            self.builder.loose_ends.append((name, "From" if from_ else "To", from_ or to, self.reader.at(key, place)))

    def read_end(self, end: str, fields: dict[str, YamlNode], key: YamlNode, place: str) -> str:
        """Return the frame that a constraint names, empty with an error where it names none."""
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
        return ":".join(part.strip() for part in self.reader.text(node, place, end).split(":"))


def _overridden(base: list[_PlacedFrame], own: list[_PlacedFrame]) -> list[_PlacedFrame]:
    """Return the template's frames, each replaced where the body has one of its name, then the others."""
    mine: dict[str, _PlacedFrame] = {}
    extra: list[_PlacedFrame] = []
    names = {frame.name for frame, _ in base}
    for placed in own:
        name = placed[0].name
        if name in names and name not in mine:
            mine[name] = placed
        else:
            extra.append(placed)
    return [mine.get(placed[0].name, placed) for placed in base] + extra

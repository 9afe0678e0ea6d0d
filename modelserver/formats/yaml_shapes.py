"""Visuals and collisions as the YAML form reads them: lists of shapes, each with a pose.

visuals:
  - box: [0.9, 0.5, 0.1]                       # x, y, z
    xyz: [0, 0, 0.06]
  - cylinder: {radius: 0.165, length: 0.114}
    rpy_deg: [90, 0, 0]
  - sphere: {radius: 0.1}
  - mesh: meshes/hull.dae                      # named, never opened
    scale: [1, 1, 1]
    material: {name: black, colour: [0, 0, 0, 1]}
"""

from __future__ import annotations

from modelserver.formats.yaml_nodes import NodeKind, YamlNode
from modelserver.formats.yaml_pose import POSE_KEYS, read_pose
from modelserver.formats.yaml_reader import NodeReader
from modelserver.geometry.shape import DIMENSIONS, Material, Shape, ShapeKind
from modelserver.spatial.pose import Pose

_KINDS = tuple(str(kind) for kind in ShapeKind)
_SHAPE = (*_KINDS, "scale", *POSE_KEYS, "name", "material")


def read_shapes(reader: NodeReader, node: YamlNode | None, place: str) -> tuple[Shape, ...]:
    """Return the shapes of a list; those that are wrong are reported and left out."""
    if node is None:
        return ()
    if node.kind is not NodeKind.LIST:
        reader.error(
            f"expected a list of shapes, got {node.kind.value}", node, place, "begin each shape with - box: ..."
        )
        return ()
    found = [_shape(reader, item, f"{place} {number}") for number, item in enumerate(node.items, 1)]
    return tuple(shape for shape in found if shape is not None)


def _shape(reader: NodeReader, node: YamlNode, place: str) -> Shape | None:
    fields = reader.fields(node, place, _SHAPE)
    kinds = [key for key in _KINDS if key in fields]
    if len(kinds) != 1:
        what = "both " + " and ".join(kinds) if kinds else "no shape"
        reader.error(f"expected one shape, got {what}", node, place, f"write one of {', '.join(_KINDS)}")
        return None
    kind = ShapeKind(kinds[0])
    file = ""
    if kind is ShapeKind.MESH:
        file = reader.text(fields["mesh"], place, "mesh")
        size = (
            [1.0, 1.0, 1.0] if "scale" not in fields else reader.numbers(fields["scale"], 3, place, "scale", "factors")
        )
    else:
        if "scale" in fields:
            reader.error(f"a {kind} has no scale; only a mesh has", fields["scale"], place, "write its size in metres")
        size = _size(reader, kind, fields[kinds[0]], place)
    pose = read_pose(reader, fields, place)
    material = _material(reader, fields["material"], f"{place}, material") if "material" in fields else None
    if size is None:
        return None
    name = reader.text(fields.get("name"), place, "name")
    try:
        return Shape(kind, tuple(size), pose or Pose.identity(), file, name, material)
    except ValueError as error:
        reader.error(str(error), fields[kinds[0]], place, "see docs/geometry-files.md")
        return None


def _size(reader: NodeReader, kind: ShapeKind, node: YamlNode, place: str) -> list[float] | None:
    if kind is ShapeKind.BOX:
        return reader.numbers(node, 3, place, "box", "metres")
    wanted = DIMENSIONS[kind]
    fix = f"write {kind}: {{{', '.join(f'{what}: number' for what in wanted)}}}, in metres"
    inside = reader.fields(node, f"{place}, {kind}", wanted)
    values = []
    for what in wanted:
        if what not in inside:
            reader.error(f"{what} is missing", node, f"{place}, {kind}", fix)
        elif (value := reader.number(inside[what], place, what, fix)) is not None:
            values.append(value)
    return values if len(values) == len(wanted) else None


def _material(reader: NodeReader, node: YamlNode, place: str) -> Material | None:
    fields = reader.fields(node, place, ("name", "colour", "texture"))
    colour = None
    if "colour" in fields:
        values = reader.numbers(fields["colour"], 4, place, "colour", "red, green, blue and opacity from 0 to 1")
        if values is None:
            return None
        colour = (values[0], values[1], values[2], values[3])
    try:
        name = reader.text(fields.get("name"), place, "name")
        return Material(name, colour, reader.text(fields.get("texture"), place, "texture"))
    except ValueError as error:
        reader.error(str(error), node, place, "write material: {name: ..., colour: [red, green, blue, opacity]}")
        return None

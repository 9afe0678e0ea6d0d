"""Visuals, collisions, materials and inertials of URDF, and the attributes that all of URDF is made of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from modelserver.errors import Location, shown
from modelserver.formats import numbers
from modelserver.formats.spelling import label, nearest_keys
from modelserver.formats.xml_document import children, line, tag
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.inertia import RigidInertia
from modelserver.geometry.shape import Material, Shape, ShapeKind
from modelserver.spatial.pose import Pose

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_GEOMETRY = tuple(str(kind) for kind in ShapeKind)


class Attributes:
    """Reads elements of one file; what is wrong is reported, and then None returned. `place` says where they stand."""

    def __init__(self, builder: ModelBuilder, file: str):
        self.builder = builder
        self.file = file

    def at(self, element: Element, place: str) -> Location:
        """Return the place of an element."""
        return Location(self.file, line(element), place)

    def error(self, message: str, element: Element, place: str, fix: str, nearest: tuple[str, ...] = ()) -> None:
        """Report an error at an element."""
        self.builder.error(message, self.at(element, place), fix, nearest)

    def warning(self, message: str, element: Element, place: str, fix: str, nearest: tuple[str, ...] = ()) -> None:
        """Report a warning at an element."""
        self.builder.warning(message, self.at(element, place), fix, nearest)

    def parts(
        self, element: Element, known: tuple[str, ...], place: str, once: tuple[str, ...] = ()
    ) -> dict[str, Element]:
        """Return the first child of each name in `known`; a second one is an error, and what is misspelt a warning.

        A second one of those in `once` is a warning: no answer depends on it.
        """
        found: dict[str, Element] = {}
        for child in children(element):
            name = tag(child)
            if name in found:
                twice, fix = f"<{name}> is given twice (first on line {line(found[name])})", "remove one of the two"
                if name in once:
                    self.warning(f"{twice}; the first is used", child, place, fix)
                else:
                    self.error(twice, child, place, fix)
            elif name in known:
                found[name] = child
            elif near := nearest_keys(name, known):
                self.warning(
                    f"unknown element <{label(name)}>; passed over", child, place, f"write <{near[0]}>", tuple(near)
                )
        return found

    def numbers(
        self, element: Element, key: str, count: int, place: str, default: Sequence[float] | None = None
    ) -> list[float] | None:
        """Return the numbers of an attribute; `default` where it is absent, an error where there is none."""
        fix = f'write {key}="{" ".join(["number"] * count)}"'
        text = element.get(key)
        if text is None:
            if default is not None:
                return list(default)
            self.error(f"<{tag(element)}> has no {key}", element, place, fix)
            return None
        try:
            values = [numbers.parse(word, f"{key}: ") for word in text.split()]
            if len(values) != count:
                raise ValueError(f"{key} has {len(values)} number{'' if len(values) == 1 else 's'}, not {count}")
        except ValueError as error:
            self.error(str(error), element, place, fix)
            return None
        return values

    def number(self, element: Element, key: str, place: str, default: float | None = None) -> float | None:
        """Return the number of an attribute; as `numbers`."""
        values = self.numbers(element, key, 1, place, None if default is None else (default,))
        return None if values is None else values[0]

    def text(self, element: Element, key: str, place: str, fix: str = "") -> str | None:
        """Return the trimmed text of an attribute; an error where it is absent or empty."""
        value = (element.get(key) or "").strip()
        if not value:
            self.error(f"<{tag(element)}> has no {key}", element, place, fix or f'write {key}="..."')
            return None
        return value

    def origin(self, element: Element | None, place: str) -> Pose | None:
        """Return the pose of an <origin>, the identity where there is none; roll, pitch, yaw are radians."""
        if element is None:
            return Pose.identity()
        for key in map(str, element.attrib):
            if key not in ("xyz", "rpy"):
                near = nearest_keys(key, ("xyz", "rpy"))
                self.warning(
                    f"<origin> has an unknown attribute {label(key)}; passed over",
                    element,
                    place,
                    "use xyz, rpy",
                    near,
                )
        position = self.numbers(element, "xyz", 3, place, (0.0, 0.0, 0.0))
        angles = self.numbers(element, "rpy", 3, place, (0.0, 0.0, 0.0))
        if position is None or angles is None:
            return None
        if not numbers.within_reach(position, self.builder, self.at(element, place)):
            return None
        return Pose.from_rpy(position, *angles)


def read_materials(reader: Attributes, elements: Sequence[Element]) -> dict[str, Material]:
    """Return the materials that a robot defines for its visuals, by name."""
    materials: dict[str, Material] = {}
    for element in elements:
        found = read_material(reader, element, {}, "material")
        if found is not None and found.name in materials:
            reader.warning(
                f"material {label(found.name)} is defined twice; the first stands", element, "material", "rename one"
            )
        elif found is not None:
            materials[found.name] = found
    return materials


def read_material(reader: Attributes, element: Element, known: dict[str, Material], place: str) -> Material | None:
    """Return a material; one that states a name alone is the one of that name in `known`, where there is one."""
    name = (element.get("name") or "").strip()
    parts = reader.parts(element, ("color", "texture"), place)
    if not parts and name in known:
        return known[name]
    colour = None
    if "color" in parts:
        values = reader.numbers(parts["color"], "rgba", 4, place)
        if values is None:
            return None
        colour = (values[0], values[1], values[2], values[3])
    texture = (parts["texture"].get("filename") or "").strip() if "texture" in parts else ""
    try:
        return Material(name, colour, texture)
    except ValueError as error:
        reader.warning(f"{error}; the material is passed over", element, place, 'write <material name="..."> with rgba')
        return None


def read_shape(reader: Attributes, element: Element, known: dict[str, Material], place: str) -> Shape | None:
    """Return a visual or a collision; None, with a warning, where it has no geometry that is known."""
    parts = reader.parts(element, ("origin", "geometry", "material"), place, once=("material",))
    if "geometry" not in parts:
        reader.warning(
            f"<{tag(element)}> has no <geometry>; passed over",
            element,
            place,
            "add <geometry> with a box or a mesh in it",
        )
        return None
    pose = reader.origin(parts.get("origin"), place)
    inside = list(children(parts["geometry"]))
    if len(inside) != 1 or tag(inside[0]) not in _GEOMETRY:
        name = tag(inside[0]) if inside else ""
        near = nearest_keys(name, _GEOMETRY)
        what = (
            f"geometry {label(name)} is not known"
            if len(inside) == 1
            else f"<geometry> holds {len(inside)} shapes, not 1"
        )
        reader.warning(
            f"{what}; passed over",
            parts["geometry"],
            place,
            f"write <{near[0]}>" if near else f"shapes are {', '.join(_GEOMETRY)}",
            tuple(near),
        )
        return None
    size = _size(reader, inside[0], place)
    if size is None or pose is None:
        return None
    material = None
    if "material" in parts:
        material = read_material(reader, parts["material"], known, place)
    kind = ShapeKind(tag(inside[0]))
    file = (inside[0].get("filename") or "").strip() if kind is ShapeKind.MESH else ""
    try:
        return Shape(kind, tuple(size), pose, file, (element.get("name") or "").strip(), material)
    except ValueError as error:
        reader.error(str(error), inside[0], place, "mend it, or remove the shape: no answer depends on it")
        return None


def _size(reader: Attributes, element: Element, place: str) -> list[float] | None:
    match ShapeKind(tag(element)):
        case ShapeKind.BOX:
            return reader.numbers(element, "size", 3, place)
        case ShapeKind.MESH:
            return reader.numbers(element, "scale", 3, place, (1.0, 1.0, 1.0))
        case ShapeKind.SPHERE:
            return reader.numbers(element, "radius", 1, place)
    radius, length = reader.number(element, "radius", place), reader.number(element, "length", place)
    return None if radius is None or length is None else [radius, length]


def read_inertial(reader: Attributes, element: Element, place: str) -> RigidInertia | None:
    """Return mass, centre of mass and inertia; None where they are wrong, or there is no mass, which is reported."""
    parts = reader.parts(element, ("origin", "mass", "inertia"), place)
    pose = reader.origin(parts.get("origin"), place)
    for key, fix in (
        ("mass", '<mass value="kilograms"/>'),
        ("inertia", '<inertia ixx="..." ixy="..." ixz="..." iyy="..." iyz="..." izz="..."/>'),
    ):
        if key not in parts:
            reader.error(f"<inertial> has no <{key}>", element, place, f"add {fix}, or remove <inertial>")
    if "mass" not in parts or "inertia" not in parts:
        return None
    mass = reader.number(parts["mass"], "value", place)
    # what is off the diagonal may be left out
    moments = [reader.number(parts["inertia"], key, place, None if key[1] == key[2] else 0.0) for key in _MOMENTS]
    if mass is None or pose is None or any(each is None for each in moments):
        return None
    xx, xy, xz, yy, yz, zz = (each or 0.0 for each in moments)
    found = RigidInertia.turned(mass, pose, ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
    if max(abs(each) for row in found.matrix() for each in row) > numbers.GREATEST_LENGTH**2:
        reader.error(
            f"the inertia is out of reach: {shown(parts['mass'].get('value') or '')} kg",
            element,
            place,
            "look for a slip",
        )
        return None
    if fault := found.fault():
        massless = not mass > 0.0
        reader.warning(
            f"{fault}{'; passed over' if massless else ''}",
            parts["mass"] if massless else parts["inertia"],
            place,
            "remove <inertial> if it is not known" if massless else "look for a wrong digit or a wrong unit (kg m2)",
        )
        return None if massless else found
    return found

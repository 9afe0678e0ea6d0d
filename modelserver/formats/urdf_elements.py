"""Read the elements of URDF that are not links or joints: attributes, origins, visuals, collisions, materials,
inertials."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from modelserver.errors import Location, quote
from modelserver.formats.reading import MAX_POSITION, check_position, label, parse_numbers, suggest_known_key
from modelserver.formats.xml_document import get_line, get_tag, iterate_children
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.inertia import RigidInertia
from modelserver.geometry.shape import Material, Shape, ShapeKind
from modelserver.transforms.pose import Pose

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

_INERTIA_KEYS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_SHAPE_NAMES = tuple(str(kind) for kind in ShapeKind)


class ElementReader:
    """Reads elements of one file; a problem is reported at `place`, and None returned."""

    def __init__(self, builder: ModelBuilder, file: str):
        self.builder = builder
        self.file = file

    def locate(self, element: Element, place: str) -> Location:
        """Return the place of an element."""
        return Location(self.file, get_line(element), place)

    def error(self, message: str, element: Element, place: str, fix: str, nearest: tuple[str, ...] = ()) -> None:
        """Report an error at an element."""
        self.builder.add_error(message, self.locate(element, place), fix, nearest)

    def warning(self, message: str, element: Element, place: str, fix: str, nearest: tuple[str, ...] = ()) -> None:
        """Report a warning at an element."""
        self.builder.add_warning(message, self.locate(element, place), fix, nearest)

    def read_parts(
        self, element: Element, known: tuple[str, ...], place: str, once: tuple[str, ...] = ()
    ) -> dict[str, Element]:
        """Return the first child of each name in `known`; a second one is an error, a misspelled name a warning.

        A second one of a name in `once` is only a warning: no query depends on it.
        """
        found: dict[str, Element] = {}
        for child in iterate_children(element):
            name = get_tag(child)
            if name in found:
                twice, fix = f"<{name}> is given twice (first on line {get_line(found[name])})", "remove one of the two"
                if name in once:
                    self.warning(f"{twice}; the first is used", child, place, fix)
                else:
                    self.error(twice, child, place, fix)
            elif name in known:
                found[name] = child
            elif near := suggest_known_key(name, known):
                self.warning(
                    f"unknown element <{label(name)}>; ignored",
                    child,
                    place,
                    f"write <{near[0]}>",
                    tuple(near),
                )
        return found

    def read_numbers(
        self, element: Element, key: str, count: int, place: str, default: Sequence[float] | None = None
    ) -> list[float] | None:
        """Read the numbers of an attribute; `default` if it is absent, an error if there is no default."""
        fix = f'write {key}="{" ".join(["number"] * count)}"'
        text = element.get(key)
        if text is None:
            if default is not None:
                return list(default)
            self.error(f"<{get_tag(element)}> has no {key}", element, place, fix)
            return None
        try:
            return parse_numbers(text.split(), count, key)
        except ValueError as error:
            self.error(str(error), element, place, fix)
            return None

    def read_number(self, element: Element, key: str, place: str, default: float | None = None) -> float | None:
        """Read the number of an attribute, as `read_numbers`."""
        values = self.read_numbers(element, key, 1, place, None if default is None else (default,))
        return None if values is None else values[0]

    def read_text(self, element: Element, key: str, place: str, fix: str = "") -> str | None:
        """Read the trimmed text of an attribute; an error if it is absent or empty."""
        value = (element.get(key) or "").strip()
        if not value:
            self.error(f"<{get_tag(element)}> has no {key}", element, place, fix or f'write {key}="..."')
            return None
        return value

    def read_origin(self, element: Element | None, place: str) -> Pose | None:
        """Read the pose of an <origin>, the identity for none; roll, pitch, yaw are in radians."""
        if element is None:
            return Pose.identity()
        for key in map(str, element.attrib):
            if key not in ("xyz", "rpy"):
                near = suggest_known_key(key, ("xyz", "rpy"))
                self.warning(
                    f"<origin> has an unknown attribute {label(key)}; ignored",
                    element,
                    place,
                    "use xyz, rpy",
                    near,
                )
        position = self.read_numbers(element, "xyz", 3, place, (0.0, 0.0, 0.0))
        angles = self.read_numbers(element, "rpy", 3, place, (0.0, 0.0, 0.0))
        if position is None or angles is None:
            return None
        if not check_position(position, self.builder, self.locate(element, place)):
            return None
        return Pose.from_rpy(position, *angles)


def read_materials(reader: ElementReader, elements: Sequence[Element]) -> dict[str, Material]:
    """Read the materials that a robot defines for its visuals, by name."""
    materials: dict[str, Material] = {}
    for element in elements:
        found = read_material(reader, element, {}, "material")
        if found is not None and found.name in materials:
            reader.warning(
                f"material {label(found.name)} is defined twice; the first is used",
                element,
                "material",
                "rename one",
            )
        elif found is not None:
            materials[found.name] = found
    return materials


def read_material(reader: ElementReader, element: Element, known: dict[str, Material], place: str) -> Material | None:
    """Read a material; a name alone refers to the material of that name in `known`."""
    name = (element.get("name") or "").strip()
    parts = reader.read_parts(element, ("color", "texture"), place)
    if not parts and name in known:
        return known[name]
    color = None
    if "color" in parts:
        values = reader.read_numbers(parts["color"], "rgba", 4, place)
        if values is None:
            return None
        color = (values[0], values[1], values[2], values[3])
    texture = (parts["texture"].get("filename") or "").strip() if "texture" in parts else ""
    try:
        return Material(name, color, texture)
    except ValueError as error:
        reader.warning(f"{error}; the material is ignored", element, place, 'write <material name="..."> with rgba')
        return None


def read_shape(reader: ElementReader, element: Element, known: dict[str, Material], place: str) -> Shape | None:
    """Read a visual or a collision; None, with a warning, without a known geometry."""
    parts = reader.read_parts(element, ("origin", "geometry", "material"), place, once=("material",))
    if "geometry" not in parts:
        reader.warning(
            f"<{get_tag(element)}> has no <geometry>; ignored",
            element,
            place,
            "add <geometry> with a box or a mesh in it",
        )
        return None
    pose = reader.read_origin(parts.get("origin"), place)
    inside = list(iterate_children(parts["geometry"]))
    if len(inside) != 1 or get_tag(inside[0]) not in _SHAPE_NAMES:
        name = get_tag(inside[0]) if inside else ""
        near = suggest_known_key(name, _SHAPE_NAMES)
        what = (
            f"geometry {label(name)} is not known"
            if len(inside) == 1
            else f"<geometry> holds {len(inside)} shapes, not 1"
        )
        reader.warning(
            f"{what}; ignored",
            parts["geometry"],
            place,
            f"write <{near[0]}>" if near else f"shapes are {', '.join(_SHAPE_NAMES)}",
            tuple(near),
        )
        return None
    size = _read_size(reader, inside[0], place)
    if size is None or pose is None:
        return None
    material = None
    if "material" in parts:
        material = read_material(reader, parts["material"], known, place)
    kind = ShapeKind(get_tag(inside[0]))
    file = (inside[0].get("filename") or "").strip() if kind is ShapeKind.MESH else ""
    try:
        return Shape(kind, tuple(size), pose, file, (element.get("name") or "").strip(), material)
    except ValueError as error:
        reader.error(str(error), inside[0], place, "correct it, or remove the shape: no query depends on it")
        return None


def _read_size(reader: ElementReader, element: Element, place: str) -> list[float] | None:
    match ShapeKind(get_tag(element)):
        case ShapeKind.BOX:
            return reader.read_numbers(element, "size", 3, place)
        case ShapeKind.MESH:
            return reader.read_numbers(element, "scale", 3, place, (1.0, 1.0, 1.0))
        case ShapeKind.SPHERE:
            return reader.read_numbers(element, "radius", 1, place)
    radius, length = reader.read_number(element, "radius", place), reader.read_number(element, "length", place)
    return None if radius is None or length is None else [radius, length]


def read_inertial(reader: ElementReader, element: Element, place: str) -> RigidInertia | None:
    """Read mass, center of mass and inertia; None, with a problem, if they are wrong or there is no mass."""
    parts = reader.read_parts(element, ("origin", "mass", "inertia"), place)
    pose = reader.read_origin(parts.get("origin"), place)
    for key, fix in (
        ("mass", '<mass value="kilograms"/>'),
        ("inertia", '<inertia ixx="..." ixy="..." ixz="..." iyy="..." iyz="..." izz="..."/>'),
    ):
        if key not in parts:
            reader.error(f"<inertial> has no <{key}>", element, place, f"add {fix}, or remove <inertial>")
    if "mass" not in parts or "inertia" not in parts:
        return None
    mass = reader.read_number(parts["mass"], "value", place)
    # off-diagonal moments are optional
    moments = [
        reader.read_number(parts["inertia"], key, place, None if key[1] == key[2] else 0.0) for key in _INERTIA_KEYS
    ]
    if mass is None or pose is None or any(each is None for each in moments):
        return None
    xx, xy, xz, yy, yz, zz = (each or 0.0 for each in moments)
    found = RigidInertia.from_moments(mass, pose, ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
    if max(abs(each) for row in found.matrix() for each in row) > MAX_POSITION**2:
        reader.error(
            f"the inertia is out of reach: {quote(parts['mass'].get('value') or '')} kg",
            element,
            place,
            "look for a slip",
        )
        return None
    if fault := found.find_problem():
        massless = not mass > 0.0
        reader.warning(
            f"{fault}{'; ignored' if massless else ''}",
            parts["mass"] if massless else parts["inertia"],
            place,
            "remove <inertial> if it is not known" if massless else "look for a wrong digit or a wrong unit (kg m2)",
        )
        return None if massless else found
    return found

"""Read the elements of URDF that are not links or joints: attributes, origins, visuals, collisions, materials,
inertials."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from modelserver.errors import quote
from modelserver.formats.reading import MAX_POSITION, ElementReader, label, parse_numbers, suggest_known_key
from modelserver.formats.xml_document import get_line, get_name, get_tag, iterate_children
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.inertia import RigidInertia
from modelserver.geometry.plausibility import looks_like_degrees
from modelserver.geometry.shape import Material, Shape, ShapeKind
from modelserver.transforms.pose import Pose

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

_INERTIA_KEYS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_SHAPE_NAMES = tuple(str(kind) for kind in ShapeKind)


class UrdfElement(ElementReader):
    """An element: reads its attributes and children; a problem is reported at its line, and None returned."""

    def __init__(self, builder: ModelBuilder, file: str, element: Element, place: str = ""):
        super().__init__(builder, file, get_line(element), place)
        self.element = element
        self.tag = get_tag(element)
        self.name = get_name(element)

    def enter(self, element: Element, place: str) -> UrdfElement:
        return UrdfElement(self.builder, self.file, element, place)

    def children(self) -> Iterator[UrdfElement]:
        return (self.enter(child, self.place) for child in iterate_children(self.element))

    def get(self, key: str) -> str:
        """Return the trimmed text of an attribute, empty for none."""
        return (self.element.get(key) or "").strip()

    def warn_unknown(self, known: tuple[str, ...]) -> bool:
        """Report an element whose name misspells a known one; return whether it does."""
        near = suggest_known_key(self.tag, known)
        if near:
            self.warning(f"unknown element <{label(self.tag)}>; ignored", f"write <{near[0]}>", nearest=tuple(near))
        return bool(near)

    def read_parts(self, known: tuple[str, ...], once: tuple[str, ...] = ()) -> dict[str, UrdfElement]:
        """Return the first child of each name in `known`; a second one is an error, a misspelled name a warning.

        A second one of a name in `once` is only a warning: no query depends on it.
        """
        found: dict[str, UrdfElement] = {}
        for child in self.children():
            if child.tag not in known:
                child.warn_unknown(known)
            elif child.tag not in found:
                found[child.tag] = child
            else:
                twice = f"<{child.tag}> is given twice (first on line {found[child.tag].line})"
                if child.tag in once:
                    child.warning(f"{twice}; the first is used", "remove one of the two")
                else:
                    child.error(twice, "remove one of the two")
        return found

    def read_numbers(self, key: str, count: int, default: Sequence[float] | None = None) -> list[float] | None:
        """Read the numbers of an attribute; `default` if it is absent, an error if there is no default."""
        fix = f'write {key}="{" ".join(["number"] * count)}"'
        text = self.element.get(key)
        try:
            if text is not None:
                return parse_numbers(text.split(), count, key)
            if default is not None:
                return list(default)
            raise ValueError(f"<{self.tag}> has no {key}")
        except ValueError as error:
            self.error(str(error), fix)
            return None

    def read_number(self, key: str, default: float | None = None) -> float | None:
        values = self.read_numbers(key, 1, None if default is None else (default,))
        return None if values is None else values[0]

    def read_text(self, key: str, fix: str = "") -> str | None:
        """Read the trimmed text of an attribute; an error if it is absent or empty."""
        value = self.get(key)
        if not value:
            self.error(f"<{self.tag}> has no {key}", fix or f'write {key}="..."')
        return value or None


def read_origin(parts: dict[str, UrdfElement]) -> Pose | None:
    """Read the pose of an <origin>, the identity for none; roll, pitch, yaw are in radians."""
    at = parts.get("origin")
    if at is None:
        return Pose.identity()
    for key in map(str, at.element.attrib):
        if key not in ("xyz", "rpy"):
            near = suggest_known_key(key, ("xyz", "rpy"))
            at.warning(f"<origin> has an unknown attribute {label(key)}; ignored", "use xyz, rpy", nearest=near)
    position = at.read_numbers("xyz", 3, (0.0, 0.0, 0.0))
    angles = at.read_numbers("rpy", 3, (0.0, 0.0, 0.0))
    if position is None or angles is None or not at.check_position(position):
        return None
    degrees = [angle for angle in angles if looks_like_degrees(angle)]
    if degrees:
        at.warning(
            f"rpy is in radians, and {degrees[0]:g} rad looks like degrees",
            f"write {math.radians(degrees[0]):.6g} if {degrees[0]:g} deg are meant",
        )
    return Pose.from_rpy(position, *angles)


def read_materials(elements: Sequence[UrdfElement]) -> dict[str, Material]:
    """Read the materials that a robot defines for its visuals, by name."""
    materials: dict[str, Material] = {}
    for at in elements:
        found = read_material(at, {})
        if found is not None and materials.setdefault(found.name, found) is not found:
            at.warning(f"material {label(found.name)} is defined twice; the first is used", "rename one")
    return materials


def read_material(at: UrdfElement, known: dict[str, Material]) -> Material | None:
    """Read a material; a name alone refers to the material of that name in `known`."""
    parts = at.read_parts(("color", "texture"))
    if not parts and at.name in known:
        return known[at.name]
    color = None
    if "color" in parts:
        values = parts["color"].read_numbers("rgba", 4)
        if values is None:
            return None
        color = (values[0], values[1], values[2], values[3])
    try:
        return Material(at.name, color, parts["texture"].get("filename") if "texture" in parts else "")
    except ValueError as error:
        at.warning(f"{error}; the material is ignored", 'write <material name="..."> with rgba')
        return None


def read_shape(at: UrdfElement, known: dict[str, Material]) -> Shape | None:
    """Read a visual or a collision; None, with a warning, without a known geometry."""
    parts = at.read_parts(("origin", "geometry", "material"), once=("material",))
    geometry = parts.get("geometry")
    if geometry is None:
        at.warning(f"<{at.tag}> has no <geometry>; ignored", "add <geometry> with a box or a mesh in it")
        return None
    pose = read_origin(parts)
    inside = list(geometry.children())
    if len(inside) != 1 or inside[0].tag not in _SHAPE_NAMES:
        name = inside[0].tag if inside else ""
        near = suggest_known_key(name, _SHAPE_NAMES)
        what = f"<geometry> holds {len(inside)} shapes, not 1"
        if len(inside) == 1:
            what = f"geometry {label(name)} is not known"
        fix = f"write <{near[0]}>" if near else f"shapes are {', '.join(_SHAPE_NAMES)}"
        geometry.warning(f"{what}; ignored", fix, nearest=tuple(near))
        return None
    (form,) = inside
    size, kind = _read_size(form), ShapeKind(form.tag)
    if size is None or pose is None:
        return None
    material = read_material(parts["material"], known) if "material" in parts else None
    try:
        return Shape(kind, tuple(size), pose, form.get("filename") if kind is ShapeKind.MESH else "", at.name, material)
    except ValueError as error:
        form.error(str(error), "correct it, or remove the shape: no query depends on it")
        return None


def _read_size(form: UrdfElement) -> list[float] | None:
    match ShapeKind(form.tag):
        case ShapeKind.BOX:
            return form.read_numbers("size", 3)
        case ShapeKind.MESH:
            return form.read_numbers("scale", 3, (1.0, 1.0, 1.0))
        case ShapeKind.SPHERE:
            return form.read_numbers("radius", 1)
    radius, length = form.read_number("radius"), form.read_number("length")
    return None if radius is None or length is None else [radius, length]


def read_inertial(at: UrdfElement) -> RigidInertia | None:
    """Read mass, center of mass and inertia; None, with a problem, if they are wrong or there is no mass."""
    parts = at.read_parts(("origin", "mass", "inertia"))
    pose = read_origin(parts)
    for key, fix in (
        ("mass", '<mass value="kilograms"/>'),
        ("inertia", '<inertia ixx="..." ixy="..." ixz="..." iyy="..." iyz="..." izz="..."/>'),
    ):
        if key not in parts:
            at.error(f"<inertial> has no <{key}>", f"add {fix}, or remove <inertial>")
    if "mass" not in parts or "inertia" not in parts:
        return None
    mass = parts["mass"].read_number("value")
    # off-diagonal moments are optional
    moments = [parts["inertia"].read_number(key, None if key[1] == key[2] else 0.0) for key in _INERTIA_KEYS]
    if mass is None or pose is None or any(each is None for each in moments):
        return None
    xx, xy, xz, yy, yz, zz = (each or 0.0 for each in moments)
    found = RigidInertia.from_moments(mass, pose, ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
    if max(abs(each) for row in found.matrix() for each in row) > MAX_POSITION**2:
        mass_text = parts["mass"].element.get("value") or ""
        at.error(f"the inertia is out of reach: {quote(mass_text)} kg", "look for a slip")
        return None
    fault = found.find_problem()
    if mass < 0.0:
        parts["mass"].error(fault, "look for a wrong sign, or remove <inertial> if it is not known")
        return None
    if fault and not mass > 0.0:
        parts["mass"].warning(f"{fault}; ignored", "remove <inertial> if it is not known")
        return None
    # what no body can have is an error of the model
    if fault and not found.find_error():
        parts["inertia"].warning(fault, "look for a wrong digit or a wrong unit (kg m2)")
    return found

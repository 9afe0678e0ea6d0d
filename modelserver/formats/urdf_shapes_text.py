"""Visuals, collisions, materials, inertials and origins as URDF writes them."""

from __future__ import annotations

from collections.abc import Iterator

from modelserver.formats.miro_text import escaped
from modelserver.formats.saved import plain
from modelserver.geometry.inertia import Rows, rigid
from modelserver.geometry.model import Model
from modelserver.geometry.shape import Material, Shape, ShapeKind
from modelserver.spatial import so3
from modelserver.spatial.pose import Pose


class MaterialBook:
    """The materials of a model, each defined once for the robot; of two that share a name the first is."""

    def __init__(self, model: Model):
        self.defined: dict[str, Material] = {}
        for body in model.bodies:
            for shape in (*body.visuals, *body.collisions):
                if shape.material is not None and _says_more(shape.material):
                    self.defined.setdefault(shape.material.name, shape.material)

    def lines(self) -> Iterator[str]:
        """Yield the definitions."""
        for material in self.defined.values():
            yield from _material_lines(material, named_only=False)

    def used(self, material: Material) -> Iterator[str]:
        """Yield a material in a visual: its name alone where that says it all."""
        known = self.defined.get(material.name)
        yield from _material_lines(material, named_only=known == material or not _says_more(material))


def _says_more(material: Material) -> bool:
    return material.colour is not None or bool(material.texture)


def _material_lines(material: Material, named_only: bool) -> Iterator[str]:
    head = f'<material name="{escaped(material.name)}"'
    if named_only:
        yield f"{head}/>"
        return
    yield f"{head}>"
    if material.colour is not None:
        rgba = " ".join(map(plain, material.colour))
        yield f'  <color rgba="{rgba}"/>'
    if material.texture:
        yield f'  <texture filename="{escaped(material.texture)}"/>'
    yield "</material>"


def shape_lines(key: str, shape: Shape, materials: MaterialBook) -> Iterator[str]:
    """Yield a visual or a collision."""
    yield f'<{key} name="{escaped(shape.name)}">' if shape.name else f"<{key}>"
    if shape.pose != Pose.identity():
        yield f"  {origin_line(shape.pose)}"
    yield "  <geometry>"
    size = [plain(value) for value in shape.size]
    together = " ".join(size)
    match shape.kind:
        case ShapeKind.BOX:
            yield f'    <box size="{together}"/>'
        case ShapeKind.CYLINDER:
            yield f'    <cylinder radius="{size[0]}" length="{size[1]}"/>'
        case ShapeKind.SPHERE:
            yield f'    <sphere radius="{size[0]}"/>'
        case ShapeKind.MESH:
            scale = "" if shape.size == (1.0, 1.0, 1.0) else f' scale="{together}"'
            yield f'    <mesh filename="{escaped(shape.file)}"{scale}/>'
    yield "  </geometry>"
    if shape.material is not None:
        yield from (f"  {line}" for line in materials.used(shape.material))
    yield f"</{key}>"


def inertial_lines(inertia: Rows | None) -> Iterator[str]:
    """Yield the inertial of a body, along the axes of its link; nothing where it is not that of a rigid body."""
    found = None if inertia is None else rigid(inertia)
    if found is None:
        return
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = found.about_centre
    greatest = max(abs(value) for row in inertia or () for value in row)
    x, y, z = (_short(value, max(map(abs, found.centre))) for value in found.centre)
    yield "<inertial>"
    yield f"  {origin_line(Pose((x, y, z)))}"
    yield f'  <mass value="{plain(found.mass)}"/>'
    moments = {"ixx": xx, "ixy": xy, "ixz": xz, "iyy": yy, "iyz": yz, "izz": zz}
    said = " ".join(f'{key}="{plain(_short(value, greatest))}"' for key, value in moments.items())
    yield f"  <inertia {said}/>"
    yield "</inertial>"


def _short(value: float, scale: float) -> float:
    """Return a number without what rounding on the way through a 6x6 or a quaternion added to it."""
    rounded = float(f"{value:.12g}")
    return rounded if abs(rounded - value) <= 4e-15 * scale else value


def origin_line(pose: Pose) -> str:
    """Return the <origin> of a pose; its angles, in radians, read back to 1e-11 everywhere."""
    angles = [plain(_short(angle, 1.0) + 0.0) for angle in so3.to_rpy(pose.wxyz)]
    xyz, rpy = " ".join(map(plain, pose.xyz)), " ".join(angles)
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'

"""Shapes and materials of bodies, as immutable values: for viewers, not used in answers. Mesh files are not opened."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from modelserver.errors import quote
from modelserver.transforms.pose import Pose


class ShapeKind(StrEnum):
    """The kind of a shape."""

    BOX = "box"
    CYLINDER = "cylinder"
    SPHERE = "sphere"
    MESH = "mesh"


DIMENSIONS: Final[dict[ShapeKind, tuple[str, ...]]] = {
    ShapeKind.BOX: ("x", "y", "z"),
    ShapeKind.CYLINDER: ("radius", "length"),
    ShapeKind.SPHERE: ("radius",),
    ShapeKind.MESH: ("x", "y", "z"),
}
"""The numbers of a shape's `size`, meters; those of a mesh are scale factors."""


@dataclass(frozen=True, slots=True)
class Material:
    """A named material: color as red, green, blue and opacity from 0 to 1, and the name of a texture file.

    Raises ValueError for a name that is empty or not printable, or a color out of its range.
    """

    name: str
    color: tuple[float, float, float, float] | None = None
    texture: str = ""

    def __post_init__(self) -> None:
        _check_text("a material's name", self.name, required=True)
        _check_text("a texture's file", self.texture)
        if self.color is not None:
            values = tuple([float(value) + 0.0 for value in self.color])
            if len(values) != 4 or not all(0.0 <= value <= 1.0 for value in values):
                raise ValueError("a color is red, green, blue and opacity, each from 0 to 1")
            object.__setattr__(self, "color", values)


@dataclass(frozen=True, slots=True)
class Shape:
    """A shape on a body: `pose` is that of its center, or of the mesh's origin, in body coordinates.

    `size` is ordered as in `DIMENSIONS`; the axis of a cylinder is z. `file` names a mesh's file and is empty for other
    kinds. Raises ValueError for sizes that are missing, not finite, or, except for a mesh, negative.
    """

    kind: ShapeKind
    size: tuple[float, ...]
    pose: Pose = field(default_factory=Pose.identity)
    file: str = ""
    name: str = ""
    material: Material | None = None

    def __post_init__(self) -> None:
        wanted = DIMENSIONS[self.kind]
        size = tuple([float(value) + 0.0 for value in self.size])
        if len(size) != len(wanted):
            raise ValueError(
                f"the size of a {self.kind} is {', '.join(wanted)}: {len(wanted)} numbers, got {len(size)}"
            )
        for what, value in zip(wanted, size, strict=True):
            # a mesh is mirrored by a negative scale
            if not math.isfinite(value) or (value < 0.0 and self.kind is not ShapeKind.MESH):
                raise ValueError(f"the {what} of a {self.kind} is finite and not negative, got {value:g}")
        object.__setattr__(self, "size", size)
        _check_text("a mesh's file", self.file, required=self.kind is ShapeKind.MESH)
        if self.file and self.kind is not ShapeKind.MESH:
            raise ValueError(f"a {self.kind} has no file")
        _check_text("a shape's name", self.name)


def _check_text(what: str, text: str, required: bool = False) -> None:
    if required and not text:
        raise ValueError(f"{what} is missing")
    if not text.isprintable() or text != text.strip():
        raise ValueError(f"{what} is printable and has no white space around it, got {quote(text)}")

"""What a body looks like and what it occupies, as immutable values: kept for others, and no part of any answer.

Mesh files are named, never opened.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from modelserver.errors import shown
from modelserver.spatial.pose import Pose


class ShapeKind(StrEnum):
    """What a shape is."""

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
"""What a shape's `size` holds, metres; a mesh's are the factors by which it is scaled."""


@dataclass(frozen=True, slots=True)
class Material:
    """A named look: colour as red, green, blue and opacity from 0 to 1, and the name of a picture to lay on.

    Raises ValueError for a name that is empty or not printable, or a colour out of its range.
    """

    name: str
    colour: tuple[float, float, float, float] | None = None
    texture: str = ""

    def __post_init__(self) -> None:
        _check_text("a material's name", self.name, needed=True)
        _check_text("a texture's file", self.texture)
        if self.colour is not None:
            values = tuple([float(value) + 0.0 for value in self.colour])
            if len(values) != 4 or not all(0.0 <= value <= 1.0 for value in values):
                raise ValueError("a colour is red, green, blue and opacity, each from 0 to 1")
            object.__setattr__(self, "colour", values)


@dataclass(frozen=True, slots=True)
class Shape:
    """A shape on a body: `pose` is the place of its centre, or of the mesh's origin, in body coordinates.

    `size` is as `DIMENSIONS` says; a cylinder stands along its z axis. `file` names a mesh's file, and is empty for
    other kinds. Raises ValueError for sizes that are missing, not finite, or, but for a mesh, negative.
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
        _check_text("a mesh's file", self.file, needed=self.kind is ShapeKind.MESH)
        if self.file and self.kind is not ShapeKind.MESH:
            raise ValueError(f"a {self.kind} has no file")
        _check_text("a shape's name", self.name)


def _check_text(what: str, text: str, needed: bool = False) -> None:
    if needed and not text:
        raise ValueError(f"{what} is missing")
    if not text.isprintable() or text != text.strip():
        raise ValueError(f"{what} is printable and has no white space around it, got {shown(text)}")

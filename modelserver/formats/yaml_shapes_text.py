"""Visuals and collisions as the YAML form writes them."""

from __future__ import annotations

from collections.abc import Callable

from modelserver.formats.saved import plain
from modelserver.geometry.shape import DIMENSIONS, Shape, ShapeKind


def shape_lines(shape: Shape, pose: list[str], text: Callable[[str], str]) -> list[str]:
    """Return the lines of one entry of a list; `pose` are its pose's, and `text` writes a text of YAML."""
    values = f"[{', '.join(map(plain, shape.size))}]"
    if shape.kind is ShapeKind.MESH:
        lines = [f"mesh: {text(shape.file)}"]
        if shape.size != (1.0, 1.0, 1.0):
            lines.append(f"scale: {values}")
    elif shape.kind is ShapeKind.BOX:
        lines = [f"box: {values}"]
    else:
        sizes = zip(DIMENSIONS[shape.kind], shape.size, strict=True)
        lines = [f"{shape.kind}: {{{', '.join(f'{what}: {plain(value)}' for what, value in sizes)}}}"]
    lines += pose
    if shape.name:
        lines.append(f"name: {text(shape.name)}")
    if shape.material is not None:
        lines += ["material:", f"  name: {text(shape.material.name)}"]
        if shape.material.colour is not None:
            lines.append(f"  colour: [{', '.join(map(plain, shape.material.colour))}]")
        if shape.material.texture:
            lines.append(f"  texture: {text(shape.material.texture)}")
    return [f"- {lines[0]}", *(f"  {line}" for line in lines[1:])]

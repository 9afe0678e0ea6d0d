"""Plain shapes of a vehicle without a drawing, for viewers: wheels, housings, masts, frusta of cameras; and what is
drawn of a body.

What a sensor sees is translucent, and so for viewers no part of the vehicle: the ground is not below it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from enum import StrEnum
from typing import Any, Final

import numpy as np
import yaml

from modelserver.geometry.parts import DIMENSIONS, Body, Material, Shape, ShapeKind
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array, Vector3

RUBBER: Final = Material("rubber", (0.2, 0.2, 0.21, 1.0))
METAL: Final = Material("metal", (0.62, 0.64, 0.67, 1.0))
DARK: Final = Material("dark", (0.27, 0.28, 0.31, 1.0))
PAINT: Final = Material("paint", (0.93, 0.66, 0.16, 1.0))
GLASS: Final = Material("glass", (0.20, 0.26, 0.32, 1.0))
ANTENNA: Final = Material("antenna", (0.92, 0.92, 0.90, 1.0))
DEVICE: Final = Material("device", (0.80, 0.28, 0.20, 1.0))
VIEW: Final = Material("view", (0.25, 0.62, 0.95, 0.45))
PICTURE: Final = Material("picture", (0.25, 0.62, 0.95, 0.15))

EDGE: Final = 0.004
"""Thickness of the edges of a frustum, m: a line at the size of a vehicle."""


BODY_COLOR: Final = (108 / 255, 140 / 255, 175 / 255)
"""sRGB of shapes that state no color."""

BOX_OPACITY: Final = 0.2
"""Of the box in place of shapes."""

MIN_EXTENT: Final = 0.04
"""Least edge of the box of a body without shapes, meters."""

Rgba = tuple[float, float, float, float]


def make_box(size: Vector3, place: Vector3, material: Material) -> Shape:
    return Shape(ShapeKind.BOX, size, Pose(place), material=material)


def make_disc(radius: float, height: float, place: Vector3, material: Material) -> Shape:
    """Return an upright cylinder with its center at a place."""
    return Shape(ShapeKind.CYLINDER, (radius, height), Pose(place), material=material)


def make_wheel(contact: Vector3, radius: float, width: float) -> list[Shape]:
    """Return tire and hub of a wheel, straight ahead, that meets the ground at `contact`."""
    x, y, z = contact
    axle = Pose.from_rpy((x, y, z + radius), roll=math.pi / 2.0)
    # the hub is a little wider than the tire, so that it is seen from both sides
    return [
        Shape(ShapeKind.CYLINDER, (radius, width), axle, material=RUBBER),
        Shape(ShapeKind.CYLINDER, (0.55 * radius, width + 0.01), axle, material=METAL),
    ]


def make_beam(begin: Vector3, end: Vector3, thickness: float, material: Material) -> Shape:
    """Return a thin box from one point to another."""
    x, y, z = (b - a for a, b in zip(begin, end, strict=True))
    middle = ((begin[0] + end[0]) / 2.0, (begin[1] + end[1]) / 2.0, (begin[2] + end[2]) / 2.0)
    pose = Pose.from_rpy(middle, pitch=-math.atan2(z, math.hypot(x, y)), yaw=math.atan2(y, x))
    return Shape(ShapeKind.BOX, (math.dist(begin, end), thickness, thickness), pose, material=material)


def make_frustum(X_BL: Pose, width: float, height: float, length: float) -> list[Shape]:
    """Return the edges and the far end of what a camera sees.

    `X_BL` is the pose of its entrance pupil with x along the optical axis; `width` and `height` are its angles of
    view in radians.
    """
    y, z = length * math.tan(width / 2.0), length * math.tan(height / 2.0)
    corners: list[Vector3] = [(length, y, z), (length, -y, z), (length, -y, -z), (length, y, -z)]
    shapes = [make_beam((0.0, 0.0, 0.0), corner, EDGE, VIEW) for corner in corners]
    shapes.append(make_box((EDGE, 2.0 * y, 2.0 * z), (length, 0.0, 0.0), PICTURE))
    return [Shape(each.kind, each.size, X_BL @ each.pose, material=each.material) for each in shapes]


def format_shapes(shapes: Iterable[Shape]) -> list[str]:
    """Return shapes as the items of a list in a geometry file, a line each; lengths to 0.1 mm, angles to 0.01 deg."""

    def shorten(values: Iterable[float], digits: int) -> list[float]:
        return [int(value) if value.is_integer() else value for value in (round(each, digits) for each in values)]

    lines = []
    for each in shapes:
        size = shorten(each.size, 4)
        fields: dict[str, Any] = {str(each.kind): size}
        if each.kind is not ShapeKind.BOX:
            fields[str(each.kind)] = dict(zip(DIMENSIONS[each.kind], size, strict=True))
        if any(xyz := shorten(each.pose.xyz, 4)):
            fields["xyz"] = xyz
        if any(rpy := shorten(map(math.degrees, each.pose.rpy.tolist()), 2)):
            fields["rpy_deg"] = rpy
        if each.material is not None:
            fields["material"] = {"name": each.material.name, "color": shorten(each.material.color or (), 4)}
        text = yaml.safe_dump(fields, default_flow_style=True, sort_keys=False, width=math.inf).strip()
        lines.append(f"- {text}")
    return lines


# --- what is drawn of a body


class DrawnAs(StrEnum):
    """What a body is drawn as, in the order of preference: its visuals, its collision shapes, a box of its frames."""

    VISUAL = "visual"
    COLLISION = "collision"
    BOX = "box"


def list_drawings(body: Body) -> Iterator[tuple[DrawnAs, tuple[Shape, ...]]]:
    """Yield what a body may be drawn as; the first of which a viewer can draw a shape is drawn."""
    yield DrawnAs.VISUAL, body.visuals
    yield DrawnAs.COLLISION, body.collisions
    yield DrawnAs.BOX, (make_frame_box(body),)


def make_frame_box(body: Body) -> Shape:
    """Return the box around the frames of a body and its origin."""
    corners = list_corners(body)
    low, high = corners.min(axis=0), corners.max(axis=0)
    x, y, z = np.maximum(high - low, MIN_EXTENT).tolist()
    return Shape(ShapeKind.BOX, (x, y, z), Pose(((low + high) / 2.0).tolist()))


def list_corners(body: Body) -> Array:
    """Return the places of the frames of a body and its origin (n, 3)."""
    return np.array([(0.0, 0.0, 0.0), *(frame.pose.xyz for frame in body.frames)])


def find_color(shape: Shape) -> Rgba | None:
    """Return the color that a shape states, sRGB and opacity; None without one."""
    return None if shape.material is None else shape.material.color


def choose_color(shape: Shape, drawn_as: DrawnAs) -> Rgba:
    """Return the color in which a shape is drawn: what it states, or that of all bodies."""
    return find_color(shape) or (*BODY_COLOR, BOX_OPACITY if drawn_as is DrawnAs.BOX else 1.0)

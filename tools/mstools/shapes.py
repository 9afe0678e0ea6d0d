"""Plain shapes of a vehicle without a drawing, for viewers: wheels, housings, masts, frusta of cameras.

What a sensor sees is translucent, and so for viewers no part of the vehicle: the ground is not below it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Final

import yaml

from modelserver.geometry.parts import DIMENSIONS, Material, Shape, ShapeKind
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3

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

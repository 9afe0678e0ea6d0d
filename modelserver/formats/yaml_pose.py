"""Poses and sigmas as the YAML form writes them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from modelserver.errors import Location
from modelserver.formats import numbers
from modelserver.formats.yaml_nodes import NodeKind, YamlNode
from modelserver.formats.yaml_reader import NodeReader
from modelserver.geometry.parts import Sigma
from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Quaternion, Vector3

POSE_KEYS = ("xyz", "rpy_deg", "rpy", "quaternion", "rotation", "matrix")
"""`xyz` in metres with at most one of the rotations, or `matrix` alone."""

_ROTATIONS = ("rpy_deg", "rpy", "quaternion", "rotation")


@dataclass(frozen=True, slots=True)
class Defaults:
    """What a sigma takes where it is not given, None where nothing is stated."""

    position: Vector3 | None = None
    rotation: Vector3 | None = None


def read_pose(reader: NodeReader, fields: dict[str, YamlNode], place: str) -> Pose | None:
    """Return the pose that `fields` give; None where they give none, or a wrong one, which is reported."""
    given = [key for key in POSE_KEYS if key in fields]
    if not given:
        return None
    if "matrix" in given:
        if len(given) > 1:
            reader.error(
                f"matrix holds the whole pose, and {given[0]} stands beside it",
                fields[given[0]],
                place,
                f"remove matrix or {given[0]}",
            )
            return None
        return _matrix(reader, fields["matrix"], place)
    turns = [key for key in given if key != "xyz"]
    if len(turns) > 1:
        reader.error(
            f"the rotation is given twice, as {turns[0]} and as {turns[1]}",
            fields[turns[1]],
            place,
            "keep one of the two",
        )
        return None
    position: list[float] | None = [0.0, 0.0, 0.0]
    if "xyz" in fields:
        position = reader.numbers(fields["xyz"], 3, place, "xyz", "metres")
        if position is not None and not numbers.within_reach(position, reader.builder, reader.at(fields["xyz"], place)):
            position = None
    turned: Quaternion | None = so3.IDENTITY
    if turns:
        turned = _rotation(reader, turns[0], fields[turns[0]], place)
    return None if position is None or turned is None else Pose(position, turned)


def _rotation(reader: NodeReader, key: str, node: YamlNode, place: str) -> Quaternion | None:
    if key == "rotation":
        rows = reader.rows(node, (3,), 3, place, key)
        return None if rows is None else numbers.rotation(rows, reader.builder, reader.at(node, place), "rotation")
    if key == "quaternion":
        values = reader.numbers(node, 4, place, "quaternion", "order w, x, y, z")
        return None if values is None else numbers.quaternion(values, reader.builder, reader.at(node, place))
    degrees = key == "rpy_deg"
    angles = reader.numbers(node, 3, place, key, "degrees" if degrees else "radians")
    if angles is None:
        return None
    largest = max(angles, key=abs)
    if not degrees and abs(largest) > math.tau:
        reader.builder.warning(
            f"rpy has {largest:.6g} rad, which is {abs(largest) / math.tau:.3g} turns",
            reader.at(node, place),
            "where degrees were meant, write rpy_deg",
        )
    roll, pitch, yaw = (math.radians(angle) for angle in angles) if degrees else angles
    return so3.from_rpy(roll, pitch, yaw)


def _matrix(reader: NodeReader, node: YamlNode, place: str) -> Pose | None:
    rows = reader.rows(node, (3, 4), 4, place, "matrix")
    if rows is None:
        return None
    if len(rows) == 4 and rows[3] != [0.0, 0.0, 0.0, 1.0]:
        reader.error(
            "the last row of a homogeneous transform is 0 0 0 1", node.items[3], place, "leave the fourth row out"
        )
        return None
    source = reader.at(node, place)
    position = [row[3] for row in rows[:3]]
    turned = numbers.rotation([row[:3] for row in rows[:3]], reader.builder, source, "matrix")
    if turned is None or not numbers.within_reach(position, reader.builder, source):
        return None
    return Pose(position, turned)


def read_sigma(reader: NodeReader, node: YamlNode, place: str, defaults: Defaults) -> Sigma | None:
    """Return the sigma of a frame or constraint; a part that is not given is the default's, else 0."""
    stated = read_sigma_parts(reader, node, place)
    if stated is None:
        return None
    none = (0.0, 0.0, 0.0)
    return Sigma(stated.position or defaults.position or none, stated.rotation or defaults.rotation or none)


def read_sigma_parts(reader: NodeReader, node: YamlNode, place: str) -> Defaults | None:
    """Return the parts that a sigma states; None where one is wrong, which is reported."""
    place = f"{place}, sigma" if place else "sigma"
    fields = reader.fields(node, place, ("xyz", "rpy_deg", "rpy"))
    if "rpy" in fields and "rpy_deg" in fields:
        reader.error("rpy and rpy_deg are both given", fields["rpy"], place, "keep one of the two")
        return None
    position = _deviations(reader, fields.get("xyz"), place, "xyz", "metres")
    rotation = _deviations(reader, fields.get("rpy"), place, "rpy", "radians")
    if "rpy_deg" in fields:
        rotation = _deviations(reader, fields["rpy_deg"], place, "rpy_deg", "degrees")
        if rotation is not None:
            a, b, c = rotation
            rotation = (math.radians(a), math.radians(b), math.radians(c))
    expected = len(fields)
    return Defaults(position, rotation) if (position is not None) + (rotation is not None) == expected else None


def _deviations(reader: NodeReader, node: YamlNode | None, place: str, key: str, unit: str) -> Vector3 | None:
    """Return three standard deviations, given as three numbers or one for all."""
    if node is None:
        return None
    if node.kind is NodeKind.SCALAR:
        value = reader.number(node, place, key, f"write {key}: number, or [number, number, number], in {unit}")
        values = None if value is None else [value] * 3
    else:
        values = reader.numbers(node, 3, place, key, unit)
    if values is None:
        return None
    for value in values:
        # the square root of the largest float: a covariance holds squares
        if not 0.0 <= value < 1e150:
            reader.builder.error(
                f"{key}: a standard deviation is not negative, got {value:g}"
                if value < 0
                else f"{key}: a standard deviation of {value:g} is out of reach",
                Location(reader.file, node.line, place),
                f"write how far off the survey may be, in {unit}",
            )
            return None
    return (values[0], values[1], values[2])

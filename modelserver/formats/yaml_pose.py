"""Read poses and sigmas of the YAML format."""

from __future__ import annotations

import math
from dataclasses import dataclass

from modelserver.errors import Location
from modelserver.formats.reading import check_position, repair_quaternion, repair_rotation
from modelserver.formats.yaml_nodes import NodeKind, NodeReader, YamlNode
from modelserver.geometry.parts import Sigma
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion, Vector3

POSE_KEYS = ("xyz", "rpy_deg", "rpy", "quaternion", "rotation", "matrix")
"""`xyz` in meters with at most one of the rotations, or `matrix` alone."""

_ROTATIONS = ("rpy_deg", "rpy", "quaternion", "rotation")


@dataclass(frozen=True, slots=True)
class SigmaDefaults:
    """Defaults of the parts of a sigma, None for one that is not stated."""

    position: Vector3 | None = None
    rotation: Vector3 | None = None


def read_pose(reader: NodeReader, fields: dict[str, YamlNode], place: str) -> Pose | None:
    """Read the pose in `fields`; None if there is none, or, with an error, if it is wrong."""
    given = [key for key in POSE_KEYS if key in fields]
    if not given:
        return None
    if "matrix" in given:
        if len(given) > 1:
            reader.error(
                f"matrix holds the whole pose, and {given[0]} is given too",
                fields[given[0]],
                place,
                f"remove matrix or {given[0]}",
            )
            return None
        return _read_matrix(reader, fields["matrix"], place)
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
        position = reader.read_numbers(fields["xyz"], 3, place, "xyz", "meters")
        if position is not None and not check_position(position, reader.builder, reader.locate(fields["xyz"], place)):
            position = None
    turned: Quaternion | None = so3.IDENTITY
    if turns:
        turned = _read_rotation(reader, turns[0], fields[turns[0]], place)
    return None if position is None or turned is None else Pose(position, turned)


def _read_rotation(reader: NodeReader, key: str, node: YamlNode, place: str) -> Quaternion | None:
    if key == "rotation":
        rows = reader.read_rows(node, (3,), 3, place, key)
        return None if rows is None else repair_rotation(rows, reader.builder, reader.locate(node, place), "rotation")
    if key == "quaternion":
        values = reader.read_numbers(node, 4, place, "quaternion", "order w, x, y, z")
        return None if values is None else repair_quaternion(values, reader.builder, reader.locate(node, place))
    degrees = key == "rpy_deg"
    angles = reader.read_numbers(node, 3, place, key, "degrees" if degrees else "radians")
    if angles is None:
        return None
    largest = max(angles, key=abs)
    if not degrees and abs(largest) > math.tau:
        reader.builder.add_warning(
            f"rpy has {largest:.6g} rad, which is {abs(largest) / math.tau:.3g} turns",
            reader.locate(node, place),
            "where degrees were meant, write rpy_deg",
        )
    roll, pitch, yaw = (math.radians(angle) for angle in angles) if degrees else angles
    return so3.from_rpy(roll, pitch, yaw)


def _read_matrix(reader: NodeReader, node: YamlNode, place: str) -> Pose | None:
    rows = reader.read_rows(node, (3, 4), 4, place, "matrix")
    if rows is None:
        return None
    if len(rows) == 4 and rows[3] != [0.0, 0.0, 0.0, 1.0]:
        reader.error(
            "the last row of a homogeneous transform is 0 0 0 1", node.items[3], place, "leave the fourth row out"
        )
        return None
    source = reader.locate(node, place)
    position = [row[3] for row in rows[:3]]
    turned = repair_rotation([row[:3] for row in rows[:3]], reader.builder, source, "matrix")
    if turned is None or not check_position(position, reader.builder, source):
        return None
    return Pose(position, turned)


def read_sigma(reader: NodeReader, node: YamlNode, place: str, defaults: SigmaDefaults) -> Sigma | None:
    """Read the sigma of a frame or constraint; a part that is not given is the default, else 0."""
    stated = read_sigma_parts(reader, node, place)
    if stated is None:
        return None
    none = (0.0, 0.0, 0.0)
    return Sigma(stated.position or defaults.position or none, stated.rotation or defaults.rotation or none)


def read_sigma_parts(reader: NodeReader, node: YamlNode, place: str) -> SigmaDefaults | None:
    """Read the parts of a sigma; None, with an error, if one is wrong."""
    place = f"{place}, sigma" if place else "sigma"
    fields = reader.read_fields(node, place, ("xyz", "rpy_deg", "rpy"))
    if "rpy" in fields and "rpy_deg" in fields:
        reader.error("rpy and rpy_deg are both given", fields["rpy"], place, "keep one of the two")
        return None
    position = _read_deviations(reader, fields.get("xyz"), place, "xyz", "meters")
    rotation = _read_deviations(reader, fields.get("rpy"), place, "rpy", "radians")
    if "rpy_deg" in fields:
        rotation = _read_deviations(reader, fields["rpy_deg"], place, "rpy_deg", "degrees")
        if rotation is not None:
            a, b, c = rotation
            rotation = (math.radians(a), math.radians(b), math.radians(c))
    expected = len(fields)
    return SigmaDefaults(position, rotation) if (position is not None) + (rotation is not None) == expected else None


def _read_deviations(reader: NodeReader, node: YamlNode | None, place: str, key: str, unit: str) -> Vector3 | None:
    """Read three standard deviations, given as three numbers or as one for all."""
    if node is None:
        return None
    if node.kind is NodeKind.SCALAR:
        value = reader.read_number(node, place, key, f"write {key}: number, or [number, number, number], in {unit}")
        values = None if value is None else [value] * 3
    else:
        values = reader.read_numbers(node, 3, place, key, unit)
    if values is None:
        return None
    for value in values:
        # a covariance holds squares, so about the square root of the largest float
        if not 0.0 <= value < 1e150:
            reader.builder.add_error(
                f"{key}: a standard deviation is not negative, got {value:g}"
                if value < 0
                else f"{key}: a standard deviation of {value:g} is out of reach",
                Location(reader.file, node.line, place),
                f"write the uncertainty of the survey, in {unit}",
            )
            return None
    return (values[0], values[1], values[2])

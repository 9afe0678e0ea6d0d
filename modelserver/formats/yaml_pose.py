"""Read poses and sigmas of the YAML format."""

from __future__ import annotations

import math
from dataclasses import dataclass

from modelserver.formats.yaml_nodes import NodeKind, YamlMapping, YamlNode
from modelserver.geometry.parts import Sigma
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion, Vector3

POSE_KEYS = ("xyz", "rpy_deg", "rpy", "quaternion", "rotation", "matrix")
"""`xyz` in meters with at most one of the rotations, or `matrix` alone."""

SIGMA_KEYS = ("xyz", "rpy_deg", "rpy")


@dataclass(frozen=True, slots=True)
class SigmaDefaults:
    """Defaults of the parts of a sigma, None for one that is not stated."""

    position: Vector3 | None = None
    rotation: Vector3 | None = None

    def complete(self, stated: SigmaDefaults | None = None) -> Sigma:
        """Return the sigma of a frame or constraint; a part that is not stated is the default, else 0."""
        stated, none = stated or SigmaDefaults(), (0.0, 0.0, 0.0)
        return Sigma(stated.position or self.position or none, stated.rotation or self.rotation or none)


def read_pose(at: YamlMapping) -> Pose | None:
    """Read the pose in a mapping; None if there is none, or, with an error, if it is wrong."""
    fields = at.fields
    given = [key for key in POSE_KEYS if key in fields]
    if not given:
        return None
    if "matrix" in given:
        if len(given) == 1:
            return _read_matrix(at)
        message = f"matrix holds the whole pose, and {given[0]} is given too"
        at.error(message, f"remove matrix or {given[0]}", given[0])
        return None
    turns = [key for key in given if key != "xyz"]
    if len(turns) > 1:
        message = f"the rotation is given twice, as {turns[0]} and as {turns[1]}"
        at.error(message, "keep one of the two", turns[1])
        return None
    position: list[float] | None = [0.0, 0.0, 0.0]
    if "xyz" in fields:
        position = at.read_numbers(fields["xyz"], 3, "xyz", "meters")
        if position is not None and not at.check_position(position, fields["xyz"].line):
            position = None
    turned = _read_rotation(at, turns[0]) if turns else so3.IDENTITY
    return None if position is None or turned is None else Pose(position, turned)


def _read_rotation(at: YamlMapping, key: str) -> Quaternion | None:
    node = at.fields[key]
    if key == "rotation":
        rows = at.read_rows(key, (3,), 3)
        return None if rows is None else at.repair_rotation(rows, "rotation", node.line)
    if key == "quaternion":
        values = at.read_numbers(node, 4, key, "order w, x, y, z")
        return None if values is None else at.repair_quaternion(values, node.line)
    degrees = key == "rpy_deg"
    angles = at.read_numbers(node, 3, key, "degrees" if degrees else "radians")
    if angles is None:
        return None
    largest = max(angles, key=abs)
    if not degrees and abs(largest) > math.tau:
        message = f"rpy has {largest:.6g} rad, which is {abs(largest) / math.tau:.3g} turns"
        at.warning(message, "where degrees were meant, write rpy_deg", node.line)
    roll, pitch, yaw = map(math.radians, angles) if degrees else angles
    return so3.from_rpy(roll, pitch, yaw)


def _read_matrix(at: YamlMapping) -> Pose | None:
    rows = at.read_rows("matrix", (3, 4), 4)
    if rows is None:
        return None
    node = at.fields["matrix"]
    if len(rows) == 4 and rows[3] != [0.0, 0.0, 0.0, 1.0]:
        fix = "leave the fourth row out"
        at.error("the last row of a homogeneous transform is 0 0 0 1", fix, node.items[3].line)
        return None
    position = [row[3] for row in rows[:3]]
    turned = at.repair_rotation([row[:3] for row in rows[:3]], "matrix", node.line)
    return None if turned is None or not at.check_position(position, node.line) else Pose(position, turned)


def read_sigma(owner: YamlMapping) -> SigmaDefaults | None:
    """Read the parts of the sigma in a mapping; None, with an error, if one is wrong."""
    at = owner.enter(owner.fields["sigma"], f"{owner.place}, sigma" if owner.place else "sigma", SIGMA_KEYS)
    if "rpy" in at.fields and "rpy_deg" in at.fields:
        at.error("rpy and rpy_deg are both given", "keep one of the two", "rpy")
        return None
    units = {"xyz": "meters", "rpy": "radians", "rpy_deg": "degrees"}
    found = {key: _read_deviations(at, node, key, units[key]) for key, node in at.fields.items()}
    if degrees := found.get("rpy_deg"):
        found["rpy"] = so3.to_vector3(map(math.radians, degrees))
    return None if None in found.values() else SigmaDefaults(found.get("xyz"), found.get("rpy"))


def _read_deviations(at: YamlMapping, node: YamlNode, key: str, unit: str) -> Vector3 | None:
    """Read three standard deviations, given as three numbers or as one for all."""
    if node.kind is NodeKind.SCALAR:
        value = at.read_number(node, key, f"write {key}: number, or [number, number, number], in {unit}")
        values = None if value is None else [value] * 3
    else:
        values = at.read_numbers(node, 3, key, unit)
    # a covariance holds squares, so about the square root of the largest float
    wrong = next((value for value in values or () if not 0.0 <= value < 1e150), None)
    if wrong is not None:
        of = f"{wrong:g} is out of reach"
        message = (
            f"a standard deviation is not negative, got {wrong:g}" if wrong < 0 else f"a standard deviation of {of}"
        )
        at.error(f"{key}: {message}", f"write the uncertainty of the survey, in {unit}", node.line)
        return None
    return None if values is None else so3.to_vector3(values)

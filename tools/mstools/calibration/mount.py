"""Check of an IMU's stated mount against gravity.

At rest an accelerometer measures the specific force, which points up: two of the three angles of a mount. The angle
about the vertical remains unknown; candidates are the 24 rotations of a cube onto itself, of which 4 share an up.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3
from mstools.calibration import CalibrationError

MAX_TILT = 0.6
"""Largest angle between the measured up and the geometry's, rad. No vehicle starts on a slope of 35 degrees; the wrong
one of two axis-aligned mounts is wrong by 90, so the limit is also below half of that.
"""

STANDARD_GRAVITY = 9.80665
GRAVITY_TOLERANCE = 1.0
"""Largest difference of the measured strength from standard gravity, m/s2: the earth's is within 0.03 of 9.81; ten
times a 3DM-GX1's bias of 10 mg. Beyond, the unit moves, or its scale is wrong.
"""

_UP: Vector3 = (0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class MountCandidate:
    """A mount that is consistent with gravity: `rpy_deg`, and the angle from the stated one in radians."""

    rpy_deg: Vector3
    rotation_angle: float


@dataclass(frozen=True, slots=True)
class MountCheck:
    """Result of the check of the stated mount against gravity.

    angle: between the measured and the stated up, radians. measured_up, stated_up: unit vectors along the sensor's
    axes. candidates: mounts that are consistent, nearest to the stated one first; empty where the stated one is.
    """

    is_consistent: bool
    angle: float
    measured_up: Vector3
    stated_up: Vector3
    candidates: tuple[MountCandidate, ...]

    @property
    def text(self) -> str:
        measured, stated = name_axis(self.measured_up), name_axis(self.stated_up)
        degrees = math.degrees(self.angle)
        if self.is_consistent:
            return (
                f"gravity is measured along the sensor's {measured} axis, {degrees:.1f} deg from up in the geometry: "
                "the mount is consistent; gravity does not determine the rotation about the vertical"
            )
        head = (
            f"gravity is measured along the sensor's {measured} axis, but up in the geometry is {stated}: "
            f"{degrees:.0f} deg apart"
        )
        if not self.candidates:
            return f"{head}; no mount along the vehicle's axes fits: the unit is tilted or the vehicle on a steep slope"
        mounts = ", ".join(f"[{', '.join(f'{angle:g}' for angle in each.rpy_deg)}]" for each in self.candidates)
        tail = "; drive straight ahead or look at the unit to find which"
        if degrees > 180.0 - math.degrees(MAX_TILT):
            tail += "; or the driver publishes gravity instead of specific force, its opposite: compare imu_t"
        return f"{head}; mounts that fit: rpy_deg {mounts}{tail}"


def check_mount(mean_force: Vector3, q_base_sensor: Quaternion) -> MountCheck:
    """Compare the specific force at rest with the stated mount.

    Candidates are the 24 rotations onto the vehicle's axes, each followed by the tilt of the stated mount relative to
    the nearest of them, where they are consistent with gravity.

    Parameters
    ----------
    mean_force : mean specific force along the sensor's axes, m/s2, on nearly level ground
    q_base_sensor : the stated rotation R_base_sensor; base: x forward, y left, z up

    Raises
    ------
    CalibrationError
        For a force whose strength is not that of gravity.
    """
    strength = math.hypot(*mean_force)
    if not abs(strength - STANDARD_GRAVITY) <= GRAVITY_TOLERANCE:
        raise CalibrationError(
            f"the mean specific force is {strength:.3g} m/s2, and gravity is 9.81: the vehicle must be stationary, "
            "and the unit publish all three axes of specific force in m/s2"
        )
    measured = so3.scale(1.0 / strength, mean_force)
    q_stated = so3.normalize(q_base_sensor)
    stated = so3.rotate(so3.conjugate(q_stated), _UP)
    angle = _angle(measured, stated)
    is_consistent = angle <= MAX_TILT
    candidates = () if is_consistent else _find_candidates(measured, q_stated)
    return MountCheck(is_consistent, angle, measured, stated, candidates)


def aligned_rotations() -> tuple[Quaternion, ...]:
    """Return the 24 rotations of a cube onto itself."""
    found = []
    for first, second in itertools.permutations(range(3), 2):
        for a, b in itertools.product((1.0, -1.0), repeat=2):
            x, y = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
            x[first], y[second] = a, b
            z = (x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0])
            found.append(so3.from_rows(((x[0], x[1], x[2]), (y[0], y[1], y[2]), z)))
    return tuple(found)


def name_axis(direction: Vector3) -> str:
    index = max(range(3), key=lambda each: abs(direction[each]))
    return f"{'+' if direction[index] >= 0 else '-'}{'xyz'[index]}"


def _find_candidates(measured: Vector3, q_stated: Quaternion) -> tuple[MountCandidate, ...]:
    rotations = aligned_rotations()
    nearest = min(rotations, key=lambda each: _rotation_angle(each, q_stated))
    # the tilt of the bracket stays when the unit is rotated in it
    tilt = so3.multiply(q_stated, so3.conjugate(nearest))
    found = []
    for each in rotations:
        q = so3.normalize(so3.multiply(tilt, each))
        if _angle(so3.rotate(q, measured), _UP) <= MAX_TILT:
            rpy_deg = so3.to_vector3(round(math.degrees(angle), 2) + 0.0 for angle in so3.to_rpy(q))
            found.append(MountCandidate(rpy_deg, _rotation_angle(q, q_stated)))
    # rounded, for a fixed order of mounts equally near
    return tuple(
        sorted(found, key=lambda each: (round(each.rotation_angle, 9), [abs(angle) for angle in each.rpy_deg]))
    )


def _rotation_angle(a: Quaternion, b: Quaternion) -> float:
    return math.hypot(*so3.logarithm(so3.normalize(so3.multiply(so3.conjugate(a), b))))


def _angle(a: Vector3, b: Vector3) -> float:
    return math.atan2(math.hypot(*so3.cross(a, b)), sum(x * y for x, y in zip(a, b, strict=True)))

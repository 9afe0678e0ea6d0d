"""Whether an inertial unit is mounted as the geometry says: gravity tells, as far as it can.

At rest an accelerometer feels the force that holds it up (imu_t), so it tells which way is up: two of the three angles
of a mount. The one about the vertical is left to choose among the rotations of a cube onto itself, of which 4 of the
24 share an up.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

from modelserver.localization.calibration.errors import CalibrationError
from modelserver.spatial import so3
from modelserver.spatial.so3 import Quaternion, Vector3

LIMIT = 0.6
"""Largest angle between the felt up and the geometry's, rad. No vehicle starts on a slope of 35 degrees; the wrong one
of two axis-aligned mounts is off by 90, so the limit also stays below half of that."""

STANDARD_GRAVITY = 9.80665
GRAVITY_STEP = 1.0
"""How far the felt strength may be off standard gravity, m/s2: the earth's own is within 0.03 of 9.81; ten times a
3DM-GX1's bias of 10 mg. Beyond, the unit is moved, or its scale is wrong."""

_UP: Vector3 = (0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class FittingMount:
    """A mount that agrees with gravity: `rpy_deg` as a geometry file takes it; `turn`: radians from the stated one."""

    rpy_deg: Vector3
    turn: float


@dataclass(frozen=True, slots=True)
class MountAdvice:
    """Whether gravity agrees with the stated mount, and what would.

    angle: between the felt and the stated up, radians. felt_up, stated_up: unit vectors along the sensor's axes.
    strength: of the felt force, m/s2. fitting: mounts that agree, nearest to the stated one first; empty where the
    stated one does. corrected_rpy_deg: the stated mount, turned the short way so that the felt up is up: what stays of
    it is tilt, of the mount or of the ground. text: all of it in words.
    """

    agrees: bool
    angle: float
    felt_up: Vector3
    stated_up: Vector3
    strength: float
    fitting: tuple[FittingMount, ...]
    corrected_rpy_deg: Vector3
    text: str


def advise(mean_force: Vector3, q_base_sensor: Quaternion, limit: float = LIMIT) -> MountAdvice:
    """Compare the force felt at rest with the stated mount.

    `mean_force`: mean specific force along the sensor's axes, m/s2, on ground near level: it points up.
    `q_base_sensor`: the stated rotation R_base_sensor; base: x forward, y left, z up. `limit`: radians.
    Offered are the 24 rotations onto the vehicle's axes, each followed by the tilt that the stated one has over the
    nearest of them, where they agree with gravity. Raises CalibrationError for a force that is no gravity.
    """
    strength = math.hypot(*mean_force)
    if not abs(strength - STANDARD_GRAVITY) <= GRAVITY_STEP:
        raise CalibrationError(
            f"the mean specific force is {strength:.3g} m/s2, and gravity is 9.81: the vehicle must stand, "
            "and the unit give all three axes of specific force in m/s2"
        )
    felt = _scaled(mean_force, 1.0 / strength)
    q_stated = so3.normalized(q_base_sensor)
    stated = so3.rotate(so3.conjugate(q_stated), _UP)
    angle = _angle(felt, stated)
    corrected = so3.normalized(so3.multiply(_short_way(so3.rotate(q_stated, felt), _UP), q_stated))
    agrees = angle <= limit
    fitting = () if agrees else _fitting(felt, q_stated, limit)
    advice = MountAdvice(agrees, angle, felt, stated, strength, fitting, _rpy_deg(corrected), "")
    return MountAdvice(agrees, angle, felt, stated, strength, fitting, advice.corrected_rpy_deg, _words(advice))


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


def axis_name(direction: Vector3) -> str:
    """Return the axis nearest to a direction, e.g. `+y`."""
    index = max(range(3), key=lambda each: abs(direction[each]))
    return f"{'+' if direction[index] >= 0 else '-'}{'xyz'[index]}"


def _fitting(felt: Vector3, q_stated: Quaternion, limit: float) -> tuple[FittingMount, ...]:
    rotations = aligned_rotations()
    nearest = min(rotations, key=lambda each: _turn(each, q_stated))
    # the bracket's tilt belongs to the vehicle: it stays where the unit is turned in it
    tilt = so3.multiply(q_stated, so3.conjugate(nearest))
    found = []
    for each in rotations:
        q = so3.normalized(so3.multiply(tilt, each))
        if _angle(so3.rotate(q, felt), _UP) <= limit:
            found.append(FittingMount(_rpy_deg(q), _turn(q, q_stated)))
    # rounded: of mounts equally near, always the same comes first
    return tuple(sorted(found, key=lambda each: (round(each.turn, 9), [abs(angle) for angle in each.rpy_deg])))


def _words(advice: MountAdvice) -> str:
    felt, stated = axis_name(advice.felt_up), axis_name(advice.stated_up)
    degrees = math.degrees(advice.angle)
    if advice.agrees:
        return (
            f"gravity is felt along the sensor's {felt} axis, {degrees:.1f} deg from where the geometry says up is: "
            "the mount agrees as far as gravity can tell; it says nothing of the turn about the vertical"
        )
    head = (
        f"gravity is felt along the sensor's {felt} axis, but the geometry says {stated} points up ({degrees:.0f} deg "
        "apart)"
    )
    if not advice.fitting:
        return (
            f"{head}; no mount along the vehicle's axes fits: the unit stands askew or the vehicle on a steep slope. "
            f"On level ground rpy_deg {_list(advice.corrected_rpy_deg)} would fit"
        )
    mounts = ", ".join(_list(each.rpy_deg) for each in advice.fitting)
    tail = "; which of them, a drive straight ahead or a look at the unit tells"
    if degrees > 180.0 - math.degrees(LIMIT):
        tail += "; or the driver gives gravity where specific force, its opposite, is asked for: compare imu_t"
    return f"{head}; mounts that fit: rpy_deg {mounts}{tail}"


def _list(rpy_deg: Vector3) -> str:
    return f"[{', '.join(f'{each:g}' for each in rpy_deg)}]"


def _rpy_deg(q: Quaternion) -> Vector3:
    roll, pitch, yaw = so3.to_rpy(q)
    return (_tidy(roll), _tidy(pitch), _tidy(yaw))


def _tidy(angle: float) -> float:
    """Return degrees to a hundredth, -180 as 180, without a negative zero."""
    degrees = round(math.degrees(angle), 2) + 0.0
    return 180.0 if degrees == -180.0 else degrees


def _turn(a: Quaternion, b: Quaternion) -> float:
    return math.hypot(*so3.logarithm(so3.normalized(so3.multiply(so3.conjugate(a), b))))


def _angle(a: Vector3, b: Vector3) -> float:
    return math.atan2(math.hypot(*_cross(a, b)), _dot(a, b))


def _short_way(a: Vector3, b: Vector3) -> Quaternion:
    """Return the smallest rotation that takes unit vector `a` to `b`; about x where they are opposite."""
    cross = _cross(a, b)
    angle, sine = _angle(a, b), math.hypot(*cross)
    axis = (1.0, 0.0, 0.0) if sine < 1e-12 else _scaled(cross, 1.0 / sine)
    return so3.exponential(_scaled(axis, angle))


def _cross(a: Vector3, b: Vector3) -> Vector3:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _dot(a: Vector3, b: Vector3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _scaled(v: Vector3, factor: float) -> Vector3:
    return (v[0] * factor, v[1] * factor, v[2] * factor)

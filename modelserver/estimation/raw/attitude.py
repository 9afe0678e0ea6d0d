"""What one inertial sample says, along the base frame's axes: angular velocity, and where up is."""

from __future__ import annotations

import math
from dataclasses import dataclass

from modelserver.estimation.raw.motion import unit
from modelserver.estimation.raw.settings import RawSettings
from modelserver.messages import ImuSample, OrientationReference
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3

STANDARD_GRAVITY = 9.80665
"""m/s2. The field differs from it by at most 0.05 over the Earth: far inside the gate."""

_FASTEST = 50.0
"""rad/s: above the range of any rate gyro fit for a vehicle."""
_HARDEST = 500.0
"""m/s2: above the range of any accelerometer fit for a vehicle."""

_NEAR_GRAVITY = 1.0
"""m/s2: a tenth of g."""


@dataclass(frozen=True, slots=True)
class Inertial:
    """An inertial sample along base axes. `up` is the device's own vertical, None where it gave none."""

    rate: Vector3
    force: Vector3 | None
    up: Vector3 | None


def read(sample: ImuSample, X_base_imu: Pose) -> Inertial | str:
    """Return the sample along base axes, or in one word why it cannot be used.

    Angular velocity is the same for every point of a rigid body, so only the mount's rotation counts. Of the
    device's orientation only the direction of gravity is used: its yaw is magnetic or drifts (report 7.2).
    """
    rate = sample.angular_velocity
    if rate is None or not math.isfinite(rate[0] + rate[1] + rate[2]):
        return "nan"
    if max(map(abs, rate)) > _FASTEST:
        return "range"
    mount = X_base_imu.wxyz
    force = sample.specific_force
    if force is not None:
        if not math.isfinite(force[0] + force[1] + force[2]):
            return "nan"
        if max(map(abs, force)) > _HARDEST:
            return "range"
        force = so3.rotate(mount, force)
    up = _device_up(sample, mount)
    if up is not None and force is not None and _contradicted(up, force):
        return "orientation"
    return Inertial(so3.rotate(mount, rate), force, up)


def _contradicted(up: Vector3, force: Vector3) -> bool:
    """Return whether a device's own vertical and its specific force cannot both be right.

    Where |f| is near g, the two can be 60 degrees apart only under an acceleration of about g that happens to keep
    |f|: no ground vehicle does that, but a wrong orientation reference or a stuck accelerometer does.
    """
    norm = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    if abs(norm - STANDARD_GRAVITY) > _NEAR_GRAVITY:
        return False
    return up[0] * force[0] + up[1] * force[1] + up[2] * force[2] < 0.5 * norm


def _device_up(sample: ImuSample, mount: so3.Quaternion) -> Vector3 | None:
    q = sample.orientation
    reference = sample.orientation_reference
    if q is None or reference == OrientationReference.NONE:
        return None
    w, x, y, z = q
    n = w * w + x * x + y * y + z * z
    if not 0.81 < n < 1.21:
        return None
    # third row of R(q): the reference's z axis along the sensor's axes; in NED that points down
    s = (-1.0 if reference == OrientationReference.NED else 1.0) / n
    return so3.rotate(
        mount, (2.0 * s * (x * z - w * y), 2.0 * s * (y * z + w * x), s * (w * w - x * x - y * y + z * z))
    )


def corrected(
    up: Vector3, force: Vector3, rate: Vector3, speed: float, lever: Vector3, dt: float, settings: RawSettings
) -> Vector3:
    """Return the vertical carried by the gyro, drawn towards what specific force says; all along base axes.

    f = a - gravity, so up ~ f - a; of the acceleration a of the unit the centripetal part w x (v + w x r) is
    known, v along the base frame's x and r the unit's `lever` arm. Taken only while |f - a| is near g.
    (R. Mahony et al., "Nonlinear complementary filters on the special orthogonal group", 2008.)
    """
    a, b, c = rate
    x, y, z = lever
    u, v, w = speed + b * z - c * y, c * x - a * z, a * y - b * x
    fx, fy, fz = force[0] - (b * w - c * v), force[1] - (c * u - a * w), force[2] - (a * v - b * u)
    norm = math.sqrt(fx * fx + fy * fy + fz * fz)
    if abs(norm - STANDARD_GRAVITY) > settings.tilt_gate:
        return up
    gain = min(dt, settings.rate_hold) / (settings.tilt_time + dt) / norm
    keep = 1.0 - gain * norm
    return unit((keep * up[0] + gain * fx, keep * up[1] + gain * fy, keep * up[2] + gain * fz))


def first_up(inertial: Inertial) -> Vector3 | None:
    """Return the vertical of a first sample, or None where it says nothing of it."""
    if inertial.up is not None:
        return inertial.up
    force = inertial.force
    if force is None:
        return None
    norm = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    return unit(force) if 0.5 < norm / STANDARD_GRAVITY < 1.5 else None

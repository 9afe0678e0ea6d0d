"""From a reply of the 3DM-GX1 to a sample in SI units."""

from __future__ import annotations

import math

from modelserver.messages import NAN, ImuSample, OrientationReference, SensorHeader, YawSource
from modelserver.spatial import so3
from modelserver.spatial.so3 import Quaternion, Vector3
from msdrivers.devices.gx1.settings import HeadingSource
from msdrivers.protocol.gx1 import Gains, Packet
from msdrivers.protocol.gx1.scaling import (
    G0,
    TESLA,
    is_saturated,
    orientation_from_euler,
    orientation_from_quaternion,
    vector,
)

_UP: Vector3 = (0.0, 0.0, -1.0)
"""In north, east, down."""


def saturated_fields(packet: Packet) -> tuple[str, ...]:
    """Return the names of the vectors that exceed what the device can say."""
    return tuple(
        name for name in ("field", "acceleration", "rate") if packet.has(name) and is_saturated(packet.field(name))
    )


def imu_sample(
    packet: Packet, gains: Gains, force_sign: int, heading: HeadingSource, header: SensorHeader, celsius: float = NAN
) -> ImuSample:
    """Return what a measurement says; what it does not say, or says saturated, is None.

    `force_sign`: of the device's acceleration as specific force. The orientation is that of the sensor's axes in
    north, east, down.
    """
    missing = saturated_fields(packet)

    def told(name: str, gain: int, unit: float = 1.0) -> Vector3 | None:
        return vector(packet.field(name), gain, unit) if packet.has(name) and name not in missing else None

    orientation = _orientation(packet)
    return ImuSample(
        header,
        angular_velocity=told("rate", gains.gyro),
        specific_force=told("acceleration", gains.accelerometer, force_sign * G0),
        magnetic_field=told("field", gains.magnetometer, TESLA),
        orientation=orientation,
        orientation_reference=OrientationReference.NED if orientation else OrientationReference.NONE,
        yaw_source=YawSource.MAGNETIC if orientation and heading is HeadingSource.MAGNETIC else YawSource.NONE,
        temperature_celsius=celsius,
    )


def _orientation(packet: Packet) -> Quaternion | None:
    if packet.has("euler"):
        return orientation_from_euler(packet.field("euler"))
    if packet.has("quaternion"):
        return orientation_from_quaternion(packet.field("quaternion"))
    return None


class GravityCheck:
    """Finds at rest whether specific force points up, by the device's own orientation."""

    NEEDED = 5
    """Samples at rest in a row."""

    STILL = 0.1
    """Rates of rest, rad/s, at most."""

    AROUND_G = 1.0
    """How far the force may be from gravity's at rest, m/s2."""

    __slots__ = ("_count", "upwards")

    def __init__(self) -> None:
        self._count = 0
        self.upwards = True
        """The specific force points up, as it must; certain once `take` has returned True."""

    def take(self, sample: ImuSample) -> bool:
        """Look at a sample; return True once: when the samples so far have decided it."""
        force, rate, orientation = sample.specific_force, sample.angular_velocity, sample.orientation
        if self._count >= self.NEEDED or force is None or rate is None or orientation is None:
            return False
        if math.hypot(*rate) > self.STILL or abs(math.hypot(*force) - G0) > self.AROUND_G:
            self._count = 0
            return False
        up = so3.rotate(so3.conjugate(orientation), _UP)
        along = sum(a * b for a, b in zip(force, up, strict=True))
        if abs(along) < 0.7 * G0:
            # neither up nor down: not at rest after all
            self._count = 0
            return False
        upwards = along > 0.0
        self._count = self._count + 1 if upwards == self.upwards else 1
        self.upwards = upwards
        return self._count >= self.NEEDED

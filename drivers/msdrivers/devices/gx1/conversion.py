"""Convert replies of the 3DM-GX1 to samples in SI units."""

from __future__ import annotations

import math

from modelserver.messages import NAN, ImuSample, OrientationReference, SensorHeader, YawSource
from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3
from msdrivers.devices.gx1.settings import HeadingSource
from msdrivers.protocol.gx1 import Gains, Gx1Packet
from msdrivers.protocol.gx1.scaling import (
    G0,
    TESLA,
    is_saturated,
    orientation_from_euler,
    orientation_from_quaternion,
    vector_from_words,
)

_UP_NED: Vector3 = (0.0, 0.0, -1.0)
"""In north, east, down."""


def find_saturated_fields(packet: Gx1Packet) -> tuple[str, ...]:
    """Return the names of the saturated vectors."""
    return tuple(
        name for name in ("field", "acceleration", "rate") if packet.has(name) and is_saturated(packet.field(name))
    )


def sample_from_packet(
    packet: Gx1Packet, gains: Gains, force_sign: int, heading: HeadingSource, header: SensorHeader, celsius: float = NAN
) -> ImuSample:
    """Convert a measurement; missing and saturated vectors are None.

    `force_sign`: of the device's acceleration as specific force. The orientation is that of the sensor's axes in
    north, east, down.
    """
    missing = find_saturated_fields(packet)

    def convert(name: str, gain: int, unit: float = 1.0) -> Vector3 | None:
        return vector_from_words(packet.field(name), gain, unit) if packet.has(name) and name not in missing else None

    orientation = _get_orientation(packet)
    return ImuSample(
        header,
        angular_velocity=convert("rate", gains.gyro),
        specific_force=convert("acceleration", gains.accelerometer, force_sign * G0),
        magnetic_field=convert("field", gains.magnetometer, TESLA),
        orientation=orientation,
        orientation_reference=OrientationReference.NED if orientation else OrientationReference.NONE,
        yaw_source=YawSource.MAGNETIC if orientation and heading is HeadingSource.MAGNETIC else YawSource.NONE,
        temperature_celsius=celsius,
    )


def _get_orientation(packet: Gx1Packet) -> Quaternion | None:
    if packet.has("euler"):
        return orientation_from_euler(packet.field("euler"))
    if packet.has("quaternion"):
        return orientation_from_quaternion(packet.field("quaternion"))
    return None


class GravityCheck:
    """Checks the sign of the specific force while stationary, by the device's own orientation."""

    MIN_SAMPLES = 5
    """Consecutive stationary samples."""

    MAX_RATE = 0.1
    """Largest angular rate of a stationary device, rad/s."""

    MAX_FORCE_ERROR = 1.0
    """Largest deviation of a stationary device's force from gravity, m/s2."""

    __slots__ = ("_count", "is_upward")

    def __init__(self) -> None:
        self._count = 0
        self.is_upward = True
        """The specific force points up, as it must; decided once `update` has returned True."""

    def update(self, sample: ImuSample) -> bool:
        """Process a sample; return True once, when the sign is decided."""
        force, rate, orientation = sample.specific_force, sample.angular_velocity, sample.orientation
        if self._count >= self.MIN_SAMPLES or force is None or rate is None or orientation is None:
            return False
        if math.hypot(*rate) > self.MAX_RATE or abs(math.hypot(*force) - G0) > self.MAX_FORCE_ERROR:
            self._count = 0
            return False
        up = so3.rotate(so3.conjugate(orientation), _UP_NED)
        along = sum(a * b for a, b in zip(force, up, strict=True))
        if abs(along) < 0.7 * G0:
            # neither up nor down: not stationary
            self._count = 0
            return False
        upwards = along > 0.0
        self._count = self._count + 1 if upwards == self.is_upward else 1
        self.is_upward = upwards
        return self._count >= self.MIN_SAMPLES
